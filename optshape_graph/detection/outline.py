"""A target's outline laid over ring ends in their plane: a quick fit before the pose is estimated, and after.

The first look tries every turn of the outline, with the centre of its area at that of the rings' area. The best turns
are refined by Gauss-Newton steps with weights that ignore stray ends (Cauchy's, narrowing). Beside turn and place, a
common shift across the edges is fitted, since the beam's width and blooming move all ring ends alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.detection.segments import OrderedScan, ring_ends
from optshape_graph.plane import ReturnsPlane
from optshape_graph.target import Target

_ANGLES = np.linspace(0.0, 2 * np.pi, 36, endpoint=False)
_STARTS = 4  # turns that are refined
_STEPS = 6  # Gauss-Newton steps from each
_MOST_RINGS = 32  # rings that a first look uses at most, evenly over all
_STRAYS = 0.1  # share of ends that lie anywhere: mixed, lost, or on something that touches the target
_PLACE, _SHIFT = 0.2, 0.03  # prior standard deviations of the place and of the common shift, in circumradii
_FITTED = 4  # numbers that are fitted: turn, place, shift


@dataclass(frozen=True, eq=False, repr=False)
class Boundary(Value):
    """The boundary of a surface, from the ends of its rings.

    Attributes:
        plane: of the surface.
        at: (M, 2) expected end of the surface beyond each ring end, metres, along the plane's axes.
        sd: (M,) its standard deviation, metres.
    """

    plane: ReturnsPlane
    at: Floats
    sd: Floats

    @classmethod
    def of(cls, scan: OrderedScan, rows: Ints, plane: ReturnsPlane, hidden: Bools | None = None) -> Boundary:
        """Return the boundary of a surface.

        It ends half a step beyond a ring's last return, with an uncertainty of half a step and of the beam.

        Args:
            scan: the ordered scan.
            rows: (N,) of it, the surface's returns.
            plane: through them.
            hidden: (2 R,) ends that do not count, in the order of `ring_ends`; None: all count.
        """
        ends = ring_ends(scan, rows)
        if hidden is not None:
            side, ends = np.repeat([-0.5, 0.5], len(ends) // 2)[~hidden], ends[~hidden]
        else:
            n_rings = len(ends) // 2
            picked = np.unique(np.linspace(0, n_rings - 1, min(n_rings, _MOST_RINGS)).round().astype(int))
            side, ends = np.repeat([-0.5, 0.5], len(picked)), np.concatenate([ends[picked], ends[n_rings + picked]])
        points, normal = scan.points[ends], plane.axes[0]
        outward = np.column_stack([-points[:, 1], points[:, 0], np.zeros(len(points))])
        outward *= (side * scan.resolution.step)[:, None]
        outward -= points * ((outward @ normal) / (points @ normal))[:, None]
        beam = scan.resolution.beam * np.linalg.norm(points, axis=1)
        variance = (outward**2).sum(axis=1) / 3.0 + beam**2 / 3.0 + scan.resolution.range_noise**2
        return cls(plane, (points + outward - plane.centre) @ plane.axes[1:].T, np.sqrt(variance))


@dataclass(frozen=True, eq=False, repr=False)
class OutlineFit(Value):
    """A target's outline laid over a boundary.

    Attributes:
        T_lidar_target: (4, 4).
        shift: of all ends across the edges, metres; outwards if the target blooms.
        edged: share of the ends within two standard deviations of the outline.
        log_odds: of this shape against any other of its size, whose ends lie anywhere within a fifth of its size.
    """

    T_lidar_target: Floats
    shift: float
    edged: float
    log_odds: float


def first_look(boundary: Boundary, centroid: Floats, target: Target) -> OutlineFit:
    """Return the outline that fits a boundary best, at any turn.

    Args:
        boundary: of a surface.
        centroid: (2,) of the surface's area, along the plane's axes, metres.
        target: the template.
    """
    start = np.tile(_centroid(target), (len(_ANGLES), 1))
    off = _beyond(_turned(_ANGLES, boundary.at - centroid), start, target).max(axis=1)
    rough = np.log1p((off / (0.1 * target.circumradius)) ** 2).sum(axis=1)
    lowest = np.flatnonzero((rough <= np.roll(rough, 1)) & (rough <= np.roll(rough, -1)))
    angle = _ANGLES[lowest[np.argsort(rough[lowest])[:_STARTS]]]
    return _refined(boundary, centroid, target, angle, start[: len(angle)], 0.1)


def look_again(boundary: Boundary, target: Target, T_lidar_target: Floats) -> OutlineFit:
    """Return the outline that fits a boundary best near a pose (4, 4)."""
    left, up = boundary.plane.axes[1:]
    y, z = T_lidar_target[:3, 1], T_lidar_target[:3, 2]
    middle = boundary.at.mean(axis=0)
    place = boundary.plane.centre + middle @ boundary.plane.axes[1:] - T_lidar_target[:3, 3]
    angle = np.arctan2(z @ left - y @ up, y @ left + z @ up)
    return _refined(boundary, middle, target, np.array([angle]), np.array([[place @ y, place @ z]]), 0.02)


def _beyond(turned: Floats, t: Floats, target: Target) -> Floats:
    """Return how far turned points (K, 2, M), moved by t (K, 2), are beyond each side (K, n, M)."""
    return np.asarray(target.normals @ (turned + t[..., None]) - target.offsets[:, None])


def _refined(
    boundary: Boundary, middle: Floats, target: Target, angle: Floats, start: Floats, width: float
) -> OutlineFit:
    """Refine the best of some starts.

    Args:
        boundary: of a surface.
        middle: (2,) centre of the turn, metres.
        target: the template.
        angle: (K,) turns, rad.
        start: (K, 2) the middle in the target's frame, metres.
        width: initial width of the weights, in circumradii.
    """
    size, sd, q = target.circumradius, boundary.sd, boundary.at - middle
    t, shift = start, np.zeros(len(angle))
    prior = np.diag([0.0, (_PLACE * size) ** -2, (_PLACE * size) ** -2, (_SHIFT * size) ** -2])
    for step in range(_STEPS):
        turned = _turned(angle, q)
        beyond = _beyond(turned, t, target)
        off, (ny, nz) = beyond.max(axis=1) - shift[:, None], target.normals.T[:, beyond.argmax(axis=1)]
        J = np.stack([nz * turned[:, 0] - ny * turned[:, 1], ny, nz, -np.ones_like(off)], axis=1)
        weighted = J / (np.maximum(sd, width * size * 0.4**step) ** 2 + off**2)[:, None]
        drift = np.column_stack([np.zeros(len(angle)), t - start, shift])
        gradient = (weighted @ off[..., None])[..., 0] + drift @ prior
        information = weighted @ np.swapaxes(J, 1, 2) + prior + 1e-9 * np.eye(_FITTED)
        change = np.linalg.solve(information, -gradient[..., None])[..., 0]
        angle, t, shift = angle + change[:, 0], t + change[:, 1:3], shift + change[:, 3]
    off = _beyond(_turned(angle, q), t, target).max(axis=1) - shift[:, None]
    log_odds = _log_odds(off, sd, size, _FITTED) - 0.5 * (shift / (_SHIFT * size)) ** 2
    best = int(log_odds.argmax())
    axes = np.eye(3)
    axes[1:, 1:] = [[np.cos(angle[best]), -np.sin(angle[best])], [np.sin(angle[best]), np.cos(angle[best])]]
    plane, T = boundary.plane, np.eye(4)
    T[:3, :3] = (axes @ plane.axes).T
    T[:3, 3] = plane.centre + middle @ plane.axes[1:] - T[:3, 1:3] @ t[best]
    return OutlineFit(T, float(shift[best]), float((np.abs(off[best]) < 2.0 * sd).mean()), float(log_odds[best]))


def rectangle_log_odds(boundary: Boundary, size: float) -> float:
    """Return the log odds of a rectangle of any size, as `OutlineFit.log_odds` of a target.

    Most flat surfaces are rectangles: faces of boxes, doors, signs, screens.

    Args:
        boundary: of a surface.
        size: of the target that it is compared with: its circumradius, metres.
    """
    q, sd = boundary.at - np.median(boundary.at, axis=0), boundary.sd
    extent = float(np.linalg.norm(q, axis=1).max())
    # At any turn the sides are where most ends lie; the best turns are refined, with turn and sides free.
    angle = np.linspace(0.0, np.pi / 2, 18, endpoint=False)
    turned = _turned(angle, q)
    inner, outer = np.percentile(turned, [6.0, 94.0], axis=2)
    off = np.minimum(np.abs(turned - inner[..., None]), np.abs(outer[..., None] - turned)).min(axis=1)
    start = np.argsort(np.log1p((off / (0.1 * extent)) ** 2).sum(axis=1))[:_STARTS]
    fitted = np.column_stack([angle, outer, -inner])[start]
    for step in range(_STEPS):
        off, side, turned = _outside_rectangle(fitted, q)
        ny, nz = _RIGHT_ANGLES.T[:, side]
        about = nz * turned[:, 0] - ny * turned[:, 1]
        J = np.concatenate([about[:, None], -1.0 * (side[:, None] == np.arange(4)[:, None])], axis=1)
        weighted = J / (np.maximum(sd, 0.1 * size * 0.4**step) ** 2 + off**2)[:, None]
        information = weighted @ np.swapaxes(J, 1, 2) + np.eye(5) * (0.5 * size) ** -2
        fitted = fitted - np.linalg.solve(information, weighted @ off[..., None])[..., 0]
    return float(_log_odds(_outside_rectangle(fitted, q)[0], sd, size, 5).max())


_RIGHT_ANGLES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def _outside_rectangle(fitted: Floats, q: Floats) -> tuple[Floats, Ints, Floats]:
    """Return how far points are outside rectangles (K, 5) of a turn and four sides (K, M), the side, and the points."""
    turned = _turned(fitted[:, 0], q)
    beyond = np.concatenate([turned, -turned], axis=1) - fitted[:, 1:, None]
    return beyond.max(axis=1), beyond.argmax(axis=1), turned


def _turned(angle: Floats, q: Floats) -> Floats:
    """Return points (M, 2) turned by angles (K,), as (K, 2, M)."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([c * q[:, 0] - s * q[:, 1], s * q[:, 0] + c * q[:, 1]], axis=1)


def _log_odds(off: Floats, sd: Floats, size: float, n_fitted: int) -> Floats:
    """Return log odds (K,) of shapes with ends off by (K, M) metres, against one whose ends lie anywhere in reach.

    Each fitted number lowers the odds.
    """
    reach = 0.4 * size
    fits = np.exp(-0.5 * (off / sd) ** 2) * reach / (np.sqrt(2 * np.pi) * sd)
    cost = 0.5 * n_fitted * np.log(max(len(sd) / n_fitted, 1.0) * reach**2 / (12.0 * np.mean(sd**2)))
    return np.asarray(np.log((1.0 - _STRAYS) * fits + _STRAYS).sum(axis=1) - cost)


def _centroid(target: Target) -> Floats:
    """Return the centroid (2,) of a target's area, metres."""
    polygon = target.polygon
    following = np.roll(polygon, -1, axis=0)
    cross = polygon[:, 0] * following[:, 1] - following[:, 0] * polygon[:, 1]
    return np.asarray(cross @ (polygon + following) / (6.0 * target.area))
