"""Initial poses: from what is known, over the measurements, to everything they reach."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.graph.observation import Observation
from optshape_graph.se3 import inverse

Poses = dict[str, Floats]

MOST_CANDIDATES = 8
"""How many of a target's measurements are tried as its initial pose."""


def initialise(
    observations: Sequence[Observation], scans: Mapping[str, Floats], targets: Mapping[str, Floats]
) -> tuple[Poses, Poses]:
    """Place every scan and target, by turns: what is next to something placed, where its measurements cost least.

    Equivalent poses of symmetric targets are all tried. A part of the graph that nothing placed reaches is placed
    about its first scan, in that scan's own frame.

    Args:
        observations: all measurements.
        scans: T_world_lidar (4, 4) that are known or predicted.
        targets: T_world_target (4, 4) that are known or predicted.

    Returns:
        T_world_lidar of every scan and T_world_target of every target.
    """
    of_scan: dict[str, list[Observation]] = defaultdict(list)
    of_target: dict[str, list[Observation]] = defaultdict(list)
    for observation in observations:
        of_scan[observation.scan].append(observation)
        of_target[observation.target].append(observation)
    placed_scans, placed_targets = dict(scans), dict(targets)
    while True:
        new_targets, new_scans = {}, {}
        for name, all_seen in of_target.items():
            seen = [o for o in all_seen if o.scan in placed_scans]
            if seen and name not in placed_targets:
                poses = [placed_scans[o.scan] @ inverse(o.T_target_lidar) for o in seen[:MOST_CANDIDATES]]
                costs = [sum(_cost(o, X, placed_scans[o.scan]) for o in seen) for X in poses]
                new_targets[name] = poses[int(np.argmin(costs))]
        placed_targets |= new_targets
        for name, all_seen in of_scan.items():
            seen = [o for o in all_seen if o.target in placed_targets]
            if seen and name not in placed_scans:
                poses = [placed_targets[o.target] @ inverse(T) for o in seen for T in o.equivalent_poses()]
                costs = [sum(_cost(o, placed_targets[o.target], T) for o in seen) for T in poses]
                new_scans[name] = poses[int(np.argmin(costs))]
        placed_scans |= new_scans
        if not new_targets and not new_scans:
            unreached = next((name for name in of_scan if name not in placed_scans), None)
            if unreached is None:
                return placed_scans, placed_targets
            placed_scans[unreached] = np.eye(4)


def _cost(observation: Observation, T_world_target: Floats, T_world_lidar: Floats) -> float:
    predicted = inverse(T_world_target) @ T_world_lidar
    return observation.nearest(predicted).measurement.error(predicted)
