"""The family of candidate targets: projective images of a regular polygon (paper, Section III-A).

P = H_S H_SH H_SC H_E (similarity, shear, scaling, elation) with unit scale and no translation leaves five parameters,

    theta   rotation of the similarity, rad
    k       shear
    lambda  scaling: lambda along the first axis, 1 / lambda along the second
    v1, v2  elation: the last row of P is (v1, v2, 1)

The image of the nominal polygon's centre stays at the origin; for a quadrilateral that is the crossing of its
diagonals. The family has, up to similarity, every convex quadrilateral and every triangle, and those n-gons with n > 4
that some projective map makes regular.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph._arrays import Floats, frozen
from optshape_graph.design.polygons import areas
from optshape_graph.errors import InputError

PARAMETERS = ("theta", "k", "lambda", "v1", "v2")


@dataclass(frozen=True)
class Family:
    """Projective images of the regular n-gon of unit area.

    Attributes:
        sides: number of sides, at least three.

    Raises:
        InputError: fewer than three sides.
    """

    sides: int = 4

    def __post_init__(self) -> None:
        if self.sides < 3:
            raise InputError(f"a polygon has at least 3 sides; found {self.sides}")

    @cached_property
    def nominal(self) -> Floats:
        """(n, 2) the regular polygon of unit area about the origin, the edge before vertex 0 facing +x."""
        angles = np.pi * (1 + 2 * np.arange(self.sides)) / self.sides
        polygon = np.column_stack([np.cos(angles), np.sin(angles)])
        return frozen(polygon / np.sqrt(areas(polygon)))

    def depths(self, parameters: ArrayLike) -> Floats:
        """(B, n) third homogeneous coordinates v1 x + v2 y + 1 of the vertices, of (B, 5) parameters.

        The image is convex if all are positive (Theorem 2, eq. 7).
        """
        elation = np.asarray(parameters, dtype=float)[..., 3:]
        return 1.0 + elation @ self.nominal.T

    def polygons(self, parameters: ArrayLike) -> Floats:
        """Return the images of unit area.

        Args:
            parameters: (B, 5) theta (rad), k, lambda, v1, v2 (without unit).

        Returns:
            (B, n, 2) vertices in units of the root of the area, counter-clockwise.

        Raises:
            InputError: lambda is not positive, or a depth is not (the image would not be convex).
        """
        parameters = np.atleast_2d(np.asarray(parameters, dtype=float))
        if parameters.shape[-1] != len(PARAMETERS):
            raise InputError(f"expected the parameters {', '.join(PARAMETERS)}; found {parameters.shape[-1]} numbers")
        depths = self.depths(parameters)
        if not (parameters[:, 2] > 0).all():
            raise InputError(f"lambda is positive; found {parameters[:, 2].min():g}")
        if not (depths > 0).all():
            raise InputError(
                f"v1 x + v2 y + 1 is positive at every vertex of the nominal polygon, or its image is not convex; "
                f"found {depths.min():g}"
            )
        images = self.nominal @ np.swapaxes(linear_parts(parameters), 1, 2) / depths[..., None]
        return images / np.sqrt(areas(images))[:, None, None]

    def parameters(self, polygon: ArrayLike) -> Floats:
        """Return the parameters of a polygon: the inverse of `polygons`, up to translation and scale.

        Args:
            polygon: (n, 2) vertices in any unit, counter-clockwise; vertex 0 is the image of the nominal vertex 0.

        Returns:
            (5,) theta (rad), k, lambda, v1, v2 (without unit).

        Raises:
            InputError: the polygon is not in the family.
        """
        polygon = np.asarray(polygon, dtype=float)
        if polygon.shape != (self.sides, 2):
            raise InputError(f"expected {self.sides} vertices as n x 2, found shape {polygon.shape}")
        size = np.sqrt(np.abs(areas(polygon)))
        P = _homography(self.nominal, polygon, affine=self.sides == 3)
        # Moving the centre's image to the origin leaves the last row alone and makes P = [A 0; v 1].
        A = P[:2, :2] - np.outer(P[:2, 2], P[2, :2])
        Q, U = np.linalg.qr(A)
        signs = np.sign(np.diag(U))
        Q, U = Q * signs, signs[:, None] * U
        found = np.array(
            [np.arctan2(Q[1, 0], Q[0, 0]), U[0, 1] / U[1, 1], np.sqrt(U[0, 0] / U[1, 1]), P[2, 0], P[2, 1]]
        )
        # A reflection, a non-convex polygon or, for n > 4, a polygon outside the family does not map back.
        ok = np.isfinite(found).all() and np.linalg.det(Q) > 0 and (self.depths(found) > 0).all()
        if not ok or np.abs(self.polygons(found)[0] * size + P[:2, 2] - polygon).max() > 1e-6 * size:
            raise InputError(f"no convex projective image of the regular {self.sides}-gon has these vertices")
        return found


def linear_parts(parameters: Floats) -> Floats:
    """Return R(theta) [1 k; 0 1] diag(lambda, 1 / lambda) (B, 2, 2) of parameters (B, 5)."""
    theta, k, scale = parameters[:, 0], parameters[:, 1], parameters[:, 2]
    c, s = np.cos(theta), np.sin(theta)
    rows = [[c * scale, (c * k - s) / scale], [s * scale, (s * k + c) / scale]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _homography(source: Floats, image: Floats, affine: bool) -> Floats:
    """Return P (3, 3) with P33 = 1 that maps `source` to `image` (n, 2), by a direct linear transformation."""
    n = len(source)
    x, y = source.T
    one, zero = np.ones(n), np.zeros(n)
    rows = [
        np.column_stack([x, y, one, zero, zero, zero, -x * image[:, 0], -y * image[:, 0]]),
        np.column_stack([zero, zero, zero, x, y, one, -x * image[:, 1], -y * image[:, 1]]),
    ]
    unknowns = 6 if affine else 8
    solution = np.zeros(8)
    solution[:unknowns] = np.linalg.lstsq(np.vstack(rows)[:, :unknowns], image.T.ravel(), rcond=None)[0]
    return np.append(solution, 1.0).reshape(3, 3)
