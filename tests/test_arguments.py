"""What the face takes, and says of what it doesn't: one line that names the argument."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from optshape_graph import (
    EstimationError,
    InputError,
    PoseEstimate,
    Scan,
    calibrate_camera,
    calibrate_mocap,
    detect_targets,
    estimate_pose,
    load_sensor,
    load_session,
    load_target,
    map_recording,
    read_scan,
)
from optshape_graph.factors import (
    FreeVertexFactor,
    LandmarkFactor,
    SummaryFactor,
    TemplateCallbackFactor,
    TemplateFactor,
)
from optshape_graph.io import Columns, make_scan
from optshape_graph.mapping import LandmarkSlam
from optshape_graph.pose import estimate_poses
from optshape_graph.simulation import Box, Patch, Scene, pose_from_rpy, simulate, simulate_target

PAPER, SENSOR = load_target("paper"), load_sensor("vlp32c")
T = pose_from_rpy([5.0, 0.1, 0.0], [0.1, 0.2, 0.1])
SCAN = simulate_target(PAPER, SENSOR, T)


def estimate() -> PoseEstimate:
    return estimate_pose(SCAN, PAPER)


def begun() -> LandmarkSlam:
    slam = LandmarkSlam()
    slam.add_odometry(0.0)
    return slam


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "scan": (lambda: estimate_pose(1, PAPER), "scan: expected Scan, found int 1"),
    "target": (lambda: estimate_pose(SCAN, "paper"), "target: expected Target, found str 'paper'"),
    "options": (lambda: estimate_pose(SCAN, PAPER, options=3), "options: expected PoseOptions, found int 3"),
    "full scan": (lambda: detect_targets(1, PAPER), "scan: expected Scan, found int 1"),
    "detection": (lambda: detect_targets(SCAN, PAPER, 3), "options: expected DetectionOptions, found int 3"),
    "mocap": (lambda: calibrate_mocap(1), "session: expected str or Path or Session, found int 1"),
    "camera": (lambda: calibrate_camera(1), "session: expected str or Path or Session, found int 1"),
    "recording": (lambda: map_recording(1), "recording: expected str or Path or Recording or Session, found int 1"),
    "targets": (lambda: map_recording("drive", ["paper"]), "targets: expected Target, found str 'paper'"),
    "cloud": (lambda: read_scan(1), "path: expected str or Path, found int 1"),
    "sensor of a cloud": (
        lambda: make_scan(Columns({}), "vlp16"),
        "sensor: expected SensorModel or None, found str 'vlp16'",
    ),
    "sensor of a scan": (
        lambda: Scan(SCAN.points, sensor="vlp16"),
        "scan: sensor: expected SensorModel or None, found str 'vlp16'",
    ),
    "sighting": (lambda: begun().add_measurements([estimate()]), "sighting: expected Sighting, found PoseEstimate"),
    "a scan for scans": (lambda: estimate_poses(SCAN, PAPER), "scans: expected a list of Scan, found Scan"),
    "a number for targets": (
        lambda: estimate_poses([SCAN], 5),
        "targets: expected a Target or a list of them, found int",
    ),
    "odometry": (lambda: begun().add_odometry(1.0, T[:3], np.eye(6)), "T_previous_current: expected a finite pose"),
    "key": (lambda: SummaryFactor(estimate(), "l0", "x0"), "key: expected a number, as gtsam.symbol_shorthand makes"),
    "key of one": (lambda: TemplateFactor(estimate(), -1), "key: expected a number, as gtsam.symbol_shorthand makes"),
    "same key": (lambda: SummaryFactor(estimate(), 3, 3), "keys 3, 3: expected a different one for each variable"),
    "same key of vertices": (lambda: FreeVertexFactor(1, 2, 1), "keys 1, 2, 1: expected a different one"),
    "same key called back": (lambda: TemplateCallbackFactor(estimate(), 3, 3), "keys 3, 3: expected a different one"),
    "half a pose": (lambda: SummaryFactor(estimate(), 0, 1, T[:3]), "T_target_lidar: expected a finite pose as 4 x 4"),
    "half a transform": (lambda: TemplateFactor(estimate(), 0, T[:3]), "T_target_a: expected a finite pose as 4 x 4"),
    "session": (lambda: load_session(None), "path: expected str or Path, found NoneType None"),
    "pose": (lambda: LandmarkFactor(estimate(), 0, 1), "T_world_lidar: expected a finite pose"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_type_is_one_line(name: str) -> None:
    call, message = WRONG[name]
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_points_in_millimetres_are_told() -> None:
    scan = replace(SCAN, points=1000 * SCAN.points)
    for call in (lambda: estimate_pose(scan, PAPER), lambda: detect_targets(scan, PAPER)):
        with pytest.raises((EstimationError, InputError), match="expected metres from the LiDAR \\(millimetres"):
            call()


def test_poses_are_taken_as_gtsam_has_them() -> None:
    estimate, pose = estimate_pose(SCAN, PAPER), gtsam.Pose3(T)
    assert simulate_target(PAPER, SENSOR, pose) == SCAN
    room = Scene((Patch(PAPER, pose),), (Box(np.array([40.0, 36.0, 6.0]), gtsam.Pose3()),))
    assert simulate(room, SENSOR, gtsam.Pose3()).scan == simulate(room, SENSOR).scan
    for factor in (
        SummaryFactor(estimate, 0, 1, pose.inverse()),
        LandmarkFactor(estimate, 0, pose),
        TemplateFactor(estimate, 0),
    ):
        assert factor.keys()
