"""Which boards stood still: those that were on their way, or moved while they should stand, are left out and named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby, pairwise
from typing import TypeAlias

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor.placements import Placement, Sighting
from optshape_graph.gaussian import chi_square_tail
from optshape_graph.se3 import difference

FEWEST_STILL = 4
"""Revolutions for which a board that came or left at once stands still at least: fewer, and it may have been on its
way."""

AT_ONCE = 0.5
"""Time between two views, seconds, in which nobody sets a board down elsewhere: one that is elsewhere was carried."""

CARRIED = (0.15, np.radians(15.0))
"""Distance, metres, and angle, rad, below which a board that is elsewhere in each of some views without stamps, one
after the other, was carried."""

MOVED = 1e-5
"""Probability of so much motion by chance below which a board moved: of sixteen hundred sessions of sixty placements,
one loses one by chance."""

Runs: TypeAlias = Mapping[str, Sequence[Sequence[Sighting]]]
"""Sightings of each board, by its name: runs in which it is in one place."""


def standing(runs: Runs) -> tuple[dict[str, list[Sequence[Sighting]]], list[str]]:
    """Return the runs of boards that were set down, and the others in words.

    A run of fewer than `FEWEST_STILL` revolutions is of a board on its way if it was elsewhere just before or after:
    by the stamps; or, where views have none, if so many runs follow one another by small steps. So is a run in the
    middle of another: its pose is wrong.

    Args:
        runs: of every board, in the order of time.
    """
    kept: dict[str, list[Sequence[Sighting]]] = {}
    left_out = []
    for name, of_board in runs.items():
        on_its_way = _on_its_way(of_board)
        kept[name] = [run for run, way in zip(of_board, on_its_way, strict=True) if not way]
        for way, group in groupby(zip(of_board, on_its_way, strict=True), key=lambda pair: pair[1]):
            if not way:
                continue
            some = [run for run, _ in group]
            count, first, last = sum(map(len, some)), some[0][0].name, some[-1][-1].name
            where = f"in {first}" if count == 1 else f"from {first} to {last}"
            steps = [1e3 * a[-1].apart(b[0])[0] for a, b in pairwise(some)]
            by = f", {np.median(steps):.0f} mm from one to the next" if steps else ""
            left_out.append(f"{count} sighting{'s' * (count > 1)} of {name} {where}: it did not stand still{by}")
    return kept, left_out


def _on_its_way(runs: Sequence[Sequence[Sighting]]) -> list[bool]:
    """Whether a board was, in each of its runs."""
    brief = [len(run) < FEWEST_STILL for run in runs]
    quick, small = [False] * (len(runs) + 1), [False] * (len(runs) + 1)  # between a run and the one before
    for k, (a, b) in enumerate(pairwise(runs), start=1):
        before, after = a[-1], b[0]
        if before.time is not None and after.time is not None:
            quick[k] = abs(after.time - before.time) <= AT_ONCE
        elif before.markers is None:
            moved, turned = before.apart(after)
            small[k] = brief[k - 1] and brief[k] and moved < CARRIED[0] and turned < CARRIED[1]
    spans = [(run[0].moment, run[-1].moment) for run in runs]
    found = [
        brief[k] and (quick[k] or quick[k + 1] or any(a < first < b for a, b in spans))
        for k, (first, _) in enumerate(spans)
    ]
    start = 0
    for k in range(1, len(runs) + 1):
        if not small[k]:
            if k - start >= FEWEST_STILL:
                found[start:k] = [True] * (k - start)
            start = k
    return found


def at_rest(placements: Sequence[Placement]) -> tuple[tuple[Placement, ...], list[str]]:
    """Return the placements whose boards did not move, and the others in words.

    Args:
        placements: of boards that should stand still.
    """
    kept, moved = [], []
    for one in placements:
        motion, probability = _motion(one.sightings)
        if probability >= MOVED:
            kept.append(one)
            continue
        first, last = one.sightings[0].name, one.sightings[-1].name
        by = f"{1e3 * np.linalg.norm(motion[3:]):.0f} mm and {np.degrees(np.linalg.norm(motion[:3])):.1f} deg"
        moved.append(f"{one.target.name} from {first} to {last}: it moved by {by} while it should stand still")
    return tuple(kept), moved


def _motion(sightings: Sequence[Sighting]) -> tuple[Floats, float]:
    """The motion (6,) that explains most of how the poses of a board differ, rotation first, rad and metres; and the
    probability of as much by chance, or more.

    It may move evenly from the first revolution to the last, or at once after any. Of four revolutions and more, two
    are on either side: one that is off by itself is a bad estimate.
    """
    n = len(sightings)
    shares = [np.repeat([0.0, 1.0], [k, n - k]) for k in range(1 + (n >= 4), n - (n >= 4))]
    if n > 2:
        shares.append(np.linspace(0.0, 1.0, n))
    reference = sightings[0].estimate.T_lidar_target
    poses = [one.near(reference) for one in sightings]
    off = np.array([difference(reference, T) for T in poses])
    weights = np.array([np.linalg.inv(one.estimate.covariance) for one in sightings])
    best, largest = np.zeros(6), 0.0
    for share in shares:
        J = np.stack([np.hstack([np.eye(6), s * np.eye(6)]) for s in share])  # by where it is at first, and its motion
        information = (J.swapaxes(1, 2) @ weights @ J).sum(axis=0)
        estimate = np.linalg.solve(information, (J.swapaxes(1, 2) @ weights @ off[..., None]).sum(axis=0)[:, 0])
        motion, covariance = estimate[6:], np.linalg.inv(information)[6:, 6:]
        square = float(motion @ np.linalg.solve(covariance, motion))
        if square > largest:
            best, largest = motion, square
    return best, len(shares) * chi_square_tail(largest, 6) if shares else 1.0
