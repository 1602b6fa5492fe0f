"""The outline of an unpatterned target: its edges tracked from a rough start.

Points along each edge of the projected polygon look for the strongest step of brightness across it (Harris and
Stennett, BMVC 1990, RAPiD); the pose is fitted to the distances across the edges with a robust weight, and the
search narrows as it converges.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.calibration.images.image_points import ImagePoints, turn_about
from optshape_graph.calibration.images.planar_pose import refine_pose
from optshape_graph.calibration.images.projection import project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import EstimationError
from optshape_graph.io.image_files import opencv
from optshape_graph.se3 import apply
from optshape_graph.target import Target

POINTS_PER_EDGE = 40
EDGE_SIGMA_PX = 0.5
"""Standard deviation across an edge of one point of it."""

ALONG_SIGMA_PX = 1e3
"""Along an edge its points say nothing; a finite weight keeps the information regular."""

NARROWING = (1.0, 0.6, 0.35, 0.2, 0.1, 0.1, 0.1)
"""Share of the search distance in successive rounds."""


def fit_outline(
    image: np.ndarray, target: Target, camera: CameraIntrinsics, T_camera_target: Floats, search_px: float = 40.0
) -> ImagePoints:
    """Find the points of a target's edges in an image.

    Args:
        image: (h, w) grey image, 8 bit.
        target: the known polygon.
        camera: the intrinsics.
        T_camera_target: (4, 4) rough pose: the projected edges lie within `search_px` of the true ones.
        search_px: how far to look on either side of an edge.

    Returns:
        Points of the edges, weighing across them, with the pixels where the image has them.

    Raises:
        EstimationError: too little of the outline is visible, or no pose fits what is.
    """
    cv2 = opencv()
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    points, edge = outline_points(target)
    T = T_camera_target
    for share in NARROWING:
        reach = max(share * search_px, 4.0)
        pixels, normals = _projected_edges(camera, T, points, edge, target)
        shift, visible = _strongest_step(smooth, pixels, normals, reach)
        visible &= _consistent(shift, visible, edge, reach)
        _check_visible(visible, edge, len(target))
        fitted = _edge_points(target, points[visible], (pixels + shift[:, None] * normals)[visible], normals[visible])
        T = refine_pose(fitted, camera, T).T_camera_target
    residual = np.abs(np.einsum("ni,ni->n", fitted.pixels - project(camera, apply(T, fitted.points)), normals[visible]))
    good = residual < 6 * EDGE_SIGMA_PX
    if good.mean() < 0.5:
        raise EstimationError(f"the outline fits only {good.mean():.0%} of the edge points found in the image")
    rows = np.flatnonzero(visible)[good]
    _check_visible(np.isin(np.arange(len(points)), rows), edge, len(target))
    return _edge_points(target, fitted.points[good], fitted.pixels[good], normals[rows])


def edge_shifts(
    image: np.ndarray, target: Target, camera: CameraIntrinsics, T_camera_target: Floats, reach_m: float
) -> Floats:
    """Return by how much each edge (n,) of a target lies further out in an image than its pose says, metres.

    Args:
        image: (h, w) grey image, 8 bit.
        target: the polygon.
        camera: the intrinsics.
        T_camera_target: (4, 4) its pose, known from its pattern.
        reach_m: how far to look on either side of an edge, metres.

    Returns:
        (n,) metres, medians over the points of each edge; NaN where too little of it is seen.
    """
    cv2 = opencv()
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    points, edge = outline_points(target)
    pixels, normals = _projected_edges(camera, T_camera_target, points, edge, target)
    outward = np.column_stack([np.zeros(len(target)), target.normals])[edge]
    further = project(camera, apply(T_camera_target, points + 1e-3 * outward))
    px_per_m = np.einsum("ni,ni->n", further - pixels, normals) / 1e-3
    reach = max(float(np.median(px_per_m)) * reach_m, 4.0)
    shift, visible = _strongest_step(smooth, pixels, normals, reach)
    visible &= _consistent(shift, visible, edge, reach)
    shifts = [(shift / px_per_m)[visible & (edge == k)] for k in range(len(target))]
    return np.array([np.median(each) if len(each) >= POINTS_PER_EDGE // 4 else np.nan for each in shifts])


def outline_points(target: Target) -> tuple[Floats, np.ndarray]:
    """Return points (n * POINTS_PER_EDGE, 3) along the target's edges, away from the vertices, and their edges."""
    share = np.linspace(0.05, 0.95, POINTS_PER_EDGE)[None, :, None]
    start, end = target.vertices[:, None], np.roll(target.vertices, -1, axis=0)[:, None]
    return ((1 - share) * start + share * end).reshape(-1, 3), np.repeat(np.arange(len(target)), POINTS_PER_EDGE)


