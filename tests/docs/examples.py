"""The files that pages speak of: what a reader has, made of bundled or simulated data."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

import optshape_graph
from optshape_graph.io import load_sensor, load_target, save_target, write_scan
from optshape_graph.io.trajectories import Trajectory, write_tum
from optshape_graph.simulation import NoiseModel, pose_from_rpy, room, simulate, synthetic_session

DEMO = Path(optshape_graph.__file__).parent / "data" / "demo"


def prepare(folder: Path, text: str) -> None:
    """Make the files that a page's blocks name, in `folder`."""
    for name, make in EXAMPLES.items():
        if name in text:
            make(folder)


def _crop(folder: Path) -> None:
    shutil.copy(DEMO / "4m.pcd", folder / "returns.pcd")


def _board(folder: Path) -> None:
    shutil.copy(DEMO / "target.yaml", folder / "board.yaml")


def _lidar(folder: Path) -> None:
    shutil.copy(DEMO / "sensor.yaml", folder / "lidar.yaml")


def _mocap_session(folder: Path) -> None:
    for path in DEMO.iterdir():
        shutil.copy(path, folder / ("SESSION.yaml" if path.name == "session.yaml" else path.name))


def _sessions(folder: Path) -> None:
    """A folder of session folders."""
    for k, target in enumerate(("paper", "built")):
        synthetic_session(
            folder / "recordings" / f"session{k}",
            load_target(target),
            load_sensor("vlp32c"),
            distances=(4.0, 6.0),
            rng=k,
        )


@cache
def _drive() -> tuple[list[tuple[float, optshape_graph.Scan]], Trajectory]:
    """Four full revolutions of a robot that passes two targets in a room, and its poses ten times as often."""
    sensor = load_sensor("vlp32c")
    targets = [
        (load_target("paper"), pose_from_rpy([8.0, 1.0, 0.2], [0.0, 0.0, 0.3])),
        (load_target("triangle"), pose_from_rpy([7.0, -3.5, 0.1], [0.0, 0.0, -0.5])),
    ]
    scene = room(targets)
    at = lambda t: pose_from_rpy([2.0 * t, 0.0, 0.0], [0.0, 0.0, 0.1 * t])  # noqa: E731 - one line of a page
    scans = [
        (stamp, simulate(scene, sensor, at(stamp), noise=NoiseModel.of(sensor), rng=k).scan)
        for k, stamp in enumerate(0.4 * np.arange(4))
    ]
    stamps = np.arange(-0.4, 1.7, 0.04)
    return scans, Trajectory(np.array([at(t) for t in stamps]), stamps)


def _revolution(folder: Path) -> None:
    write_scan(folder / "revolution.pcd", _drive()[0][0][1])


def _clouds(folder: Path) -> None:
    scans, trajectory = _drive()
    (folder / "clouds").mkdir()
    for k, (_, scan) in enumerate(scans):
        write_scan(folder / "clouds" / f"{k:04}.pcd", scan)
    (folder / "clouds" / "timestamps.txt").write_text("".join(f"{stamp:.6f}\n" for stamp, _ in scans))
    write_tum(folder / "odometry.tum", trajectory)


def _two_lidars(folder: Path) -> None:
    """The same drive by a robot with two LiDARs, a folder of clouds for each."""
    _, trajectory = _drive()
    targets = [(load_target("paper"), pose_from_rpy([8.0, 1.0, 0.2], [0.0, 0.0, 0.3]))]
    for name, model, mounted in (
        ("front", "vlp32c", pose_from_rpy([0.4, 0.1, 0.3], [0.0, 0.0, np.radians(11.0)])),
        ("rear", "vlp16", pose_from_rpy([-0.5, 0.0, 0.1], [0.0, 0.0, np.radians(174.0)])),
    ):
        sensor, stamps = load_sensor(model), 0.4 * np.arange(3)
        (folder / "robot" / name).mkdir(parents=True)
        for k, stamp in enumerate(stamps):
            at = pose_from_rpy([2.0 * stamp, 0.0, 0.0], [0.0, 0.0, 0.1 * stamp])
            scan = simulate(room(targets), sensor, at @ mounted, noise=NoiseModel.of(sensor), rng=k).scan
            write_scan(folder / "robot" / name / f"{k}.pcd", scan)
        (folder / "robot" / name / "timestamps.txt").write_text("".join(f"{stamp:.6f}\n" for stamp in stamps))
    write_tum(folder / "robot" / "odometry.tum", trajectory)


def _bag(folder: Path) -> None:
    from tests.io.recordings.writing import LAYOUTS, maker, write_bag

    scans, trajectory = _drive()
    make, items = maker("ros1"), []
    for stamp, scan in scans:
        points = np.zeros(len(scan), LAYOUTS["velodyne"])
        for axis, values in zip("xyz", scan.points.T, strict=True):
            points[axis] = values
        points["ring"] = scan.ring
        items.append((stamp, "/points", make.cloud(100.0 + stamp, points)))
    assert trajectory.stamps is not None
    for stamp, T in zip(trajectory.stamps, trajectory.poses, strict=True):
        items.append((stamp, "/odom", make.odometry(100.0 + stamp, T)))
    items.sort(key=lambda item: item[0])
    write_bag(folder, "ros1", [item[1:] for item in items]).rename(folder / "drive.bag")


def _camera_session(folder: Path) -> None:
    from tests.calibration.session_support import write_session

    (folder / "camera").mkdir()
    write_session(folder / "camera")


def _rig_session(folder: Path) -> None:
    from tests.cli.test_calibrate_rig import write_session

    (folder / "rig").mkdir()
    write_session(folder / "rig")


def _shape(folder: Path) -> None:
    save_target(folder / "shape.yaml", load_target("score-optimal"))


EXAMPLES: dict[str, Callable[[Path], None]] = {
    "returns.pcd": _crop,
    "board.yaml": _board,
    "lidar.yaml": _lidar,
    "SESSION.yaml": _mocap_session,
    "recordings": _sessions,
    "revolution.pcd": _revolution,
    "odometry.tum": _clouds,
    "drive.bag": _bag,
    "map robot": _two_lidars,
    "camera/session.yaml": _camera_session,
    "rig/session.yaml": _rig_session,
    "shape.yaml": _shape,
}
"""What a page calls a file or folder, and what makes it."""
