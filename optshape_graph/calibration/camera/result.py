"""What a camera calibration results in, and the form in which it is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np

from optshape_graph._arrays import Floats, Value, shortened
from optshape_graph.calibration.camera.consistency import of_view
from optshape_graph.calibration.camera.evidence import CrossValidation, ViewErrors
from optshape_graph.calibration.camera.graph import Discrepancy, Rig, Sighting
from optshape_graph.calibration.camera.lens import LensCheck
from optshape_graph.calibration.camera.next_placement import NextPlacement, suggest_placement
from optshape_graph.calibration.camera.observability import Direction, principal_directions
from optshape_graph.calibration.camera.sightings import TargetInScan, View
from optshape_graph.calibration.camera.uncertainty import Uncertainty
from optshape_graph.calibration.exports import Mounted, static_transforms
from optshape_graph.calibration.free_shape import MeasuredShape, measure_shape
from optshape_graph.calibration.verdict import Calibration, Finding
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.results import Row
from optshape_graph.se3 import difference, inverse, inverse_covariance, relative_covariance
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class ViewResult(Value):
    """What became of a view.

    Attributes:
        view: the view.
        used: whether it takes part in the calibration.
        reason: why it does not, "" if it does.
        errors: by the extrinsic of the other views where it takes part, of all used ones where it does not; None
            where there is nothing to compare.
    """

    view: View
    used: bool
    reason: str
    errors: ViewErrors | None


@dataclass(frozen=True, eq=False, repr=False)
class CameraCalibration(Calibration):
    """The sensors' places, and how far to trust them.

    Attributes:
        lidars: names; the first is the base.
        cameras: names.
        rig: where the sensors are, for clouds as they come.
        corrected: where they are, for clouds whose ranges are corrected by its `range_bias`; None where no bias is
            estimated.
        given: where they are, for clouds as they come and the lenses as they were given; None where none was refined.
        most_likely: where they are if range biases and all lenses may be off, the given ones being a prior.
        uncertainty: of those places.
        views: what became of them, in the order given.
        cross_validations: leave-one-out, and k-fold.
        discrepancy: what the scans scatter beyond their noise model; the covariances allow for it.
        lenses: what the images say of the lenses, where they are many enough to say something.
        refined: names of the cameras whose lens was refined: the extrinsics belong to the rig's intrinsics.
        shapes: each target's shape by each LiDAR's scans of the used views, vertices free, by the names of both.
        findings: what is wrong, or has to be known before trusting the result.
        sightings: how every sighting was read.
        passed_over: what of the session's files was not used.
    """

    FORM: ClassVar[str] = "camera-calibration"

    lidars: tuple[str, ...]
    cameras: tuple[str, ...]
    rig: Rig
    corrected: Rig | None
    given: Rig | None
    most_likely: Rig
    uncertainty: Uncertainty
    views: tuple[ViewResult, ...]
    cross_validations: tuple[CrossValidation, ...]
    discrepancy: Discrepancy
    lenses: tuple[LensCheck, ...]
    refined: frozenset[str]
    shapes: Mapping[tuple[str, str], MeasuredShape]
    findings: tuple[Finding, ...]
    sightings: tuple[Sighting, ...]
    passed_over: PassedOver = field(default_factory=PassedOver, compare=False)

    def transform(self, a: str, b: str, rig: Rig | None = None) -> tuple[Floats, Floats]:
        """Return T_a_b (4, 4) of two sensors, and the covariance (6, 6) of its right perturbation (frame b).

        The covariance is that of where the sensors are. A range bias in the clouds, or a lens that is not quite as
        given, moves the transform away from the most likely one, and the covariance allows for it: the mean square
        error of T is P + m m^T, P being the covariance of the most likely one and m the difference of the two.

        Args:
            a: a sensor's name.
            b: another's.
            rig: `rig`, which is for clouds as they come (by default), `corrected` or `given`.

        Raises:
            InputError: no such sensor.
        """
        for name in (a, b):
            if name not in self.rig.T_base_sensor:
                raise InputError(f"no sensor '{name}'; the session has: {', '.join((*self.lidars, *self.cameras))}")
        T, T_likely = (
            inverse(each.T_base_sensor[a]) @ each.T_base_sensor[b] for each in (rig or self.rig, self.most_likely)
        )
        rows = (self.uncertainty.rows.get(("pose", name)) for name in (a, b))
        moved = difference(T, T_likely)
        return T, relative_covariance(T_likely, self.uncertainty.covariance, *rows) + np.outer(moved, moved)

    def mounted(self) -> list[Mounted]:
        """Return where the sensors are, for clouds as they come: LiDARs first, the base before all."""
        lenses = self.rig.cameras
        return [
            Mounted(name, self.transform(self.lidars[0], name)[0], lenses.get(name))
            for name in (*self.lidars, *self.cameras)
        ]

    def range_bias(self, lidar: str) -> tuple[float, float]:
        """Return a LiDAR's range bias, metres, and its standard deviation; positive: it measures too far.

        It is that of `corrected`; as with `transform`, the deviation allows for a lens that is not quite as given.
        """
        if self.corrected is None or lidar not in self.corrected.range_bias:
            return 0.0, 0.0
        row = self.uncertainty.rows["range_bias", lidar].start
        moved = self.corrected.range_bias[lidar] - self.most_likely.range_bias[lidar]
        return self.corrected.range_bias[lidar], float(np.sqrt(self.uncertainty.covariance[row, row] + moved**2))

    def edge_insets(self, lidar: str) -> Floats:
        """Return the azimuths (N,), rad, from a ring's last return to the target's edge in a LiDAR's used scans.

        Each is the median of a scan; clouds without rings have none.
        """
        scans = {id(result.view.scan): result.view.scan for result in self.views if result.used and result.view.scan}
        insets = np.array([scan.edge_inset for scan in scans.values() if scan.lidar == lidar], dtype=float)
        return np.asarray(insets[np.isfinite(insets)])

    def edge_inset(self, lidar: str) -> float:
        """Return the median of the scans' `edge_insets`, rad; not a number where the clouds have no rings."""
        insets = self.edge_insets(lidar)
        return float(np.median(insets)) if len(insets) else float("nan")

    def pairs(self, lidar: str, camera: str) -> list[tuple[Sighting, Sighting]]:
        """Return the scans and images of the used views that the two sensors took together."""
        found = [of_view(number, self.sightings) for number, result in enumerate(self.views) if result.used]
        return [(s, i) for s, i in found if s and i and (s.sensor, i.sensor) == (lidar, camera)]

    def directions(self, lidar: str, camera: str) -> list[Direction]:
        """Return the principal directions of the uncertainty of T_camera_lidar, as it is stated, the worst first."""
        return principal_directions(self.transform(camera, lidar)[1], self._middle(lidar))

    def most_likely_sigma(self, lidar: str, camera: str) -> float:
        """Return the standard deviation of the worst direction, metres, of the most likely transform, lens free."""
        covariance = self.transform(camera, lidar, self.most_likely)[1]
        return principal_directions(covariance, self._middle(lidar))[0].sigma_m

    def next_placement(self, lidar: str, camera: str) -> NextPlacement | None:
        """Suggest where to put the target next; None where the two took no view together."""
        pairs = self.pairs(lidar, camera)
        if not pairs:
            return None
        T, covariance = self.transform(camera, lidar, self.most_likely)
        target = self.views[pairs[0][0].views[0]].view.target
        return suggest_placement(target, pairs, self.rig.cameras[camera], T, covariance)

    def _middle(self, lidar: str) -> Floats:
        used = [s for s in self.sightings if any(self.views[view].used for view in s.views)]
        return middle([s for s in used if s.sensor == lidar])

    def __repr__(self) -> str:
        used, means = sum(view.used for view in self.views), self.cross_validations[0].means()
        covariance = self.transform(self.cameras[0], self.lidars[0])[1]
        sd = np.sqrt(np.diag(covariance))
        said = f"± {1e3 * sd[3:].max():.1f} mm, ± {np.degrees(sd[:3].max()):.2f} deg, {self.verdict}"
        centre = f"centre {means['mean_centre_error_mm']:.1f} mm" if means else "no errors"
        return shortened(f"CameraCalibration({used} of {len(self.views)} views, {centre}, {said})")

    def rows(self) -> list[Row]:
        """Return a row for each view: whether it was used, and its errors, left out of what predicts it."""
        return [_view(view) for view in self.views]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, `schema: optshape/camera-calibration/1`.

        With one LiDAR and one camera the transform stands at the top; with several, `extrinsics` lists every pair, and
        the top repeats the first.
        """
        pairs = [_pair(self, lidar, camera) for camera in self.cameras for lidar in self.lidars]
        several = len(pairs) > 1
        biases = [_lidar_errors(self, lidar) for lidar in self.lidars]
        document: dict[str, Any] = {"schema": "optshape/camera-calibration/1", **pairs[0], **biases[0]}
        if several:
            document["extrinsics"] = pairs
            document["lidars"] = [
                {"lidar": lidar, **bias, **_lidar_pair(self, lidar)}
                for lidar, bias in zip(self.lidars, biases, strict=True)
            ]
        document["discrepancy"] = {
            "rotation_deg": float(np.degrees(self.discrepancy.rotation)),
            "translation_m": self.discrepancy.translation,
        }
        document["views"] = [_view(result) for result in self.views]
        for key, validation in zip(("cross_validation", "k_fold"), self.cross_validations, strict=True):
            document[key] = {"protocol": validation.protocol, "views": len(validation.views), **validation.means()}
        document["cameras"] = [_camera(self, name) for name in self.cameras]
        document["targets"] = [_shape(lidar, shape) for (lidar, _), shape in self.shapes.items()]
        document["verdict"] = self.verdict
        document["warnings"] = list(self.warnings)
        document |= self.passed_over.to_dict()
        return document


def measure_shapes(views: Sequence[ViewResult]) -> dict[tuple[str, str], MeasuredShape]:
    """Measure each target's shape by each LiDAR's scans of the used views, vertices free, by the names of both."""
    used: dict[tuple[str, str], dict[int, TargetInScan]] = {}
    targets: dict[str, Target] = {}
    for result in views:
        if result.used and (scan := result.view.scan) is not None:
            used.setdefault((scan.lidar, result.view.target.name), {})[id(scan)] = scan
            targets[result.view.target.name] = result.view.target
    found = {}
    for (lidar, name), scans in used.items():
        with suppress(EstimationError):  # angles with noise: no shape to be told
            found[lidar, name] = measure_shape([scan.own for scan in scans.values()], targets[name])
    return found


def middle(scans: Sequence[Sighting]) -> Floats:
    """Return the mean centre (3,), metres, of the targets in scans of one LiDAR."""
    return np.asarray(np.mean([scan.T_sensor_target[:3, 3] for scan in scans], axis=0))


def _pair(calibration: CameraCalibration, lidar: str, camera: str) -> dict[str, Any]:
    T_camera_lidar, covariance = calibration.transform(camera, lidar)
    T_lidar_camera = inverse(T_camera_lidar)
    found: dict[str, Any] = {
        "camera": camera,
        "lidar": lidar,
        "T_camera_lidar": T_camera_lidar.tolist(),
        "covariance": covariance.tolist(),
        "T_lidar_camera": T_lidar_camera.tolist(),
        "covariance_T_lidar_camera": inverse_covariance(T_camera_lidar, covariance).tolist(),
        "static_transforms": {
            "T_lidar_camera": static_transforms(lidar, camera, T_lidar_camera),
            "T_camera_lidar": static_transforms(camera, lidar, T_camera_lidar),
        },
        "directions": [
            {"direction": direction.text, "sigma_m": direction.sigma_m}
            for direction in calibration.directions(lidar, camera)
        ],
    }
    for rig, name in ((calibration.corrected, "corrected"), (calibration.given, "given_lens")):
        if rig is not None:
            T, covariance = calibration.transform(camera, lidar, rig)
            found[f"T_camera_lidar_{name}"] = T.tolist()
            found[f"covariance_T_camera_lidar_{name}"] = covariance.tolist()
    if (suggestion := calibration.next_placement(lidar, camera)) is not None:
        found["next_placement"] = {
            "T_lidar_target": suggestion.T_lidar_target.tolist(),
            "yaw_deg": suggestion.yaw_deg,
            "pitch_deg": suggestion.pitch_deg,
            "worst_direction": suggestion.worst,
            "sigma_m": suggestion.sigma_m,
            "expected_sigma_m": suggestion.expected_sigma_m,
        }
    return found


def _lidar_pair(calibration: CameraCalibration, lidar: str) -> dict[str, Any]:
    base = calibration.lidars[0]
    if lidar == base:
        return {}
    T, covariance = calibration.transform(base, lidar)
    return {"base": base, "T_base_lidar": T.tolist(), "covariance": covariance.tolist()}


def _lidar_errors(calibration: CameraCalibration, lidar: str) -> dict[str, float | None]:
    value, sigma = calibration.range_bias(lidar)
    inset = float(np.degrees(calibration.edge_inset(lidar)))
    return {"range_bias_m": value, "range_bias_sigma_m": sigma, "edge_inset_deg": inset if np.isfinite(inset) else None}


def _shape(lidar: str, shape: MeasuredShape) -> dict[str, Any]:
    return {
        "target": shape.target.name,
        "lidar": lidar,
        "sides_m": shape.target.edge_lengths.tolist(),
        "measured_sides_m": shape.joint.sides.tolist(),
        "sigma_m": np.sqrt(np.diag(shape.joint.sides_covariance)).tolist(),
        "measured_vertices": shape.joint.polygon.tolist(),
        "agrees": shape.agrees,
        "beam_crossing": shape.beam_crossing,
        "mean_absolute_error_m": shape.mean_absolute_error,
        "scans": [{"scan": scan.name, "measured_sides_m": scan.sides.tolist()} for scan in shape.scans],
    }


def _view(result: ViewResult) -> dict[str, Any]:
    nothing = dict.fromkeys(("centre_error_mm", "plane_offset_mm", "normal_error_deg", "reprojection_px"))
    return {
        "scan": result.view.scan_name,
        "image": result.view.image_name,
        "target": result.view.target.name,
        "lidar": result.view.scan.lidar if result.view.scan else None,
        "camera": result.view.image.camera.name if result.view.image else None,
        "used": result.used,
        "reason": result.reason,
        **(asdict(result.errors) if result.errors is not None else nothing),
    }


def _camera(calibration: CameraCalibration, name: str) -> dict[str, Any]:
    camera = calibration.rig.cameras[name]
    found: dict[str, Any] = {
        "name": camera.name,
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        "K": np.asarray(camera.K).tolist(),
        "D": np.asarray(camera.D).tolist(),
        "refined": name in calibration.refined,
    }
    if calibration.given is not None:
        lens = calibration.given.cameras[name]
        found["given"] = {"K": np.asarray(lens.K).tolist(), "D": np.asarray(lens.D).tolist()}
    return found
