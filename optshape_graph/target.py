"""The target: a planar convex polygon, its edges and its symmetry group.

Target frame: plane x = 0, origin at the vertex mean, vertices counter-clockwise seen from +x
(y right, z up). The sensor is on the -x side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, Ints, Value, frozen, shortened
from optshape_graph.errors import InputError
from optshape_graph.se3 import rotation, transform

LARGEST_EXTENT_M = 50.0
"""A target that is wider must have been given in millimetres."""

MOST_VERTICES = 1000
"""Vertices that a target has at most; finding its symmetries takes time with their square."""

SYMMETRY_TOLERANCE = 5e-3
"""Vertex mismatch, relative to the circumradius, under which a rotation counts as a symmetry."""

FLATNESS = 1e-3
"""Standard deviation of a sawn board's points from its plane, and of its edges from straight lines, metres."""


@dataclass(frozen=True)
class Chessboard:
    """A chessboard printed on a target.

    Attributes:
        inner_corners: number of inner corners along the target's z and y axes.
        square: side of a square, metres.
        offset: (y, z) of the pattern's centre in the target frame, metres.
    """

    inner_corners: tuple[int, int]
    square: float
    offset: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False, repr=False)
class Tags(Value):
    """Square fiducial tags printed on a target.

    Attributes:
        dictionary: OpenCV's name of the predefined dictionary, as `APRILTAG_36h11` or `4X4_50`.
        size: side of a tag's black square, metres.
        centres: tag number to the (y, z) of its centre in the target frame, metres.
        turn: angle about +x, rad, by which all tags are turned; without it their top edge is towards +z.
    """

    dictionary: str
    size: float
    centres: dict[int, tuple[float, float]]
    turn: float = 0.0

    def corners(self, number: int) -> Floats:
        """Return the corners (4, 2) of one tag, (y, z), metres, in OpenCV's order.

        They run clockwise from the top left, as seen from the -x side, where y points left.
        """
        upright = 0.5 * self.size * np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(upright @ np.array([[c, s], [-s, c]]) + np.array(self.centres[number]))


