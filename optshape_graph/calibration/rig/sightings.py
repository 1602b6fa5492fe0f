"""What a rig's calibration starts from: targets as LiDARs, cameras and motion capture see them, at some moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.calibration.camera.sightings import Candidate, TargetInScan, candidates
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.factors import RANGE_BIAS, BiasedMeasurement, SharedError
from optshape_graph.factors._rows import triangular
from optshape_graph.scan import Scan
from optshape_graph.se3 import inverse
from optshape_graph.target import Target

Kind: TypeAlias = Literal["lidar", "camera", "mocap body"]
"""Of a sensor."""


@dataclass(frozen=True, eq=False, repr=False)
class TargetInMarkers(Value):
    """One target's markers in one frame, as a body on the platform, or motion capture itself, sees them.

    Attributes:
        points: (k, 3) metres, the sensor's frame.
        vertices: (k,) the vertex that each is near.
        sigma: standard deviation of a coordinate, metres.
        T_sensor_target: (4, 4) rigid fit of the vertices to the markers.
        covariance: (6, 6) of its right perturbation, rotation first.
        of_body: (6, 6) covariance of the sensor's own pose, by its markers: the right perturbation, rotation first.
    """

    points: Floats
    vertices: Ints
    sigma: float
    T_sensor_target: Floats
    covariance: Floats
    of_body: Floats


Seen: TypeAlias = TargetInScan | TargetInImage | TargetInMarkers


@dataclass(frozen=True, eq=False, repr=False)
class Sighting(Value):
    """One target, seen by one sensor.

    Attributes:
        sensor: its name.
        target: the target, under the session's name of it.
        moment: number of the moment at which it was seen: those of one number show one scene.
        placement: what tells whether the target is where it was: equal where it is.
        seen: what was seen.
        file: of the session, for messages.
        time: seconds on the sensor's clock, or None; of a scan of what moves, the mean of the returns on the target.
        moving: whether the target, or the platform, moved.
        fired: the returns as they were fired, where those of `seen` were brought to one time.
        reading: which of its `candidates` it is read as.
    """

    sensor: str
    target: Target
    moment: int
    placement: str
    seen: Seen
    file: str
    time: float | None = None
    moving: bool = False
    fired: Scan | None = None
    reading: int = 0

    @cached_property
    def candidates(self) -> tuple[Candidate, ...]:
        """Ways to read it, the plainest first."""
        if isinstance(self.seen, TargetInMarkers):
            return (Candidate(self.seen.T_sensor_target, self.seen.covariance, np.eye(4)),)
        return candidates(self.seen, self.target)

    @cached_property
    def poses(self) -> Floats:
        """(I, 4, 4) T_sensor_target of every way to read it."""
        return np.stack([candidate.T_sensor_target for candidate in self.candidates])

    @property
    def relative(self) -> bool:
        """Whether it is known up to the target's symmetries, all ways to read it being one placement."""
        return isinstance(self.seen, TargetInScan)

    def read_as(self, number: int) -> Sighting:
        """Return it in one of its ways to be read."""
        return replace(self, reading=number)

    @cached_property
    def pose(self) -> Floats:
        """(4, 4) T_sensor_target by this sighting alone, as it is read."""
        return self.candidates[self.reading].T_sensor_target

    @property
    def S(self) -> Floats:
        """(4, 4) how it is read: the motion from its own labelling of the target to the one used, p' = S p."""
        return self.candidates[self.reading].S

    def relabelled(self, S: Floats) -> Sighting:
        """Return it with the target's labelling moved by one of its symmetries (4, 4) more."""
        wanted = S @ self.S
        off = [float(np.abs(candidate.S - wanted).max()) for candidate in self.candidates]
        return self.read_as(int(np.argmin(off)))

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"'{self.sensor}' in {self.file}"


def persistent(scans: Sequence[TargetInScan], common_sigma: float = 0.0) -> list[BiasedMeasurement]:
    """Return the measurements of one LiDAR's scans, its rings' errors in the same units in all of them.

    A scan whose biases look larger than the sensor file's has them in a unit of its own; here the unit is the scans'
    median.

    Args:
        scans: of one LiDAR.
        common_sigma: standard deviation of a range bias that all rings have alike, metres; 0: they have none.
    """
    unit = float(np.median([scan.bias_factor for scan in scans]))
    measurements = []
    for scan in scans:
        measurement, sensor = scan.persistent, scan.own.sensor
        k = len(measurement.shared)
        of_ranges = np.array([error.kind == RANGE_BIAS for error in measurement.shared], bool)
        stack = np.array(measurement.stack)
        stack[:, :k][:, of_ranges] *= unit / scan.bias_factor
        errors = measurement.shared
        if common_sigma > 0 and of_ranges.any():
            of_ring = unit * (sensor.ring_bias if sensor else 0.01)
            together = stack[:, :k][:, of_ranges].sum(axis=1) * common_sigma / of_ring
            stack, errors = np.column_stack([together, stack]), (SharedError(RANGE_BIAS), *errors)
        R = triangular(stack)
        measurements.append(BiasedMeasurement(R, measurement.n_rows, measurement.T_target_lidar, errors))
    return measurements


def read_as(measurement: BiasedMeasurement, S: Floats) -> BiasedMeasurement:
    """Return a measurement of T_target_lidar as one of the target relabelled by S (4, 4), p' = S p in metres."""
    return measurement if np.array_equal(S, np.eye(4)) else measurement.substituted(inverse(S))
