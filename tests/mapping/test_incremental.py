"""LandmarkSlam: names known and unknown, wrong names, symmetric and ambiguous targets, known maps, lag, bad input."""

import numpy as np
import pytest

from optshape_graph import Target
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.mapping import Landmark, LandmarkSlam, Map, Sighting, Start, solve_batch
from optshape_graph.se3 import difference, inverse
from tests.factors.support import TARGET, measure, retract
from tests.mapping.support import at, covariance, loop

SQUARE = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], "square")


def drive(world, seed, slam=None, named=True, wrong=0.0, template=TARGET, reach=20.0, odometry=None):
    """Drive a world's path; with a probability `wrong` a sighting goes by another target's name."""
    rng, liar = np.random.default_rng(seed), np.random.default_rng(1000 + seed)
    motions = odometry or world.odometry(rng)
    slam = slam or LandmarkSlam()
    for i in range(len(world.poses)):
        if i == 0:
            slam.add_odometry(0.0)
        else:
            slam.add_odometry(float(i), motions[i - 1], covariance(world.motion_sigma))
        sightings = []
        for j in world.near(i, reach):
            k = int(liar.integers(len(world.targets))) if liar.random() < wrong else j
            sightings.append(world.sighting(rng, i, j, f"t{k}" if named else None, template))
        slam.add_measurements(sightings)
    slam.settle()
    return slam


def position_rmse(slam, world):
    return float(np.sqrt(np.square(slam.trajectory.poses[:, :3, 3] - world.poses[:, :3, 3]).sum(axis=1).mean()))


WORLD = loop(length=120.0, n_poses=80, n_targets=6, laps=1)


def test_names_known_or_not_give_the_same_map():
    named, unnamed = drive(WORLD, 0), drive(WORLD, 0, named=False)
    assert len(named.landmarks) == len(unnamed.landmarks) == 6
    np.testing.assert_allclose(named.trajectory.poses, unnamed.trajectory.poses, atol=1e-9)
    assert named.counts["rejected"] == 0


def test_poses_and_landmarks_agree_with_the_batch():
    slam = drive(WORLD, 1)
    batch = solve_batch(slam.problem())
    assert batch.converged
    # Settled, everything is linearised where it is: to a fraction of the standard deviations, which are centimetres.
    np.testing.assert_allclose(slam.trajectory.poses, batch.trajectory("session").poses, atol=0.005)
    ours, theirs = slam.covariance(["t0", "t3"], [40]), batch.covariance(["t0", "t3"], [("session", 40)])
    np.testing.assert_allclose(np.diag(ours), np.diag(theirs), rtol=0.01)


def test_two_laps_close_the_loop():
    world = loop(length=120.0, n_poses=80, n_targets=6, laps=2)
    slam = drive(world, 2)
    assert len(slam.landmarks) == 6
    dead = np.eye(4)
    rng = np.random.default_rng(2)
    for T in world.odometry(rng):
        dead = dead @ T
    drift = np.linalg.norm(dead[:3, 3] - world.poses[-1, :3, 3])
    assert np.linalg.norm(slam.pose[:3, 3] - world.poses[-1, :3, 3]) < 0.5 * drift


def test_wrong_names_are_rejected():
    for seed in range(3):
        slam = drive(WORLD, seed, wrong=0.1)
        assert slam.counts["rejected"] > 0
        for match in slam.problem().tracks[0].matches:
            j = int(match.landmark[1:])
            measured = WORLD.poses[match.pose] @ inverse(match.measurement.T_target_lidar)
            # Taken 0.01 rad beside the truth, up to 20 m away; another target is as far.
            assert np.linalg.norm(measured[:3, 3] - WORLD.targets[j][:3, 3]) < 1.0


