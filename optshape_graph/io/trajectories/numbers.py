"""Numbers of trajectory files: lines, poses and quaternions, and the text they are written as."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.files import read_text

NORM_TOLERANCE = 1e-2
"""Largest deviation from 1 of a quaternion's norm, and of R^T R from the identity: files have four digits or more."""


def lines_of(path: Path) -> Iterator[tuple[str, str]]:
    """Yield each line that is neither empty nor a comment, after its place as "FILE:NUMBER"."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}:{number}", line


def rows_of(path: Path, columns: int) -> Iterator[tuple[str, list[float]]]:
    """Yield the numbers of each line, after its place.

    Raises:
        InputError: another count of words in a line, or a word that is not a finite number.
    """
    for where, line in lines_of(path):
        words = line.replace(",", " ").split()
        if len(words) != columns:
            raise InputError(f"{where}: expected {columns} numbers, found {len(words)} words")
        yield where, numbers_in(words, where)


def numbers_in(words: list[str], where: str) -> list[float]:
    """Return words as finite numbers.

    Raises:
        InputError: one of them is not a finite number; the message begins with `where`.
    """
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {next(w for w, v in zip(words, values, strict=True) if not np.isfinite(v))}"
                         " is not a finite number")  # fmt: skip
    return values


def poses_of(translations: Floats, quaternions: Floats, where: list[str]) -> Floats:
    """Return the poses (N, 4, 4) of translations (N, 3) and quaternions (N, 4), x y z w.

    Raises:
        InputError: a quaternion whose norm is not 1; the message begins with its place in `where`.
    """
    poses = np.tile(np.eye(4), (len(translations), 1, 1))
    norms = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(np.abs(norms - 1) > NORM_TOLERANCE)[:1]:
        raise InputError(f"{where[k]}: quaternion {quaternions[k].tolist()} has norm {norms[k]:g}; expected 1")
    if len(poses):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = translations
    return poses


def quaternions_of(poses: Floats) -> Floats:
    """Return the quaternions (N, 4), x y z w with w >= 0, of poses (N, 4, 4)."""
    if not len(poses):
        return np.zeros((0, 4))
    return np.asarray(Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True))


def pose_text(T: Floats) -> str:
    """Return a pose (4, 4) as the text of its translation and its quaternion."""
    return f"{text_of(T[:3, 3])} {text_of(quaternions_of(T[None])[0])}"


def text_of(values: Floats) -> str:
    """Return numbers (n,) as text that reads back to the same bits."""
    return " ".join(repr(float(value)) for value in values)
