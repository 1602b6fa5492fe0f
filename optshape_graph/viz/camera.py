"""Pictures of a LiDAR-camera calibration: images with LiDAR returns and outlines, and the errors of every view."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.consistency import of_view, pose_alone
from optshape_graph.calibration.camera.result import CameraCalibration
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.projection import in_view, project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.files import read_bytes, write_atomically
from optshape_graph.io.image_files import decode_image, opencv
from optshape_graph.names import file_name
from optshape_graph.se3 import apply, inverse
from optshape_graph.target import Target
from optshape_graph.viz.style import BLUE, GREY, INK, VERMILLION, legend_below, literal, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIDAR_COLOUR, CAMERA_COLOUR, CORNER_COLOUR = (60, 60, 255), (255, 200, 0), (80, 220, 80)
"""Colours (blue, green, red) of the outline predicted from the LiDAR, of the camera's own, and of corners in the
image."""

AXES = (("x", (80, 80, 255)), ("y", (80, 200, 80)), ("z", (255, 140, 60)))
"""Axes of the target's frame as the camera estimates it, and their colours (blue, green, red)."""

AXIS = 0.5
"""Length of these axes, in circumradii of the target."""

RANGES = (1.0, 30.0)
"""Nearest and farthest range, metres, of the colours from yellow to violet, whose steps are equal ratios of range."""

TICKS = (1, 2, 5, 10, 20, 30)
"""Ranges, metres, with a number on the scale."""

POINTS_PER_EDGE = 50

PANELS = (
    ("centre_error_mm", "centre (mm)"),
    ("plane_offset_mm", "plane (mm), signed"),
    ("normal_error_deg", "normal (deg)"),
    ("reprojection_px", "vertices (px)"),
)


def plot_view_errors(calibration: CameraCalibration) -> Figure:
    """Plot the errors of every view, each predicted by the extrinsic of the others; views not used are hollow.

    Args:
        calibration: the result.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    rows = [result for result in calibration.views if result.errors is not None]
    y = np.arange(len(rows))
    used = np.array([result.used for result in rows], dtype=bool)
    figure = new_figure(12.0, 1.8 + 0.3 * max(len(rows), 5))
    panels = figure.subplots(1, len(PANELS), sharey=True)
    for axes, (field, label) in zip(panels, PANELS, strict=True):
        values = np.array([getattr(result.errors, field) for result in rows], dtype=float)
        plain(axes).set_xlabel(label)
        axes.axvline(0.0, color=INK, lw=0.8)
        axes.hlines(y, 0.0, values, color=GREY, lw=1.0)
        axes.plot(values[used], y[used], "o", color=BLUE, ms=6, label="used")
        if not used.all():
            axes.plot(values[~used], y[~used], "o", mfc="none", color=VERMILLION, ms=7, label="not used")
        if used.any():
            axes.axvline(float(values[used].mean()), color=BLUE, lw=1.2, ls="--", label="mean of the used")
    panels[0].set_yticks(y, [literal(result.view.name) for result in rows])
    panels[0].invert_yaxis()
    legend_below(figure, panels[0])
    figure.suptitle("errors of the views, each predicted by the extrinsic of the others")
    return figure


def draw_overlay(calibration: CameraCalibration, number: int) -> np.ndarray:
    """Draw one view: the image with returns, outlines, corners, axes and the scale of ranges.

    Returns are those that the lens can see. The outline by the LiDAR is red, that by the camera light blue; the corners
    found are green crosses; the axes are those of the target by the camera.

    Args:
        calibration: the result.
        number: the view's number.

    Returns:
        (h, w, 3) blue, green, red.

    Raises:
        InputError: the view has no image, or it cannot be read.
    """
    view = calibration.views[number].view
    lidar_side, camera_side = of_view(number, calibration.sightings)
    if view.image is None or view.image.image.lower().endswith(".csv") or camera_side is None:
        raise InputError(f"view {view.name}: no image to draw on")
    picture = decode_image(read_bytes(view.image.image), view.image.image, channels=3)
    rig = calibration.rig
    camera = rig.cameras[camera_side.sensor]
    _outline(picture, camera, view.target, pose_alone(camera_side, rig), CAMERA_COLOUR)
    caption = "camera's outline light blue, corners green"
    if lidar_side is not None and isinstance(lidar_side.seen, TargetInScan):
        T_camera_lidar = inverse(rig.T_base_sensor[camera_side.sensor]) @ rig.T_base_sensor[lidar_side.sensor]
        _returns(picture, camera, T_camera_lidar, lidar_side.seen.all_returns, 1)
        _returns(picture, camera, T_camera_lidar, lidar_side.seen.returns, 2)
        _outline(picture, camera, view.target, T_camera_lidar @ pose_alone(lidar_side, rig), LIDAR_COLOUR)
        caption = f"LiDAR's outline red, {caption}"
    _corners(picture, view.image.points.pixels)
    _axes(picture, camera, view.target, pose_alone(camera_side, rig))
    _scale(picture)
    _caption(picture, calibration, number, caption)
    return np.asarray(picture)


def save_overlays(
    calibration: CameraCalibration, folder: Path, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Write one PNG for each view that has an image; return their paths.

    Args:
        calibration: the result.
        folder: where to write; it is made if it does not exist.
        progress: called with the number of finished images, and of all.
    """
    cv2 = opencv()
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for number, result in enumerate(calibration.views):
        if result.view.image is not None and not result.view.image.image.lower().endswith(".csv"):
            picture = draw_overlay(calibration, number)
            name = f"{number:03d}_{Path(result.view.image_name).stem}_{result.view.target.name}"
            path = folder / f"{file_name(name)}.png"
            write_atomically(path, cv2.imencode(".png", picture)[1].tobytes())
            written.append(path)
        if progress is not None:
            progress(number + 1, len(calibration.views))
    return written


