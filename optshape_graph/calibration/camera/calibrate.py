"""LiDAR-camera calibration from views of targets: start, joint solution, rejection of bad views, evidence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.consistency import (
    LIMIT,
    describe,
    estimate_discrepancy,
    of_view,
    scatter,
    squared_distances,
)
from optshape_graph.calibration.camera.evidence import CrossValidation, ViewErrors, view_errors
from optshape_graph.calibration.camera.graph import CalibrationGraph, Discrepancy, Rig, Sighting, Unknowns
from optshape_graph.calibration.camera.lens import LensCheck, check_lenses
from optshape_graph.calibration.camera.next_placement import NextPlacement, suggest_placement
from optshape_graph.calibration.camera.noise import with_estimated_pixel_noise
from optshape_graph.calibration.camera.observability import (
    Direction,
    check_observable,
    parallel_planes,
    principal_directions,
)
from optshape_graph.calibration.camera.sightings import TargetInScan, View
from optshape_graph.calibration.camera.start import Start, find_start
from optshape_graph.calibration.camera.uncertainty import Uncertainty
from optshape_graph.calibration.free_shape import MeasuredShape, measure_shape
from optshape_graph.errors import EstimationError
from optshape_graph.se3 import adjoint, inverse
from optshape_graph.target import Target

FOLDS = 5
FEW_VIEWS = 5
"""Views below which a warning says that there is little evidence."""

Progress = Callable[[int, int], None]
"""Called with how many solutions are done, and how many there are."""


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
class CameraCalibration(Value):
    """The sensors' places, and how far to trust them.

    Attributes:
        lidars: names; the first is the base.
        cameras: names.
        rig: where the sensors are.
        uncertainty: of their places.
        views: what became of them, in the order given.
        cross_validations: leave-one-out, and k-fold.
        discrepancy: what the scans scatter beyond their noise model; the covariances allow for it.
        lenses: what the images say of the lenses, where they are many enough to say something.
        refined: names of the cameras whose lens was refined: the extrinsics belong to the rig's intrinsics.
        warnings: what to know before trusting the result.
        sightings: how every sighting was read.
    """

    lidars: tuple[str, ...]
    cameras: tuple[str, ...]
    rig: Rig
    uncertainty: Uncertainty
    views: tuple[ViewResult, ...]
    cross_validations: tuple[CrossValidation, ...]
    discrepancy: Discrepancy
    lenses: tuple[LensCheck, ...]
    refined: frozenset[str]
    warnings: tuple[str, ...]
    sightings: tuple[Sighting, ...]

    def transform(self, a: str, b: str) -> tuple[Floats, Floats]:
        """Return T_a_b (4, 4) of two sensors, and the covariance (6, 6) of its right perturbation (frame b)."""
        rig, rows = self.rig, self.uncertainty.rows
        T = inverse(rig.T_base_sensor[a]) @ rig.T_base_sensor[b]
        J = np.zeros((6, len(self.uncertainty.covariance)))
        # (T_a Exp(x_a))^-1 T_b Exp(x_b) = T_a_b Exp(x_b - Ad(T_b_a) x_a)
        for name, block in ((b, np.eye(6)), (a, -adjoint(inverse(T)))):
            if ("pose", name) in rows:
                J[:, rows["pose", name]] += block
        return T, J @ self.uncertainty.covariance @ J.T

    def range_bias(self, lidar: str) -> tuple[float, float]:
        """Return a LiDAR's range bias, metres, and its standard deviation; positive: it measures too far."""
        if lidar not in self.rig.range_bias:
            return 0.0, 0.0
        row = self.uncertainty.rows["range_bias", lidar].start
        return self.rig.range_bias[lidar], float(np.sqrt(self.uncertainty.covariance[row, row]))

    def edge_inset(self, lidar: str) -> float:
        """Return the median azimuth from a ring's last return to the target's edge over a LiDAR's used scans, rad.

        Not a number where the clouds have no rings.
        """
        scans = {id(result.view.scan): result.view.scan for result in self.views if result.used and result.view.scan}
        insets = [scan.edge_inset for scan in scans.values() if scan.lidar == lidar and np.isfinite(scan.edge_inset)]
        return float(np.median(insets)) if insets else float("nan")

    def pairs(self, lidar: str, camera: str) -> list[tuple[Sighting, Sighting]]:
        """Return the scans and images of the used views that the two sensors took together."""
        found = [of_view(number, self.sightings) for number, result in enumerate(self.views) if result.used]
        return [(s, i) for s, i in found if s and i and (s.sensor, i.sensor) == (lidar, camera)]

    def directions(self, lidar: str, camera: str) -> list[Direction]:
        """Return the principal directions of the uncertainty of T_camera_lidar, the worst first."""
        return principal_directions(self.transform(camera, lidar)[1], self._middle(lidar))

    def next_placement(self, lidar: str, camera: str) -> NextPlacement | None:
        """Suggest where to put the target next; None where the two took no view together."""
        pairs = self.pairs(lidar, camera)
        if not pairs:
            return None
        T, covariance = self.transform(camera, lidar)
        target = self.views[pairs[0][0].views[0]].view.target
        return suggest_placement(target, pairs, self.rig.cameras[camera], T, covariance)

    @cached_property
    def shapes(self) -> dict[tuple[str, str], MeasuredShape]:
        """Each target's shape by each LiDAR's scans of the used views, vertices free, by the names of both."""
        used: dict[tuple[str, str], dict[int, TargetInScan]] = {}
        targets: dict[str, Target] = {}
        for result in self.views:
            if result.used and (scan := result.view.scan) is not None:
                used.setdefault((scan.lidar, result.view.target.name), {})[id(scan)] = scan
                targets[result.view.target.name] = result.view.target
        found = {}
        for (lidar, name), scans in used.items():
            with suppress(EstimationError):  # angles with noise: no shape to be told
                found[lidar, name] = measure_shape([scan.own for scan in scans.values()], targets[name])
        return found

    def _middle(self, lidar: str) -> Floats:
        used = [s for s in self.sightings if any(self.views[view].used for view in s.views)]
        return middle([s for s in used if s.sensor == lidar])


