"""What a rig's calibration results in, and the form in which it is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from optshape_graph._arrays import Floats, Value, shortened
from optshape_graph.calibration.camera.observability import Direction, principal_directions
from optshape_graph.calibration.exports import Mounted, static_transforms
from optshape_graph.calibration.rig.sightings import Kind
from optshape_graph.calibration.verdict import Calibration, Finding
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.results import Row
from optshape_graph.se3 import inverse, inverse_covariance, relative_covariance

AXES = ("x", "y", "z")

DISAGREES = "disagrees with "
"""How the reason of a sighting begins that contradicts the others."""


@dataclass(frozen=True)
class RingError:
    """What the session says of an error that a LiDAR's ring keeps.

    Attributes:
        kind: what it is, such as "range bias" or "elevation".
        ring: its number, from the lowest; None: all rings have it alike.
        value: in standard deviations of what the sensor file lets expect; positive: it measures too far, or looks above
            its table.
        sigma: its standard deviation, in the same unit.
    """

    kind: str
    ring: int | None
    value: float
    sigma: float


@dataclass(frozen=True, eq=False, repr=False)
class RigSensor(Value):
    """A sensor of a rig.

    Attributes:
        name: of the sensor.
        kind: "lidar", "camera" or "mocap body".
        T_base_sensor: (4, 4) where it is in the first sensor's frame.
        T_base_sensor_as_they_come: (4, 4) the same for clouds whose rings nobody corrects.
        time_offset: seconds by which its clock is ahead of the first sensor's: what happens at t has the stamp
            t + offset; 0 where nothing moved.
        sightings: how many of them take part.
        rings: a LiDAR's errors.
        lens: a camera's intrinsics.
    """

    name: str
    kind: Kind
    T_base_sensor: Floats
    T_base_sensor_as_they_come: Floats
    time_offset: float
    sightings: int
    rings: tuple[RingError, ...] = ()
    lens: CameraIntrinsics | None = None


@dataclass(frozen=True)
class SightingResult:
    """What became of a sighting.

    Attributes:
        sensor: whose.
        target: of which target.
        placement: which place of the target.
        file: of the session.
        used: whether it takes part.
        reason: why it does not, "" if it does.
        centre_error_m: distance of the target's centre from where the placement's other sightings see it by the rig of
            all other placements, metres; None where nothing is left to compare with.
        turn_error_deg: angle between the rotations, degrees, likewise.
        chi_square: both in the stated covariances: 6 degrees of freedom.
    """

    sensor: str
    target: str
    placement: str
    file: str
    used: bool
    reason: str
    centre_error_m: float | None = None
    turn_error_deg: float | None = None
    chi_square: float | None = None


@dataclass(frozen=True, eq=False, repr=False)
class NextPlacement(Value):
    """A placement of a target that was not taken yet.

    Attributes:
        target: its name.
        sensor: in whose frame it is stated.
        T_sensor_target: (4, 4).
        seen_by: names of the sensors that are expected to see it.
        pair: of the sensors that are known worst to one another.
        worst: their worst direction now, in words.
        sigma_m: its standard deviation now, metres.
        expected_sigma_m: the standard deviation of the worst direction with this placement, metres.
    """

    target: str
    sensor: str
    T_sensor_target: Floats
    seen_by: tuple[str, ...]
    pair: tuple[str, str]
    worst: str
    sigma_m: float
    expected_sigma_m: float

    @property
    def text(self) -> str:
        """The advice in words."""
        x, y, z = self.T_sensor_target[:3, 3]
        a, b = self.pair
        return (
            f"with '{self.target}' at ({x:.1f}, {y:.1f}, {z:.1f}) m in '{self.sensor}', its normal along "
            f"({', '.join(f'{n:.2f}' for n in self.T_sensor_target[:3, 0])}), in view of "
            f"{', '.join(self.seen_by)}, the worst direction of '{a}' and '{b}' would be "
            f"{1e3 * self.expected_sigma_m:.1f} mm instead of {1e3 * self.sigma_m:.1f}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class RigCalibration(Calibration):
    """Where a rig's sensors are to one another, and how far to trust it.

    Attributes:
        sensors: the first is the base.
        covariance: (6 n - 6, 6 n - 6) of the right perturbations of T_base_sensor of all but the base, rotation first,
            and
        time_covariance: (n - 1, n - 1) of their time offsets, square seconds.
        middle: (3,) middle of the targets, metres, the base's frame.
        scatter: what sightings are off by, mean square, in their standard deviations: 1 where covariances are right.
            Where it is significantly more, the covariance is widened by it.
        sightings: what became of each.
        unobservable: directions that nothing determines, in words.
        next_placement: where to put a target next; None where no placement tried would help.
        findings: what is wrong, or has to be known before trusting the result.
        passed_over: what of the session's files was not used.
    """

    FORM: ClassVar[str] = "rig"

    sensors: tuple[RigSensor, ...]
    covariance: Floats
    time_covariance: Floats
    middle: Floats
    scatter: float
    sightings: tuple[SightingResult, ...]
    unobservable: tuple[str, ...]
    next_placement: NextPlacement | None
    findings: tuple[Finding, ...]
    passed_over: PassedOver = field(default_factory=PassedOver, compare=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(sensor.name for sensor in self.sensors)

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Every pair of sensors."""
        return list(combinations(self.names, 2))

    @property
    def contradicting(self) -> tuple[SightingResult, ...]:
        """The sightings that take no part because they contradict the others."""
        return tuple(sighting for sighting in self.sightings if sighting.reason.startswith(DISAGREES))

    def transform(self, a: str, b: str) -> tuple[Floats, Floats]:
        """Return T_a_b (4, 4), and the covariance (6, 6) of its right perturbation: rotation first, frame b.

        Raises:
            InputError: no such sensor.
        """
        i, j = self._number(a), self._number(b)
        T = inverse(self.sensors[i].T_base_sensor) @ self.sensors[j].T_base_sensor
        rows = (slice(6 * k - 6, 6 * k) if k > 0 else None for k in (i, j))
        return T, relative_covariance(T, self.covariance, *rows)

    def as_they_come(self, a: str, b: str) -> Floats:
        """Return T_a_b (4, 4) for clouds whose rings nobody corrects.

        Raises:
            InputError: no such sensor.
        """
        T_a, T_b = (self.sensors[self._number(name)].T_base_sensor_as_they_come for name in (a, b))
        return inverse(T_a) @ T_b

    def time_offset(self, a: str, b: str) -> tuple[float, float]:
        """Return by how many seconds b's clock is ahead of a's, and the standard deviation.

        Raises:
            InputError: no such sensor.
        """
        i, j = self._number(a), self._number(b)
        c = np.zeros(len(self.sensors))
        c[j], c[i] = c[j] + 1.0, c[i] - 1.0
        variance = float(c[1:] @ self.time_covariance @ c[1:])
        return self.sensors[j].time_offset - self.sensors[i].time_offset, float(np.sqrt(max(variance, 0.0)))

    def directions(self, a: str, b: str) -> list[Direction]:
        """Return the principal directions of the uncertainty of T_a_b, in frame b, the worst first.

        Raises:
            InputError: a sensor that the rig does not have.
        """
        T_b_base = inverse(self.sensors[self._number(b)].T_base_sensor)
        centre = T_b_base[:3, :3] @ self.middle + T_b_base[:3, 3]
        return principal_directions(self.transform(a, b)[1], centre, b)

    def mounted(self) -> list[Mounted]:
        """Return where the sensors are, for other programs."""
        return [Mounted(sensor.name, sensor.T_base_sensor, sensor.lens) for sensor in self.sensors]

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise InputError(f"no sensor '{name}'; the rig has: {', '.join(self.names)}")
        return self.names.index(name)

    def __repr__(self) -> str:
        sd = np.sqrt(np.abs([np.diag(self.transform(a, b)[1]) for a, b in self.pairs]))
        used = sum(sighting.used for sighting in self.sightings)
        said = f"± {1e3 * sd[:, 3:].max():.1f} mm, ± {np.degrees(sd[:, :3].max()):.3f} deg, {self.verdict}"
        return shortened(f"RigCalibration({', '.join(self.names)}: {used} of {len(self.sightings)} sightings, {said})")

    def rows(self) -> list[Row]:
        """Return a row for each pair of sensors: where the second is in the first's frame, and how well it is known."""
        rows = []
        for a, b in self.pairs:
            T, covariance = self.transform(a, b)
            sd = np.sqrt(np.abs(np.diag(covariance)))
            rows.append({
                "a": a, "b": b, **{f"{axis}_m": float(T[k, 3]) for k, axis in enumerate(AXES)},
                **{f"sd_{axis}_mm": float(1e3 * sd[3 + k]) for k, axis in enumerate(AXES)},
                **{f"sd_about_{axis}_deg": float(np.degrees(sd[k])) for k, axis in enumerate(AXES)},
                "time_offset_ms": 1e3 * self.time_offset(a, b)[0], "sd_ms": 1e3 * self.time_offset(a, b)[1],
            })  # fmt: skip
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, `schema: optshape/rig/1`."""
        suggestion = self.next_placement
        return {
            "schema": "optshape/rig/1",
            "verdict": self.verdict,
            "warnings": list(self.warnings),
            "base": self.names[0],
            "transforms": [self._pair(a, b) for a, b in self.pairs],
            "sensors": [_sensor(sensor) for sensor in self.sensors],
            "scatter": self.scatter,
            "unobservable": list(self.unobservable),
            "protocol": "leave-one-out by placement",
            "sightings": [vars(sighting) for sighting in self.sightings],
            "mean": means(self.sightings),
            "next_placement": None if suggestion is None else {
                "target": suggestion.target, "sensor": suggestion.sensor,
                "T_sensor_target": suggestion.T_sensor_target.tolist(), "seen_by": list(suggestion.seen_by),
                "pair": list(suggestion.pair), "worst_direction": suggestion.worst, "sigma_m": suggestion.sigma_m,
                "expected_sigma_m": suggestion.expected_sigma_m,
            },
            **self.passed_over.to_dict(),
        }  # fmt: skip

    def _pair(self, a: str, b: str) -> dict[str, Any]:
        T, covariance = self.transform(a, b)
        sd, (offset, offset_sd) = np.sqrt(np.abs(np.diag(covariance))), self.time_offset(a, b)
        return {
            "a": a,
            "b": b,
            "T_a_b": T.tolist(),
            "covariance": covariance.tolist(),
            "T_b_a": inverse(T).tolist(),
            "covariance_T_b_a": inverse_covariance(T, covariance).tolist(),
            "T_a_b_as_they_come": self.as_they_come(a, b).tolist(),
            "time_offset_s": offset,
            "time_offset_sd_s": offset_sd,
            "frame": b,
            "sd_deg": {axis: float(np.degrees(sd[k])) for k, axis in enumerate(AXES)},
            "sd_m": {axis: float(sd[3 + k]) for k, axis in enumerate(AXES)},
            "directions": [{"direction": d.text, "sigma_m": d.sigma_m} for d in self.directions(a, b)],
            "static_transforms": static_transforms(a, b, T),
        }


def means(sightings: Sequence[SightingResult]) -> dict[str, dict[str, float]]:
    """Return each sensor's mean errors, the placements left out."""
    found: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(sighting.sensor for sighting in sightings):
        own = [s for s in sightings if s.sensor == name and s.centre_error_m is not None]
        if own:
            found[name] = {
                key: float(np.mean([getattr(sighting, key) for sighting in own]))
                for key in ("centre_error_m", "turn_error_deg", "chi_square")
            }
    return found


def _sensor(sensor: RigSensor) -> dict[str, Any]:
    return {
        "sensor": sensor.name,
        "kind": sensor.kind,
        "T_base_sensor": sensor.T_base_sensor.tolist(),
        "sightings": sensor.sightings,
        "rings": [vars(ring) for ring in sensor.rings],
    }
