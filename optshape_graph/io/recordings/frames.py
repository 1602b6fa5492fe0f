"""Where the LiDAR sits on the body that odometry is of: frames named by messages, linked by static transforms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value


@dataclass(frozen=True, eq=False, repr=False)
class Mounting(Value):
    """The LiDAR on the body that moves.

    Attributes:
        body: frame that the poses are of; empty: the recording does not say.
        lidar: frame of the scans; empty: the recording does not say.
        T_body_lidar: (4, 4); None: the recording does not say.
    """

    body: str
    lidar: str
    T_body_lidar: Floats | None


def chained(static: Mapping[tuple[str, str], Floats], a: str, b: str) -> Floats | None:
    """Return T_a_b (4, 4), by way of static transforms T_parent_child, or None where none lead from a to b.

    Args:
        static: T_parent_child (4, 4) by names of parent and child.
        a: name of a frame.
        b: name of a frame.
    """
    neighbours: dict[str, dict[str, Floats]] = {}
    for (parent, child), T in static.items():
        neighbours.setdefault(parent, {})[child] = T
        neighbours.setdefault(child, {})[parent] = np.asarray(np.linalg.inv(T), float)
    reached = {a: np.eye(4)}
    front = [a]
    while front and b not in reached:
        frame = front.pop(0)
        for neighbour, T in neighbours.get(frame, {}).items():
            if neighbour not in reached:
                reached[neighbour] = reached[frame] @ T
                front.append(neighbour)
    return reached.get(b)
