"""A target in an image file: which method finds it, and several images at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from os import cpu_count
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Value
from optshape_graph.calibration.camera.sightings import TargetInImage
from optshape_graph.calibration.images.chessboard import find_chessboard
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.outline import fit_outline
from optshape_graph.calibration.images.pixel_table import read_pixel_table
from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.images.tags import find_tags
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.files import read_bytes
from optshape_graph.io.image_files import decode_image, opencv
from optshape_graph.target import Target

LARGEST_ERROR = 5.0
"""Reprojection error, in standard deviations of the pixels, beyond which intrinsics or pattern are others than stated.

Published intrinsics leave 0.1 to 0.3 px of a chessboard's 0.2; those of another lens model leave 1.2 px and more."""


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


def find_target(task: ImageTask) -> TargetInImage:
    """Find a target in an image by what is printed on it, or by its outline, and its pose or two.

    Raises:
        InputError: the file cannot be read, or is not of the intrinsics' size; a target without pattern or start; or
            intrinsics that do not fit the image.
        EstimationError: the target is not found.
    """
    points = _points(task)
    poses = planar_poses(points, task.camera)
    limit = LARGEST_ERROR / float(np.linalg.norm(points.sqrt_information, axis=(1, 2), ord=2).mean())
    if poses[0].rms_px > limit:
        raise InputError(
            f"{task.image}: the best pose of '{task.target.name}' leaves {poses[0].rms_px:.1f} px; expected less than "
            f"{limit:.1f} px: are the intrinsics ('{task.camera.model}') those of camera '{task.camera.name}', "
            f"and the pattern's numbers right?"
        )
    return TargetInImage(task.camera, str(task.image), points, poses)


def find_targets(
    tasks: Sequence[ImageTask], tick: Callable[[], None] | None = None
) -> list[TargetInImage | EstimationError | InputError]:
    """Find targets in several images at once, in threads: OpenCV lets go of the interpreter while it works.

    Args:
        tasks: what to find where.
        tick: called once for every image that is done.

    Returns:
        For each task the target or the error, in the tasks' order.
    """
    found: list[TargetInImage | EstimationError | InputError | None] = [None] * len(tasks)
    opencv()
    with ThreadPoolExecutor(max_workers=min(len(tasks), cpu_count() or 1) or 1) as pool:
        futures = {pool.submit(_attempt, task): k for k, task in enumerate(tasks)}
        for future in as_completed(futures):
            found[futures[future]] = future.result()
            if tick is not None:
                tick()
    return [result for result in found if result is not None]


def read_grey(path: Path) -> np.ndarray:
    """Read an image as (h, w) grey values, 8 bit.

    Raises:
        InputError: the file is missing, not an image that OpenCV reads, or unreasonably large.
    """
    return decode_image(read_bytes(path), str(path), channels=1)


def _attempt(task: ImageTask) -> TargetInImage | EstimationError | InputError:
    try:
        return find_target(task)
    except (EstimationError, InputError) as error:
        return error


def _points(task: ImageTask) -> ImagePoints:
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
        return find_chessboard(image, target.chessboard)
    if target.tags is not None:
        return find_tags(image, target.tags)
    if task.start is None:
        raise InputError(
            f"{task.image}: target '{target.name}' has no pattern, so its outline needs a start: a CSV file "
            f"(vertex,u,v) with rough pixels of its vertices, as the view's 'corners'"
        )
    start = planar_poses(read_pixel_table(task.start, target), camera)[0]
    return fit_outline(image, target, camera, start.T_camera_target)
