"""What the face takes, and says of what it doesn't: one line that names the argument."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from optshape_graph import (
    InputError,
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
from optshape_graph.factors import LandmarkFactor, SummaryFactor, TemplateFactor
from optshape_graph.simulation import Box, Patch, Scene, pose_from_rpy, simulate, simulate_target

PAPER, SENSOR = load_target("paper"), load_sensor("vlp32c")
T = pose_from_rpy([5.0, 0.1, 0.0], [0.1, 0.2, 0.1])
SCAN = simulate_target(PAPER, SENSOR, T)

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
    "session": (lambda: load_session(None), "path: expected str or Path, found NoneType None"),
    "pose": (lambda: LandmarkFactor(estimate_pose(SCAN, PAPER), 0, 1), "T_world_lidar: expected a finite pose"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_type_is_one_line(name: str) -> None:
    call, message = WRONG[name]
    with pytest.raises(InputError) as caught:
        call()
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


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
