"""Several LiDARs of one robot in one map; clocks that differ, and that are set back."""

import json
from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import InputError
from optshape_graph.cli.map import command
from optshape_graph.io import load_sensor, load_target, write_scan
from optshape_graph.io.recordings.stream import Stamped
from optshape_graph.io.trajectories import Trajectory, write_tum
from optshape_graph.mapping import LandmarkSlam, Sighting, map_recording
from optshape_graph.mapping.recording import OdometryTrack, read_extrinsics
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import adjoint, exp, inverse
from optshape_graph.simulation import ConstantTwist, Floor, NoiseModel, Patch, Scene, simulate
from tests.mapping.support import World, at

FRONT, REAR, TARGET = load_sensor("vlp32c"), load_sensor("vlp16"), load_target("paper")
MOUNTED = {"front": at(0.4, 0.1, 0.2, 0.3), "rear": at(-0.5, 0.0, np.pi - 0.1, 0.1)}
WHERE = [at(7.0, 1.0, 0.2, 0.3), at(-5.5, 1.5, np.pi - 0.3, 0.2)]
"""Ahead, and behind."""

TWIST = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])


def body(stamps):
    return exp(np.asarray(stamps)[..., None] * TWIST)


def write_robot(folder, n=4, step=0.6, together=False, odometry_late=0.0, speed=1.0):
    """Write a robot's scans of two LiDARs, each a folder, and its odometry; return true landmarks by the first scan."""
    rng, scene = np.random.default_rng(1), Scene(tuple(Patch(TARGET, T) for T in WHERE), (Floor(-1.5),))
    folder.mkdir()
    for name, sensor, late in (("front", FRONT, 0.0), ("rear", REAR, 0.0 if together else 0.03)):
        (folder / name).mkdir()
        stamps = late + step * np.arange(n)
        twist = speed * adjoint(inverse(MOUNTED[name])) @ TWIST
        for k, stamp in enumerate(stamps):
            motion = ConstantTwist(body(speed * stamp) @ MOUNTED[name], twist)
            write_scan(folder / name / f"{k}.pcd",
                       simulate(scene, sensor, motion, noise=NoiseModel.of(sensor), rng=rng).scan)  # fmt: skip
        (folder / name / "timestamps.txt").write_text("".join(f"{stamp:.6f}\n" for stamp in stamps))
    times = np.arange(-0.5, step * n + 0.5, 0.05)
    write_tum(folder / "odometry.tum", Trajectory(body(speed * times), times + odometry_late))
    return [inverse(MOUNTED["front"]) @ T for T in WHERE]


def assert_mapped(result, true):
    """Both targets are there, in the frame of the first LiDAR at its first scan, and no other."""
    assert len(result.map.landmarks) == len(true)
    for landmark in result.map.landmarks:
        assert min(np.linalg.norm(landmark.T_world_target[:3, 3] - T[:3, 3]) for T in true) < 0.05


@pytest.mark.parametrize("together", [False, True])
def test_two_lidars_make_one_map(tmp_path, together):
    true = write_robot(tmp_path / "robot", together=together)
    sensors = {"front": FRONT, "rear": REAR}
    given = {
        "scans": ["front", "rear"], "mounting": MOUNTED, "pool": Pool(1),
    }  # fmt: skip
    result = map_recording(tmp_path / "robot", TARGET, sensors, **given)
    assert not result.problems
    assert_mapped(result, true)
    # One pose for scans at one time; else one each. The poses are the first LiDAR's.
    assert len(result.trajectory) == (4 if together else 8)
    expected = inverse(MOUNTED["front"]) @ body(result.trajectory.stamps) @ MOUNTED["front"]
    np.testing.assert_allclose(result.trajectory.poses[:, :3, 3], expected[:, :3, 3], atol=0.02)
    assert {match.sighting.lidar for _, match in result.solution.problem.matches} == {"front", "rear"}
    with pytest.raises(InputError, match="where 'rear' is relative to 'front' is not known"):
        map_recording(tmp_path / "robot", TARGET, sensors, scans=["front", "rear"], pool=Pool(1))
    with pytest.raises(InputError, match="mounting of 'top': the LiDARs are front, rear"):
        map_recording(tmp_path / "robot", TARGET, sensors, **{**given, "mounting": {"top": np.eye(4)}})


def test_two_lidars_from_the_command_line(tmp_path):
    true = write_robot(tmp_path / "robot", n=3)
    rig = tmp_path / "rig.json"
    transforms = [
        {"a": "body", "b": "front", "T_a_b": MOUNTED["front"].tolist()},
        {"a": "rear", "b": "front", "T_a_b": (inverse(MOUNTED["rear"]) @ MOUNTED["front"]).tolist()},
    ]
    rig.write_text(json.dumps({"schema": "optshape/rig/1", "transforms": transforms}))
    arguments = [
        str(tmp_path / "robot"), "--targets", "paper", "--scans", "front", "--scans", "rear", "--sensor", "vlp32c",
        "--sensor", "vlp16", "--workers", "1",
    ]  # fmt: skip
    by_hand = [
        word for x, y, z, yaw in ((0.4, 0.1, 0.3, 0.2), (-0.5, 0.0, 0.1, np.pi - 0.1))
        for word in ("--mounting", x, y, z, 0, 0, np.degrees(yaw))
    ]  # fmt: skip
    found = []
    for extra in (["--extrinsics", rig], by_hand):
        out = tmp_path / f"{len(found)}.json"
        run = CliRunner().invoke(command, [*arguments, *map(str, extra), "--json", str(out)], standalone_mode=False)
        assert run.return_value == 0, run.output
        assert "scans are from 0.000 to 1.230 s, odometry is from" in run.output
        document = json.loads(out.read_text())
        assert document["report"]["clocks"]["offset_s"] == 0.0
        found.append(np.array([landmark["T_world_target"] for landmark in document["landmarks"]]))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    assert len(found[0]) == len(true)
    few = CliRunner().invoke(command, [*arguments, *map(str, by_hand[:7])])
    assert few.exit_code == 2
    assert "--mounting is given 1 times, for 2 LiDARs" in few.output


