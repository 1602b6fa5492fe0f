"""Sightings as GTSAM factors.

The world of every placement is its target's frame, so that both kinds of sighting have compiled factors:

    W_p = T_target_base      where the base LiDAR is, seen from the target, in placement p
    S_s = T_base_sensor      the extrinsic of sensor s; the base LiDAR has none
    L_k = T_target_lidar     where scan k's returns put its LiDAR, seen from the target
    P_j                      a point of the target that images show
    O_t                      how far the pattern of target t is from where the target's file says
    B_l                      range bias of LiDAR l, where it is estimated
    K_c                      intrinsics of camera c, where they are refined

A scan measures L_k by the template factor; L_k is W_p S_l but for the range bias, and for a discrepancy, which stands
for what the noise model of the returns leaves out. An image measures W_p, S_c and P_j by GTSAM's projection factor
with a body, a transform, and a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import gtsam_unstable
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.projection import normalised, projection_derivative
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.factors import CheckedFactor
from optshape_graph.se3 import adjoint

PRINT_SIGMA_M = 1e-4
"""Standard deviation of a point's place in its pattern, metres."""

OFFSET_SIGMA_M = (1e-4, 2e-3, 2e-3)
"""Standard deviation of where a pattern lies on its target, metres: above the plane, and in it (y, z)."""

INTRINSICS_SIGMA = np.array([20.0, 20.0, 1e-6, 10.0, 10.0, 0.05, 0.05, 0.05, 0.05])
"""Prior standard deviations of the intrinsics: fx, fy, skew, cx, cy (px), and the four distortion terms."""

LENS = np.array([0, 1, 3, 4, 5, 6, 7, 8])
"""The entries of the intrinsics that may be off: all but the skew."""


def coupling_factor(
    keys: tuple[int, int | None, int, int | None], scan: TargetInScan, sigmas: Floats, T_target_lidar: Floats
) -> gtsam.NonlinearFactor:
    """Return the factor that a scan sees its placement where the rig says, L = Exp(x) W S Trans(-b r).

    r is the ray to the target and b the range bias; x is the discrepancy, target frame. With
    L = W S Trans(-b r) Exp(e), x is Ad(L) e, so e is whitened by diag(1 / sigma) Ad(L).

    Args:
        keys: of W; of S, None for the base LiDAR's scan; of L; of the range bias, None where there is none.
        scan: the scan.
        sigmas: (6,) standard deviations of x, rotation first.
        T_target_lidar: (4, 4) about where L is.
    """
    k_placement, k_sensor, k_scan, k_bias = keys
    whitening = adjoint(T_target_lidar) / sigmas[:, None]
    if k_sensor is None and k_bias is None:
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(whitening, False)
        return gtsam.BetweenFactorPose3(k_placement, k_scan, gtsam.Pose3(), noise)
    by_bias = np.concatenate([np.zeros(3), scan.ray])

    def evaluate(values: gtsam.Values) -> tuple[Floats, list[Floats]]:
        shift = gtsam.Pose3(gtsam.Rot3(), -values.atDouble(k_bias) * scan.ray) if k_bias is not None else gtsam.Pose3()
        right = shift if k_sensor is None else values.atPose3(k_sensor).compose(shift)
        difference = values.atPose3(k_placement).compose(right).between(values.atPose3(k_scan))
        e = gtsam.Pose3.Logmap(difference)
        by_scan = whitening @ gtsam.Pose3.LogmapDerivative(e)
        # Exp(-y) D = D Exp(-Ad(D^-1) y) for a perturbation y left of D, and A Exp(a) B = A B Exp(Ad(B^-1) a).
        by_left = -by_scan @ difference.inverse().AdjointMap()
        jacobians = [by_left @ right.inverse().AdjointMap()]
        if k_sensor is not None:
            jacobians.append(by_left @ shift.inverse().AdjointMap())
        jacobians.append(by_scan)
        if k_bias is not None:
            jacobians.append(-by_left @ by_bias[:, None])
        return whitening @ e, jacobians

    used = [key for key in keys if key is not None]
    return CheckedFactor(evaluate, 6, used, [1 if key == k_bias else 6 for key in used])