def test_a_landmark_that_was_wrong_from_the_start_is_outvoted():
    rng, slam = np.random.default_rng(3), LandmarkSlam()
    T_a, T_b = at(6.0, 1.0, 0.3), at(6.0, -4.0, -0.3)
    names = ["b", "b", "a", "a", "a", "a"]  # of what stands at a
    for i, name in enumerate(names):
        T = at(0.5 * i, 0.0, 0.0)
        if i == 0:
            slam.add_odometry(0.0)
        else:
            slam.add_odometry(float(i), at(0.5, 0.0, 0.0), covariance([0.001] * 3 + [0.003] * 3))
        a = measure(rng, inverse(T_a) @ T)
        b = measure(rng, inverse(T_b) @ T)
        slam.add_measurements([Sighting(TARGET, (a,), name), Sighting(TARGET, (b,), "b" if i > 1 else "c")])
    # Both had a wrong name first: "b" stood at a, and "c" at b.
    assert slam.counts["landmarks outvoted"] == 2
    assert set(slam.landmarks) == {"a", "b"}
    np.testing.assert_allclose(slam.landmarks["a"][:3, 3], T_a[:3, 3], atol=0.02)
    np.testing.assert_allclose(slam.landmarks["b"][:3, 3], T_b[:3, 3], atol=0.02)


def test_a_symmetric_target_keeps_its_names():
    slam = drive(WORLD, 4, template=SQUARE, named=False)
    assert len(slam.landmarks) == 6
    assert position_rmse(slam, WORLD) == pytest.approx(position_rmse(drive(WORLD, 4), WORLD), abs=0.3)


def test_an_ambiguous_pose_is_carried_until_another_view_tells():
    rng, slam = np.random.default_rng(5), LandmarkSlam()
    T_true = at(6.0, 0.5, 0.2)
    wrong_side = at(6.0, 0.5, -0.5)
    verdicts = []
    for i in range(3):
        T = at(0.0, 1.5 * i, 0.0)
        slam.add_odometry(float(i), None if i == 0 else at(0.0, 1.5, 0.0), covariance([0.001] * 3 + [0.003] * 3))
        best = measure(rng, inverse(T_true) @ T)
        H = best.T_target_lidar
        # The flipped pose has its own mirror image in every view: only the true one stays where it is.
        flipped = retract(inverse(wrong_side) @ T, np.array([0, 0, 0.2 * i, 0, 0, 0]))
        other = best.substituted(H @ inverse(flipped))
        order = (other, best) if i == 0 else (best, other)
        [outcome] = slam.add_measurements([Sighting(TARGET, order, "door")])
        verdicts.append(outcome.verdict)
    assert verdicts == ["pending", "new", "matched"]
    np.testing.assert_allclose(slam.landmarks["door"], T_true, atol=0.02)


def test_surveyed_landmarks_hold_the_trajectory():
    survey = Map(tuple(Landmark(f"t{j}", TARGET, T, covariance([0.01] * 6)) for j, T in enumerate(WORLD.targets)))
    free = drive(WORLD, 6)
    held = drive(WORLD, 6, LandmarkSlam(survey, Start(WORLD.poses[0], covariance([0.01] * 6))))
    assert held.counts["new"] == 0
    assert position_rmse(held, WORLD) < 0.7 * position_rmse(free, WORLD)


def test_a_robot_finds_itself_in_a_known_map():
    made = drive(WORLD, 7).map()
    rng = np.random.default_rng(8)
    later = LandmarkSlam(made, name="later")
    with pytest.raises(EstimationError, match="not known"):
        _ = later.pose
    start = 20
    for i in range(start, start + 10):
        motion = None if i == start else inverse(WORLD.poses[i - 1]) @ WORLD.poses[i]
        later.add_odometry(float(i), motion, None if motion is None else covariance(WORLD.motion_sigma))
        later.add_measurements([world_sighting(rng, i, j) for j in WORLD.near(i, 20.0)])
    # In the frame of the map, which has drifted by what its covariance says.
    there = np.linalg.norm(later.pose[:3, 3] - WORLD.poses[start + 9, :3, 3])
    assert there < 3 * np.sqrt(np.trace(later.covariance(poses=[len(later.trajectory) - 1])[3:, 3:]))
    extended = later.map()
    assert set(extended.trajectories) == {"session", "later"}
    assert {m.id for m in extended.landmarks} >= {m.id for m in made.landmarks}


def world_sighting(rng, i, j):
    return WORLD.sighting(rng, i, j, f"t{j}")


def test_without_odometry_landmarks_alone_place_the_poses():
    rng = np.random.default_rng(9)
    slam = LandmarkSlam(confirmations=1)
    targets = {"a": at(6.0, 1.0, 0.3), "b": at(7.0, -2.0, -0.2)}
    poses = [np.eye(4), at(0.5, 0.8, 0.4), at(-1.0, -0.5, -0.6, 0.2)]
    for k, T in enumerate(poses):
        slam.add_odometry(float(k))
        slam.add_measurements([Sighting(TARGET, (measure(rng, inverse(X) @ T),), n) for n, X in targets.items()])
    np.testing.assert_allclose(slam.trajectory.poses, poses, atol=0.03)


