"""Where sensors are to one another, by the placements of targets that they share, when poses are wrong or ambiguous."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, TypeVar

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.consensus import CUT, TIE, Consensus, distances, relative_pose
from optshape_graph.errors import EstimationError, UnobservableError

AMBIGUOUS = 4.0
"""Truncated cost by which the best relative pose has to beat every different one; a view adds at most 9."""


class Reading(Protocol):
    """One sensor's sighting of a target in one placement."""

    @property
    def sensor(self) -> str:
        """Name of the sensor."""

    @property
    def poses(self) -> Floats:
        """(I, 4, 4) T_sensor_target of every way to read it, the plainest first."""

    @property
    def relative(self) -> bool:
        """Whether all ways to read it are the target's symmetries, so that any of them may be the reference."""


R = TypeVar("R", bound=Reading)


def connected(
    base: str, placements: Sequence[Sequence[Reading]], about: Mapping[str, Floats] | None = None
) -> dict[str, Floats]:
    """Add sensors one by one, each by the pair of sensors on which most placements agree.

    Args:
        base: whose frame is the common one.
        placements: of each, what sensors saw.
        about: T_base_sensor (4, 4) of sensors that are known beside the base.

    Returns:
        T_base_sensor (4, 4) of every sensor that can be reached.

    Raises:
        EstimationError: most placements of a pair contradict each other.
        UnobservableError: two answers fit equally well.
    """
    T_base_sensor = {base: np.eye(4), **(about or {})}
    missing = list(dict.fromkeys(r.sensor for group in placements for r in group if r.sensor not in T_base_sensor))
    pairs: dict[tuple[str, str], Consensus | None] = {}
    while missing:
        for known in T_base_sensor:
            for new in missing:
                if (known, new) not in pairs:
                    pairs[known, new] = _pair(known, new, placements)
        links = [(found, known, new) for (known, new), found in pairs.items() if found is not None and new in missing]
        if not links:
            break
        found, known, new = max(links, key=lambda link: int(link[0].inlier.sum()))
        _check(known, new, found)
        T_base_sensor[new] = T_base_sensor[known] @ found.T_a_b
        missing.remove(new)
    return T_base_sensor


def read(
    group: Sequence[R], T_base_sensor: Mapping[str, Floats], *, as_it_is: bool = False
) -> tuple[Floats, list[tuple[R, int, bool]]]:
    """Choose the target's pose in a placement, and how each sighting is read.

    Args:
        group: what sensors saw.
        T_base_sensor: (4, 4) of each.
        as_it_is: a reference that is read up to the target's symmetries is read in its first way, and the others to it:
            each of them must have all ways.

    Returns:
        T_base_target (4, 4), and for each sighting the number of the reading that agrees best, and whether it agrees.
    """
    # Where all are read up to the target's symmetries, the reference is as it is read: the others are the same place.
    reference = next((r for r in group if r.relative), group[0])
    first = reference.relative and (as_it_is or all(r.relative for r in group))
    options = reference.poses[:1] if first else reference.poses
    readings = []
    for number, pose in enumerate(options):
        T_base_target = T_base_sensor[reference.sensor] @ pose
        chosen, cost = list[tuple[R, int, bool]](), 0.0
        for reading in group:
            own = reading is reference
            moved = T_base_sensor[reading.sensor] @ (pose[None] if own else reading.poses)
            squared, _, j, _ = distances(np.eye(4), T_base_target[None, None], moved[None])
            chosen.append((reading, number if own else int(j[0]), bool(squared[0] < CUT**2)))
            cost += min(float(squared[0]), CUT**2)
        readings.append((cost, T_base_target, chosen))
    # Where several fit alike, the target as its file has it: whatever it has of its own is in one place then.
    least = min(cost for cost, _, _ in readings)
    _, T_base_target, chosen = next(reading for reading in readings if reading[0] <= least + TIE)
    return T_base_target, chosen


def _pair(a: str, b: str, placements: Sequence[Sequence[Reading]]) -> Consensus | None:
    shared = [
        (next((r for r in group if r.sensor == a), None), next((r for r in group if r.sensor == b), None))
        for group in placements
    ]
    both = [(r, s) for r, s in shared if r is not None and s is not None]
    if not both:
        return None
    # Of two sightings that are read up to the target's symmetries only how they are turned to each other tells.
    return relative_pose(
        [r.poses[:1] if r.relative and s.relative else r.poses for r, s in both], [s.poses for _, s in both]
    )


def _check(a: str, b: str, found: Consensus) -> None:
    agree, all_ = int(found.inlier.sum()), len(found.inlier)
    if 2 * agree <= all_ and all_ > 1:
        raise EstimationError(
            f"'{a}' and '{b}': only {agree} of the {_views(all_)} that both took part in agree on where the sensors are"
        )
    if found.runner_up - found.cost < AMBIGUOUS:
        raise UnobservableError(
            f"'{a}' and '{b}': a second relative pose fits the {_views(all_)} as well "
            f"(costs {found.cost:.1f} and {found.runner_up:.1f}); add views with the target at other angles",
            (f"which of the symmetric poses of the target '{b}' saw",),
        )


def _views(count: int) -> str:
    return "1 view" if count == 1 else f"{count} views"