@dataclass(frozen=True, eq=False, repr=False)
class CompiledCamera(Value):
    """A camera in the form in which GTSAM projects.

    Attributes:
        intrinsics: what is compiled.
        ideal: whether its pixels have to be freed of distortion first, GTSAM having no model of it.
    """

    intrinsics: CameraIntrinsics
    ideal: bool

    @classmethod
    def of(cls, camera: CameraIntrinsics) -> CompiledCamera:
        """Choose GTSAM's Cal3Fisheye or Cal3DS2, or Cal3_S2 on undistorted pixels for longer distortion models."""
        return cls(camera, camera.model == "pinhole" and bool(np.any(camera.D[4:])))

    def check_refinable(self) -> None:
        """Raise unless the lens can be refined.

        Raises:
            InputError: it has more than four distortion terms.
        """
        if self.ideal:
            raise InputError(
                f"camera '{self.intrinsics.name}': {len(self.intrinsics.D)} distortion terms; intrinsics of the "
                f"pinhole model are refined with k1, k2, p1, p2 only"
            )

    @property
    def vector(self) -> Floats:
        """(9,) fx, fy, skew, cx, cy and four distortion terms, GTSAM's order."""
        K, D = self.intrinsics.K, np.zeros(4)
        D[: len(self.intrinsics.D[:4])] = self.intrinsics.D[:4]
        return np.array([K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], *D])

    @property
    def calibration(self) -> gtsam.Cal3Fisheye | gtsam.Cal3DS2 | gtsam.Cal3_S2:
        """The camera as GTSAM has it."""
        if self.intrinsics.model == "equidistant":
            return gtsam.Cal3Fisheye(self.vector)
        return gtsam.Cal3_S2(self.vector[:5]) if self.ideal else gtsam.Cal3DS2(self.vector)

    def refined(self, vector: Floats) -> CameraIntrinsics:
        """Return the intrinsics with other values of `vector`, (9,): pixels, then coefficients without unit."""
        fx, fy, _, cx, cy, *D = vector
        return replace(self.intrinsics, K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), D=np.array(D))

    def factors(
        self,
        points: ImagePoints,
        k_placement: int,
        k_sensor: int,
        k_points: Sequence[int],
        k_intrinsics: int | None,
    ) -> list[gtsam.NonlinearFactor]:
        """Return one projection factor for each point of a target in an image.

        Args:
            points: what the image shows.
            k_placement: key of W.
            k_sensor: key of S.
            k_points: keys of the points.
            k_intrinsics: key of the intrinsics; None: they are known.
        """
        pixels, whitening = self._measured(points)
        noises = [gtsam.noiseModel.Gaussian.SqrtInformation(M, False) for M in whitening]
        calibration = self.calibration
        kind = type(calibration).__name__
        if k_intrinsics is not None:
            variable = getattr(gtsam_unstable, f"ProjectionFactorPPPC{kind}")
            return [
                variable(pixel, noise, k_placement, k_sensor, key, k_intrinsics)
                for pixel, noise, key in zip(pixels, noises, k_points, strict=True)
            ]
        constant = getattr(gtsam_unstable, f"ProjectionFactorPPP{kind}")
        return [
            constant(pixel, noise, k_placement, k_sensor, key, calibration)
            for pixel, noise, key in zip(pixels, noises, k_points, strict=True)
        ]

    def _measured(self, points: ImagePoints) -> tuple[Floats, Floats]:
        """Return pixels and whitening as GTSAM's model has them."""
        if not self.ideal:
            return points.pixels, points.sqrt_information
        rays = normalised(self.intrinsics, points.pixels)
        by_ray = projection_derivative(self.intrinsics, np.column_stack([rays, np.ones(len(rays))]))[:, :, :2]
        f = self.vector[:2]
        return rays * f + self.vector[3:5], points.sqrt_information @ by_ray / f


def as_vector(calibration: gtsam.Cal3Fisheye | gtsam.Cal3DS2) -> Floats:
    """Return (9,) fx, fy, skew, cx, cy, four distortion terms; GTSAM's own `vector` leaves out the fisheye's."""
    linear = [calibration.fx(), calibration.fy(), calibration.skew(), calibration.px(), calibration.py()]
    if isinstance(calibration, gtsam.Cal3DS2):
        return np.asarray(calibration.vector())
    return np.array([*linear, calibration.k1(), calibration.k2(), calibration.k3(), calibration.k4()])
