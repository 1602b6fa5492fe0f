"""Whether a camera calibration is to be trusted: its views, range biases, edges, lenses, and the targets' files."""

from __future__ import annotations

import numpy as np

from optshape_graph.calibration.camera.consistency import of_view, pose_alone
from optshape_graph.calibration.camera.graph import Unknowns
from optshape_graph.calibration.camera.lens import LensChange, LensCheck
from optshape_graph.calibration.camera.observability import parallel_planes
from optshape_graph.calibration.camera.result import CameraCalibration
from optshape_graph.calibration.camera.sides import sides_in_images
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.free_shape import MeasuredShape
from optshape_graph.calibration.verdict import Finding, of_doubts
from optshape_graph.edges import extract_edge_points

FEW_VIEWS = 5
"""Views below which a warning says that there is little evidence."""

FAR_BIAS = 3.0
"""Range bias, in standard deviations of its prior, beyond which something else is wrong."""

SCALE_OFF = (0.025, 4.0)
"""Share by which images and scans differ in the distances between placements at least, and in standard deviations."""

SIDES_OFF = (0.01, 5.0)
"""Difference of a side by the images from the target's file: metres at least, and standard deviations."""

SIGMAS = 2.5
"""Standard deviations by which the median of the scans' insets must be beyond what beam and step explain."""

MOST_DISCREPANCY = (3.0, 0.02)
"""Scatter beyond the noise, deg and metres, that a real sensor and a bent board make at most."""

LOOSE = (0.03, 0.1)
"""Standard deviation of a pair's worst direction, metres, or rad times the targets' distance: of the most likely
transform, from which it has to be known; and of the one that is stated, from which it is grave."""


def judge(result: CameraCalibration, unknowns: Unknowns) -> tuple[Finding, ...]:
    """Judge a calibration by what it found.

    Args:
        result: the calibration, its findings not being known yet.
        unknowns: what was estimated beside the extrinsics.
    """
    scale = [] if len(result.lidars) > 1 or len(result.cameras) > 1 else _of_scale(result)
    return (
        *_of_views(result),
        *of_doubts([view.view.scan.doubt for view in result.views if view.used and view.view.scan is not None]),
        *_of_bias(result, unknowns),
        *scale,
        *_of_edges(result),
        *_of_sides(result),
        *_of_discrepancy(result),
        *(finding for (lidar, _), shape in result.shapes.items() for finding in _of_shape(lidar, shape)),
        *(finding for lens in result.lenses for finding in _of_lens(result, lens)),
        *_of_planes(result),
        *_of_spread(result),
    )


def _of_views(result: CameraCalibration) -> list[Finding]:
    found = []
    used = sum(view.used for view in result.views)
    if used < FEW_VIEWS:
        found.append(Finding(f"{used} views took part: too few for the others to show that one is wrong", used < 3))
    disagreeing = [view for view in result.views if not view.used and not view.view.problem]
    if missing := [view for view in result.views if not view.used and view.view.problem]:
        few = 3 * len(missing) <= len(result.views)
        found.append(Finding(f"{len(missing)} of {len(result.views)} views show no target", not few))
    if disagreeing:
        names = ", ".join(view.view.name for view in disagreeing)
        few = 3 * len(disagreeing) <= used + len(disagreeing)
        text = f"{len(disagreeing)} of {used + len(disagreeing)} views disagree with the others: {names}"
        found.append(Finding(text, not few))
    return found


def _of_bias(result: CameraCalibration, unknowns: Unknowns) -> list[Finding]:
    found = []
    for lidar in result.lidars:
        bias, _ = result.range_bias(lidar)
        if abs(bias) > FAR_BIAS * unknowns.range_bias_sigma > 0:
            text = (
                f"the range bias of '{lidar}' would be {1e3 * bias:+.0f} mm, beyond {FAR_BIAS:g} standard deviations "
                f"of its prior ({1e3 * unknowns.range_bias_sigma:g} mm): are the sizes of pattern and target right?"
            )
            found.append(Finding(text, True))
    return found


