"""`optshape calibrate camera`: calibrate LiDARs and cameras from scans and images of targets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from optshape_graph.cli.calibrate import (
    conclude_calibration,
    crops_option,
    json_option,
    range_bias_option,
    session_argument,
)
from optshape_graph.cli.console import say, warn
from optshape_graph.cli.html_report import report_option
from optshape_graph.cli.options import example, force_option, outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from optshape_graph.calibration.camera import CameraCalibration


@click.command(
    epilog=example("optshape calibrate camera session.yaml --json camera.json --report camera.html --plot pictures")
)
@session_argument
@json_option
@report_option
@plot_option("errors of the views, and for each its image with the returns and outlines", "--overlays")
@click.option("--camchain", type=click.Path(path_type=Path), help="Write a Kalibr-style camchain to this file.")
@crops_option
@click.option(
    "--refine-intrinsics/--keep-intrinsics",
    default=None,
    help="Refine the cameras' focal lengths and distortion, the given ones being a prior, or never do. Without "
    "either: where the images contradict them.",
)
@range_bias_option(0.03, "Prior standard deviation of a LiDAR's range bias, metres; 0: it has none.")
@force_option
@outside_option
def command(
    session: Path,
    allow_outside: bool,
    force: bool,
    json_path: Path | None,
    html: Path | None,
    plots: Path | None,
    camchain: Path | None,
    use_target_points: bool,
    refine_intrinsics: bool | None,
    range_bias_sigma: float,
) -> int:
    """Calibrate T_camera_lidar from scans and images of targets; no initial guess is needed.

    Errors are leave-one-out: each view is predicted by the extrinsic of the others. T_camera_lidar is for clouds as
    they come. Exit status 3: some views took no part, or the result is not to be trusted; it is written all the same,
    with the reasons.
    """
    from optshape_graph.calibration.camera import calibrate_camera
    from optshape_graph.calibration.camera.checks import check_camchain
    from optshape_graph.calibration.exports import kalibr_camchain
    from optshape_graph.cli.console import progress_bar
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_session
    from optshape_graph.io.documents import write_json, write_yaml
    from optshape_graph.runs.kept import keeping

    loaded = load_session(session, allow_outside=allow_outside)
    outputs = Outputs([session], force=force)
    outputs.file("--json", json_path, "camera-calibration")
    outputs.file("--camchain", camchain)
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    if camchain:
        check_camchain(loaded)
    with progress_bar("images, scans and cross-validation") as progress, keeping(json_path) as kept:
        calibration = calibrate_camera(
            loaded,
            use_target_points=use_target_points,
            refine_intrinsics=refine_intrinsics,
            range_bias_sigma=range_bias_sigma,
            progress=progress,
            kept=kept,
        )
        if json_path:
            write_json(json_path, calibration.to_dict())
    if camchain:
        write_yaml(camchain, kalibr_camchain(calibration.mounted()))
    _print(calibration)
    pictures = Pictures(plots) if plots else None
    if plots and pictures:
        from optshape_graph.viz.camera import plot_view_errors, save_overlays

        pictures.save("errors", plot_view_errors(calibration))
        with progress_bar("overlays") as progress:
            pictures.paths += save_overlays(calibration, plots, progress)
        pictures.tell()
    conclude_calibration(calibration, calibration.passed_over, html, pictures)
    return 0 if calibration.trusted and all(result.used for result in calibration.views) else 3


def _print(calibration: CameraCalibration) -> None:
    import numpy as np

    from optshape_graph.cli.console import print_table

    rows = []
    for result in calibration.views:
        errors = result.errors
        numbers = ["", "", "", ""] if errors is None else [
            f"{errors.centre_error_mm:.1f}", f"{errors.plane_offset_mm:+.1f}",
            f"{errors.normal_error_deg:.2f}", f"{errors.reprojection_px:.1f}",
        ]  # fmt: skip
        rows.append([result.view.name, "yes" if result.used else "no", *numbers])
    left_out = calibration.cross_validations[0]
    means = left_out.means()
    rows.append([
        "mean", "", f"{means['mean_centre_error_mm']:.1f}", f"{means['mean_signed_plane_offset_mm']:+.1f}",
        f"{means['mean_normal_error_deg']:.2f}", f"{means['mean_reprojection_px']:.1f}",
    ])  # fmt: skip
    print_table(
        "Views, each predicted by the extrinsic of the others",
        ["view", "used", "centre [mm]", "plane [mm]", "normal [deg]", "vertices [px]"],
        rows,
        "plane: signed; its mean absolute value is " + f"{means['mean_absolute_plane_offset_mm']:.1f} mm",
    )
    for result in calibration.views:
        if not result.used:
            warn(f"not used: {result.view.name}: {result.reason}")
    for camera in calibration.cameras:
        for lidar in calibration.lidars:
            _print_pair(calibration, camera, lidar)
    for (lidar, name), shape in calibration.shapes.items():
        numbers = [" ".join(f"{1e3 * side:.0f}" for side in sides) for sides in (
            shape.joint.sides, np.sqrt(np.diag(shape.joint.sides_covariance)), shape.target.edge_lengths,
        )]  # fmt: skip
        verdict = "agrees with" if shape.agrees else "CONTRADICTS"
        say(
            f"sides of {name} by {lidar}, vertices free: {numbers[0]} mm, sd {numbers[1]} (mostly common: the beam's "
            f"width); by its file: {numbers[2]}; single scans are off by {1e3 * shape.mean_absolute_error:.1f} mm on "
            f"average; that {verdict} the file"
        )


def _print_pair(calibration: CameraCalibration, camera: str, lidar: str) -> None:
    import numpy as np

    from optshape_graph.calibration.exports import static_transforms
    from optshape_graph.cli.console import print_transform
    from optshape_graph.se3 import inverse, inverse_covariance

    lens = "the refined lens" if camera in calibration.refined else "the lens as given"
    T, covariance = calibration.transform(camera, lidar)
    T_inverse, covariance_inverse = inverse(T), inverse_covariance(T, covariance)
    print_transform(f"T_{camera}_{lidar}", f"for clouds as they come, and {lens}", T, covariance)
    print_transform(f"T_{lidar}_{camera}", "its inverse", T_inverse, covariance_inverse)
    bias, sigma = calibration.range_bias(lidar)
    if calibration.corrected is not None:
        meaning = f"for clouds with the range bias of {1e3 * bias:+.1f} mm subtracted from every range, and {lens}"
        print_transform(
            f"T_{camera}_{lidar}_corrected", meaning, *calibration.transform(camera, lidar, calibration.corrected)
        )
    if calibration.given is not None and camera in calibration.refined:
        print_transform(
            f"T_{camera}_{lidar}_given_lens", "for clouds as they come, and the lens as given",
            *calibration.transform(camera, lidar, calibration.given),
        )  # fmt: skip
        _print_lens(calibration, camera)
    lines = static_transforms(lidar, camera, T_inverse)
    for line in (lines["ros1"], lines["ros2"], f"URDF: {lines['urdf']}"):
        say(line)
    inset = np.degrees(calibration.edge_inset(lidar))
    lie = f"; its last returns lie {inset:.2f} deg inside the targets' edges" if np.isfinite(inset) else ""
    say(f"range bias of {lidar}: {1e3 * bias:+.1f} mm, sd {1e3 * sigma:.1f} (positive: measures too far){lie}")
    say(f"worst direction: {calibration.directions(lidar, camera)[0].text} (sd)")
    if (place := calibration.next_placement(lidar, camera)) is not None:
        x, y, z = place.T_lidar_target[:3, 3]
        say(
            f"a view with the target at ({x:.1f}, {y:.1f}, {z:.1f}) m, turned {place.yaw_deg:+.0f} deg and "
            f"tilted {place.pitch_deg:+.0f} deg from facing the LiDAR, would make the worst direction "
            f"{1e3 * place.expected_sigma_m:.1f} mm instead of {1e3 * place.sigma_m:.1f}"
        )


def _print_lens(calibration: CameraCalibration, camera: str) -> None:
    assert calibration.given is not None
    for words, rig in (("refined", calibration.rig), ("given", calibration.given)):
        lens = rig.cameras[camera]
        K = " ".join(f"{lens.K[i, j]:.2f}" for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        say(f"{words} lens of {camera}: fx fy cx cy {K} px, distortion {' '.join(f'{k:.5f}' for k in lens.D)}")
    say("")
