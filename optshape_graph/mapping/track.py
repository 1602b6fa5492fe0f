"""What a mapping run knows, as plain data: sightings, poses in time and odometry between them, and what is matched."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.factors import (
    BiasedMeasurement,
    ShapeMeasurement,
    SharedError,
    Summary,
    TemplateMeasurement,
    summarise,
)
from optshape_graph.factors.static import OF_TARGET
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.smoother import root_of
from optshape_graph.pose import PoseEstimate, PoseOptions
from optshape_graph.se3 import PoseLike, as_transform, inverse
from optshape_graph.target import Target

LOOSEST = 10.0
"""Standard deviation, rad or metres, beyond which a measurement does not determine a pose."""


@dataclass(frozen=True, eq=False, repr=False)
class Sighting(Value):
    """One target in one scan.

    Attributes:
        target: the template.
        measurements: of T_target_lidar, one for each pose that is not ruled out, the likeliest first.
        landmark: which landmark it is, where that is known (a tag, a template of which there is one); None: it is to
            be found out, among those of the same template.
        shape: the same returns without the template, to refine the target's as-built vertices; None: not kept.
        biased: the first measurement before the errors that the LiDAR and the target keep are marginalised, in units of
            their standard deviations; None: not kept.
        lidar: name of the LiDAR, of several on one robot, whose biases those are.

    Raises:
        InputError: no measurement.
    """

    target: Target
    measurements: tuple[TemplateMeasurement, ...]
    landmark: str | None = None
    shape: ShapeMeasurement | None = None
    biased: BiasedMeasurement | None = None
    lidar: str = ""

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
        """Return the sighting that a pose estimate makes; where another pose is not ruled out, both.

        Of the other pose only the pose is known: its measurement is taken to be that of the best one, moved there.

        Args:
            estimate: of the pose.
            landmark: which it is, where that is known.
            shape: of the same returns.
            biases: whether to keep `biased`, so that a map can tell what all scans have in common: some kilobytes.
                Biases of ranges are then as large as the sensor file says, in all scans, also in those that show more.

        Raises:
            InputError: the estimate failed or is doubtful.
        """
        if not estimate.usable:
            raise InputError(f"the estimate of target '{estimate.target.name}' is {estimate.status}: {estimate.reason}")
        kept = estimate.of_sensor_and_target if biases else None
        best = estimate.measurement if kept is None else kept.of_one_scan().at(estimate.T_target_lidar)
        measurements: tuple[TemplateMeasurement, ...] = (best,)
        other = estimate.ambiguity.T_lidar_target
        if other is not None and estimate.ambiguity.margin < PoseOptions.ambiguity_margin:
            measurements = (best, best.substituted(best.T_target_lidar @ other))
        return cls(estimate.target, measurements, landmark, shape, kept)

    def moved(self, T_lidar_then: Floats, covariance: Floats | None = None) -> Sighting:
        """Return the sighting as one from another pose of the LiDAR.

        Args:
            T_lidar_then: (4, 4) the pose that it was made from, in the frame of the one that it is to be from.
            covariance: (6, 6) of its right perturbation, rotation first; None: it is known exactly.
        """
        if covariance is not None:
            loosened = replace(
                self,
                measurements=tuple(m.loosened(covariance) for m in self.measurements),
                shape=None if self.shape is None else self.shape.loosened(covariance, self.target.vertices),
                biased=None if self.biased is None else self.biased.loosened(covariance),
            )
            return loosened.moved(T_lidar_then)
        shape = self.shape
        if shape is not None:  # planes map by the transposed pose: H_then^T = T^T H^T
            U = shape.U.reshape(len(shape.U), -1, 4) @ T_lidar_then.T
            triangle = np.asarray(np.linalg.qr(U.reshape(shape.U.shape), mode="r"))
            shape = ShapeMeasurement(triangle, shape.n_rows, shape.T_target_lidar @ inverse(T_lidar_then))
        measurements = tuple(m.substituted(np.eye(4), T_lidar_then) for m in self.measurements)
        biased = None if self.biased is None else self.biased.substituted(np.eye(4), T_lidar_then)
        return replace(self, measurements=measurements, shape=shape, biased=biased)

    def on_body(self, T_body_lidar: PoseLike, lidar: str) -> Sighting:
        """Return the sighting as one from a robot's body, of which poses and odometry are then, with several LiDARs.

        Args:
            T_body_lidar: (4, 4) of the LiDAR on the body.
            lidar: its name: each LiDAR's rings have biases of their own.
        """
        return replace(self.moved(as_transform(T_body_lidar, "T_body_lidar")), lidar=lidar)

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


@dataclass(frozen=True, eq=False, repr=False)
class Odometry(Value):
    """Motion between two poses of one session.

    Attributes:
        i, j: numbers of the poses.
        T_i_j: (4, 4) pose of the LiDAR at j in its frame at i.
        covariance: (6, 6) of its right perturbation, rotation first.
        sqrt_information: (6, 6) square root of its inverse, upper triangular.

    Raises:
        InputError: a covariance that is none.
    """

    i: int
    j: int
    T_i_j: Floats
    covariance: Floats
    sqrt_information: Floats = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_i_j", as_transform(self.T_i_j, "odometry"))
        object.__setattr__(self, "covariance", frozen(self.covariance))
        object.__setattr__(self, "sqrt_information", root_of(self.covariance, "odometry"))


@dataclass(frozen=True, eq=False, slots=True)
class Match:
    """A sighting taken for a landmark.

    Attributes:
        pose: number of the LiDAR pose.
        landmark: name of the landmark.
        sighting: what was seen.
        hypothesis: under which of its hypotheses.
    """

    pose: int
    landmark: str
    sighting: Sighting
    hypothesis: int

    @property
    def measurement(self) -> TemplateMeasurement:
        """Of T_target_lidar, in the landmark's own naming of the vertices."""
        return self.sighting.hypotheses[self.hypothesis]

    @property
    def biased(self) -> BiasedMeasurement | None:
        """The same before the errors that the LiDAR and the target keep are marginalised, where that is kept."""
        return self.sighting.biased_as(self.hypothesis)

    def kept(self, error: SharedError, track: int = 0) -> Hashable:
        """Return a name of an error of `biased`: of the landmark in all tracks, or of the track's LiDAR."""
        return (self.landmark, error) if error.kind in OF_TARGET else (track, self.sighting.lidar, error)


