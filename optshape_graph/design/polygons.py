"""Batches of polygons: areas, centroids, convexity, rotations. A batch is (..., n, 2)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Bools, Floats


def areas(polygons: Floats) -> NDArray[np.float64]:
    """Return the signed areas (...,), in the square of the polygons' unit, positive if counter-clockwise."""
    return np.asarray(0.5 * _crosses(polygons).sum(axis=-1))


def centroids(polygons: Floats) -> Floats:
    """Return the centroids (..., 2) of the areas, in the polygons' unit."""
    crosses = _crosses(polygons)
    sums = polygons + np.roll(polygons, -1, axis=-2)
    return np.asarray((sums * crosses[..., None]).sum(axis=-2) / (3.0 * crosses.sum(axis=-1)[..., None]))


def centred(polygons: Floats) -> Floats:
    """Return the polygons (..., n, 2), in their unit, with the centroids of their areas at the origin."""
    return np.asarray(polygons - centroids(polygons)[..., None, :])


def edges(polygons: Floats) -> Floats:
    """Return the edge vectors (..., n, 2), in the polygons' unit; edge k runs from vertex k to vertex k + 1."""
    return np.roll(polygons, -1, axis=-2) - polygons


def turns(polygons: Floats) -> Floats:
    """Return the exterior angles (..., n), rad in (-pi, pi]: at vertex k, from edge k - 1 to edge k."""
    after = edges(polygons)
    before = np.roll(after, 1, axis=-2)
    cross = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
    return np.asarray(np.arctan2(cross, (before * after).sum(axis=-1)))


def strictly_convex(polygons: Floats) -> Bools:
    """Return (...,) whether each polygon turns left at every vertex, once round, and has no edge of length zero."""
    angles = turns(polygons)
    lengths = np.linalg.norm(edges(polygons), axis=-1)
    sound = lengths.min(axis=-1) > 1e-9 * lengths.max(axis=-1)
    return np.asarray(sound & (angles.min(axis=-1) > 1e-9) & (angles.sum(axis=-1) < 3 * np.pi))


def rotated(polygons: Floats, angles: Floats) -> Floats:
    """Return the polygons (..., R, n, 2) turned counter-clockwise about the origin by angles (..., R), rad."""
    c, s = np.cos(angles), np.sin(angles)
    R = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)
    return np.asarray(polygons[..., None, :, :] @ np.swapaxes(R, -1, -2))


def _crosses(polygons: Floats) -> NDArray[np.float64]:
    following = np.roll(polygons, -1, axis=-2)
    return np.asarray(polygons[..., 0] * following[..., 1] - polygons[..., 1] * following[..., 0])
