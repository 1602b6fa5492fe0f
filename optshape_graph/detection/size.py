"""The size of targets, against that of surfaces whose rings cover them in part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist

from optshape_graph._arrays import Floats
from optshape_graph._value import Value
from optshape_graph.detection.candidates import Candidate
from optshape_graph.target import Target

LEAST, LEAST_HIDDEN, LEAST_CUT = 0.8, 0.6, 0.3
"""Share of a target's measures that is seen at least: of one in full view; where something stands before it; where it
reaches the end of the field of view."""

EXCESS = 0.2
"""By how much a target may seem larger than it is: half a step at both ends of each ring, mixed returns, a stand."""


@dataclass(frozen=True, eq=False, repr=False)
class Size(Value):
    """Measures of a polygon that no rotation changes.

    Attributes:
        area: square metres.
        spread: (2,) standard deviations of the area along its principal axes, the smaller first, metres.
        diameter: largest distance of two vertices, metres.
        width: distance of the closest two parallels that hold it, metres.
    """

    area: float
    spread: Floats
    diameter: float
    width: float

    @classmethod
    def of(cls, target: Target) -> Size:
        """Measure a target."""
        polygon = target.polygon
        following = np.roll(polygon, -1, axis=0)
        # Green's theorem, triangle by triangle from the origin.
        triangles = 0.5 * (polygon[:, 0] * following[:, 1] - following[:, 0] * polygon[:, 1])
        centroid = triangles @ (polygon + following) / (3.0 * target.area)
        a, b = polygon, following
        second = np.einsum("k,kij->ij", triangles / 6.0, a[:, :, None] * a[:, None] + b[:, :, None] * b[:, None])
        cross = np.einsum("k,kij->ij", triangles / 12.0, a[:, :, None] * b[:, None] + b[:, :, None] * a[:, None])
        covariance = (second + cross) / target.area - np.outer(centroid, centroid)
        across = target.offsets - (polygon @ target.normals.T).min(axis=0)
        return cls(
            target.area, np.sqrt(np.linalg.eigvalsh(covariance)), float(pdist(polygon).max()), float(across.min())
        )

    def objection(self, candidate: Candidate) -> str:
        """Say why a candidate cannot be of this size; empty: it can.

        Rings cover a surface to half a ring's spacing at the top and the bottom.
        """
        most = 1.0 + EXCESS + 0.5 / candidate.n_rings
        seen = LEAST_CUT if candidate.cut else LEAST_HIDDEN if candidate.hidden else LEAST
        least = seen - 0.5 / candidate.n_rings
        area = candidate.area / self.area
        if not least <= area <= most:
            return f"covers {candidate.area:.2f} m2, the target {self.area:.2f} m2"
        ratio = candidate.spread / self.spread
        if not (least <= ratio.min() and ratio.max() <= most):
            return (
                f"spreads {candidate.spread[0]:.2f} x {candidate.spread[1]:.2f} m, "
                f"the target {self.spread[0]:.2f} x {self.spread[1]:.2f} m"
            )
        return ""