def _returns(
    picture: np.ndarray, camera: CameraIntrinsics, T_camera_lidar: Floats, points: Floats, radius: int
) -> None:
    cv2 = opencv()
    in_camera = apply(T_camera_lidar, points)
    seen = in_view(camera, in_camera)
    in_camera, distance = in_camera[seen], np.linalg.norm(points[seen], axis=1)
    if not len(in_camera):
        return
    near, far = np.log(RANGES)
    colours = _by_range((np.log(distance) - near) / (far - near))
    for pixel, colour in zip(project(camera, in_camera), colours, strict=True):
        if (pixel >= 0).all() and (pixel < (camera.width, camera.height)).all():
            cv2.circle(picture, [int(x) for x in pixel], radius, [int(c) for c in colour], -1, cv2.LINE_AA)


def _outline(
    picture: np.ndarray, camera: CameraIntrinsics, target: Target, T_camera_target: Floats, colour: tuple[int, int, int]
) -> None:
    cv2 = opencv()
    share = np.linspace(0, 1, POINTS_PER_EDGE, endpoint=False)[None, :, None]
    points = ((1 - share) * target.vertices[:, None] + share * np.roll(target.vertices, -1, axis=0)[:, None]).reshape(
        -1, 3
    )
    in_camera = apply(T_camera_target, points)
    if in_view(camera, in_camera).all():
        pixels = np.round(16 * project(camera, in_camera)).astype(np.int32)
        cv2.polylines(picture, [pixels], True, colour, 2, cv2.LINE_AA, 4)


def _corners(picture: np.ndarray, pixels: Floats) -> None:
    cv2 = opencv()
    for u, v in np.round(pixels).astype(int).tolist():
        cv2.drawMarker(picture, (u, v), CORNER_COLOUR, cv2.MARKER_CROSS, 13, 1, cv2.LINE_AA)


def _by_range(share: Floats) -> np.ndarray:
    """Return colours (N, 3), blue, green, red, for positions (N,) from 0, the nearest range, to 1, the farthest."""
    cv2 = opencv()
    levels = (255 * (1 - np.clip(share, 0, 1))).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_PLASMA)[:, 0])


def _axes(picture: np.ndarray, camera: CameraIntrinsics, target: Target, T_camera_target: Floats) -> None:
    """Draw the axes of the target's frame with their names: x is away from the sensors."""
    cv2 = opencv()
    ends = apply(T_camera_target, np.vstack([np.zeros(3), AXIS * target.circumradius * np.eye(3)]))
    if not in_view(camera, ends).all():
        return
    origin, *tips = np.round(project(camera, ends)).astype(int).tolist()
    for tip, (name, colour) in zip(tips, AXES, strict=True):
        cv2.arrowedLine(picture, origin, tip, colour, 2, cv2.LINE_AA, tipLength=0.08)
        cv2.putText(picture, name, (tip[0] + 6, tip[1] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)


def _scale(picture: np.ndarray) -> None:
    """Draw the colours of the ranges down the right side, with metres beside them."""
    cv2 = opencv()
    height, width = picture.shape[:2]
    length, thick = height // 3, max(width // 100, 6)
    top, right = (height - length) // 2, width - 8
    left = right - thick
    cv2.rectangle(picture, (left - 64, top - 34), (width - 1, top + length + 14), (0, 0, 0), -1)
    picture[top : top + length, left:right] = _by_range(np.linspace(0, 1, length))[:, None]
    near, far = np.log(RANGES)

    def write(text: str, left_end: int, row: int) -> None:
        cv2.putText(picture, text, (left_end, row), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)

    write("range", left - 60, top - 14)
    for tick in TICKS:
        row = top + round((np.log(tick) - near) / (far - near) * (length - 1))
        text = f"{tick} m"
        (across, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
        cv2.line(picture, (left - 5, row), (left, row), (255, 255, 255), 1)
        write(text, left - 9 - across, row + 6)


def _caption(picture: np.ndarray, calibration: CameraCalibration, number: int, text: str) -> None:
    cv2 = opencv()
    result = calibration.views[number]
    lines = [f"{result.view.name}: {'used' if result.used else 'not used'}; {text}"]
    if (errors := result.errors) is not None:
        lines.append(
            f"centre {errors.centre_error_mm:.1f} mm, plane {errors.plane_offset_mm:+.1f} mm, "
            f"normal {errors.normal_error_deg:.2f} deg, vertices {errors.reprojection_px:.1f} px"
        )
    for row, line in enumerate(lines):
        (width, height), below = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.7, 1)
        bottom = 30 + 32 * row
        cv2.rectangle(picture, (6, bottom - height - 6), (18 + width, bottom + below), (0, 0, 0), -1)
        cv2.putText(picture, line, (12, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 1, cv2.LINE_AA)