def _of_scale(result: CameraCalibration) -> list[Finding]:
    """Compare how far apart images and scans see the placements: a pattern of another size scales the images'."""
    pairs = [of_view(number, result.sightings) for number, view in enumerate(result.views) if view.used]
    centres = [
        (pose_alone(image, result.rig)[:3, 3], pose_alone(scan, result.rig)[:3, 3])
        for scan, image in pairs
        if scan and image
    ]
    if len(centres) < FEW_VIEWS:
        return []
    by_image, by_scan = (np.array(points) - np.mean(points, axis=0) for points in zip(*centres, strict=True))
    U, _, Vt = np.linalg.svd(by_image.T @ by_scan)
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    ratio = float(np.sqrt((by_image**2).sum() / (by_scan**2).sum()))
    left = by_image - ratio * by_scan @ R.T
    sigma = float(np.sqrt((left**2).sum() / max(3 * len(left) - 7, 1) / (by_scan**2).sum()))
    least, sigmas = SCALE_OFF
    if abs(ratio - 1) < max(least, sigmas * sigma):
        return []
    text = (
        f"the images see the placements {100 * abs(ratio - 1):.1f} % {'farther apart' if ratio > 1 else 'closer'} "
        f"than the scans do (sd {100 * sigma:.1f} %): the pattern's size is probably {100 / ratio:.1f} % of what its "
        f"file says"
    )
    return [Finding(text, True)]


def _of_edges(result: CameraCalibration) -> list[Finding]:
    """Compare where the rings end with how far the beam lets them: half a step and a beam's width about the edge."""
    found = []
    for lidar in result.lidars:
        scans = [view.view.scan for view in result.views if view.used and view.view.scan is not None]
        own = next((scan.own for scan in scans if scan.lidar == lidar and scan.own.sensor is not None), None)
        inset = np.degrees(result.edge_inset(lidar) + _by_bias(result, lidar))
        if own is None or own.sensor is None or not np.isfinite(inset):
            continue
        step = own.sensor.azimuth_step or float(extract_edge_points(own).azimuth_step)
        most = np.degrees(step / 2 + own.sensor.beam_divergence)
        insets = result.edge_insets(lidar)
        # Of a median, were the scans' insets Gaussian.
        sigma = np.degrees(insets.std()) * np.sqrt(np.pi / 2 / len(insets))
        if abs(inset) > most + SIGMAS * sigma:
            where, size = ("inside", "smaller") if inset > 0 else ("outside", "larger")
            text = (
                f"the last returns of '{lidar}' lie {abs(inset):.2f} deg {where} the targets' edges, where its beam "
                f"and its azimuth step explain {most:.2f}: is the target {size} than its file says?"
            )
            found.append(Finding(text, True))
    return found


def _of_sides(result: CameraCalibration) -> list[Finding]:
    """Compare the targets' sides by the images with their files."""
    targets = {number: view.view.target for number, view in enumerate(result.views) if view.used}
    found = []
    for seen in sides_in_images(targets, result.sightings, result.rig):
        off = np.abs(seen.sides - seen.target.edge_lengths)
        least, sigmas = SIDES_OFF
        if (off > np.maximum(least, sigmas * seen.sigma)).any():
            measured = " ".join(f"{1e3 * side:.0f}" for side in seen.sides)
            stated = " ".join(f"{1e3 * side:.0f}" for side in seen.target.edge_lengths)
            text = (
                f"the sides of target '{seen.target.name}' by the images ({measured} mm, the pattern being the scale) "
                f"contradict its file ({stated} mm): measure the target and its pattern"
            )
            found.append(Finding(text, True))
    return found


