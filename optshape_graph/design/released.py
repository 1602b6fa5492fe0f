"""The cost that the authors' released optimiser minimises, for the reproduction of its published values.

It differs from the paper's score: each ring is weighted by the height over the width of the two edges that it crosses,
taken together; the squares of the chords are added; cells are summed instead of taking the worst; and the smallest
value over motions is taken from a 25 x 25 grid of the sphere.
"""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.polygons import rotated
from optshape_graph.design.rings import Rings
from optshape_graph.design.sensitivity import MU, edge_crossings

GRID = 25


def released_cost(polygon: Floats, turns: Floats, rings: Rings, mu: float = MU) -> float:
    """Return the released cost, negative; smaller is better.

    Args:
        polygon: (n, 2) vertices, with the centre of the rotation at the origin. The published values are for unit area
            and rotation about the crossing of the diagonals.
        turns: (R,) orientations, rad.
        rings: the rings.
        mu: weight of the squared chords.
    """
    polygons = rotated(polygon, turns)
    low, high = polygons[..., 1].min(axis=-1), polygons[..., 1].max(axis=-1)
    crossings = edge_crossings(polygons, rings.heights(low, high))
    ends = np.stack([polygons, np.roll(polygons, -1, axis=-2)], axis=-2)
    low_high = np.stack([ends.min(axis=-2), ends.max(axis=-2)])
    x, y = (np.moveaxis(low_high[..., axis], -1, 1)[:, None, ..., None] for axis in (0, 1))
    hit = crossings.hit
    width, height = (np.where(hit, v[1], -np.inf).max(axis=1) - np.where(hit, v[0], np.inf).min(axis=1) for v in (x, y))
    lit = hit.any(axis=1)
    ratio = np.divide(height, width, out=np.zeros(lit.shape), where=lit)
    moved = crossings.motion(sphere_grid())
    energies = (ratio[..., None] * (moved**2).sum(axis=1)).sum(axis=0)
    return -float((energies.min(axis=-1) + mu * (crossings.chords**2).sum(axis=0)).sum())


def sphere_grid(size: int = GRID) -> Floats:
    """(size^2, 3) unit motions (omega, u, v): `size` polar angles by `size` azimuths, poles and seam included."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, size), np.linspace(0, 2 * np.pi, size), indexing="ij")
    motions = [np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)]
    return np.stack(motions, axis=-1).reshape(-1, 3)
