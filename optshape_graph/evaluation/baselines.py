"""Other methods for a board's pose: edge lines by RANSAC, and ICP to the template. For comparison only.

Both take the returns of one target, as `estimate_pose` does, and know its template and on which side the sensor is.
Neither gives a covariance, a certificate or a warning of ambiguity.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import extract_edge_points
from optshape_graph.errors import EstimationError
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse, transform
from optshape_graph.target import Target

INLIER = 0.03
"""Largest distance of an edge point from its line, metres: a few centimetres, as in common tools."""

DRAWS = 300
"""Pairs of edge points that are drawn for each line."""

ITERATIONS = 60
"""Of ICP."""

SPACING = 0.01
"""Spacing of the outline's points for ICP, metres."""


def ransac_corners(scan: Scan, target: Target, seed: int = 0) -> Floats:
    """Fit a line to each edge by RANSAC, intersect neighbours in corners, and fit the template to the corners.

    This is how common calibration tools find boards in LiDAR scans: one line after the other, each from the edge points
    that the lines before have left.

    Args:
        scan: returns of the target; with rings.
        target: the template.
        seed: of the draws.

    Returns:
        (4, 4) T_lidar_target.

    Raises:
        EstimationError: too few edge points for as many lines as the target has edges, or two of them are parallel.
    """
    T_lidar_plane = _plane(scan.points)
    edges = apply(inverse(T_lidar_plane), extract_edge_points(scan).points)[:, 1:]
    rng, left, lines = np.random.default_rng(seed), edges, []
    for _ in range(len(target)):
        if len(left) < 2:
            raise EstimationError(f"{scan.name}: {len(edges)} edge points make no {len(target)} lines")
        inliers = _line_inliers(left, rng)
        centre = left[inliers].mean(axis=0)
        along = np.linalg.svd(left[inliers] - centre)[2][0]
        lines.append((np.array([along[1], -along[0]]), centre))
        left = left[~inliers]
    # In the order of the outline: by the direction of each line from the middle.
    middle = edges.mean(axis=0)
    outward = [n * (np.sign(n @ (c - middle)) or 1.0) for n, c in lines]
    order = np.argsort([np.arctan2(n[1], n[0]) for n in outward])
    corners = []
    for a, b in pairwise([*order, order[0]]):
        A = np.array([lines[a][0], lines[b][0]])
        if abs(np.linalg.det(A)) < 0.05:
            raise EstimationError(f"{scan.name}: two lines are parallel: no corner")
        corners.append(np.linalg.solve(A, [lines[k][0] @ lines[k][1] for k in (a, b)]))
    return np.asarray(T_lidar_plane @ _best_turn(np.array(corners), target))


def icp_to_template(scan: Scan, target: Target) -> Floats:
    """Register the returns to the template by ICP, from the centroid and the principal axes.

    Ring ends are matched to the nearest points of the outline, in the plane of all returns. The principal axes leave a
    half turn open; the one with the smaller residual counts.

    Args:
        scan: returns of the target; with rings.
        target: the template.

    Returns:
        (4, 4) T_lidar_target.

    Raises:
        EstimationError: fewer than three edge points.
    """
    T_lidar_plane = _plane(scan.points)
    T_plane_lidar = inverse(T_lidar_plane)
    ends = apply(T_plane_lidar, extract_edge_points(scan).points)[:, 1:]
    inside = apply(T_plane_lidar, scan.points)[:, 1:]
    if len(ends) < 3:
        raise EstimationError(f"{scan.name}: {len(ends)} edge points determine no pose")
    outline = _outline(target)
    tree = cKDTree(outline)
    start = _axis(inside) - _axis(_filled(target))
    best, least = np.eye(4), np.inf
    for turn in (start, start + np.pi):
        c, s = np.cos(turn), np.sin(turn)
        R, t = (
            np.array([[c, -s], [s, c]]),
            inside.mean(axis=0) - np.array([[c, -s], [s, c]]) @ _filled(target).mean(axis=0),
        )
        for _ in range(ITERATIONS):
            matched = outline[tree.query((ends - t) @ R)[1]]
            R, t = _rigid(matched, ends)
        residual = float(np.mean(tree.query((ends - t) @ R)[0] ** 2))
        if residual < least:
            best, least = _in_plane(R, t), residual
    return np.asarray(T_lidar_plane @ best)


def _plane(points: Floats) -> Floats:
    """Return T_lidar_plane (4, 4) of the returns' plane, x being its normal away from the sensor."""
    centre = points.mean(axis=0)
    normal = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, 0]
    normal *= np.sign(normal @ centre) or 1.0
    y = np.cross([0.0, 0.0, 1.0], normal)
    y /= np.linalg.norm(y)
    return transform(np.column_stack([normal, y, np.cross(normal, y)]), centre)


def _line_inliers(points: Floats, rng: np.random.Generator) -> np.ndarray:
    """Return (N,) which points lie near that line, through two drawn points, that has the most points near it."""
    best: np.ndarray = np.zeros(len(points), dtype=bool)
    for _ in range(DRAWS):
        a, b = points[rng.choice(len(points), 2, replace=False)]
        along = b - a
        length = float(np.linalg.norm(along))
        if length < INLIER:
            continue
        near = np.abs((points - a) @ np.array([along[1], -along[0]])) / length < INLIER
        if near.sum() > best.sum():
            best = near
    if best.sum() < 2:
        best[:2] = True
    return best


def _best_turn(corners: Floats, target: Target) -> Floats:
    """Return the fit (4, 4) of the template to corners that are in order, but with an unknown first one."""
    fits = [_rigid(target.polygon, np.roll(corners, -shift, axis=0)) for shift in range(len(target))]
    misfits = [
        float(np.square(target.polygon @ R.T + t - np.roll(corners, -shift, axis=0)).sum())
        for shift, (R, t) in enumerate(fits)
    ]
    return _in_plane(*fits[int(np.argmin(misfits))])


def _rigid(source: Floats, image: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares rotation (2, 2) and translation (2,) that take `source` to `image` (n, 2)."""
    a, b = source.mean(axis=0), image.mean(axis=0)
    U, _, Vt = np.linalg.svd((image - b).T @ (source - a))
    R = U @ np.diag([1.0, np.linalg.det(U @ Vt)]) @ Vt
    return R, b - R @ a


def _in_plane(R: Floats, t: Floats) -> Floats:
    T = np.eye(4)
    T[1:3, 1:3], T[1:3, 3] = R, t
    return T


def _outline(target: Target) -> Floats:
    """Return points of the outline, `SPACING` apart."""
    ends = np.roll(target.polygon, -1, axis=0)
    counts: Ints = np.ceil(target.edge_lengths / SPACING).astype(np.int64)
    return np.vstack([
        a + np.linspace(0.0, 1.0, count, endpoint=False)[:, None] * (b - a)
        for a, b, count in zip(target.polygon, ends, counts, strict=True)
    ])  # fmt: skip


def _filled(target: Target) -> Floats:
    """Return points of the whole face on a grid."""
    (y0, z0), (y1, z1) = target.polygon.min(axis=0), target.polygon.max(axis=0)
    grid = np.stack(np.meshgrid(np.linspace(y0, y1, 60), np.linspace(z0, z1, 60)), axis=-1).reshape(-1, 2)
    return np.asarray(grid[target.contains(grid)])


def _axis(points: Floats) -> float:
    """Return the direction of the longest extent of points (N, 2), rad."""
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    return float(np.arctan2(along[1], along[0]))
