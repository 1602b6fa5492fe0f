"""Where the rings of a spinning LiDAR cut polygons: each ring of a convex one is a chord."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.se3 import cross


def sight_planes(corners: Floats) -> Floats:
    """Return outward unit normals (S, n, 3) of the planes through sensor and edges of polygons (S, n, 3), metres."""
    normal = cross(corners, np.roll(corners, -1, axis=1))
    inwards = np.sign(np.vecdot(normal, corners.mean(axis=1, keepdims=True)))
    return np.asarray(normal * (-inwards / np.sqrt(np.vecdot(normal, normal)))[..., None])


def chords(
    normals: Floats, elevations: Floats, reference_azimuth: Floats | float, margin: Floats | float = 0.0
) -> tuple[Floats, Floats]:
    """Return the azimuths between which rings are inside polygons, or outside by at most an angle.

    A ray of azimuth a and elevation e is outside edge k by the angle asin(m . d): at most `margin` where
    m_x cos a + m_y sin a <= (sin margin - m_z sin e) / cos e, an arc. The chord is where all arcs meet.

    Args:
        normals: (S, n, 3), see `sight_planes`.
        elevations: (R,) rad, or (S, 1, R) of each.
        reference_azimuth: some azimuth of the target, rad, or one of each (S, 1).
        margin: (S,), or one for all, rad.

    Returns:
        Right and left end (S, R), rad, relative to the reference; right above left where the ring misses.
    """
    across = np.hypot(normals[..., 0], normals[..., 1])
    centre = np.angle((-normals[..., 0] - 1j * normals[..., 1]) * np.exp(-1j * reference_azimuth))
    level = np.sin(np.atleast_1d(margin))[:, None, None] - normals[..., 2, None] * np.sin(elevations)
    cosine = level / (np.maximum(across, 1e-300)[..., None] * np.cos(elevations))
    half = np.where(cosine < -1, -np.inf, np.pi - np.arccos(np.clip(cosine, -1, 1)))
    return (centre[..., None] - half).max(axis=1), (centre[..., None] + half).min(axis=1)
