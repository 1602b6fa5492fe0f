"""TUM trajectories, and tables of poses that name their columns (EuRoC, TUM-VI)."""

from __future__ import annotations

import logging
import math
import re
from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.files import read_bytes, write_atomically
from optshape_graph.io.times import parse_stamp
from optshape_graph.io.trajectories.columns import Layout, attach_units, check_width, layout_of, names_in
from optshape_graph.io.trajectories.numbers import NORM_TOLERANCE, poses_of, quaternions_of, text_of
from optshape_graph.io.trajectories.trajectory import Trajectory

LARGEST_BAD_SHARE = 0.1
"""Share of lines that may be bad; they are left out and counted."""

FEWEST = 2
"""A single bad line is left out if at least this many poses remain, however short the file."""

log = logging.getLogger(__name__)


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory: lines of `stamp tx ty tz qx qy qz qw`, `#` for comments; see `read_trajectory`.

    Raises:
        InputError: as `read_trajectory`.
    """
    return read_lines(Path(path), decode(read_bytes(path)))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory; stamps to the nanosecond.

    Raises:
        InputError: the trajectory has no stamps.
    """
    if trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: a TUM trajectory needs stamps")
    body = np.column_stack([trajectory.poses[:, :3, 3], quaternions_of(trajectory.poses)])
    lines = [f"{stamp:.9f} {text_of(row)}\n" for stamp, row in zip(trajectory.stamps, body, strict=True)]
    write_atomically(Path(path), "# stamp tx ty tz qx qy qz qw\n" + "".join(lines))


def read_lines(path: Path, text: str) -> Trajectory:
    """Return the trajectory in a text that has a pose on each line; see `read_trajectory`.

    Raises:
        InputError: as `read_trajectory`; the message names the file and the line.
    """
    layout, bad = Layout(), _BadLines(path)
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), 1):
        comment = line.lstrip().startswith(("#", "%", "//"))
        words = re.sub(r"[,;]", " ", attach_units(line.lstrip(" #%/"))).split()
        if not words or words == ["[]"]:
            continue
        if comment or not _is_number(words[0]):
            layout = (not rows and layout_of(path, names_in(line))) or layout
            if not (comment or layout.named):
                bad.add(number, f"could not convert string to float: '{words[0]}'")
            continue
        rows.append((number, words))
    check_width(path, rows, layout, "," in text.partition("\n")[2] or "," in text[:400])
    stamps: list[float] = []
    values: list[list[float]] = []
    places: list[str] = []
    for number, words in rows:
        try:
            stamp, numbers = _pose_of_line(words, layout)
        except ValueError as error:
            bad.add(number, str(error))
            continue
        if stamps and stamp <= stamps[-1]:
            bad.add(number, f"stamp {stamp:.9f} does not exceed {stamps[-1]:.9f}")
            continue
        stamps.append(stamp)
        values.append(numbers)
        places.append(f"{path}:{number}")
    bad.judge(len(stamps))
    array = np.array(values).reshape(-1, 7)
    return Trajectory(poses_of(array[:, :3], array[:, 3:], places), np.array(stamps, dtype=float), str(path))


def _pose_of_line(words: list[str], layout: Layout) -> tuple[float, list[float]]:
    """Return the stamp of a line, and its position and quaternion (x y z w) as seven numbers.

    Raises:
        ValueError: the line is not a pose; the message says why.
    """
    if len(words) < layout.width or (not layout.named and len(words) != layout.width):
        raise ValueError(f"expected {layout.width} numbers, found {len(words)} words")
    picked = [words[k] for k in layout.words]
    numbers = [float(word) for word in picked[1:]]
    for word, number in zip(picked[1:], numbers, strict=True):
        if not math.isfinite(number):
            raise ValueError(f"{word} is not a finite number")
    stamp = parse_stamp(picked[0]) if layout.stamp_unit is None else float(picked[0]) * layout.stamp_unit
    if stamp is None or not math.isfinite(stamp):
        raise ValueError(f"expected a stamp, found '{picked[0]}'")
    norm = math.sqrt(sum(q * q for q in numbers[3:]))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise ValueError(f"quaternion {numbers[3:]} has norm {norm:g}; expected 1")
    return stamp, [x * layout.length_unit for x in numbers[:3]] + numbers[3:]


class _BadLines:
    """Counts the bad lines of a file, and refuses the file if they are too many."""

    def __init__(self, path: Path) -> None:
        self.path, self.count, self.first = path, 0, ""

    def add(self, line: int, problem: str) -> None:
        self.count += 1
        self.first = self.first or f"{self.path}:{line}: {problem}"

    def judge(self, good: int) -> None:
        if self.count > LARGEST_BAD_SHARE * (self.count + good) and (self.count > 1 or good < FEWEST):
            raise InputError(self.first)
        if self.count:
            log.warning(
                "%d of %d lines are no pose and left out, the first: %s", self.count, self.count + good, self.first
            )


def _is_number(word: str) -> bool:
    return parse_stamp(word) is not None or word.lower().lstrip("+-") in ("nan", "inf")