def test_a_session_of_two_lidars_at_rest(tmp_path):
    """Views of one stamp are one pose; the poses of later ones are found by the landmarks."""
    true = write_robot(tmp_path / "robot", n=2, together=True, speed=0.0)
    views = [
        {"scan": f"{name}/{k}.pcd", "lidar": name, "stamp": float(k)} for k in range(2) for name in ("front", "rear")
    ]
    session = {
        "schema": "optshape/session/1", "targets": {"paper": "paper"}, "views": views,
        "lidars": {"front": {"sensor": "vlp32c"}, "rear": {"sensor": "vlp16"}},
    }  # fmt: skip
    file = tmp_path / "robot" / "session.json"
    file.write_text(json.dumps(session))
    between = inverse(MOUNTED["front"]) @ MOUNTED["rear"]
    result = map_recording(file, extrinsics={("front", "rear"): between}, pool=Pool(1))
    assert_mapped(result, true)
    assert len(result.trajectory) == 2
    assert sum(landmark.observations for landmark in result.map.landmarks) >= 6  # of eight
    with pytest.raises(InputError, match="where 'rear' is relative to 'front' is not known"):
        map_recording(file, pool=Pool(1))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "transforms"),
        ('{"transforms": [{"a": "x", "b": "y"}]}', "T_a_b"),
        ('{"transforms": [{"a": "x", "b": "y", "T_a_b": [[1]]}]}', "4 elements"),
        (json.dumps({"transforms": [{"a": "x", "b": "y", "T_a_b": (2 * np.eye(4)).tolist()}]}), "T_a_b"),
    ],
)
def test_bad_extrinsics_are_said(tmp_path, text, said):
    (tmp_path / "rig.json").write_text(text)
    with pytest.raises(InputError, match=said) as error:
        read_extrinsics(tmp_path / "rig.json")
    assert "rig.json" in str(error.value)


def test_a_clock_that_is_set_back_is_followed(tmp_path):
    """Of the scans alone, whose clock is set back by an hour in the middle."""
    true = write_robot(tmp_path / "robot", n=12, step=0.25)
    file = tmp_path / "robot" / "front" / "timestamps.txt"
    stamps = [float(line) - (3600.0 if k >= 6 else 0.0) for k, line in enumerate(file.read_text().split())]
    file.write_text("".join(f"{stamp}\n" for stamp in stamps))
    result = map_recording(tmp_path / "robot", TARGET, FRONT, scans="front", mounting=MOUNTED["front"], pool=Pool(1))
    assert not result.problems
    assert result.progress.scans == 12
    assert not result.passed_over.lines()
    [said] = [line for line in result.clocks.lines() if "set back by 3600.0" in line]
    assert "front" in said
    assert_mapped(result, true)


def test_half_of_the_scans_lost_is_a_problem_and_both_spans_are_said(tmp_path):
    write_robot(tmp_path / "robot", odometry_late=1.5)
    given = {"scans": "front", "mounting": MOUNTED["front"], "pool": Pool(1)}
    result = map_recording(tmp_path / "robot", TARGET, FRONT, **given)
    assert "2 of 4 scans were lost" in result.problems
    assert any("from 0.000 to 1.800 s, odometry is from 1.000 to" in text for text in result.problems)
    mended = map_recording(tmp_path / "robot", TARGET, FRONT, clock_offset=-1.5, **given)
    assert not mended.problems
    assert any("-1.5000 s (given)" in line for line in mended.clocks.lines())


def test_two_lidars_see_a_new_target_at_once():
    """Sightings of one pose by two LiDARs agree on a landmark, and are held against it in what follows."""
    rng = np.random.default_rng(0)
    poses = np.array([at(0.5 * k, 0.0, 0.05 * k) for k in range(3)])
    world = World(poses, np.array([at(6.0, 1.0, 0.2, 0.3)]), np.full(6, 1e-3))
    T_first_second = at(0.1, -0.4, 0.6)
    second = World(poses @ T_first_second, world.targets, world.motion_sigma)
    slam = LandmarkSlam(confirmations=2)
    steps = [inverse(a) @ b for a, b in pairwise(poses)]
    for k in range(3):
        slam.add_odometry(float(k), *((steps[k - 1], 1e-6 * np.eye(6)) if k else ()))
        for name, seen, T in (("a", world, np.eye(4)), ("b", second, T_first_second)):
            sighting: Sighting = seen.sighting(rng, k, 0, None).on_body(T, name)
            outcome = slam.add_measurements([sighting])[0]
            assert outcome.verdict == ("pending" if (k, name) == (0, "a") else "new" if k == 0 else "matched")
    assert len(slam.landmarks) == 1
    [T] = slam.landmarks.values()
    np.testing.assert_allclose(T[:3, 3], world.targets[0, :3, 3], atol=0.05)


def test_odometry_with_a_gap_is_not_interpolated():
    stamps = np.concatenate([np.arange(0.0, 2.0, 0.1), np.arange(3602.0, 3604.0, 0.1)])
    track = OdometryTrack([Stamped(float(s), np.eye(4)) for s in stamps])
    assert track.sweep(1.0, -0.05, 0.05) is not None
    assert track.sweep(3602.02, -0.05, 0.05) is None
    assert track.sweep(3603.0, -0.05, 0.05) is not None