@dataclass(frozen=True, eq=False, repr=False)
class Start(Value):
    """Where a session starts.

    Attributes:
        T_world_lidar: (4, 4) its first pose.
        covariance: (6, 6) of its right perturbation, rotation first.

    Raises:
        InputError: a pose that is none.
    """

    T_world_lidar: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_lidar", as_transform(self.T_world_lidar, "start"))


@dataclass(frozen=True, eq=False, repr=False)
class Track(Value):
    """One session: a robot's poses and what was measured from them.

    Attributes:
        name: of the session.
        stamps: (N,) seconds.
        T_world_lidar: (N, 4, 4) estimates.
        odometry: between the poses.
        matches: the landmarks that were measured.
        start: what is known of the first pose; None: nothing, landmarks place it.
    """

    name: str
    stamps: Floats
    T_world_lidar: Floats
    odometry: tuple[Odometry, ...]
    matches: tuple[Match, ...]
    start: Start | None


@dataclass(frozen=True, eq=False, repr=False)
class MappingProblem(Value):
    """All that there is to solve for in one map.

    Attributes:
        tracks: sessions or robots, in one world frame.
        targets: template of each landmark.
        T_world_target: (4, 4) estimate of each landmark.
        known: what was known of landmarks before; None: nothing.
    """

    tracks: tuple[Track, ...]
    targets: Mapping[str, Target]
    T_world_target: Mapping[str, Floats]
    known: Map | None = None

    @cached_property
    def matches(self) -> tuple[tuple[int, Match], ...]:
        """All matches, each with the number of its track, in the order of tracks and matches."""
        return tuple((t, match) for t, track in enumerate(self.tracks) for match in track.matches)