def test_a_lag_bounds_what_is_held():
    slam = drive(WORLD, 10, LandmarkSlam(lag=15.0))
    assert len(slam.landmarks) == 6
    assert len(slam._graph.matches) < 60
    assert not slam._graph.odometry
    with pytest.raises(InputError, match="not kept"):
        slam.problem()
    with pytest.raises(InputError, match="pose 3 is not in the graph"):
        slam.covariance(poses=[3])
    assert len(slam.trajectory) == 80


def test_bad_odometry_changes_nothing():
    slam = LandmarkSlam()
    with pytest.raises(InputError, match="no pose to measure from"):
        slam.add_measurements([])
    slam.add_odometry(1.0)
    good = covariance([0.01] * 6)
    for stamp, T, C, message in (
        (1.0, np.eye(4), good, "does not follow 1.0"),
        (np.nan, np.eye(4), good, "does not follow"),
        (2.0, 2 * np.eye(4), good, "rigid"),
        (2.0, np.full((4, 4), np.nan), good, "finite"),
        (2.0, np.eye(4), -good, "positive definite"),
        (2.0, np.eye(4), np.full((6, 6), np.nan), "positive definite"),
    ):
        with pytest.raises(InputError, match=message):
            slam.add_odometry(stamp, T, C)
    assert slam.add_odometry(2.0, np.eye(4), good) == 1
    np.testing.assert_allclose(slam.pose, np.eye(4), atol=1e-9)
    with pytest.raises(InputError, match="no landmark 'x'; the map has none"):
        slam.covariance(["x"])
    with pytest.raises(InputError, match="expected at least 1"):
        LandmarkSlam(confirmations=0)


def test_several_lidars_of_one_robot_make_one_map():
    rng, slam = np.random.default_rng(11), LandmarkSlam(confirmations=1)
    mounted = {"front": at(0.5, 0.1, 0.1, 0.8), "rear": at(-0.4, 0.0, np.pi - 0.2, 0.8)}
    targets = {"a": at(6.0, 1.0, 0.3), "b": at(-6.0, 1.0, 3.0)}
    bodies = [at(0.4 * i, 0.1 * i, 0.1 * i) for i in range(6)]
    for i, T in enumerate(bodies):
        motion = inverse(bodies[i - 1]) @ T if i else None
        slam.add_odometry(float(i), motion, covariance([0.01] * 6) if i else None)
        slam.add_measurements([
            Sighting(TARGET, (measure(rng, inverse(X) @ T @ mounted[lidar]),), name).on_body(mounted[lidar], lidar)
            for lidar, (name, X) in zip(mounted, targets.items(), strict=True)
        ])  # fmt: skip
    solution = solve_batch(slam.problem())
    assert set(solution.keys.biases) == {(0, "front"), (0, "rear")}
    for name, X in targets.items():
        error = difference(solution.landmarks[name], X)
        # 99.9 % of chi-square with 6 degrees of freedom.
        assert error @ np.linalg.solve(solution.covariance([name]), error) < 22.5


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("confirmations", [1, 2])
def test_a_target_seen_twice_from_one_pose_counts_once(named, confirmations):
    rng, twice = np.random.default_rng(0), LandmarkSlam(confirmations=confirmations)
    once, motions = LandmarkSlam(confirmations=confirmations), WORLD.odometry(rng)
    for i in range(3):
        step = (motions[i - 1], covariance(WORLD.motion_sigma)) if i else ()
        sighting = WORLD.sighting(rng, i, 0, "t0" if named else None)
        once.add_odometry(float(i), *step)
        once.add_measurements([sighting])
        twice.add_odometry(float(i), *step)
        _, again = twice.add_measurements([sighting, sighting])
        [later] = twice.add_measurements([sighting])
        for outcome in (again, later):
            assert outcome.verdict == "rejected"
            assert outcome.reason.startswith("another sighting from this pose")
    once.settle()
    twice.settle()
    assert list(twice.landmarks) == list(once.landmarks)
    name = next(iter(once.landmarks))
    np.testing.assert_allclose(np.diag(twice.covariance([name])), np.diag(once.covariance([name])), rtol=0.01)