@dataclass(frozen=True, eq=False, repr=False)
class Target(Value):
    """A planar convex polygon with n >= 3 vertices.

    Edge k runs from vertex k to vertex k + 1 (mod n).

    Attributes:
        vertices: (n, 3) metres, target frame, x = 0, counter-clockwise seen from +x, mean at the origin.
        name: what results call it.
        chessboard: the pattern printed on it, if any.
        tags: the tags printed on it, if any.

    Raises:
        InputError: fewer than three vertices or more than `MOST_VERTICES`; vertices that are not finite, not planar,
            not centred, not strictly convex or clockwise; or a size that no target in metres has.
    """

    vertices: Floats
    name: str = "target"
    chessboard: Chessboard | None = None
    tags: Tags | None = None

    def __post_init__(self) -> None:
        vertices = frozen(self.vertices)
        _check_vertices(vertices, self.name)
        object.__setattr__(self, "vertices", vertices)

    @classmethod
    def from_polygon(cls, yz: ArrayLike, name: str = "target") -> Target:
        """Make a target of a polygon drawn anywhere in its plane: the vertex mean becomes the origin.

        Args:
            yz: (n, 2) vertices, metres, y right and z up seen from +x, counter-clockwise.
            name: what results call it.

        Raises:
            InputError: another shape of array, or a polygon that is not a target (see the class).
        """
        polygon = np.asarray(yz, dtype=float)
        if polygon.ndim != 2 or polygon.shape[1] != 2:
            raise InputError(f"target '{name}': expected (n, 2) vertices, found shape {polygon.shape}")
        centred = polygon - polygon.mean(axis=0)
        return cls(np.column_stack([np.zeros(len(centred)), centred]), name)

    def __len__(self) -> int:
        return len(self.vertices)

    def __repr__(self) -> str:
        width, height = np.ptp(self.polygon, axis=0)
        return shortened(f"Target('{self.name}', {len(self)} vertices, {width:.3g} x {height:.3g} m)")

    @cached_property
    def polygon(self) -> Floats:
        """(n, 2) vertices in the plane, (y, z), metres."""
        return frozen(self.vertices[:, 1:])

    @cached_property
    def normals(self) -> Floats:
        """(n, 2) outward unit normals of the edges, in the plane."""
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        outward = np.column_stack([edges[:, 1], -edges[:, 0]])
        return frozen(outward / np.linalg.norm(edges, axis=1, keepdims=True))

    @cached_property
    def offsets(self) -> Floats:
        """(n,) edge offsets c_k, metres: a point of edge k satisfies normals[k] . (y, z) = c_k."""
        return frozen(np.einsum("ij,ij->i", self.normals, self.polygon))

    @cached_property
    def edge_lengths(self) -> Floats:
        """(n,) edge lengths, metres."""
        return frozen(np.linalg.norm(np.roll(self.polygon, -1, axis=0) - self.polygon, axis=1))

    @cached_property
    def area(self) -> float:
        """Area, square metres."""
        return _signed_area(self.polygon)

    @property
    def gyration(self) -> float:
        """Radius of gyration of a disc of the target's area, metres: sqrt(area / 2 pi)."""
        return float(np.sqrt(self.area / (2 * np.pi)))

    @cached_property
    def circumradius(self) -> float:
        """Largest distance of a vertex from the origin, metres."""
        return float(np.linalg.norm(self.polygon, axis=1).max())

    @cached_property
    def symmetries(self) -> tuple[float, ...]:
        """Angles about +x, rad, by which the target can be turned onto itself; the first is 0.

        The sensor is on the -x side always, so mirror images through the plane do not count.
        """
        n, polygon = len(self), self.polygon[:, 0] + 1j * self.polygon[:, 1]
        angles = [0.0]
        for shift in range(1, n):
            turned = np.roll(polygon, -shift)
            angle = float(np.angle(np.vdot(polygon, turned)))
            mismatch = np.abs(polygon * np.exp(1j * angle) - turned).max()
            if mismatch <= SYMMETRY_TOLERANCE * self.circumradius:
                angles.append(angle % (2 * np.pi))
        return tuple(sorted(angles))

    @cached_property
    def symmetry_transforms(self) -> Floats:
        """(S, 4, 4) of `symmetries`, the identity first; T_lidar_target S is the same placement with other names."""
        return frozen(transform(rotation([[angle, 0.0, 0.0] for angle in self.symmetries])))

    @cached_property
    def lookalike_transforms(self) -> Floats:
        """(n, 4, 4) turns in the plane after which the target may be taken for itself: half a turn, and the best fits.

        A fit brings each vertex as near as it gets to the one so many places further on.
        """
        vertices = self.polygon[:, 0] + 1j * self.polygon[:, 1]
        fits = [np.angle(np.vdot(vertices, np.roll(vertices, -k))) for k in range(1, len(self))]
        return frozen(transform(rotation([[angle, 0.0, 0.0] for angle in (np.pi, *fits)])))

    def nearest_symmetry(self, T_lidar_target: Floats, predicted: Floats) -> Ints:
        """Return the index (...) of the symmetry S for which T S is turned least from a predicted pose.

        Args:
            T_lidar_target: (..., 4, 4) T.
            predicted: (..., 4, 4) T_lidar_target.
        """
        between = np.swapaxes(predicted[..., :3, :3], -1, -2) @ T_lidar_target[..., :3, :3]
        # The trace of a product of rotations grows as its angle falls.
        return np.asarray(np.einsum("...ij,sji->...s", between, self.symmetry_transforms[:, :3, :3]).argmax(axis=-1))

    def nearest_equivalent(self, T_lidar_target: Floats, predicted: Floats) -> Floats:
        """Return the pose (..., 4, 4) of the same placement that is turned least from a predicted one.

        Args:
            T_lidar_target: (..., 4, 4).
            predicted: (..., 4, 4) T_lidar_target.
        """
        return np.asarray(T_lidar_target @ self.symmetry_transforms[self.nearest_symmetry(T_lidar_target, predicted)])

    def scaled(self, factor: float) -> Target:
        """Return the target scaled about its origin; the chessboard, being a print, is dropped.

        Raises:
            InputError: a factor that is not positive.
        """
        if not (np.isfinite(factor) and factor > 0):
            raise InputError(f"target '{self.name}': scale {factor} is not a positive number")
        return Target(self.vertices * factor, self.name)

    def scaled_to_area(self, area: float) -> Target:
        """Return the target scaled about its origin to `area`, square metres.

        Raises:
            InputError: an area that is not positive.
        """
        if not (np.isfinite(area) and area > 0):
            raise InputError(f"target '{self.name}': area {area} m2 is not a positive number")
        return self.scaled(float(np.sqrt(area / self.area)))

    def contains(self, yz: ArrayLike, margin: float = 0.0) -> np.ndarray:
        """Return (N,) whether points (N, 2) of the plane lie inside, or outside by at most `margin` metres."""
        return np.asarray(self.outside_distance(yz) <= margin)

    def outside_distance(self, yz: ArrayLike) -> Floats:
        """Return the largest signed distance (N,) of points (N, 2) beyond an edge's line, metres; negative inside."""
        points = np.asarray(yz, dtype=float)
        return np.asarray((self.normals @ points.T - self.offsets[:, None]).max(axis=0))  # edge by edge: rows are long


