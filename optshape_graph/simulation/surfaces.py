"""Surfaces that rays can meet, each with its own `cast`: planar polygons, floors and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.se3 import as_transform
from optshape_graph.simulation.rays import NO_MARGIN, EdgeMargin, Sphere, at
from optshape_graph.target import Target

Hits = tuple[Ints, Floats, Floats]
"""Rays that meet a surface: index of the ray (M,), range in metres (M,), cosine of incidence (M,)."""


class Surface(Protocol):
    """Anything that a ray can meet."""

    @property
    def reflectivity(self) -> float:
        """Share of the light that is reflected at normal incidence, 0 to 1."""

    @property
    def bounds(self) -> Sphere | None:
        """A sphere around it, world frame; None: it has no bounds."""

    def cast(self, origins: Floats, directions: Floats, margin: EdgeMargin) -> Hits:
        """Return the first hit of each ray that meets the surface.

        Args:
            origins: (N, 3) metres, world frame, or (1, 3) if all rays have the same.
            directions: (N, 3) unit vectors, world frame.
            margin: how far outside a polygon's edge a beam's axis may pass while the beam still returns. Other surfaces
                ignore it.
        """


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Value):
    """A planar convex polygon, seen from both sides: a target, or a wall.

    Attributes:
        shape: the polygon.
        T_world_patch: (4, 4).
        reflectivity: 0 to 1.
    """

    shape: Target
    T_world_patch: Floats
    reflectivity: float = 0.8

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_patch", as_transform(self.T_world_patch, "T_world_patch"))

    @property
    def bounds(self) -> Sphere:
        """See `Surface.bounds`."""
        return self.T_world_patch[:3, 3], self.shape.circumradius

    def cast(self, origins: Floats, directions: Floats, margin: EdgeMargin) -> Hits:
        """Intersect with the plane inside the polygon; see `Surface.cast`.

        A beam's angle beyond edge k is that between its axis and the plane through its origin and the edge; blooming
        subtracts the part that the ray's azimuth adds. If a beam returns though its axis is outside, its range is that
        of the polygon's plane on its axis.
        """
        R, t = self.T_world_patch[:3, :3], self.T_world_patch[:3, 3]
        near = towards_sphere(origins, directions, self.bounds, margin)
        o, d = (at(origins, near) - t) @ R, directions[near] @ R
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = -o[:, 0] / d[:, 0]
        vertices = self.shape.vertices
        outward = np.cross(np.roll(vertices, -1, axis=0) - vertices, vertices - o[:, None, :])
        outward *= -np.sign(o[:, None, :1]) / np.linalg.norm(outward, axis=-1, keepdims=True)
        sin_beyond = np.einsum("mkj,mj->mk", outward, d)
        if margin.further:
            sin_beyond -= margin.further * np.abs(np.einsum("mkj,mj->mk", outward, np.cross(margin.axis @ R, d)))
        sin_beyond = sin_beyond.max(axis=1)
        ahead = np.flatnonzero(np.isfinite(ranges) & (ranges > 0))
        hit = ahead[sin_beyond[ahead] <= np.sin(margin.angle(near[ahead], ranges[ahead]))]
        return near[hit], ranges[hit], np.abs(d[hit, 0])


@dataclass(frozen=True, eq=False, repr=False)
class Floor(Value):
    """The plane z = height of the world, without bounds.

    Attributes:
        height: metres.
        reflectivity: 0 to 1.
    """

    height: float
    reflectivity: float = 0.3

    @property
    def bounds(self) -> None:
        """See `Surface.bounds`."""
        return None

    def cast(self, origins: Floats, directions: Floats, margin: EdgeMargin) -> Hits:
        """See `Surface.cast`."""
        drop, slope = self.height - origins[:, 2], directions[:, 2]
        index = np.flatnonzero(slope * drop > 0)
        return index, at(drop, index) / slope[index], np.abs(slope[index])


@dataclass(frozen=True, eq=False, repr=False)
class Box(Value):
    """A box; from inside, a room.

    Attributes:
        size: (3,) extents along its x, y and z, metres.
        T_world_box: (4, 4), of its centre.
        reflectivity: 0 to 1.

    Raises:
        InputError: extents that are not three positive numbers.
    """

    size: Floats
    T_world_box: Floats
    reflectivity: float = 0.5

    def __post_init__(self) -> None:
        size = frozen(self.size)
        if size.shape != (3,) or not (np.isfinite(size).all() and (size > 0).all()):
            raise InputError(f"box: expected three extents > 0, found {size.tolist()}")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "T_world_box", as_transform(self.T_world_box, "T_world_box"))

    @property
    def bounds(self) -> Sphere:
        """See `Surface.bounds`."""
        return self.T_world_box[:3, 3], float(np.linalg.norm(self.size) / 2)

    def cast(self, origins: Floats, directions: Floats, margin: EdgeMargin) -> Hits:
        """See `Surface.cast`: a ray enters at the last entry of the three slabs, if that is before the first exit."""
        R, t, half = self.T_world_box[:3, :3], self.T_world_box[:3, 3], self.size / 2
        near = towards_sphere(origins, directions, self.bounds)
        o, d = (at(origins, near) - t) @ R, directions[near] @ R
        with np.errstate(divide="ignore", invalid="ignore"):
            to_centre, half_length = -o / d, half / np.abs(d)
            entry, exit_ = to_centre - half_length, to_centre + half_length
        # A ray along a slab (d = 0) is always in it, or never.
        never = np.where(np.abs(o) <= half, -np.inf, np.inf)
        entry, exit_ = np.where(d == 0, never, entry), np.where(d == 0, -never, exit_)
        first, last = entry.max(axis=1), exit_.min(axis=1)
        hit = np.flatnonzero((first <= last) & (last > 0))
        outside = first[hit] > 0
        face = np.where(outside, entry[hit].argmax(axis=1), exit_[hit].argmin(axis=1))
        return near[hit], np.where(outside, first[hit], last[hit]), np.abs(d[hit, face])


def towards_sphere(origins: Floats, directions: Floats, sphere: Sphere, margin: EdgeMargin = NO_MARGIN) -> Ints:
    """Return the rays that pass through a sphere in front of their origin, or miss its content by less than a margin.

    Args:
        origins: (N, 3) metres, world frame, or (1, 3) if all rays have the same.
        directions: (N, 3) unit vectors, world frame.
        sphere: centre and radius, metres, world frame.
        margin: how far outside a beam's axis may pass.

    Returns:
        (K,) their indices.
    """
    to_centre = sphere[0] - origins
    along = (directions * to_centre).sum(axis=1) if len(origins) > 1 else directions @ to_centre[0]
    distance = np.linalg.norm(to_centre, axis=1)
    reach = margin.widen(sphere, distance)
    least = np.where(distance > reach, np.sqrt(np.maximum(distance**2 - reach**2, 0.0)), -np.inf)
    return np.flatnonzero(along >= least)
