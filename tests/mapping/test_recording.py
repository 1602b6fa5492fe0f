"""From scans and poses to a map: keyframes, odometry in between, bad scans, a moving LiDAR, several processes."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError, Scan
from optshape_graph.io import load_sensor, load_target
from optshape_graph.io.clouds import write_scan
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.io.trajectories import Trajectory, write_tum
from optshape_graph.mapping import LandmarkSlam
from optshape_graph.mapping.recording import (
    KeyframePolicy,
    MotionNoise,
    OdometryTrack,
    Progress,
    _contradictions,
    build_map,
    keyframes,
    map_recording,
    observe_all,
)
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import difference, exp, inverse, transform
from optshape_graph.simulation import ConstantTwist, Floor, NoiseModel, Patch, Scene, simulate
from tests.mapping.support import at

SENSOR, TARGET = load_sensor("vlp32c"), load_target("paper")
SPEED, TURN = 2.0, 0.4
WHERE = [at(8.0, 1.0, 0.2, 0.3), at(7.0, -3.5, -0.5, 0.2)]


def drive(n, step=0.3):
    """Return a robot's scans on a curve past two targets, and its poses ten times as often."""
    motion = ConstantTwist(np.eye(4), np.array([0.0, 0.0, TURN, SPEED, 0.0, 0.0]))
    scene = Scene(tuple(Patch(TARGET, T) for T in WHERE), (Floor(-1.5),))
    noise = NoiseModel.of(SENSOR)
    scans, stamps = [], step * np.arange(n)
    for k, stamp in enumerate(stamps):
        R, t = motion.at(np.array([stamp]))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R[0], t[0]
        scan = simulate(scene, SENSOR, ConstantTwist(pose, motion.twist), noise=noise, rng=k).scan
        scans.append(Stamped(float(stamp), scan))
    times = np.arange(-1.0, stamps[-1] + 1.0, step / 10)
    R, t = motion.at(times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, t
    return scans, [Stamped(float(s), T) for s, T in zip(times, poses, strict=True)]


@pytest.mark.parametrize("workers", [1, 2])
def test_a_moving_robot_maps_its_targets(workers):
    scans, poses = drive(5)
    slam, progress = LandmarkSlam(), Progress()
    frames = keyframes(scans, OdometryTrack(poses), KeyframePolicy(), progress)
    reported = []
    seen = observe_all(frames, [TARGET], named=False, shapes=False, pool=Pool(workers))
    build_map(slam, seen, MotionNoise(), progress, lambda now: reported.append(now.scans))
    assert progress.keyframes == len(reported) == 5
    assert not progress.skipped
    assert len(slam.landmarks) == 2
    # Centimetres at 8 m while moving 0.2 m and turning 2 deg within a scan; ignored, that would be decimetres.
    for T in slam.landmarks.values():
        assert min(np.linalg.norm(T[:3, 3] - true[:3, 3]) for true in WHERE) < 0.05


def test_bad_scans_are_counted_and_nothing_else_is_lost():
    scans, poses = drive(5)
    good = scans[2].value
    scans[2] = Stamped(scans[2].stamp, Scan(np.zeros((0, 3)), ring=np.zeros(0, int), sensor=SENSOR))
    scans.insert(3, Stamped(scans[2].stamp + 0.3, Scan(good.points, sensor=SENSOR, name="no rings")))
    del scans[4]
    scans.append(Stamped(100.0, good))
    slam, progress = LandmarkSlam(), Progress()
    frames = keyframes(scans, OdometryTrack(poses), KeyframePolicy(), progress)
    build_map(slam, observe_all(frames, [TARGET], False, False), MotionNoise(), progress)
    assert progress.skipped["empty"] == 1
    assert progress.skipped["no odometry at its time"] == 1
    assert sum("ring" in reason for reason in progress.skipped) == 1
    assert progress.skipped.total() == 3
    assert len(slam.landmarks) == 2


def test_keyframes_leave_out_a_robot_at_rest():
    scan = Scan(np.ones((5, 3)), np.arange(5))
    scans = [Stamped(0.1 * k, scan) for k in range(50)]
    poses = [Stamped(0.1 * k, at(max(0.0, 0.1 * (k - 20)), 0.0, 0.0)) for k in range(50)]
    progress = Progress()
    kept = list(keyframes(scans, OdometryTrack(poses), KeyframePolicy(0.5, np.inf), progress))
    np.testing.assert_allclose([frame.stamp for frame in kept], [0.0, 2.5, 3.0, 3.5, 4.0, 4.5], atol=1e-9)
    np.testing.assert_allclose([frame.distance for frame in kept[1:]], 0.5, atol=1e-9)
    assert progress.scans == 50


def test_odometry_between_poses_and_beside_them():
    rng_twist = np.array([0.1, -0.2, 0.5, 1.0, 0.3, -0.1])
    motion = ConstantTwist(at(1.0, 2.0, 0.3), rng_twist)
    mounted = at(0.2, -0.1, 0.5, 0.9)
    times = np.arange(0.0, 2.0, 0.25)
    R, t = motion.at(times)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, t
    track = OdometryTrack([Stamped(float(s), T) for s, T in zip(times, poses, strict=True)], mounted)
    assert track.sweep(-0.1) is None
    for stamp in (0.0, 0.1, 0.25, 1.6):
        found = track.sweep(stamp)
        assert found is not None
        R, t = motion.at(np.array([stamp]))
        expected = np.eye(4)
        expected[:3, :3], expected[:3, 3] = R[0], t[0]
        np.testing.assert_allclose(found.T_odometry_lidar, expected @ mounted, atol=1e-9)
    assert track.sweep(5.0) is None


def write_folder(folder, scans, poses):
    """Write scans and poses as a folder of clouds with timestamps and a TUM file."""
    folder.mkdir()
    for k, scan in enumerate(scans):
        write_scan(folder / f"scan_{k}.pcd", scan.value)
    (folder / "timestamps.txt").write_text("".join(f"{scan.stamp}\n" for scan in scans))
    stamps, T = np.array([p.stamp for p in poses]), np.array([p.value for p in poses])
    write_tum(folder / "odometry.tum", Trajectory(T, stamps))
    return folder


def test_a_recording_becomes_a_map_in_one_call(tmp_path):
    scans, poses = drive(5)
    folder = write_folder(tmp_path / "drive", scans, poses)
    result = map_recording(folder, TARGET, SENSOR, pool=Pool(1))
    assert not result.problems
    assert not result.warnings
    assert (result.progress.scans, result.progress.keyframes, result.progress.landmarks) == (5, 5, 2)
    assert result.solution is not None
    assert repr(result) == "MapResult(2 landmarks, 5 poses)"
    for landmark in result.map.landmarks:
        assert min(np.linalg.norm(landmark.T_world_target[:3, 3] - true[:3, 3]) for true in WHERE) < 0.05
    # The LiDAR's clock is 100 s ahead of the odometry's: said, and mended.
    late = [Stamped(pose.stamp - 100.0, pose.value) for pose in poses]
    other = write_folder(tmp_path / "late", scans, late)
    nothing = map_recording(other, TARGET, SENSOR, pool=Pool(1))
    assert [text for text in nothing.problems if "clock offset" in text and "from 0.000 to 1.200 s" in text]
    mended = map_recording(other, TARGET, SENSOR, pool=Pool(1), clock_offset=100.0)
    assert len(mended.map.landmarks) == 2
    # Without odometry it says what it takes for granted.
    assert any("no odometry" in text for text in map_recording(folder, TARGET, SENSOR, odometry="none").warnings)
    with pytest.raises(InputError, match="no targets"):
        map_recording(folder, [], SENSOR)
    with pytest.raises(InputError, match="batch"):
        map_recording(folder, TARGET, SENSOR, as_built_sigma=0.01, batch=False)


def test_most_scans_lost_is_a_problem(tmp_path):
    scans, poses = drive(5)
    folder = write_folder(tmp_path / "drive", scans, [pose for pose in poses if pose.stamp < 0.5])
    result = map_recording(folder, TARGET, SENSOR, pool=Pool(1))
    assert "3 of 5 scans were lost" in result.problems


@pytest.mark.parametrize("hz", [20, 50, 200, 500])
def test_jitter_of_fast_odometry_is_averaged_away(hz):
    """1 mm between neighbours 2 to 50 ms apart would be up to 0.7 m/s; of a tenth of a second it is millimetres."""
    rng = np.random.default_rng(hz)
    motion = ConstantTwist(at(1.0, 2.0, 0.3), np.array([0.0, 0.0, 0.5, 0.8, 0.0, 0.0]))
    times = np.arange(0.0, 3.0, 1.0 / hz)
    R, t = motion.at(times)
    jitter = exp(rng.normal(size=(len(times), 6)) * np.repeat([np.radians(0.03), 1e-3], 3))
    track = OdometryTrack([Stamped(float(s), T) for s, T in zip(times, transform(R, t) @ jitter, strict=True)])
    errors = []
    for stamp in np.arange(0.5, 2.5, 0.1):
        sweep = track.sweep(stamp, -0.05, 0.05)
        R, t = motion.at(np.array([stamp, stamp + 0.05]))
        a, b = transform(R, t)
        error = difference(sweep.between(0.0, 0.05), inverse(a) @ b)
        assert np.linalg.norm(error[3:]) < 0.006
        errors.append(np.square(error) / np.diag(replace(sweep, drift=None).uncertainty(0.0, 0.05)))
    # The jitter is known after a few scans; then 15 overlapping fits of six independent axes each.
    assert 0.4 < np.mean(errors[5:]) < 2.0


@pytest.mark.parametrize(
    ("rejected", "said", "many"), [(0, False, False), (2, False, False), (6, True, False), (30, True, True)]
)
def test_sightings_that_contradict_a_map_are_said(rejected: int, said: bool, many: bool) -> None:
    """Of a hundred that were taken: a few are clutter, some are a warning, many say that the map is wrong."""
    texts, are_many = _contradictions(Counter(matched=95 - rejected, new=5, rejected=rejected, pending=40))
    assert [f"{rejected} of 100 sightings contradict the map" in text for text in texts] == [True] * said
    assert are_many is many
