"""Camera sessions with one thing wrong: each changes the files of a session's folder."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml


def change(name: str, key: str, how: Callable[[Any], Any]) -> Callable[[Path], None]:
    """Change one value of the session's `target` or `camera` file; `key` may lead into a mapping: a.b."""

    def apply(folder: Path) -> None:
        path = folder / yaml.safe_load((folder / "session.yaml").read_text())[name]
        document = yaml.safe_load(path.read_text())
        *outer, last = key.split(".")
        inner = document
        for part in outer:
            inner = inner[part]
        inner[last] = how(inner[last])
        path.write_text(yaml.safe_dump(document))

    return apply


def _wider(vertices: list[list[float]]) -> list[list[float]]:
    """Both sides 23 mm longer."""
    return [[x, y + math.copysign(0.0115, y), z + math.copysign(0.0115, z)] for x, y, z in vertices]


def _off_centre(K: list[list[float]]) -> list[list[float]]:
    """The principal point 1 % of the image's width to the side."""
    K[0][2] += 19.0
    return K


def _shorter(share: float) -> Callable[[list[list[float]]], list[list[float]]]:
    """The focal length by so much."""
    return lambda K: [[(1 - share) * K[0][0], *K[0][1:]], [K[1][0], (1 - share) * K[1][1], K[1][2]], K[2]]


def _swapped(folder: Path) -> None:
    session = yaml.safe_load((folder / "session.yaml").read_text())
    a, b = session["views"][1], session["views"][3]
    a["image"], b["image"] = b["image"], a["image"]
    (folder / "session.yaml").write_text(yaml.safe_dump(session))


def _flat(points: list[int]) -> list[int]:
    return [points[1], points[0]]


@dataclass(frozen=True)
class Wrong:
    """One thing that is wrong.

    Attributes:
        name: what.
        apply: changes the session in a folder.
        said: a pattern of what the calibration has to say, in a refusal, a warning or a reason.
    """

    name: str
    apply: Callable[[Path], None]
    said: str


WRONG = (
    Wrong("squares of 105 mm for 95", change("target", "chessboard.square", lambda s: s * 105 / 95),
          r"reaches beyond its board.*is 'square' right\?"),
    Wrong("squares of 100 mm for 95", change("target", "chessboard.square", lambda s: s * 100 / 95),
          r"images see the placements \d\.\d % farther apart"),
    Wrong("a pattern larger than its board", change("target", "chessboard.square", lambda s: s * 1.5),
          "reaches beyond its board"),
    Wrong("squares counted for corners", change("target", "chessboard.inner_corners", lambda n: [n[0] + 1, n[1] + 1]),
          r"shows (\d) x (\d)|but this one (\d) x (\d)"),
    Wrong("corners in the other order", change("target", "chessboard.inner_corners", _flat), "in the other order"),
    Wrong("another lens model", change("camera", "model", lambda m: "pinhole" if m == "equidistant" else "equidistant"),
          "are the intrinsics .* those of|contradict the given intrinsics"),
    Wrong("board sides 23 mm off", change("target", "vertices", _wider), r"sides of target .* by the images \(\d+ "),
    Wrong("a principal point 1 % off", change("camera", "K", _off_centre), r"principal point moves by \d+\.\d px"),
    Wrong("a focal length 3 % short", change("camera", "K", _shorter(0.03)), r"focal length by \d\.\d+ %"),
    Wrong("a focal length 10 % short", change("camera", "K", _shorter(0.1)), r"focal length by \d+\.\d+ %"),
    Wrong("two images swapped", _swapped, "were they swapped|disagree with the others"),
)  # fmt: skip


def says(text: str, wrong: Wrong) -> bool:
    return re.search(wrong.said, text, re.DOTALL) is not None