def _by_bias(result: CameraCalibration, lidar: str) -> float:
    """Return by what angle, rad, a range bias moves the last returns outward: what seems farther seems larger."""
    scans = [view.view.scan for view in result.views if view.used and view.view.scan is not None]
    targets = [view.view.target for view in result.views if view.used]
    depth = float(np.mean([2 * target.area / target.edge_lengths.sum() for target in targets]))
    ranges = [np.linalg.norm(scan.T_lidar_target[:3, 3]) for scan in scans if scan.lidar == lidar]
    return result.range_bias(lidar)[0] * depth / float(np.median(ranges)) ** 2


def _of_discrepancy(result: CameraCalibration) -> list[Finding]:
    rotation, translation = np.degrees(result.discrepancy.rotation), result.discrepancy.translation
    if rotation < MOST_DISCREPANCY[0] and translation < MOST_DISCREPANCY[1]:
        return []
    text = (
        f"scans and images scatter by {1e3 * translation:.0f} mm and {rotation:.1f} deg beyond their noise: something "
        f"is wrong with targets, times or sensor files that no view shows alone"
    )
    return [Finding(text, True)]


def _of_shape(lidar: str, shape: MeasuredShape) -> list[Finding]:
    if shape.agrees:
        return []
    measured = " ".join(f"{1e3 * side:.0f}" for side in shape.joint.sides)
    stated = " ".join(f"{1e3 * side:.0f}" for side in shape.target.edge_lengths)
    text = (
        f"the sides of target '{shape.target.name}' by {lidar} ({measured} mm) contradict its file ({stated} mm): "
        f"measure the target"
    )
    return [Finding(text, True)]


def _of_lens(result: CameraCalibration, lens: LensCheck) -> list[Finding]:
    if not lens.contradicted and lens.camera not in result.refined:
        return []
    text = (
        f"'{lens.camera}': its {lens.images} images contradict the given intrinsics: with another lens the errors of "
        f"the corners fall from {lens.rms_px:.2f} to {lens.refined_rms_px:.2f} px"
    )
    if not lens.contradicted:
        text = f"the lens of '{lens.camera}' is"
    if result.given is None:
        return [
            Finding(
                f"{text}; calibrate the camera again, or let its lens be refined", 2 * lens.refined_rms_px < lens.rms_px
            )
        ]
    change = LensChange.of(result.given.cameras[lens.camera], result.rig.cameras[lens.camera])
    far = change.far
    text += f"{';' if lens.contradicted else ''} refined"
    text += (
        f", {change.text}, and T_camera_lidar belongs to the refined lens ('cameras'); T_camera_lidar_given_lens is "
        "for the given one"
    )
    if not lens.contradicted:  # as it was asked for
        return [Finding(f"{text}; calibrate the camera again", False)] if far else []
    return [Finding(f"{text}; calibrate the camera again" if far else text, far)]


def _of_spread(result: CameraCalibration) -> list[Finding]:
    """Say which pairs are known worse than what the views leave is worth, and whether it is for the lens."""
    found = []
    for lidar in result.lidars:
        for camera in result.cameras:
            worst, likely = result.directions(lidar, camera)[0], result.most_likely_sigma(lidar, camera)
            if likely < LOOSE[0] and worst.sigma_m < LOOSE[1]:
                continue
            text = f"'{camera}' against '{lidar}' is hardly known: {worst.text} (sd)"
            if likely < 0.5 * worst.sigma_m and camera not in result.refined:
                text += "; mostly for what its images leave open of the lens: refine it, or calibrate the camera again"
            found.append(Finding(text, worst.sigma_m > LOOSE[1]))
    return found


def _of_planes(result: CameraCalibration) -> list[Finding]:
    found = []
    used = {number for number, view in enumerate(result.views) if view.used}
    scans = [s for s in result.sightings if used & set(s.views) and isinstance(s.seen, TargetInScan)]
    for lidar in dict.fromkeys(s.sensor for s in scans):
        normals = np.stack([s.T_sensor_target[:3, 0] for s in scans if s.sensor == lidar])
        if problem := parallel_planes(normals):
            found.append(Finding(f"'{lidar}': {problem}", False))
    return found
