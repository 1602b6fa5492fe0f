"""Topics of a recording, the choice of one, and the static transforms between the frames of topics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError

Kind = Literal["scan", "image", "camera", "pose", "other"]

CALLED = {"scan": "point clouds", "image": "images", "camera": "camera parameters", "pose": "poses"}


@dataclass(frozen=True)
class Topic:
    """A named stream of a recording.

    Attributes:
        name: as recorded; a transform of a tf topic is called TOPIC:PARENT:CHILD.
        kind: what it holds.
        type: message type, or the suffix of its files.
        count: number of messages; None: only reading tells.
    """

    name: str
    kind: Kind
    type: str
    count: int | None


def choose(topics: Sequence[Topic], kind: Kind, name: str | None, path: Path) -> Topic:
    """Return the topic of that kind with that name, or the only one of that kind.

    Transforms are candidates only if there is no topic of pose messages, since nearly every robot publishes several.

    Raises:
        InputError: no such topic, or several and no name; the message lists them.
    """
    candidates = [topic for topic in topics if topic.kind == kind]
    if name is not None:
        for topic in candidates:
            if topic.name == name:
                return topic
        raise InputError(f"{path}: no topic '{name}' of {CALLED[kind]}; {listed(candidates)}")
    direct = [topic for topic in candidates if topic.count is not None] or candidates
    if not direct:
        raise InputError(f"{path}: no topic of {CALLED[kind]}; it has {listed(topics)}")
    if len(direct) > 1:
        raise InputError(f"{path}: several topics of {CALLED[kind]}, name one: {listed(direct)}")
    return direct[0]


def listed(topics: Sequence[Topic]) -> str:
    """Return topics in words."""
    return ", ".join(f"{topic.name} ({topic.type})" for topic in topics) or "none"


@dataclass(frozen=True, eq=False, repr=False)
class Mounting(Value):
    """The place of the LiDAR on the body that moves.

    Attributes:
        body: frame whose poses are recorded; empty: not stated.
        lidar: frame of the scans; empty: not stated.
        T_body_lidar: (4, 4); None: not stated.
    """

    body: str
    lidar: str
    T_body_lidar: Floats | None


def chained(static: Mapping[tuple[str, str], Floats], a: str, b: str) -> Floats | None:
    """Return T_a_b (4, 4) through static transforms T_parent_child; None: they do not lead from a to b.

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
