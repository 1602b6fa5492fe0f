"""Single points as factors, for robust losses and graduated non-convexity: a loss weighs a factor as a whole."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from optshape_graph.factors._noise import gaussian
from optshape_graph.factors._rows import checked

ALONG = 1e-4
"""Square root information along what a point does not measure, 1/m: GNC's weights break silently without any,
and at this one a metre adds 5e-9 to the cost."""


def PointToEdgeFactor(
    point: ArrayLike,
    normal: ArrayLike,
    offset: float,
    key: int,
    sigma: float,
    plane_sigma: float | None = None,
    loss: gtsam.noiseModel.mEstimator.Base | None = None,
) -> gtsam.KnownLandmarkFactor2Pose3:
    """Return the compiled factor of one edge point on T_target_lidar: n . (R p + t) - c, and e_x . (R p + t).

    Args:
        point: (3,) edge point, metres, LiDAR frame.
        normal: (2,) outward unit normal of its edge, (y, z) of the target frame.
        offset: offset of its edge, metres.
        key: of T_target_lidar.
        sigma: standard deviation across the edge, metres.
        plane_sigma: standard deviation across the plane, metres; None: the point says nothing about the plane.
        loss: robust loss on the point as a whole; None: least squares.
    """
    n = np.append(0.0, checked("normal", normal, (2,)))
    foot, along = offset * n, np.cross([1.0, 0.0, 0.0], n)
    across_plane = ALONG if plane_sigma is None else 1.0 / plane_sigma
    S = np.stack([n / sigma, across_plane * np.array([1.0, 0.0, 0.0]), ALONG * along])
    return gtsam.KnownLandmarkFactor2Pose3(key, checked("point", point, (3,)), foot, gaussian(S, loss))


def PointToPlaneFactor(
    point: ArrayLike, key: int, sigma: float, loss: gtsam.noiseModel.mEstimator.Base | None = None
) -> gtsam.KnownLandmarkFactor2Pose3:
    """Return the compiled factor of one return of the target on T_target_lidar: e_x . (R p + t).

    Args:
        point: (3,) return, metres, LiDAR frame.
        key: of T_target_lidar.
        sigma: standard deviation across the plane, metres.
        loss: robust loss; None: least squares.
    """
    S = np.diag([1.0 / sigma, ALONG, ALONG])
    return gtsam.KnownLandmarkFactor2Pose3(key, checked("point", point, (3,)), np.zeros(3), gaussian(S, loss))