def middle(scans: Sequence[Sighting]) -> Floats:
    """Return the mean centre (3,), metres, of the targets in scans of one LiDAR."""
    return np.asarray(np.mean([scan.T_sensor_target[:3, 3] for scan in scans], axis=0))


def calibrate(
    views: Sequence[View], unknowns: Unknowns | None = None, progress: Progress | None = None
) -> CameraCalibration:
    """Calibrate LiDARs and cameras jointly from views of targets; no initial guess is needed.

    Args:
        views: of all sensors.
        unknowns: what is estimated beside the extrinsics.
        progress: called as the cross-validation advances.

    Raises:
        EstimationError: the views are too few, or contradict each other.
        UnobservableError: the views leave directions of the extrinsic open, which it names.
    """
    views = with_estimated_pixel_noise(views)
    start = find_start(views)
    lidars = tuple(dict.fromkeys(s.sensor for s in start.sightings if isinstance(s.seen, TargetInScan)))
    base = next(iter(start.rig.T_base_sensor))
    unknowns = unknowns or Unknowns()
    lenses = check_lenses(views)
    wrong = {lens.camera for lens in lenses if lens.contradicted}
    refined = {None: wrong, True: set(start.rig.cameras), False: set[str]()}[unknowns.intrinsics]
    graph = CalibrationGraph(start.sightings, base, unknowns.range_bias_sigma, refined)
    rig, used, squared, discrepancy = _solve_robustly(graph, start)
    taking_part = {s.sensor for s in start.sightings if used & set(s.views)}
    if missing := sorted(set(start.rig.T_base_sensor) - taking_part):
        raise EstimationError(f"no view of {', '.join(missing)} agrees with those of the other sensors")
    scans = [s for s in start.sightings if s.sensor == base and used & set(s.views)]
    uncertainty = graph.uncertainty(used.__contains__, rig, discrepancy)
    check_observable(uncertainty, middle(scans))
    left_out, k_fold = _cross_validations(graph, start, rig, discrepancy, views, used, progress)
    errors = _errors(start.sightings, views, rig, range(len(views))) | left_out.views
    limit = LIMIT * scatter(squared, used)

    def reason(number: int, view: View) -> str:
        if number in used:
            return ""
        if number not in squared:
            return view.problem or "no other sensor saw the target at that time"
        return describe(number, views, start.sightings, rig, limit)

    return CameraCalibration(
        lidars=(base, *(name for name in lidars if name != base)),
        cameras=tuple(start.rig.cameras),
        rig=rig,
        uncertainty=uncertainty,
        views=tuple(ViewResult(v, k in used, reason(k, v), errors.get(k)) for k, v in enumerate(views)),
        cross_validations=(left_out, k_fold),
        discrepancy=discrepancy,
        lenses=lenses,
        refined=frozenset(refined),
        warnings=(
            *_warnings(views, used, start),
            *(_of_lens(lens, lens.camera in refined) for lens in lenses if lens.contradicted),
        ),
        sightings=start.sightings,
    )


