"""A target in an image file: which method finds it, and several images at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from os import cpu_count
from pathlib import Path
from typing import TypeAlias

import numpy as np

from optshape_graph._arrays import Value
from optshape_graph.calibration.images.chessboard import find_chessboard, shown_counts
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.outline import fit_outline
from optshape_graph.calibration.images.pixel_table import read_pixel_table
from optshape_graph.calibration.images.planar_pose import PlanarPose, planar_poses
from optshape_graph.calibration.images.tags import find_tags
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.files import read_bytes
from optshape_graph.io.image_files import decode_image, opencv
from optshape_graph.runs.files import fingerprint
from optshape_graph.runs.kept import Kept
from optshape_graph.target import Target

LARGEST_ERROR = 5.0
"""Reprojection error, in standard deviations of the pixels, beyond which intrinsics or pattern are others than stated.

Published intrinsics leave 0.1 to 0.3 px of a chessboard's 0.2; those of another lens model leave 1.2 px and more."""


@dataclass(frozen=True, eq=False, repr=False)
class TargetInImage(Value):
    """One target in one image.

    Attributes:
        camera: the intrinsics; their name is the camera's.
        image: the image's name.
        points: points of the target with their pixels.
        poses: the one or two poses that explain them, the better one first.
    """

    camera: CameraIntrinsics
    image: str
    points: ImagePoints
    poses: tuple[PlanarPose, ...]


Found: TypeAlias = TargetInImage | EstimationError | InputError
"""A target in an image, or why it isn't."""


@dataclass(frozen=True, eq=False, repr=False)
class ImageTask(Value):
    """A target to be found in an image.

    Attributes:
        image: the image's file, or a CSV file with pixel coordinates (see `read_pixel_table`).
        target: the target.
        camera: the intrinsics.
        start: for an unpatterned target, a CSV file with rough pixel coordinates of its vertices, or None.
    """

    image: Path
    target: Target
    camera: CameraIntrinsics
    start: Path | None = None


def find_target(task: ImageTask, thorough: bool = True) -> TargetInImage:
    """Find a target in an image by what is printed on it, or by its outline, and its pose or two.

    Args:
        task: what to find where.
        thorough: see `find_chessboard`.

    Raises:
        InputError: the file cannot be read, or is not of the intrinsics' size; a target without pattern or start; or
            intrinsics that do not fit the image.
        EstimationError: the target is not found.
    """
    points = _points(task, thorough)
    poses = planar_poses(points, task.camera)
    limit = LARGEST_ERROR / float(np.linalg.norm(points.sqrt_information, axis=(1, 2), ord=2).mean())
    if poses[0].rms_px > limit:
        raise InputError(
            f"{task.image}: the best pose of '{task.target.name}' leaves {poses[0].rms_px:.1f} px; expected less than "
            f"{limit:.1f} px: are the intrinsics ('{task.camera.model}') those of camera '{task.camera.name}', "
            f"the pattern's numbers right, and is it this target?{_other_lens(points, task.camera, limit)}"
        )
    return TargetInImage(task.camera, str(task.image), points, poses)


