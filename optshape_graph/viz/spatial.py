"""Points and lines in space, of a scan, a result or a map, for the viewers to draw."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Value
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.se3 import apply
from optshape_graph.viz.style import GREY, INK, VERMILLION, colour

Colours = NDArray[np.uint8]

SIGMAS = 3.0
"""Standard deviations that ellipsoids enclose."""

RANGES = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=float)
"""Colours of ranges, near to far: viridis."""


@dataclass(frozen=True, eq=False, repr=False)
class Points(Value):
    """Points in space.

    Attributes:
        name: place in the tree of what is shown, as `scan/returns`.
        points: (N, 3) metres.
        colours: (N, 3) red, green, blue; or (3,) for all.
        radius: metres.
        step: number of the scan that they belong to; None: to all.
    """

    name: str
    points: Floats
    colours: Colours
    radius: float = 0.01
    step: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Lines(Value):
    """Lines in space, each through several points.

    Attributes:
        name: place in the tree of what is shown.
        strips: (k, 3) points of each line, metres.
        colours: (m, 3) of each line, or (3,) for all.
        label: a text beside them; "": none.
        radius: metres.
        step: number of the scan that they belong to; None: to all.
    """

    name: str
    strips: tuple[Floats, ...]
    colours: Colours
    label: str = ""
    radius: float = 0.005
    step: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Spatial(Value):
    """All points and lines to show.

    Attributes:
        items: points and lines, in one frame.
        steps: names of the steps, for a viewer's slider.
        notes: what could not be shown, with the reason.
    """

    items: tuple[Points | Lines, ...]
    steps: tuple[str, ...] = ()
    notes: tuple[str, ...] = field(default=())


def require_screen(viewer: str) -> None:
    """Check before a viewer is started that there is a screen.

    Raises:
        InputError: on Linux, no display is set.
    """
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError(f"there is no screen for {viewer} (DISPLAY is not set); write a file: --save FILE.rrd")


def rgb(colour: str) -> Colours:
    """Return red, green, blue (3,) of `#rrggbb`."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=np.uint8)


def by_range(points: Floats) -> Colours:
    """Return colours (N, 3) of points (N, 3), metres, by the logarithm of their distance from the origin."""
    distance = np.log(np.maximum(np.linalg.norm(points, axis=1), 1e-3))
    share = (distance - distance.min(initial=np.inf)) / max(float(np.ptp(distance)) if len(distance) else 0.0, 1e-9)
    nodes = np.linspace(0.0, 1.0, len(RANGES))
    return np.column_stack([np.interp(share, nodes, channel) for channel in RANGES.T]).astype(np.uint8)


def by_label(labels: Sequence[int]) -> Colours:
    """Return colours (N, 3) of points by the edge that they were assigned to."""
    return np.array([rgb(colour(int(k))) for k in labels], dtype=np.uint8).reshape(-1, 3)


def outline(name: str, vertices: Floats, colour: str = INK, label: str = "", step: int | None = None) -> Lines:
    """Return a closed polygon.

    Args:
        name: place in the tree of what is shown.
        vertices: (n, 3) metres.
        colour: `#rrggbb`.
        label: beside it; "": none.
        step: number of the scan; None: all.
    """
    return Lines(name, (np.vstack([vertices, vertices[:1]]),), rgb(colour), label, step=step)


def axes(name: str, T: Floats, size: float = 0.3, label: str = "", step: int | None = None) -> Lines:
    """Return the axes of a frame: x orange, y green, z blue.

    Args:
        name: place in the tree of what is shown.
        T: (4, 4) the frame's pose, metres.
        size: of each axis, metres.
        label: beside it; "": none.
        step: number of the scan; None: all.
    """
    strips = tuple(np.array([T[:3, 3], T[:3, 3] + size * T[:3, k]]) for k in range(3))
    return Lines(name, strips, np.array([[213, 94, 0], [0, 158, 115], [0, 114, 178]], dtype=np.uint8), label, step=step)


def ellipsoid(name: str, T: Floats, covariance: Floats, step: int | None = None) -> Lines:
    """Return the ellipsoid of three standard deviations of a pose's origin, as three circles.

    Args:
        name: place in the tree of what is shown.
        T: (4, 4) the pose, metres.
        covariance: (6, 6) of its right perturbation, rotation first, rad and metres.
        step: number of the scan; None: all.
    """
    R = T[:3, :3]
    values, vectors = np.linalg.eigh(R @ covariance[3:, 3:] @ R.T)
    radii = SIGMAS * np.sqrt(np.maximum(values, 0.0)) * vectors
    angle = np.linspace(0.0, 2 * np.pi, 49)[:, None]
    circles = tuple(
        T[:3, 3] + np.cos(angle) * radii[:, i] + np.sin(angle) * radii[:, j] for i, j in ((0, 1), (1, 2), (2, 0))
    )
    return Lines(name, circles, rgb(VERMILLION), radius=0.001, step=step)


def frustum(name: str, T_world_camera: Floats, camera: CameraIntrinsics, depth: float = 0.4) -> Lines:
    """Return the pyramid that a camera sees, without its distortion.

    Args:
        name: place in the tree of what is shown.
        T_world_camera: (4, 4) the camera's pose, metres.
        camera: its intrinsics.
        depth: of the pyramid, metres.
    """
    w, h = camera.width, camera.height
    pixels = np.array([[0.0, 0.0, 1.0], [w, 0.0, 1.0], [w, h, 1.0], [0.0, h, 1.0]])
    corners = depth * pixels @ np.linalg.inv(camera.K).T
    corners = apply(T_world_camera, corners)
    sides = tuple(np.array([T_world_camera[:3, 3], corner]) for corner in corners)
    return Lines(name, (np.vstack([corners, corners[:1]]), *sides), rgb(GREY), camera.name)
