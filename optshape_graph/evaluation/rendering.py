"""Images of targets with known truth, rendered as a camera sees them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from optshape_graph._arrays import Floats
from optshape_graph.calibration.images.projection import normalised, project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.image_files import opencv
from optshape_graph.se3 import apply
from optshape_graph.target import Target

SAMPLES = 2
"""Samples per pixel and axis."""


def render_target(
    target: Target, camera: CameraIntrinsics, T_camera_target: Floats, rng: np.random.Generator | int = 0
) -> np.ndarray:
    """Render a white target, with its chessboard or tags, before a dark, uneven background.

    Args:
        target: with a pattern, or without one.
        camera: its intrinsics and image size.
        T_camera_target: (4, 4) pose of the target in the camera's frame.
        rng: generator or seed, of the background and the noise.

    Returns:
        (h, w) grey image, 8 bits.

    Raises:
        InputError: a vertex is not ahead of the camera, or the target is not in its image.
        MissingExtraError: OpenCV is absent.
    """
    cv2, rng, T = opencv(), np.random.default_rng(rng), T_camera_target
    if (apply(T, target.vertices)[:, 2] <= 0).any():
        raise InputError(f"target '{target.name}' is not ahead of camera '{camera.name}'")
    h, w = camera.height, camera.width
    corners = _vertex_pixels(target, camera, T)
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 5, 0)
    high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 5, [w, h])
    if (low >= high).any():
        raise InputError(f"target '{target.name}' is not in the image of camera '{camera.name}'")
    image = cv2.GaussianBlur(rng.uniform(20, 90, (h, w)).astype(np.float32), (0, 0), 6.0)
    inner = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    u = (np.arange(low[0], high[0])[:, None] + inner).ravel()
    v = (np.arange(low[1], high[1])[:, None] + inner).ravel()
    rays = np.column_stack([_rays(camera, u, v), np.ones(len(u) * len(v))])
    normal = T[:3, 0]
    points = rays * ((normal @ T[:3, 3]) / (rays @ normal))[:, None]
    yz = ((points - T[:3, 3]) @ T[:3, :3])[:, 1:]
    shade = np.where(target.contains(yz), _pattern(target, yz), np.nan).reshape(len(v), len(u))
    background = np.kron(image[low[1] : high[1], low[0] : high[0]], np.ones((SAMPLES, SAMPLES)))
    fine = np.where(np.isnan(shade), background, shade)
    patch = fine.reshape(high[1] - low[1], SAMPLES, high[0] - low[0], SAMPLES).mean(axis=(1, 3))
    image[low[1] : high[1], low[0] : high[0]] = patch
    return np.asarray(np.clip(np.round(image + rng.normal(0, 1.0, image.shape)), 0, 255).astype(np.uint8))


def _rays(camera: CameraIntrinsics, u: Floats, v: Floats) -> Floats:
    """Return the rays of a fine grid of pixels, interpolated between every fourth pixel, accurate to 0.002 px."""
    nodes_u, nodes_v = (np.arange(x[0] - 4, x[-1] + 8, 4.0) for x in (u, v))
    nodes = normalised(camera, np.stack(np.meshgrid(nodes_u, nodes_v), axis=-1).reshape(-1, 2))
    shape = (len(nodes_v), len(nodes_u), 2)
    where_u, where_v = np.meshgrid((u - nodes_u[0]) / 4, (v - nodes_v[0]) / 4)
    return np.stack(
        [map_coordinates(nodes.reshape(shape)[..., k], [where_v, where_u], order=1).ravel() for k in (0, 1)],
        axis=-1,
    )


def _vertex_pixels(target: Target, camera: CameraIntrinsics, T: Floats) -> Floats:
    return project(camera, apply(T, target.vertices))


def _pattern(target: Target, yz: Floats) -> Floats:
    shade = np.full(len(yz), 220.0)
    if (board := target.chessboard) is not None:
        n_z, n_y = board.inner_corners
        i = np.floor((yz[:, 0] - board.offset[0]) / board.square + (n_y + 1) / 2)
        j = np.floor((yz[:, 1] - board.offset[1]) / board.square + (n_z + 1) / 2)
        inside = (i >= 0) & (i <= n_y) & (j >= 0) & (j <= n_z)
        shade[inside & ((i + j) % 2 == 0)] = 15.0
    if (tags := target.tags) is not None:
        cv2 = opencv()
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{tags.dictionary}"))
        c, s = np.cos(tags.turn), np.sin(tags.turn)
        for number, centre in tags.centres.items():
            print_ = cv2.aruco.generateImageMarker(dictionary, number, 200)
            # Upright, seen from the -x side: columns run towards -y, rows towards -z.
            own = (yz - centre) @ np.array([[c, -s], [s, c]])
            column = np.floor((0.5 - own[:, 0] / tags.size) * 200).astype(int)
            row = np.floor((0.5 - own[:, 1] / tags.size) * 200).astype(int)
            on = (column >= 0) & (column < 200) & (row >= 0) & (row < 200)
            shade[on] = np.where(print_[row[on], column[on]] > 0, 220.0, 15.0)
    return shade