def find_targets(
    tasks: Sequence[ImageTask], tick: Callable[[], None] = lambda: None, kept: Kept | None = None
) -> list[TargetInImage | EstimationError | InputError]:
    """Find targets in several images at once, in threads: OpenCV lets go of the interpreter while it works.

    Chessboards are looked for in reduced images first. Where none of a kind is found, another number of corners than
    stated is looked for, and two of the full images are tried before the others are.

    Args:
        tasks: what to find where.
        tick: called once for every image that is done.
        kept: what was found in a run that was stopped, and is in this one; None: it is not kept.

    Returns:
        For each task the target or the error, in the tasks' order.
    """
    opencv()
    kept = kept or Kept()
    found: dict[int, Found] = {}

    def attempt(numbers: Sequence[int], thorough: bool) -> None:
        with ThreadPoolExecutor(max_workers=min(len(numbers), cpu_count() or 1) or 1) as pool:
            futures = {pool.submit(_attempt, tasks[k], thorough, kept): k for k in numbers}
            for future in as_completed(futures):
                found[futures[future]] = future.result()
                if thorough or not isinstance(future.result(), EstimationError):
                    tick()

    attempt(range(len(tasks)), thorough=False)
    missed: dict[tuple[int, str], list[int]] = {}
    for k, task in enumerate(tasks):
        if isinstance(found[k], EstimationError):
            missed.setdefault((id(task.target), task.camera.name), []).append(k)
    for kind, numbers in missed.items():
        alike = [k for k, other in enumerate(tasks) if (id(other.target), other.camera.name) == kind]
        if len(alike) > len(numbers):
            attempt(numbers, thorough=True)
        elif (reason := _other_counts([tasks[k] for k in numbers])) is not None:
            found |= dict.fromkeys(numbers, reason)
        else:
            first = numbers[:: max(1, len(numbers) // 2)][:2]
            attempt(first, thorough=True)
            if any(isinstance(found[k], TargetInImage) for k in first):
                attempt([k for k in numbers if k not in first], thorough=True)
    return [found[k] for k in range(len(tasks))]


def read_grey(path: Path) -> np.ndarray:
    """Read an image as (h, w) grey values, 8 bit.

    Raises:
        InputError: the file is missing, not an image that OpenCV reads, or unreasonably large.
    """
    return decode_image(read_bytes(path), str(path), channels=1)


def _attempt(task: ImageTask, thorough: bool, kept: Kept) -> Found:
    files = [str(path) for path in (task.image, task.start) if path is not None]
    of = {"files": fingerprint(files), "target": task.target, "camera": task.camera, "thorough": thorough}
    try:
        return kept(TargetInImage, of, lambda: find_target(task, thorough))
    except (EstimationError, InputError) as error:
        return error


def _other_counts(tasks: Sequence[ImageTask]) -> InputError | None:
    """Say which other number of corners images show in which the stated one is nowhere found."""
    board = tasks[0].target.chessboard
    if board is None:
        return None
    for task in tasks[:: max(1, len(tasks) // 3)][:3]:
        try:
            shown = shown_counts(read_grey(task.image), board)
        except InputError:
            continue
        if shown is not None and shown != board.inner_corners:
            (a, b), (c, d) = board.inner_corners, shown
            return InputError(
                f"{task.image}: no image shows the {a} x {b} inner corners of target '{task.target.name}', but this "
                f"one {c} x {d}: 'inner_corners' counts the corners inside the pattern, not its squares"
            )
    return None


def _other_lens(points: ImagePoints, camera: CameraIntrinsics, limit: float) -> str:
    """Say which other reading of the intrinsics fits an image that contradicts them; empty: none."""
    other = "pinhole" if camera.model == "equidistant" else "equidistant"
    D = np.array(camera.D[:4]) if len(camera.D) else np.zeros(4)
    tried = {
        f"as those of model '{other}'": replace(camera, model=other, D=D),
        "without distortion": replace(camera, D=np.zeros(4)),
    }
    for words, lens in tried.items():
        try:
            left = planar_poses(points, lens)[0].rms_px
        except EstimationError:
            continue
        if left < limit / 2:
            return f" Read {words} they leave {left:.1f} px"
    return ""


def _points(task: ImageTask, thorough: bool) -> ImagePoints:
    target, camera = task.target, task.camera
    if task.image.suffix.lower() == ".csv":
        return read_pixel_table(task.image, target)
    image = read_grey(task.image)
    if image.shape != (camera.height, camera.width):
        raise InputError(
            f"{task.image}: {image.shape[1]} x {image.shape[0]} pixels; the intrinsics of camera '{camera.name}' are "
            f"for {camera.width} x {camera.height}"
        )
    if target.chessboard is not None:
        return find_chessboard(image, target.chessboard, thorough)
    if target.tags is not None:
        return find_tags(image, target.tags)
    if task.start is None:
        raise InputError(
            f"{task.image}: target '{target.name}' has no pattern, so its outline needs a start: a CSV file "
            f"(vertex,u,v) with rough pixels of its vertices, as the view's 'corners'"
        )
    start = planar_poses(read_pixel_table(task.start, target), camera)[0]
    return fit_outline(image, target, camera, start.T_camera_target)
