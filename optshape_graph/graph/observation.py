"""What links a LiDAR pose to a target: one measurement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.factors import TemplateMeasurement
from optshape_graph.se3 import inverse
from optshape_graph.target import Target


class Estimate(Protocol):
    """What an observation takes from a pose estimate."""

    @property
    def target(self) -> Target:
        """The template."""

    @property
    def status(self) -> str:
        """`failed` or `doubtful` where the estimate is not to be used."""

    @property
    def measurement(self) -> TemplateMeasurement:
        """The measurement, taken at the estimated pose."""


@dataclass(frozen=True, eq=False, repr=False)
class Observation(Value):
    """One target measured in one scan.

    Attributes:
        scan: whose LiDAR pose; scans from one unmoved LiDAR share it.
        target: which target; a target that was moved is another one.
        measurement: of T_target_lidar, taken at its estimate. What several scans of the same scan-target pair have
            measured is fused first, by `fuse_static`.
        template: of the target, whose symmetries its poses are known up to; None: it has none.
    """

    scan: str
    target: str
    measurement: TemplateMeasurement
    template: Target | None = None

    @classmethod
    def of(cls, scan: str, estimate: Estimate, target: str | None = None) -> Observation:
        """Return the observation that a pose estimate makes.

        Args:
            scan: whose LiDAR pose.
            estimate: a pose estimate with its measurement.
            target: which target; None: the template's name.

        Raises:
            InputError: the estimate failed or is doubtful.
        """
        name = estimate.target.name if target is None else target
        if estimate.status in ("failed", "doubtful"):
            raise InputError(
                f"scan '{scan}': the estimate of target '{name}' is {estimate.status}; it is no observation"
            )
        return cls(scan, name, estimate.measurement, estimate.target)

    @property
    def T_target_lidar(self) -> Floats:
        """(4, 4) pose the measurement was taken at."""
        return self.measurement.T_target_lidar

    def nearest(self, T_target_lidar: Floats) -> Observation:
        """Return the equivalent observation of a symmetric target whose rotation is nearest to a predicted pose (4, 4).

        The target turned by S is the same target: its pose is then T_target_lidar' with T_target_lidar = S T'.
        """
        if self.template is None or len(self.template.symmetries) == 1:
            return self
        k = self.template.nearest_symmetry(inverse(self.T_target_lidar), inverse(T_target_lidar))
        return replace(self, measurement=self.measurement.substituted(self.template.symmetry_transforms[k]))

    def equivalent_poses(self) -> Floats:
        """Return T_lidar_target (S, 4, 4) of every way to name the vertices of a symmetric target."""
        turns = np.eye(4)[None] if self.template is None else self.template.symmetry_transforms
        return np.asarray(inverse(self.T_target_lidar) @ turns)
