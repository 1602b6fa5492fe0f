"""What a scan says about one target: a measurement for every pose of it that is not ruled out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.factors import BiasedMeasurement, ShapeMeasurement, Summary, TemplateMeasurement, summarise
from optshape_graph.pose import PoseEstimate
from optshape_graph.se3 import inverse
from optshape_graph.target import Target

LOOSEST = 10.0
"""Standard deviation, rad or metres, from which on a measurement does not determine a pose."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """One target in one scan.

    Attributes:
        target: the template.
        measurements: of T_target_lidar, one for each pose that is not ruled out, the likeliest first.
        landmark: which landmark it is, where that is known (a tag, a template of which there is one); None: it is to
            be found out, among those of the same template.
        shape: the same returns without the template, to refine the target's as-built vertices; None: not kept.
        biased: the first measurement before the range biases that the LiDAR's rings keep are marginalised, in units of
            their standard deviations; None: not kept.

    Raises:
        InputError: no measurement.
    """

    target: Target
    measurements: tuple[TemplateMeasurement, ...]
    landmark: str | None = None
    shape: ShapeMeasurement | None = None
    biased: BiasedMeasurement | None = None

    def __post_init__(self) -> None:
        if not self.measurements:
            raise InputError(f"a sighting of target '{self.target.name}' without a measurement")

    @classmethod
    def of(
        cls,
        estimate: PoseEstimate,
        landmark: str | None = None,
        shape: ShapeMeasurement | None = None,
        *,
        biases: bool = True,
    ) -> Sighting:
        """Return the sighting that a pose estimate makes; of an ambiguous one, both of its poses.

        Of the other pose only the pose is known: its measurement is taken to be that of the best one, moved there.

        Args:
            estimate: of the pose.
            landmark: which it is, where that is known.
            shape: of the same returns.
            biases: whether to keep `biased`, so that a batch can tell what all scans have in common: some kilobytes.

        Raises:
            InputError: the estimate failed.
        """
        if estimate.status == "failed":
            raise InputError(f"the estimate of target '{estimate.target.name}' failed ({estimate.reason})")
        best = estimate.measurement
        measurements: tuple[TemplateMeasurement, ...] = (best,)
        other = estimate.ambiguity.T_lidar_target
        if estimate.status != "ok" and other is not None:
            measurements = (best, best.substituted(best.T_target_lidar @ other))
        return cls(estimate.target, measurements, landmark, shape, _biased(estimate) if biases else None)

    def moved(self, T_lidar_then: Floats) -> Sighting:
        """Return the sighting as one from another pose of the LiDAR.

        Args:
            T_lidar_then: (4, 4) the pose that it was made from, in the frame of the one that it is to be from.
        """
        shape = self.shape
        if shape is not None:  # planes map by the transposed pose: H_then^T = T^T H^T
            U = shape.U.reshape(len(shape.U), -1, 4) @ T_lidar_then.T
            triangle = np.asarray(np.linalg.qr(U.reshape(shape.U.shape), mode="r"))
            shape = ShapeMeasurement(triangle, shape.n_rows, shape.T_target_lidar @ inverse(T_lidar_then))
        measurements = tuple(m.substituted(np.eye(4), T_lidar_then) for m in self.measurements)
        biased = None if self.biased is None else self.biased.substituted(np.eye(4), T_lidar_then)
        return replace(self, measurements=measurements, shape=shape, biased=biased)

    @cached_property
    def hypotheses(self) -> tuple[TemplateMeasurement, ...]:
        """All measurements, under every way to name the vertices of a symmetric target."""
        return tuple(
            measurement if turn is None else measurement.substituted(turn)
            for measurement in self.measurements
            for turn in self._turns
        )

    def biased_as(self, hypothesis: int) -> BiasedMeasurement | None:
        """Return `biased` under one of the hypotheses; None where it is not kept, or not known of that pose."""
        if self.biased is None or hypothesis >= len(self._turns):
            return None
        turn = self._turns[hypothesis]
        return self.biased if turn is None else self.biased.substituted(turn)

    @cached_property
    def summaries(self) -> tuple[Summary, ...]:
        """The hypotheses as measured poses."""
        return tuple(summarise(self.hypotheses))

    @cached_property
    def determined(self) -> bool:
        """Whether the best measurement determines all six degrees of freedom of the pose."""
        least = np.linalg.svd(self.summaries[0].sqrt_information, compute_uv=False).min()
        return bool(least > 1.0 / LOOSEST)

    @property
    def _turns(self) -> list[Floats | None]:
        return [None, *self.target.symmetry_transforms[1:]]

    def T_lidar_target(self) -> Floats:
        """Return the likeliest pose (4, 4)."""
        return inverse(self.summaries[0].T_target_lidar)


def _biased(estimate: PoseEstimate) -> BiasedMeasurement | None:
    """What the estimate's returns say before ring biases are marginalised; the offset at edges is of one scan.

    It is as wide as the measurement, which is wider where associations disagree.
    """
    if estimate.shared is None:
        return None
    biased = estimate.shared.without([error for error in estimate.shared.shared if error.ring is None])
    own = np.trace(biased.marginal(1.0).information(estimate.T_target_lidar))
    scale = float(np.sqrt(np.trace(estimate.measurement.information()) / own))
    return replace(biased, stack=biased.stack * min(scale, 1.0))
