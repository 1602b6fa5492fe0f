"""What is known beside the returns: measured distances between boards, and motion capture.

Free boards leave the mean range open; either of the two tells it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, H, M

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.graph import MarkerModel, marker_factor
from optshape_graph.calibration.sensor.graph import Known
from optshape_graph.calibration.sensor.placements import Placement
from optshape_graph.errors import InputError
from optshape_graph.factors import CheckedFactor
from optshape_graph.se3 import apply, inverse, skew
from optshape_graph.target import Target

FITS = 3.0
"""Standard deviations within which boards are as far apart as was measured."""

OPEN = 0.01
"""Standard deviation, metres, of what ranges are off by in common, before a distance tells it."""


@dataclass(frozen=True)
class Distance:
    """A distance between points of two boards that was measured while both stood.

    Attributes:
        a: name of the one board, and the number of its vertex; None: its origin.
        b: of the other.
        metres: measured.
        sd: standard deviation, metres.
        scan: name of one in which they stood so far apart; "": of those that it fits.
    """

    a: tuple[str, int | None]
    b: tuple[str, int | None]
    metres: float
    sd: float = 2e-3
    scan: str = ""

    @classmethod
    def parsed(cls, a: str, b: str, metres: float | str, sd: float = 2e-3) -> Distance:
        """Return the distance between points given as BOARD or BOARD/VERTEX.

        Args:
            a: the one point.
            b: the other.
            metres: between them; as text also METRES@SCAN, with the name of a scan in which they stood so.
            sd: standard deviation, metres.

        Raises:
            InputError: a vertex that is no number, or a distance or standard deviation that is not positive.
        """

        def point(text: str) -> tuple[str, int | None]:
            name, slash, vertex = text.partition("/")
            if slash and not vertex.isdecimal():
                raise InputError(f"'{text}': expected BOARD or BOARD/VERTEX, the vertex as its number from 0")
            return name, int(vertex) if slash else None

        number, _, scan = str(metres).partition("@")
        try:
            length = float(number)
        except ValueError:
            length = -1.0
        if not (0 < length < np.inf and 0 < sd < np.inf):
            raise InputError(f"distance '{metres}' +- {sd} m between {a} and {b}: expected positive numbers")
        return cls(point(a), point(b), length, sd, scan)


def known_beside(
    placements: Sequence[Placement],
    distances: Sequence[Distance] = (),
    frames: Sequence[tuple[Sequence[int], Floats]] = (),
    model: MarkerModel | None = None,
) -> Known:
    """Return the factors of distances and of markers.

    Args:
        placements: all of them; their numbers are those of the poses' keys.
        distances: between boards; each holds where both stood at once, that far apart.
        frames: of each motion-capture frame, the numbers of the placements that it saw, and about T_lidar_mocap (4, 4).
        model: of the markers; None: the usual one.

    Raises:
        InputError: a distance to a board or a vertex that is not there; between boards that never stood at once, or
            never so far apart; or that fits several ways in which they stood.
    """
    factors, values, model = gtsam.NonlinearFactorGraph(), gtsam.Values(), model or MarkerModel()
    for distance in distances:
        pairs = _measured(placements, distance)
        for i, j in pairs:
            a, b = (point_of(placements[k].target, v) for k, (_, v) in ((i, distance.a), (j, distance.b)))
            # One measurement: however often it is used, it says the same once.
            factors.push_back(distance_factor(i, a, j, b, distance.metres, distance.sd * np.sqrt(len(pairs))))
    layouts: dict[str, int] = {}
    for frame, (numbers, T_lidar_mocap) in enumerate(frames):
        values.insert(E(frame), gtsam.Pose3(T_lidar_mocap))
        for p in numbers:
            target, markers = placements[p].target, placements[p].markers
            assert markers is not None
            if layouts.setdefault(target.name, len(layouts)) > 0:
                raise InputError(f"motion capture is used with one board; found {' and '.join(layouts)}")
            factors.push_back(marker_factor(markers, p, model.noise, False, frame))
    if layouts:
        target = placements[frames[0][0][0]].target
        near = gtsam.noiseModel.Isotropic.Sigma(3, model.layout_prior)
        for k, vertex in enumerate(target.vertices):
            values.insert(M(k), vertex)
            factors.push_back(gtsam.PriorFactorPoint3(M(k), vertex, near))
    return Known(factors, values)


def distance_factor(i: int, a: Floats, j: int, b: Floats, metres: float, sd: float) -> gtsam.CustomFactor:
    """Return the factor of a distance between points of two boards, in one LiDAR frame.

    Args:
        i: number of the one placement, of the key of T_target_lidar.
        a: (3,) point, target frame, metres.
        j: number of the other.
        b: (3,) point, target frame, metres.
        metres: between them.
        sd: standard deviation, metres.
    """

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        p, q = (apply(inverse(values.atPose3(H(k)).matrix()), x[None])[0] for k, x in ((i, a), (j, b)))
        length = float(np.linalg.norm(p - q))
        u = (p - q) / max(length, 1e-9)
        # (H Exp(xi))^-1 x = Exp(-xi) p
        by_p, by_q = (np.hstack([skew(x), -np.eye(3)]) for x in (p, q))
        return np.array([(length - metres) / sd]), [(u @ by_p)[None] / sd, -(u @ by_q)[None] / sd]

    return CheckedFactor(evaluate, 1, [H(i), H(j)], [6, 6])


def _measured(placements: Sequence[Placement], distance: Distance) -> list[tuple[int, int]]:
    """Numbers of the placements of both boards in which they are as far apart as was measured."""
    names = {placement.target.name for placement in placements}
    for name, _ in (distance.a, distance.b):
        if name not in names:
            raise InputError(f"distance to board '{name}', which was not seen; found {', '.join(sorted(names))}")
    spans = [(one.sightings[0].moment, one.sightings[-1].moment) for one in placements]
    between = f"boards '{distance.a[0]}' and '{distance.b[0]}'"
    found: dict[tuple[int, int], tuple[float, float]] = {}
    for i, j in product(range(len(placements)), repeat=2):
        named = (placements[i].target.name, placements[j].target.name) == (distance.a[0], distance.b[0])
        if named and i != j and spans[i][0] <= spans[j][1] and spans[j][0] <= spans[i][1]:
            found[i, j] = _length(placements[i], distance.a[1], placements[j], distance.b[1])
    if distance.scan:
        found = {
            (i, j): value for (i, j), value in found.items() if _stood_in(distance.scan, placements[i], placements[j])
        }
    if not found:
        raise InputError(f"{between} were never seen at once{f' in {distance.scan}' if distance.scan else ''}")
    near = {
        pair: (length, sd)
        for pair, (length, sd) in found.items()
        if abs(length - distance.metres) < FITS * np.hypot(np.hypot(sd, distance.sd), 2 * OPEN)
    }
    if not near:
        closest = min((length for length, _ in found.values()), key=lambda length: abs(length - distance.metres))
        raise InputError(
            f"{between} were measured {distance.metres:g} m apart; where both were seen they are {closest:.3f} m apart"
            f"{' at best' if len(found) > 1 else ''}"
        )
    first, last = (pick(near, key=lambda pair: near[pair]) for pick in (min, max))
    (shortest, sd), (longest, other) = near[first], near[last]
    if longest - shortest > FITS * np.hypot(sd, other):
        firsts = ([placements[k].sightings[0] for k in pair] for pair in (first, last))
        scans = [max(both, key=lambda one: one.moment).name for both in firsts]
        raise InputError(
            f"{between}, {distance.metres:g} m apart: more than one way in which they stood fits, {shortest:.3f} m in "
            f"{scans[0]} and {longest:.3f} m in {scans[1]}; name the scan: {distance.metres:g}@{scans[0]}"
        )
    return list(near)


def _stood_in(scan: str, one: Placement, other: Placement) -> bool:
    """Whether two boards were in a place from a scan of that name on, or until it."""
    moments = {sighting.moment for board in (one, other) for sighting in board.sightings if sighting.name == scan}
    return any(
        all(board.sightings[0].moment <= moment <= board.sightings[-1].moment for board in (one, other))
        for moment in moments
    )


def _length(one: Placement, a: int | None, other: Placement, b: int | None) -> tuple[float, float]:
    """How far two points of boards are apart by what their first scans show, and its standard deviation, metres."""
    points, spreads = [], []
    for placement, vertex in ((one, a), (other, b)):
        estimate, point = placement.sightings[0].estimate, point_of(placement.target, vertex)
        T = estimate.T_lidar_target
        J = T[:3, :3] @ np.hstack([-skew(point), np.eye(3)])
        points.append(apply(T, point[None])[0])
        spreads.append(J @ estimate.covariance @ J.T)
    apart = points[0] - points[1]
    length = float(np.linalg.norm(apart))
    u = apart / max(length, 1e-9)
    return length, float(np.sqrt(u @ (spreads[0] + spreads[1]) @ u))


def point_of(board: Target, vertex: int | None) -> Floats:
    """Return the place (3,) of a board's vertex, or of its origin, in its frame, metres.

    Args:
        board: the board.
        vertex: its number; None: the origin.

    Raises:
        InputError: the board has no such vertex.
    """
    if vertex is None:
        return np.zeros(3)
    if vertex >= len(board):
        raise InputError(f"board '{board.name}' has vertices 0 to {len(board) - 1}; found {vertex}")
    return np.asarray(board.vertices[vertex])