def _solve_robustly(graph: CalibrationGraph, start: Start) -> tuple[Rig, set[int], dict[int, float], Discrepancy]:
    """Solve, take out the worst view or take in those that turn out to agree, until nothing changes."""
    used, rig, discrepancy = set(start.agreeing), start.rig, Discrepancy()
    for _ in range(2 * len(start.sightings) + 10):
        if len(used) < 2:
            raise EstimationError(
                f"{len(used)} view in which all sensors agree; a calibration needs at least 2, and 10 to be trusted"
            )
        rig = graph.solve(used.__contains__, rig, discrepancy)
        squared = squared_distances(start.sightings, rig, discrepancy)
        limit = LIMIT * scatter(squared, used)
        worst = max(used, key=lambda view: squared[view])
        agreeing = {view for view, value in squared.items() if value <= limit / 2}
        if squared[worst] > limit:
            used.remove(worst)
        elif not agreeing <= used:
            used |= agreeing
        else:
            previous, discrepancy = discrepancy, estimate_discrepancy(start.sightings, rig, used)
            if np.allclose(np.log(discrepancy.sigmas / previous.sigmas), 0.0, atol=0.05):
                break
    return rig, used, squared, discrepancy


def _cross_validations(
    graph: CalibrationGraph,
    start: Start,
    rig: Rig,
    discrepancy: Discrepancy,
    views: Sequence[View],
    used: set[int],
    progress: Progress | None,
) -> tuple[CrossValidation, CrossValidation]:
    numbers = sorted(used)
    k = min(FOLDS, len(numbers))
    protocols = (
        ("leave-one-out", [[number] for number in numbers]),
        (f"k-fold, k = {k}", [numbers[i::k] for i in range(k)]),
    )
    total, done, found = len(numbers) + k, 0, []
    for protocol, folds in protocols:
        errors: dict[int, ViewErrors] = {}
        for fold in folds:
            others = used - set(fold)
            without = graph.solve(others.__contains__, rig, discrepancy)
            errors |= _errors(start.sightings, views, without, fold)
            done += 1
            if progress is not None:
                progress(done, total)
        found.append(CrossValidation(protocol, errors))
    return found[0], found[1]


def _errors(
    sightings: Sequence[Sighting], views: Sequence[View], rig: Rig, numbers: Iterable[int]
) -> dict[int, ViewErrors]:
    errors = {}
    for number in numbers:
        scan, image = of_view(number, sightings)
        if scan is not None and image is not None and {scan.sensor, image.sensor} <= set(rig.T_base_sensor):
            errors[number] = view_errors(scan, image, views[number].target, rig)
    return errors


def _warnings(views: Sequence[View], used: set[int], start: Start) -> tuple[str, ...]:
    found = []
    if len(used) < FEW_VIEWS:
        found.append(f"{len(used)} views took part: too few for the others to show that one is wrong")
    rejected = len(views) - len(used)
    if rejected > len(views) / 3:
        found.append(f"{rejected} of {len(views)} views were not used")
    scans = [s for s in start.sightings if used & set(s.views) and isinstance(s.seen, TargetInScan)]
    for lidar in dict.fromkeys(s.sensor for s in scans):
        normals = np.stack([s.T_sensor_target[:3, 0] for s in scans if s.sensor == lidar])
        if problem := parallel_planes(normals):
            found.append(f"'{lidar}': {problem}")
    return tuple(found)


def _of_lens(lens: LensCheck, refined: bool) -> str:
    found = (
        f"'{lens.camera}': its {lens.images} images contradict the given intrinsics: with another lens the errors of "
        f"the corners fall from {lens.rms_px:.2f} to {lens.refined_rms_px:.2f} px"
    )
    if refined:
        return f"{found}; the lens was refined, and the extrinsic belongs to the refined intrinsics ('cameras')"
    return f"{found}; calibrate the camera again, or let its lens be refined"
