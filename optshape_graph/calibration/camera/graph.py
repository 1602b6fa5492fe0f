"""The calibration graph: built once from all sightings, solved over any of the views."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, K, L, O, P, S, W

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.factors import (
    INTRINSICS_SIGMA,
    OFFSET_SIGMA_M,
    PRINT_SIGMA_M,
    CompiledCamera,
    as_vector,
    coupling_factor,
)
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.camera.uncertainty import Uncertainty, uncertainty_of
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.factors import TemplateMeasurement
from optshape_graph.graph import Chain, Templates
from optshape_graph.graph import solve as minimise
from optshape_graph.graph.chain import State
from optshape_graph.graph.solution import linearised
from optshape_graph.se3 import adjoint, inverse


@dataclass(frozen=True)
class Unknowns:
    """What is estimated beside the extrinsics.

    Attributes:
        range_bias_sigma: prior standard deviation of each LiDAR's range bias, metres; 0: there is none.
        intrinsics: whether the cameras' lenses are refined, the given intrinsics being the prior; None: those that
            the images contradict.
    """

    range_bias_sigma: float = 0.03
    intrinsics: bool | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Sighting(Value):
    """A sighting with its place in the graph.

    Attributes:
        views: numbers of the views it belongs to; several where they share a scan or an image.
        sensor: name of the sensor.
        placement: number of the placement.
        seen: what the sensor saw.
        target: name of the target.
        S: (4, 4) motion from the sighting's labelling of the target to the placement's: p' = S p.
        T_sensor_target: (4, 4) pose of the target, in the placement's labelling, from this sighting alone.
        covariance: (6, 6) of its right perturbation.
    """

    views: tuple[int, ...]
    sensor: str
    placement: int
    seen: TargetInScan | TargetInImage
    target: str
    S: Floats
    T_sensor_target: Floats
    covariance: Floats


@dataclass(frozen=True)
class Discrepancy:
    """How much further than its noise model says a scan's pose of a target is off, in the target's frame.

    Attributes:
        rotation: standard deviation about each axis, rad.
        translation: standard deviation along each axis, metres.
    """

    rotation: float = 1e-4
    translation: float = 1e-4

    @property
    def sigmas(self) -> Floats:
        """(6,) standard deviations, rotation first."""
        return np.repeat([self.rotation, self.translation], 3)


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Value):
    """Where the sensors are, and where they saw the targets.

    Attributes:
        T_base_sensor: (4, 4) by sensor; the identity for the base LiDAR.
        T_target_base: (4, 4) by placement.
        range_bias: by LiDAR, metres, where it is estimated; positive: it measures too far.
        cameras: intrinsics by camera, refined or as given.
    """

    T_base_sensor: Mapping[str, Floats]
    T_target_base: Mapping[int, Floats]
    range_bias: Mapping[str, float] = field(default_factory=dict)
    cameras: Mapping[str, CameraIntrinsics] = field(default_factory=dict)


class CalibrationGraph:
    """The factors of all sightings.

    Args:
        sightings: of all views.
        base: name of the base LiDAR.
        range_bias_sigma: prior standard deviation of each LiDAR's range bias, metres; 0: there is none.
        refined: names of the cameras whose lens is a variable; of one with more than four distortion terms, focal
            lengths and principal point are.
        as_they_come: whether the clouds are to be fitted as they come, biases of the rings included.
    """

    def __init__(
        self,
        sightings: Sequence[Sighting],
        base: str,
        range_bias_sigma: float,
        refined: Collection[str] = (),
        as_they_come: bool = False,
    ) -> None:
        self._base, self._bias_sigma, self._refined, self._sightings = base, range_bias_sigma, refined, sightings
        self._as_they_come = as_they_come
        self._sensors = list(dict.fromkeys([base, *(sighting.sensor for sighting in sightings)]))
        self._targets = list(dict.fromkeys(sighting.target for sighting in sightings))
        self._points: dict[tuple[str, bool, tuple[float, ...]], int] = {}
        self._cameras = {
            s.sensor: CompiledCamera.of(s.seen.camera) for s in sightings if isinstance(s.seen, TargetInImage)
        }
        self._in_images = [self._image_factors(sighting) for sighting in sightings]

    def solve(self, used: Callable[[int], bool], start: Rig, discrepancy: Discrepancy) -> Rig:
        """Minimise over some of the views.

        Args:
            used: says of a view's number whether it takes part.
            start: where to start.
            discrepancy: of the scans.
        """
        factors, values, returns = self._build(used, start, discrepancy)
        return self._rig(minimise(values, [returns], factors).values, start)

    def uncertainty(self, used: Callable[[int], bool], rig: Rig, discrepancy: Discrepancy) -> Uncertainty:
        """Linearise at a solution over some of the views."""
        factors, values, returns = self._build(used, rig, discrepancy)
        rows: dict[tuple[str, str], slice] = {}
        kept: list[int] = []
        for number, name in enumerate(self._sensors):
            for key, kind in ((S(number), "pose"), (B(number), "range_bias")):
                if values.exists(key):
                    first = max((block.stop for block in rows.values()), default=0)
                    rows[kind, name] = slice(first, first + (6 if kind == "pose" else 1))
                    kept.append(key)
        shifts = {}
        for number, sighting in enumerate(self._sightings):
            if isinstance(sighting.seen, TargetInScan) and values.exists(L(number)):
                # (T Exp(x))^-1 = T^-1 Exp(-Ad(T) x)
                effect = -adjoint(sighting.seen.T_lidar_target) @ sighting.seen.shared_effect
                errors = [(sighting.sensor, error) for error in sighting.seen.shared]
                shifts[L(number)] = errors, sighting.seen.measurement.information() @ effect
        state = State.of(values)
        return uncertainty_of(linearised([returns.at(state)], factors, state), values, kept, rows, shifts)

    # The factors of one image, and what they touch.

    def _sensor_key(self, name: str) -> int | None:
        return None if name == self._base else S(self._sensors.index(name))

    def _image_factors(self, sighting: Sighting) -> list[gtsam.NonlinearFactor]:
        seen = sighting.seen
        if isinstance(seen, TargetInScan):
            return []
        sensor = self._sensors.index(sighting.sensor)
        points = seen.points.relabelled(sighting.S)
        k_points = [self._point(sighting.target, points.printed, point) for point in points.points]
        k_intrinsics = K(sensor) if sighting.sensor in self._refined else None
        camera = self._cameras[sighting.sensor]
        return camera.factors(points, W(sighting.placement), S(sensor), k_points, k_intrinsics)

    def _point(self, target: str, printed: bool, point: Floats) -> int:
        """Return the key of a point: one for the same place of the same target in all images."""
        place = (target, printed, tuple((np.round(point, 6) + 0.0).tolist()))
        return P(self._points.setdefault(place, len(self._points)))

    def _build(
        self, used: Callable[[int], bool], start: Rig, discrepancy: Discrepancy
    ) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, Templates]:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        measurements, chains = list[TemplateMeasurement](), list[Chain]()
        for number, (sighting, factors) in enumerate(zip(self._sightings, self._in_images, strict=True)):
            if not any(used(view) for view in sighting.views):
                continue
            for factor in factors:
                graph.push_back(factor)
            if not values.exists(W(sighting.placement)):
                values.insert(W(sighting.placement), gtsam.Pose3(start.T_target_base[sighting.placement]))
            if isinstance(sighting.seen, TargetInScan):
                T_target_lidar = start.T_target_base[sighting.placement] @ start.T_base_sensor[sighting.sensor]
                values.insert(L(number), gtsam.Pose3(T_target_lidar))
                measurements.append(sighting.seen.uncorrected if self._as_they_come else sighting.seen.measurement)
                chains.append([inverse(sighting.S), L(number)])
                k_bias = B(self._sensors.index(sighting.sensor)) if self._bias_sigma > 0 else None
                keys = (W(sighting.placement), self._sensor_key(sighting.sensor), L(number), k_bias)
                graph.push_back(coupling_factor(keys, sighting.seen, discrepancy.sigmas, T_target_lidar))
        keys_used = set(graph.keyVector())
        self._add_points(graph, values, keys_used)
        self._add_sensors(graph, values, keys_used, start)
        return graph, values, Templates.of(measurements, chains)

    def _add_points(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: set[int]) -> None:
        exact = gtsam.noiseModel.Isotropic.Sigma(3, PRINT_SIGMA_M)
        for (target, printed, place), number in self._points.items():
            if P(number) not in keys:
                continue
            values.insert(P(number), np.array(place))
            if not printed:
                graph.push_back(gtsam.PriorFactorPoint3(P(number), np.array(place), exact))
                continue
            k_offset = O(self._targets.index(target))
            graph.push_back(gtsam.BetweenFactorPoint3(k_offset, P(number), np.array(place), exact))
            if not values.exists(k_offset):
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.array(OFFSET_SIGMA_M))
                graph.push_back(gtsam.PriorFactorPoint3(k_offset, np.zeros(3), noise))
                values.insert(k_offset, np.zeros(3))

    def _add_sensors(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, keys: set[int], start: Rig) -> None:
        for number, name in enumerate(self._sensors):
            if S(number) in keys:
                values.insert(S(number), gtsam.Pose3(start.T_base_sensor[name]))
            if B(number) in keys:
                values.insert(B(number), start.range_bias.get(name, 0.0))
                noise = gtsam.noiseModel.Isotropic.Sigma(1, self._bias_sigma)
                graph.push_back(gtsam.PriorFactorDouble(B(number), 0.0, noise))
            if K(number) in keys:
                given = self._cameras[name]
                values.insert(K(number), replace(given, intrinsics=start.cameras[name]).calibration)
                prior = getattr(gtsam, f"PriorFactor{type(given.calibration).__name__}")
                sigmas = INTRINSICS_SIGMA[: 5 if given.ideal else None]
                graph.push_back(prior(K(number), given.calibration, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))

    def _rig(self, values: gtsam.Values, start: Rig) -> Rig:
        T_base_sensor, range_bias, cameras = {self._base: np.eye(4)}, {}, dict(start.cameras)
        for number, name in enumerate(self._sensors):
            if values.exists(S(number)):
                T_base_sensor[name] = values.atPose3(S(number)).matrix()
            if values.exists(B(number)):
                range_bias[name] = values.atDouble(B(number))
            if values.exists(K(number)):
                camera = self._cameras[name]
                read = values.atCal3Fisheye if camera.intrinsics.model == "equidistant" else values.atCal3DS2
                cameras[name] = camera.refined(as_vector(read(K(number))))
        T_target_base = {
            placement: values.atPose3(W(placement)).matrix() if values.exists(W(placement)) else T
            for placement, T in start.T_target_base.items()
        }
        return Rig(T_base_sensor, T_target_base, range_bias, cameras)