def _signed_area(polygon: Floats) -> float:
    y, z = polygon.T
    return float(0.5 * np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z))


def _check_vertices(vertices: Floats, name: str) -> None:
    def fail(problem: str) -> InputError:
        return InputError(f"target '{name}': {problem}")

    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise fail(f"expected vertices as n x 3 (x, y, z), found shape {vertices.shape}")
    if len(vertices) < 3:
        raise fail(f"{len(vertices)} vertices do not close a polygon; at least 3 are expected")
    if len(vertices) > MOST_VERTICES:
        raise fail(f"{len(vertices)} vertices; expected at most {MOST_VERTICES}")
    if not np.isfinite(vertices).all():
        raise fail("a vertex is not a finite number")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent > LARGEST_EXTENT_M:
        raise fail(f"it is {extent:g} m wide; vertices are in metres (are these millimetres?)")
    if extent < 1e-3:
        raise fail(f"it is {extent:g} m wide; expected a polygon of some size, in metres")
    if np.abs(vertices[:, 0]).max() > 1e-6:
        raise fail(f"vertices lie in the plane x = 0; found x = {vertices[np.abs(vertices[:, 0]).argmax(), 0]:g}")
    mean = vertices.mean(axis=0)
    if np.abs(mean).max() > 1e-3 * extent:
        raise fail(
            f"the vertex mean is the origin; found (y, z) = ({mean[1]:.6g}, {mean[2]:.6g}): "
            "subtract it from all vertices"
        )
    polygon = vertices[:, 1:]
    edges = np.roll(polygon, -1, axis=0) - polygon
    short = np.linalg.norm(edges, axis=1) < 1e-6 * extent
    if short.any():
        k = int(short.argmax())
        raise fail(
            f"vertices {k} and {(k + 1) % len(vertices)} coincide; list each once (the polygon closes by itself)"
        )
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    turns /= np.linalg.norm(edges, axis=1) * np.linalg.norm(following, axis=1)
    if _signed_area(polygon) < 0:
        raise fail("vertices run clockwise; expected counter-clockwise seen from +x (y right, z up)")
    winding = np.arctan2(
        turns,
        np.einsum("ij,ij->i", edges, following) / np.linalg.norm(edges, axis=1) / np.linalg.norm(following, axis=1),
    ).sum()
    if turns.min() < 1e-6 or winding > 3 * np.pi:
        k = (int(turns.argmin()) + 1) % len(vertices)
        raise fail(f"the polygon is not strictly convex at vertex {k}")
