"""Which views agree with a rig, how far off the others are, and what seems to be wrong with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.graph import Discrepancy, Rig, Sighting
from optshape_graph.calibration.camera.sightings import TargetInScan, View, candidates
from optshape_graph.calibration.images.planar_pose import refine_pose
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.se3 import angle, difference, inverse

FALSE_REJECTION = 1e-4
"""Probability that a good view is rejected, were its errors Gaussian."""

CHANCE = float(chi2.isf(0.05, 2))
"""Twice the gain in log likelihood that two more parameters bring by chance, at most, in 95 of 100 cases."""

LIMIT = float(chi2.isf(FALSE_REJECTION, 6))
MEDIAN = float(chi2.median(6))


def pose_alone(sighting: Sighting, rig: Rig) -> Floats:
    """Return T_sensor_target (4, 4) of a sighting alone, range bias and intrinsics being the rig's."""
    if not isinstance(sighting.seen, TargetInScan):
        camera = rig.cameras[sighting.sensor]
        if camera is sighting.seen.camera:
            return sighting.T_sensor_target
        return refine_pose(
            sighting.seen.points.relabelled(sighting.S), camera, sighting.T_sensor_target
        ).T_camera_target
    return sighting.seen.pose(rig.range_bias.get(sighting.sensor, 0.0)) @ inverse(sighting.S)


def squared_distances(sightings: Sequence[Sighting], rig: Rig, discrepancy: Discrepancy) -> dict[int, float]:
    """Return by view the largest squared Mahalanobis distance (6 degrees of freedom) of its sightings from others.

    A view's scan and image are compared with each other; a view with one of them, with the other sightings of its
    placement. Views with nothing to compare are left out.
    """
    poses = {id(s): rig.T_base_sensor[s.sensor] @ pose_alone(s, rig) for s in sightings}
    by_placement: dict[int, list[Sighting]] = {}
    for sighting in sightings:
        by_placement.setdefault(sighting.placement, []).append(sighting)
    squared: dict[int, float] = {}
    for group in by_placement.values():
        paired = {view for s, t in combinations(group, 2) for view in set(s.views) & set(t.views)}
        for s, t in combinations(group, 2):
            distance = _squared(poses[id(s)], _covariance(s, discrepancy), poses[id(t)], _covariance(t, discrepancy))
            common = set(s.views) & set(t.views)
            for view in common or (set(s.views) | set(t.views)) - paired:
                squared[view] = max(squared.get(view, 0.0), distance)
    return squared


def scatter(squared: Mapping[int, float], used: set[int]) -> float:
    """Return how much more the used views scatter than their covariances say, robustly; at least 1."""
    return max(1.0, float(np.median([squared[view] for view in used if view in squared] or [MEDIAN])) / MEDIAN)


def estimate_discrepancy(sightings: Sequence[Sighting], rig: Rig, used: set[int], fitted: int = 0) -> Discrepancy:
    """Estimate what the scans' poses scatter beyond their covariances, by comparing them with the images'.

    The restricted likelihood of the differences x_v ~ N(0, C_v + D): the extrinsic was fitted to them, which takes one
    view's worth of freedom, and perhaps lenses.

    Args:
        sightings: of all views.
        rig: fitted to the used ones.
        used: numbers of the views to compare.
        fitted: number of parameters of lenses that were fitted to them, too.
    """
    pairs = [(scan, image) for scan, image in (of_view(v, sightings) for v in sorted(used)) if scan and image]
    if len(pairs) < 2:
        return Discrepancy()
    base = rig.T_base_sensor
    x = np.stack(
        [difference(base[i.sensor] @ pose_alone(i, rig), base[s.sensor] @ pose_alone(s, rig)) for s, i in pairs]
    )
    C = np.stack([s.covariance + i.covariance for s, i in pairs])
    share = max(len(pairs) - 1 - fitted / 6, 1.0) / len(pairs)

    def cost(log_sigmas: Floats) -> float:
        total = C + np.diag(np.repeat(np.exp(2 * log_sigmas), 3))
        fit = np.einsum("vi,vi->", x, np.linalg.solve(total, x[..., None])[..., 0])
        return float(fit + share * np.linalg.slogdet(total)[1].sum())

    smallest = np.log([Discrepancy().rotation, Discrepancy().translation])
    largest = np.log([np.radians(5.0), 0.1])
    start = np.log([np.radians(0.2), 0.002])
    best = minimize(cost, start, method="L-BFGS-B", bounds=list(zip(smallest, largest, strict=True)))
    if cost(smallest) - best.fun < CHANCE:
        return Discrepancy()
    rotation, translation = np.exp(best.x)
    return Discrepancy(float(rotation), float(translation))


def describe(
    number: int, views: Sequence[View], sightings: Sequence[Sighting], rig: Rig, discrepancy: Discrepancy, limit: float
) -> str:
    """Say how far apart a view's two sightings are under a rig, and whose image its scan fits instead."""
    scan, image = of_view(number, sightings)
    if scan is None or image is None:
        return "it does not agree with the other sightings of its placement"
    T_lidar_target, camera = pose_alone(scan, rig), rig.cameras[image.sensor]
    predicted = inverse(rig.T_base_sensor[image.sensor]) @ rig.T_base_sensor[scan.sensor] @ T_lidar_target
    shift = 1e3 * np.linalg.norm(predicted[:3, 3] - image.T_sensor_target[:3, 3])
    turn = np.degrees(angle(inverse(predicted) @ image.T_sensor_target))
    text = f"scan and image disagree by {shift:.0f} mm and {turn:.1f} deg under the extrinsic of the other views"
    for other, view in enumerate(views):
        if other == number or view.image is None or view.image.camera.name != image.sensor:
            continue
        for candidate in candidates(view.image, view.target):
            seen = candidate.T_sensor_target
            if camera is not view.image.camera:
                seen = refine_pose(view.image.points.relabelled(candidate.S), camera, seen).T_camera_target
            moved = predicted @ _nearest_symmetry(predicted, seen, view)
            if _squared(moved, _covariance(scan, discrepancy), seen, candidate.covariance) < limit:
                return f"{text}; its scan fits the image {view.image_name} instead: were they swapped?"
    return text


def of_view(number: int, sightings: Sequence[Sighting]) -> tuple[Sighting | None, Sighting | None]:
    """Return the scan and the image of a view, None where it has none."""
    own = [s for s in sightings if number in s.views]
    scan = next((s for s in own if isinstance(s.seen, TargetInScan)), None)
    image = next((s for s in own if isinstance(s.seen, TargetInImage)), None)
    return scan, image


def _squared(T: Floats, covariance_T: Floats, U: Floats, covariance_U: Floats) -> float:
    x = difference(U, T)
    return float(x @ np.linalg.solve(covariance_T + covariance_U, x))


def _covariance(sighting: Sighting, discrepancy: Discrepancy) -> Floats:
    if not isinstance(sighting.seen, TargetInScan):
        return sighting.covariance
    return sighting.covariance + np.diag(discrepancy.sigmas**2)


def _nearest_symmetry(T: Floats, U: Floats, view: View) -> Floats:
    """Return the symmetry (4, 4) of the view's target that brings T closest to U."""
    return np.asarray(view.target.symmetry_transforms[view.target.nearest_symmetry(T, U)])