def _edge_points(target: Target, points: Floats, pixels: Floats, normals: Floats) -> ImagePoints:
    tangents = np.column_stack([-normals[:, 1], normals[:, 0]])
    W = np.stack([normals / EDGE_SIGMA_PX, tangents / ALONG_SIGMA_PX], axis=1)
    return ImagePoints(points, pixels, W, tuple(turn_about((0.0, 0.0), angle) for angle in target.symmetries))


def _projected_edges(
    camera: CameraIntrinsics, T: Floats, points: Floats, edge: np.ndarray, target: Target
) -> tuple[Floats, Floats]:
    """Return the pixels (N, 2) of points on the edges, and the unit normals of the projected edges, outwards."""
    outward = np.column_stack([np.zeros(len(target)), target.normals])[edge]
    along = np.column_stack([outward[:, 0], -outward[:, 2], outward[:, 1]]) * 1e-3
    pixels = project(camera, apply(T, points))
    tangent = project(camera, apply(T, points + along)) - pixels
    # (y, z) turns the way (u, v) does on the side that the camera sees, so the outward normal is the tangent,
    # which runs counter-clockwise, turned back by a quarter.
    normals = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    return pixels, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _strongest_step(image: Floats, pixels: Floats, normals: Floats, reach: float) -> tuple[Floats, Bools]:
    """Return the distance along each normal of the steepest change of brightness, and where there is a clear one."""
    cv2 = opencv()
    offsets = np.arange(-np.ceil(reach) - 1, np.ceil(reach) + 2)
    where = pixels[:, None] + offsets[None, :, None] * normals[:, None]
    profile = cv2.remap(
        image, where[..., 0].astype(np.float32), where[..., 1].astype(np.float32), cv2.INTER_LINEAR
    ).astype(float)
    slope = np.abs(profile[:, 2:] - profile[:, :-2]) / 2
    # Near the middle is likelier: the start is rough, but it is a start.
    peak = (slope * (1 - 0.5 * (offsets[1:-1] / offsets[-1]) ** 2))[:, 1:-1].argmax(axis=1) + 1
    row = np.arange(len(pixels))
    before, at, after = (slope[row, peak + k] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    sub = np.where(curvature < 0, 0.5 * (before - after) / np.minimum(curvature, -1e-9), 0.0).clip(-0.5, 0.5)
    height, width = image.shape
    inside = ((where >= 0) & (where <= [width - 1, height - 1])).all(axis=(1, 2))
    return offsets[1:-1][peak] + sub, inside & (at > 3.0)


def _consistent(shift: Floats, visible: Bools, edge: np.ndarray, reach: float) -> Bools:
    """Keep, edge by edge, the shifts near a line along the edge through their bulk: the rest saw something else."""
    keep = np.zeros_like(visible)
    for k in np.unique(edge[visible]):
        rows = np.flatnonzero(visible & (edge == k))
        s, x = shift[rows], np.linspace(-1, 1, POINTS_PER_EDGE)[rows - POINTS_PER_EDGE * k]
        # The line through two points with the most others near it: all pairs of a few dozen are few.
        i, j = np.triu_indices(len(rows), 1)
        slope = (s[j] - s[i]) / (x[j] - x[i])
        off = np.abs(s - s[i][:, None] - slope[:, None] * (x - x[i][:, None]))
        near = off < max(0.08 * reach, 1.5)
        if len(i):
            keep[rows[near[near.sum(axis=1).argmax()]]] = True
    return keep


def _check_visible(visible: Bools, edge: np.ndarray, n_edges: int) -> None:
    enough = [k for k in range(n_edges) if (visible & (edge == k)).sum() >= POINTS_PER_EDGE // 4]
    if len(enough) < min(n_edges, 4) and len(enough) < 3:
        raise EstimationError(f"{len(enough)} of {n_edges} edges of the target are visible in the image; 3 are needed")
