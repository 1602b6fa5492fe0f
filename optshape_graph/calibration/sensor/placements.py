"""Boards in scans, and the placements that they make up: runs in which a board is in one place."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.pose import PoseEstimate
from optshape_graph.scan import Scan
from optshape_graph.se3 import angle
from optshape_graph.target import Target

STILL = (0.02, np.radians(2.0))
"""Distance, metres, and angle, rad, from the run's first pose within which a board stands still: a step's noise. Who
carries one moves it by more from a revolution to the next."""

MARKERS_STILL = 0.005
"""Distance, metres, within which markers stay that do not move: their noise."""

MOST_REVOLUTIONS = 8
"""Revolutions of a placement that take part, evenly spread: by then ring ends and ring errors limit it."""


@dataclass(frozen=True, eq=False, repr=False)
class Sighting(Value):
    """A board in one scan.

    Attributes:
        moment: number of the scan.
        name: of the scan.
        estimate: its pose.
        returns: its returns.
        markers: (n, 3) motion-capture markers near its vertices, metres, NaN where not seen; None: none.
        time: of the scan, seconds on one clock; None: not known.
        place: that the board is said to stay in, a number; None: nothing is said.
    """

    moment: int
    name: str
    estimate: PoseEstimate
    returns: Scan
    markers: Floats | None = None
    time: float | None = None
    place: int | None = None

    def near(self, T_lidar_target: Floats) -> Floats:
        """Return its pose (4, 4), of all in which the board looks the same the one that is turned least from another.

        Args:
            T_lidar_target: (4, 4) the other.
        """
        return self.estimate.target.nearest_equivalent(self.estimate.T_lidar_target, T_lidar_target)

    def apart(self, other: Sighting) -> tuple[float, float]:
        """Return the distance, metres, and the angle, rad, to another pose of the board.

        Args:
            other: sighting of it.
        """
        T = self.estimate.T_lidar_target
        its = other.near(T)
        return float(np.linalg.norm(T[:3, 3] - its[:3, 3])), float(angle(T[:3, :3].T @ its[:3, :3]))


@dataclass(frozen=True, eq=False, repr=False)
class Placement(Value):
    """A board that stood still for some revolutions.

    Attributes:
        sightings: of it, one for each revolution.
    """

    sightings: tuple[Sighting, ...]

    @property
    def target(self) -> Target:
        """The board."""
        return self.sightings[0].estimate.target

    @property
    def moment(self) -> int:
        """Number of its first scan."""
        return self.sightings[0].moment

    @property
    def distance(self) -> float:
        """From the sensor, metres."""
        return float(np.linalg.norm(self.sightings[0].estimate.T_lidar_target[:3, 3]))

    @property
    def markers(self) -> Floats | None:
        """(n, 3) motion-capture markers, on average, metres, NaN where not seen; None: none."""
        if self.sightings[0].markers is None:
            return None
        markers = np.array([one.markers for one in self.sightings])
        seen = np.isfinite(markers)
        return np.asarray(
            np.where(seen, markers, 0.0).sum(axis=0) / np.where(seen.any(axis=0), seen.sum(axis=0), np.nan)
        )

    def __repr__(self) -> str:
        return f"Placement({self.target.name!r} at {self.distance:.1f} m, {len(self.sightings)} revolutions)"


def gather(sightings: Iterable[Sighting]) -> tuple[Placement, ...]:
    """Return the placements of sightings in the order of time: runs in which a board is in one place.

    Args:
        sightings: of all boards.
    """
    return placed(runs_of(sightings))


def runs_of(sightings: Iterable[Sighting]) -> dict[str, list[list[Sighting]]]:
    """Return runs in which each board is in one place, by its name: that it is said to stay in, or as its poses say.

    One sighting elsewhere, between others, does not end a run.

    Args:
        sightings: of all boards, in the order of time.
    """
    runs: dict[str, list[list[Sighting]]] = {}
    said: dict[tuple[str, int], list[Sighting]] = {}
    for one in sightings:
        name = one.estimate.target.name
        of_board = runs.setdefault(name, [])
        last = of_board[-2:] if len(of_board) > 1 and len(of_board[-1]) == 1 else of_board[-1:]
        run = None if one.place is None else said.get((name, one.place))
        if run is None:
            run = next((run for run in reversed(last) if _still(run[0], one)), None)
        if run is None:
            run = []
            of_board.append(run)
        run.append(one)
        if one.place is not None:
            said[name, one.place] = run
    return runs


def placed(runs: Mapping[str, Sequence[Sequence[Sighting]]], fewest: int = 1) -> tuple[Placement, ...]:
    """Return the placements of runs, in the order of time.

    Args:
        runs: of each board, by its name.
        fewest: revolutions of a placement at least.
    """
    placements = [
        Placement(tuple(run[k] for k in _spread(len(run))))
        for of_board in runs.values()
        for run in of_board
        if len(run) >= fewest
    ]
    return tuple(sorted(placements, key=lambda placement: placement.moment))


def _still(first: Sighting, one: Sighting) -> bool:
    if first.markers is not None and one.markers is not None:
        off = np.linalg.norm(first.markers - one.markers, axis=1)
        return bool(np.nanmax(off, initial=0.0) < MARKERS_STILL)
    sd = first.estimate.sigma_m + one.estimate.sigma_m, first.estimate.sigma_rad + one.estimate.sigma_rad
    moved, turned = first.apart(one)
    return moved < STILL[0] + 2 * sd[0] and turned < STILL[1] + 2 * sd[1]


def _spread(n: int) -> list[int]:
    return [int(k) for k in np.linspace(0, n - 1, min(n, MOST_REVOLUTIONS)).round()]
