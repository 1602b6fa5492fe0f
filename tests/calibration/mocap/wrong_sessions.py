"""Motion-capture sessions with one thing wrong: each changes the files of a session's folder."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

Frames = dict[int, dict[str, np.ndarray]]
"""Positions (3,) by frame and marker."""


def read_frames(folder: Path) -> Frames:
    frames: Frames = {}
    with (folder / "markers.csv").open() as lines:
        for row in csv.DictReader(lines):
            frames.setdefault(int(row["frame"]), {})[row["marker"]] = np.array([float(row[axis]) for axis in "xyz"])
    return frames


def write_frames(folder: Path, frames: Frames) -> None:
    lines = ["frame,marker,x,y,z"]
    lines += [f"{k},{name},{p[0]:.6f},{p[1]:.6f},{p[2]:.6f}" for k, f in frames.items() for name, p in f.items()]
    (folder / "markers.csv").write_text("\n".join(lines) + "\n")


def by_points(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Change every position."""

    def apply(folder: Path) -> None:
        frames = read_frames(folder)
        write_frames(folder, {k: {name: change(p) for name, p in f.items()} for k, f in frames.items()})

    return apply


def by_frames(change: Callable[[Frames], Frames]) -> Callable[[Path], None]:
    return lambda folder: write_frames(folder, change(read_frames(folder)))


def by_scans(change: Callable[[list[dict]], list[dict]]) -> Callable[[Path], None]:
    """Change the session's list of scans."""

    def apply(folder: Path) -> None:
        session = yaml.safe_load((folder / "session.yaml").read_text())
        session["scans"] = change(session["scans"])
        (folder / "session.yaml").write_text(yaml.safe_dump(session))

    return apply


def marker_in_all_frames(offset: np.ndarray) -> Callable[[Path], None]:
    """Move corner1 by the same vector of the target's frame in every frame."""

    def change(frames: Frames) -> Frames:
        for frame in frames.values():
            a, b, c = (frame[f"corner{k}"] for k in (0, 2, 3))
            x = (b - a) / np.linalg.norm(b - a)
            z = np.cross(x, c - a)
            z /= np.linalg.norm(z)
            frame["corner1"] = frame["corner1"] + np.column_stack([x, np.cross(z, x), z]) @ offset
        return frames

    return by_frames(change)


def _frame_moved(frames: Frames, metres: float) -> Frames:
    frames[1] = {name: p + metres * np.array([0.6, 0.0, 0.8]) for name, p in frames[1].items()}
    return frames


def _permuted(frames: Frames) -> Frames:
    numbers = list(frames)
    return dict(zip(numbers, [frames[k] for k in (*numbers[1:], numbers[0])], strict=True))


def _marker_moved(frames: Frames) -> Frames:
    frames[1]["corner2"] = frames[1]["corner2"] + np.array([0.0, 0.8, 0.6])
    return frames


def _shifted(frames: Frames) -> Frames:
    return {
        k: {name: f[other] for name, other in zip(f, (*list(f)[1:], next(iter(f))), strict=True)}
        for k, f in frames.items()
    }


def _swapped(frames: Frames) -> Frames:
    frames[2]["corner0"], frames[2]["corner1"] = frames[2]["corner1"], frames[2]["corner0"]
    return frames


def _larger_layout(frames: Frames) -> Frames:
    found = {}
    for k, frame in frames.items():
        middle = np.mean(list(frame.values()), axis=0)
        found[k] = {name: middle + 1.08 * (p - middle) for name, p in frame.items()}
    return found


def _larger_target(folder: Path) -> None:
    session = yaml.safe_load((folder / "session.yaml").read_text())
    path = (folder / session["target"]).resolve()
    target = yaml.safe_load(path.read_text())
    target["vertices"] = (1.05 * np.array(target["vertices"])).tolist()
    (folder / "larger.yaml").write_text(yaml.safe_dump(target))
    session["target"] = "larger.yaml"
    (folder / "session.yaml").write_text(yaml.safe_dump(session))


@dataclass(frozen=True)
class Wrong:
    """One thing that is wrong.

    Attributes:
        name: what.
        apply: changes the session in a folder.
        said: a pattern of what the calibration has to say, in a refusal, a warning or a reason.
        mended: whether the result is right all the same.
    """

    name: str
    apply: Callable[[Path], None]
    said: str
    mended: bool = False


WRONG = (
    Wrong("one frame off by 1 m", by_frames(lambda f: _frame_moved(f, 1.0)), r"disagree by (0\.9|1\.0)\d+ m", True),
    Wrong("frames permuted", by_frames(_permuted), r"frames look permuted: .* fits frame"),
    Wrong("left-handed", by_points(lambda p: p * [1, -1, 1]), "the markers are mirrored"),
    Wrong("y and z swapped", by_points(lambda p: p[[0, 2, 1]]), "the markers are mirrored"),
    Wrong("inches read as metres", by_points(lambda p: p / 0.0254), r"inches|span .* m"),
    Wrong("metres read as inches", by_points(lambda p: p * 0.0254), "in metres, read as inches"),
    Wrong("feet read as metres", by_points(lambda p: p / 0.3048), "feet"),
    Wrong("one frame for all", by_scans(lambda s: [e | {"mocap_frame": 0} for e in s]),
          "all . scans name marker frame"),
    Wrong("one scan for all", by_scans(lambda s: [e | {"file": s[0]["file"]} for e in s]), "hold the same returns"),
    Wrong("a marker fallen across the plane", marker_in_all_frames(np.array([0.0, 0.0, 0.3])),
          r"the marker of vertex 1 is 0\.\d+ m from it"),
    Wrong("a marker fallen in the plane", marker_in_all_frames(np.array([0.18, -0.24, 0.0])),
          r"the marker of vertex 1 is 0\.\d+ m from it"),
    Wrong("one marker of one frame off by 1 m", by_frames(_marker_moved), r"corner2 is (0\.9|1\.0)\d+ m from", True),
    Wrong("the motion capture 5 % too large", by_points(lambda p: 1.05 * p), r"lengths are [45]\.\d % too large"),
    Wrong("markers 8 % farther out", by_frames(_larger_layout), r"markers are \d+\.\d % larger than target"),
    Wrong("names shifted by one corner", by_frames(_shifted), "names look shifted by 1 corner", True),
    Wrong("two names swapped in one frame", by_frames(_swapped), "corner0 and corner1 look swapped in frame 2", True),
    Wrong("a target file 5 % too large", _larger_target, r"markers are \d+\.\d % smaller|sides of target .* shorter"),
    Wrong("two scans only", by_scans(lambda s: s[:2]), "2 placements of the target: no other shows"),
)  # fmt: skip


def says(text: str, wrong: Wrong) -> bool:
    return re.search(wrong.said, text) is not None
