"""What a mapping run knows, as plain data: poses in time, odometry between them, landmarks, and what is matched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from optshape_graph._arrays import Floats, frozen
from optshape_graph.factors import BiasedMeasurement, TemplateMeasurement
from optshape_graph.mapping.map import Map
from optshape_graph.mapping.priors import root_of
from optshape_graph.mapping.sighting import Sighting
from optshape_graph.se3 import as_transform
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False)
class Odometry:
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
        """The same before the biases of the LiDAR's rings are marginalised, where that is kept."""
        return self.sighting.biased_as(self.hypothesis)


@dataclass(frozen=True, eq=False)
class Start:
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


@dataclass(frozen=True, eq=False)
class Track:
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


@dataclass(frozen=True, eq=False)
class MappingProblem:
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


@dataclass(frozen=True, eq=False)
class Keys:
    """Variables: poses X, landmarks L, and as-built vertices V.

    Attributes:
        poses: of each track.
        landmarks: by name.
        shapes: of the landmarks whose vertices are refined, by name.
        biases: of the LiDARs whose rings' biases are, by number of the track.
    """

    poses: tuple[tuple[int, ...], ...]
    landmarks: Mapping[str, int]
    shapes: Mapping[str, int]
    biases: Mapping[int, int] = field(default_factory=dict)
