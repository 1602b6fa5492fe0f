"""What a calibration starts from: targets seen in scans and in images, and the views that pair them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.factors import BiasedMeasurement, SharedError, TemplateMeasurement
from optshape_graph.scan import Scan
from optshape_graph.se3 import adjoint, inverse
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class TargetInScan(Value):
    """One target in one scan.

    Attributes:
        lidar: which LiDAR made the scan.
        scan: the scan's name.
        T_lidar_target: (4, 4) estimated pose.
        covariance: (6, 6) of its right perturbation, rotation first.
        measurement: the exact cost of the returns, range biases of the rings allowed for.
        uncorrected: the same, the rings' biases being part of what is measured: for clouds as they come.
        shared: the errors that all scans of the LiDAR have in common: the range biases of its rings.
        shared_effect: (6, k) right perturbation of the pose, rad and metres, by a standard deviation of each.
        persistent: the measurement, the errors that the LiDAR keeps from scan to scan being unknowns of it; of range
            biases the unit is `bias_factor` times the sensor file's.
        bias_factor: how much larger than the sensor file's biases were seen.
        edge_inset: median azimuth from a ring's last return to the target's edge, rad; the estimate lets it be what it
            is in each scan.
        doubt: why the returns do not fit the target as they should, "" if they do; the other sightings judge the pose.
        own: the returns on the target.
        all_returns: (M, 3) every return of the scan, metres, for overlays.
    """

    lidar: str
    scan: str
    T_lidar_target: Floats
    covariance: Floats
    measurement: TemplateMeasurement
    uncorrected: TemplateMeasurement
    shared: tuple[SharedError, ...]
    shared_effect: Floats
    persistent: BiasedMeasurement
    bias_factor: float
    edge_inset: float
    doubt: str
    own: Scan
    all_returns: Floats

    def __post_init__(self) -> None:
        for field in ("T_lidar_target", "covariance", "shared_effect", "all_returns"):
            object.__setattr__(self, field, frozen(getattr(self, field)))

    @property
    def returns(self) -> Floats:
        """(N, 3) the returns on the target, metres, LiDAR frame."""
        return self.own.points

    @cached_property
    def ray(self) -> Floats:
        """(3,) unit vector from the LiDAR to the middle of the returns."""
        middle = self.returns.mean(axis=0)
        return frozen(middle / np.linalg.norm(middle))

    def pose(self, range_bias: float) -> Floats:
        """Return T_lidar_target (4, 4) of these returns alone, every range being too long by a bias, metres.

        The target moves as a whole along the ray to its middle. That rays to its rim point elsewhere would also
        change its apparent size, by the bias over the range; the width of the beam does that too, and more.
        """
        T = np.array(self.T_lidar_target)
        T[:3, 3] -= range_bias * self.ray
        return T


@dataclass(frozen=True, eq=False, repr=False)
class View(Value):
    """One target, in one place, seen by a LiDAR, a camera or both at one time.

    Attributes:
        placement: views of one placement see the same target without it or the sensors having moved.
        target: the target.
        scan: what the LiDAR saw of it.
        image: what the camera saw of it.
        scan_name: file of the scan, "" if none was taken.
        image_name: file of the image, "" if none was taken.
        problem: why a sighting is missing, "" if none is.
    """

    placement: str
    target: Target
    scan: TargetInScan | None = None
    image: TargetInImage | None = None
    scan_name: str = ""
    image_name: str = ""
    problem: str = ""

    @property
    def name(self) -> str:
        """The view's files, for messages."""
        return " / ".join(name for name in (self.scan_name, self.image_name) if name)


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Value):
    """One way to read a sighting.

    Attributes:
        T_sensor_target: (4, 4) pose of the relabelled target.
        covariance: (6, 6) of its right perturbation.
        S: (4, 4) motion from the sighting's own labelling of the target to this one: p' = S p.
    """

    T_sensor_target: Floats
    covariance: Floats
    S: Floats


def candidates(sighting: TargetInScan | TargetInImage, target: Target) -> tuple[Candidate, ...]:
    """List the poses of the target that a sighting cannot tell apart, the plainest first.

    A scan shows an outline, which looks the same after each of the target's symmetries; an image shows a pattern,
    which has symmetries of its own, and leaves up to two poses of a plane.
    """
    if isinstance(sighting, TargetInScan):
        poses = [(sighting.T_lidar_target, sighting.covariance)]
        motions = tuple(target.symmetry_transforms)
    else:
        poses = [(pose.T_camera_target, np.asarray(np.linalg.inv(pose.information))) for pose in sighting.poses]
        motions = sighting.points.symmetries
    # T Exp(xi) S^-1 = T S^-1 Exp(Ad(S) xi)
    return tuple(
        Candidate(T @ inverse(S), adjoint(S) @ covariance @ adjoint(S).T, S) for S in motions for T, covariance in poses
    )
