"""The batch against exact callbacks, several sessions, consistency over seeds, as-built vertices."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from optshape_graph import Target
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.evaluation.trajectories import consistency_of, pose_nees, predicted_rmse
from optshape_graph.factors import ShapeMeasurement, TemplateCallbackFactor, shape_rows
from optshape_graph.mapping import MappingProblem, Match, Odometry, Sighting, Start, Track, factor_graph, solve_batch
from optshape_graph.mapping.batch import pose_graph
from optshape_graph.se3 import inverse
from tests.factors.support import TARGET, edge_points, measure, retract
from tests.mapping.support import at, covariance, loop

START = Start(np.eye(4), 1e-8 * np.eye(6))


def problem_of(world, seed, reach=20.0, name="robot", known=None, start=START):
    """Return a problem as a front end leaves it: poses by odometry, landmarks where they were first seen."""
    rng = np.random.default_rng(seed)
    poses = [world.poses[0]]
    for T in world.odometry(rng):
        poses.append(poses[-1] @ T)
    rng = np.random.default_rng(seed)
    edges = tuple(Odometry(i, i + 1, T, covariance(world.motion_sigma)) for i, T in enumerate(world.odometry(rng)))
    matches, landmarks = [], {}
    for i in range(len(poses)):
        for j in world.near(i, reach):
            sighting = world.sighting(rng, i, j, f"t{j}")
            matches.append(Match(i, f"t{j}", sighting, 0))
            landmarks.setdefault(f"t{j}", poses[i] @ inverse(sighting.measurements[0].T_target_lidar))
    track = Track(name, np.arange(len(poses), dtype=float), np.array(poses), edges, tuple(matches), start)
    return MappingProblem((track,), dict.fromkeys(landmarks, TARGET), landmarks, known)


def test_it_is_the_solution_of_the_exact_factors():
    problem = problem_of(loop(length=100.0, n_poses=40, n_targets=5), 0)
    ours = solve_batch(problem, robust=False)
    assert ours.converged
    [track] = problem.tracks
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.noiseModel.Gaussian.Covariance(START.covariance)
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), start))
    for edge in track.odometry:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        graph.push_back(gtsam.BetweenFactorPose3(X(edge.i), X(edge.j), gtsam.Pose3(edge.T_i_j), noise))
    key = {name: L(k) for k, name in enumerate(problem.T_world_target)}
    for match in track.matches:
        graph.push_back(TemplateCallbackFactor(match.measurement, key[match.landmark], X(match.pose)))
    for i, T in enumerate(track.T_world_lidar):
        values.insert(X(i), gtsam.Pose3(T))
    for name, T in problem.T_world_target.items():
        values.insert(key[name], gtsam.Pose3(T))
    for _ in range(10):
        values = values.retract(graph.linearize(values).optimize())
    exact = np.array([values.atPose3(X(i)).matrix() for i in range(40)])
    np.testing.assert_allclose(ours.trajectory("robot").poses, exact, atol=1e-6)
    for name, T in ours.landmarks.items():
        np.testing.assert_allclose(T, values.atPose3(key[name]).matrix(), atol=1e-6)
    assert ours.error == pytest.approx(graph.error(values), rel=1e-9)
    marginals = gtsam.Marginals(graph, values)
    for i in (10, 39):
        theirs = marginals.marginalCovariance(X(i))
        np.testing.assert_allclose(ours.covariance(poses=[("robot", i)]), theirs, atol=0.01 * np.abs(theirs).max())
    np.testing.assert_allclose(np.diag(ours.covariance(["t2"])), np.diag(marginals.marginalCovariance(key["t2"])), 0.01)


@pytest.mark.parametrize("surveyed", [False, True])
def test_covariances_are_honest(surveyed):
    from optshape_graph.mapping import Landmark, Map

    # A fifth of the poses of a 500 m loop keeps this quick; the odometry's noise per metre is the same.
    nees, squared, predicted = [], [], []
    for seed in range(20):
        world = loop(n_poses=100)
        rng = np.random.default_rng(500 + seed)
        known = Map(
            tuple(
                Landmark(f"t{j}", TARGET, retract(T, 0.01 * rng.normal(size=6)), covariance([0.01] * 6))
                for j, T in enumerate(world.targets)
            )
        ) if surveyed else None  # fmt: skip
        problem = problem_of(world, seed, known=known)
        solution = solve_batch(problem, robust=False)
        assert solution.converged
        numbers = list(range(5, 100, 10))
        estimated = solution.trajectory("robot").poses[numbers]
        C = np.array([solution.covariance(poses=[("robot", i)]) for i in numbers])
        nees.append(pose_nees(estimated, world.poses[numbers], C).mean())
        squared.append(np.square(estimated[:, :3, 3] - world.poses[numbers][:, :3, 3]).sum(axis=1).mean())
        predicted.append(predicted_rmse(C) ** 2)
    assert np.sqrt(np.mean(squared)) <= 1.2 * np.sqrt(np.mean(predicted))
    assert 0.8 <= consistency_of(np.array(nees)).per_dof <= 1.25


def test_several_robots_share_a_map():
    world = loop(length=100.0, n_poses=40, n_targets=5)
    first, second = problem_of(world, 1, name="one"), problem_of(world, 2, name="two", start=None)
    # The second robot's frame is anywhere: its poses are guessed a metre off, and nothing but landmarks ties them.
    guess = np.array([at(0.5, -0.5, 0.02) @ T for T in second.tracks[0].T_world_lidar])
    track = Track("two", second.tracks[0].stamps, guess, second.tracks[0].odometry, second.tracks[0].matches, None)
    both = MappingProblem((first.tracks[0], track), first.targets, first.T_world_target)
    solution = solve_batch(both)
    assert solution.converged
    one = solve_batch(first)
    for name in ("t0", "t3"):
        assert np.trace(solution.covariance([name])) < np.trace(one.covariance([name]))
    np.testing.assert_allclose(solution.trajectory("two").poses, world.poses, atol=0.5)
    assert {r.track for r in solution.residuals} == {"one", "two"}
    assert set(solution.map().trajectories) == {"one", "two"}


def test_a_robust_loss_bears_outliers():
    world = loop(length=100.0, n_poses=40, n_targets=5)
    problem = problem_of(world, 3)
    [track] = problem.tracks
    rng = np.random.default_rng(0)
    matches = list(track.matches)
    for k in rng.choice(len(matches), len(matches) // 20, replace=False):
        H = matches[k].measurement.T_target_lidar
        wrong = measure(rng, retract(H, np.array([0.0, 0, 0, 0.5, 0.5, 0])))
        matches[k] = Match(matches[k].pose, matches[k].landmark, Sighting(TARGET, (wrong,)), 0)
    spoiled = MappingProblem(
        (Track("robot", track.stamps, track.T_world_lidar, track.odometry, tuple(matches), START),),
        problem.targets,
        problem.T_world_target,
    )

    def error(solution):
        return np.linalg.norm(solution.trajectory("robot").poses[:, :3, 3] - world.poses[:, :3, 3])

    robust, plain, clean = solve_batch(spoiled), solve_batch(spoiled, robust=False), solve_batch(problem)
    assert error(robust) < 0.7 * error(plain)
    assert error(robust) < 1.5 * error(clean)
    assert min(r.weight for r in robust.residuals) < 0.2


@pytest.mark.parametrize("sigma", [0.02, 1.0])
def test_vertices_are_refined_to_what_was_built(sigma):
    built = Target.from_polygon(TARGET.polygon + 0.02 * np.array([[1, 0], [0, -1], [-1, 0.5], [0, 0.5]]))
    rng = np.random.default_rng(4)
    T_target = at(5.0, 0.0, 0.0)
    poses = np.array([at(0.0, y, 0.02 * y) for y in np.linspace(-1.0, 1.0, 20)])
    matches = []
    for i, T in enumerate(poses):
        H = inverse(T_target) @ T
        points, edge = edge_points(rng, inverse(H), 60, built, noise=0.005)
        rows = np.vstack([shape_rows(points, edge, 4), shape_rows(points, np.full(60, 4), 4)]) / 0.005
        shape = ShapeMeasurement.from_rows(rows, H)
        matches.append(Match(i, "t", Sighting(TARGET, (shape.of_template(TARGET.vertices),), "t", shape), 0))
    edges = tuple(
        Odometry(i, i + 1, inverse(poses[i]) @ poses[i + 1], covariance([1e-3] * 6)) for i in range(len(poses) - 1)
    )
    start = Start(poses[0], 1e-8 * np.eye(6))
    track = Track("robot", np.arange(20.0), poses, edges, tuple(matches), start)
    solution = solve_batch(MappingProblem((track,), {"t": TARGET}, {"t": T_target}), as_built_sigma=sigma)
    assert solution.converged
    refined = solution.templates["t"]
    lengths = [np.linalg.norm(np.roll(t.vertices, -1, axis=0) - t.vertices, axis=1) for t in (refined, built, TARGET)]
    # 20 views x 15 points per edge of 5 mm: edges are known to about a millimetre, vertices to two.
    assert np.abs(lengths[0] - lengths[1]).max() < 0.005
    assert np.abs(lengths[2] - lengths[1]).max() > 0.015
    assert solution.map()["t"].target is refined


def test_plain_factors_for_those_who_own_their_graph():
    problem = problem_of(loop(length=100.0, n_poses=20, n_targets=5), 5)
    graph, values = factor_graph(problem)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    ours = solve_batch(problem)
    assert graph.size() == 1 + 19 + len(problem.tracks[0].matches)
    last = ours.keys.poses[0][-1]
    # Summaries of the initial values, not made again: a fraction of the standard deviation off.
    np.testing.assert_allclose(theirs.atPose3(last).matrix(), ours.values.atPose3(last).matrix(), atol=0.02)
    drawn = pose_graph(ours)
    assert len(drawn.vertices) == 20 + len(problem.T_world_target)
    assert len(drawn.edges) == 19 + len(problem.tracks[0].matches)
    assert drawn.fixed == {0}


def test_nothing_and_too_little():
    with pytest.raises(InputError, match="without a pose"):
        solve_batch(MappingProblem((), {}, {}))
    problem = problem_of(loop(length=100.0, n_poses=5, n_targets=5), 6, start=None)
    with pytest.raises(EstimationError, match="not determined"):
        solve_batch(problem).covariance(poses=[("robot", 0)])
