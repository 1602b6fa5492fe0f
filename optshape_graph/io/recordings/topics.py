"""Topics of a recording, and the choice of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

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
        count: number of messages, or None where only reading tells.
    """

    name: str
    kind: Kind
    type: str
    count: int | None


def choose(topics: Sequence[Topic], kind: Kind, name: str | None, path: Path) -> Topic:
    """Return the topic of that kind with that name, or the only one of that kind.

    Transforms are candidates only where no topic of pose messages is: nearly every robot publishes several.

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
