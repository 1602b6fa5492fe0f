"""A ready-made scene: targets on stands in a room."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.simulation.placement import pose_from_rpy
from optshape_graph.simulation.scene import Scene
from optshape_graph.simulation.surfaces import Box, Patch
from optshape_graph.target import Target

STAND_WIDTH = 0.05
STAND_BEHIND = 0.05
"""A stand's size, and how far its axis is behind the target's plane, metres."""


def room(
    targets: Sequence[tuple[Target, Floats]],
    size: tuple[float, float, float] = (24.0, 18.0, 5.0),
    centre: tuple[float, float] = (0.0, 0.0),
    floor: float = -1.5,
) -> Scene:
    """Return targets in a room with floor, ceiling and four walls, each target on a stand behind it.

    Args:
        targets: every target with its T_world_target (4, 4).
        size: length along x, width along y and height of the room, metres.
        centre: (x, y) of the room, metres.
        floor: z of the floor, metres.

    Raises:
        InputError: a target's centre is not in the room.
    """
    length, width, height = size
    walls = Box(np.array(size), pose_from_rpy([*centre, floor + height / 2]))
    stands = []
    for target, T in targets:
        inside = np.abs(T[:3, 3] - walls.T_world_box[:3, 3]) < np.array([length, width, height]) / 2
        if not inside.all():
            raise InputError(f"target '{target.name}' at {T[:3, 3].round(3).tolist()} m is not in the room")
        x, y, z = T[:3, 3] + STAND_BEHIND * T[:3, 0]
        pole = pose_from_rpy([x, y, (floor + z) / 2])
        stands.append(Box(np.array([STAND_WIDTH, STAND_WIDTH, z - floor]), pole, reflectivity=0.2))
    return Scene(tuple(Patch(target, T) for target, T in targets), (walls, *stands))
