"""Target files: `schema: optshape/target/1`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from optshape_graph.errors import InputError
from optshape_graph.io.builtin import RENAMED, builtin_names, find
from optshape_graph.io.documents import Node, read_document, write_yaml
from optshape_graph.target import Chessboard, Tags, Target


def load_target(name_or_path: str | Path, folder: Path | None = None) -> Target:
    """Return a built-in target, a built-in target scaled to an area, or the target of a file.

    Args:
        name_or_path: a built-in name ("paper"), NAME@AREA with the area in square metres ("paper@0.5"), or a file.
        folder: where a relative path starts; by default the current folder.

    Raises:
        InputError: neither name nor file; a file with a missing, unknown or wrong key; or vertices that are not the
            corners of a convex polygon in the target frame (see `Target`).
    """
    name, _, area = str(name_or_path).partition("@")
    if area and (name in builtin_names("target") or name in RENAMED["target"]):
        try:
            scaled = load_target(name).scaled_to_area(float(area))
        except ValueError as error:  # InputError is one
            raise InputError(f"{name_or_path}: expected NAME@AREA with the area in m2, found '{area}'") from error
        return Target(scaled.vertices, str(name_or_path))
    return _read_target(find("target", str(name_or_path), folder))


def save_target(path: str | Path, target: Target) -> None:
    """Write a target file, which `load_target` reads back with the same numbers.

    Raises:
        InputError: the file cannot be written.
    """
    document: dict[str, Any] = {
        "schema": "optshape/target/1",
        "name": target.name,
        "vertices": target.vertices.tolist(),
    }
    if (board := target.chessboard) is not None:
        document["chessboard"] = {
            "inner_corners": list(board.inner_corners),
            "square": float(board.square),
            "offset": [float(x) for x in board.offset],
        }
    if (tags := target.tags) is not None:
        document["tags"] = {
            "dictionary": tags.dictionary,
            "size": float(tags.size),
            "centres": {str(number): [float(x) for x in centre] for number, centre in tags.centres.items()},
            "turn_deg": math.degrees(tags.turn),
        }
    write_yaml(path, document)


def _read_target(path: Path) -> Target:
    root = read_document(path, "target")
    fields = root.entries()
    vertices = fields["vertices"].numbers(-1, 3)
    name = fields["name"].text() if "name" in fields else path.stem
    chessboard = _read_chessboard(fields["chessboard"]) if "chessboard" in fields else None
    tags = _read_tags(fields["tags"]) if "tags" in fields else None
    try:
        return Target(vertices, name, chessboard, tags)
    except InputError as error:
        raise InputError(f"{fields['vertices'].where}: {error}") from error


def _read_chessboard(node: Node) -> Chessboard:
    fields = node.entries()
    along_z, along_y = fields["inner_corners"].value
    y, z = fields["offset"].numbers(2) if "offset" in fields else (0.0, 0.0)
    return Chessboard((along_z, along_y), fields["square"].number(), (float(y), float(z)))


def _read_tags(node: Node) -> Tags:
    fields = node.entries()
    centres = {int(number): (float(y), float(z)) for number, (y, z) in fields["centres"].value.items()}
    turn = fields["turn_deg"].number() if "turn_deg" in fields else 0.0
    return Tags(fields["dictionary"].text(), fields["size"].number(), centres, math.radians(turn))
