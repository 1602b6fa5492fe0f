import pickle

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B
from hypothesis import given, settings

from optshape_graph import EstimationError, InputError, Target, UnobservableError
from optshape_graph.factors import TemplateCallbackFactor, TemplateMeasurement, edge_rows, plane_rows
from optshape_graph.graph import Observation, build
from optshape_graph.se3 import adjoint, inverse
from tests.factors.support import TARGET, edge_points, log, measure, minimise, retract, seeds

SIGMA = 0.01


def scene(rng, scans=4, targets=3):
    """Return true poses: targets about 5 m ahead, LiDARs within a metre of the world's origin."""
    lidars = {f"s{i}": retract(np.eye(4), 0.3 * rng.normal(size=6)) for i in range(scans)}
    lidars["s0"] = np.eye(4)
    placed = {}
    for j in range(targets):
        placed[f"t{j}"] = retract(np.eye(4), 0.4 * rng.normal(size=6))
        placed[f"t{j}"][:3, 3] += [5.0, 1.5 * (j - 1), 0.0]
    return lidars, placed


def observe(rng, lidars, targets, n=40, template=TARGET, noise=None, skip=()):
    observations = []
    for scan, T_world_lidar in lidars.items():
        for target, T_world_target in targets.items():
            if (scan, target) in skip:
                continue
            T = inverse(T_world_target) @ T_world_lidar
            measurement = measure(rng, T, n, SIGMA, template, noise)
            observations.append(Observation(scan, target, measurement.at(minimise(measurement, T, 5)), template))
    return observations


def errors(solution, lidars, targets):
    pairs = [(solution.T_world_lidar, lidars), (solution.T_world_target, targets)]
    return {name: log(inverse(T) @ found[name]) for found, true in pairs for name, T in true.items()}


@settings(max_examples=10)
@given(seeds)
def test_noise_free_scene_is_recovered(seed):
    rng = np.random.default_rng(seed)
    lidars, targets = scene(rng)
    solution = build(observe(rng, lidars, targets, noise=0.0)).solve()
    assert solution.converged
    assert not solution.unobservable
    assert solution.error < 1e-12
    assert max(np.abs(e).max() for e in errors(solution, lidars, targets).values()) < 1e-8


def test_solution_and_covariance_are_those_of_the_exact_callbacks():
    rng = np.random.default_rng(1)
    lidars, targets = scene(rng)
    graph = build(observe(rng, lidars, targets, skip={("s1", "t2"), ("s3", "t0")}))
    solution = graph.solve()
    reference = gtsam.NonlinearFactorGraph()
    anchor = gtsam.symbol("a", 0)
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)
    reference.push_back(gtsam.PriorFactorPose3(anchor, gtsam.Pose3(), tight))
    for o in graph.observations:
        reference.push_back(
            TemplateCallbackFactor(o.measurement, graph.target_keys[o.target], graph.lidar_keys.get(o.scan, anchor))
        )
    values = graph.initial_values()
    values.insert(anchor, gtsam.Pose3())
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    exact = gtsam.LevenbergMarquardtOptimizer(reference, values, parameters).optimize()
    assert solution.converged
    assert solution.error == pytest.approx(reference.error(exact), rel=1e-9)
    for key in [*graph.lidar_keys.values(), *graph.target_keys.values()]:
        gap = exact.atPose3(key).localCoordinates(solution.values.atPose3(key))
        assert np.abs(gap).max() < 1e-6  # a ten-thousandth of a standard deviation
    keys = [graph.lidar_keys["s2"], graph.target_keys["t1"]]
    joint = gtsam.Marginals(reference, exact).jointMarginalCovariance(keys)
    expected = np.block([[joint.at(i, j) for j in keys] for i in keys])
    found = solution.covariance(["s2"], ["t1"])
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert np.abs(found[:6, 6:]).max() > 0.05 * np.abs(found).max()


def test_relative_pose_with_covariance():
    rng = np.random.default_rng(2)
    lidars, targets = scene(rng)
    solution = build(observe(rng, lidars, targets)).solve()
    T, covariance = solution.T_lidar_target("s1", "t1")
    np.testing.assert_allclose(T, inverse(solution.T_world_lidar["s1"]) @ solution.T_world_target["t1"])
    # From the anchored scan it is the target's own covariance: its pose there is known.
    T, covariance = solution.T_lidar_target("s0", "t1")
    np.testing.assert_allclose(covariance, solution.covariance(targets=["t1"]), rtol=1e-9, atol=1e-15)
    # Seen from the world, the perturbation of the inverse goes through the Adjoint.
    joint = solution.covariance(["s1"], ["t1"])
    T, covariance = solution.T_lidar_target("s1", "t1")
    samples = np.linalg.cholesky(joint) @ rng.normal(size=(12, 3000))
    lidar, target = solution.T_world_lidar["s1"], solution.T_world_target["t1"]
    scatter = np.stack([log(inverse(T) @ inverse(retract(lidar, x[:6])) @ retract(target, x[6:])) for x in samples.T])
    scale = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
    assert (np.abs(np.cov(scatter.T) - covariance) / scale).max() < 0.12


@pytest.mark.parametrize("known", ["lidars", "targets"])
def test_known_poses_are_no_variables(known):
    rng = np.random.default_rng(3)
    lidars, targets = scene(rng)
    observations = observe(rng, lidars, targets)
    if known == "lidars":
        graph = build(observations, known_lidars=lidars)
        assert not graph.lidar_keys
        # Nothing couples the targets then: each is the sum of its own measurements.
        solution = graph.solve()
        X = targets["t1"]
        total = [o.measurement.substituted(np.eye(4), lidars[o.scan]) for o in observations if o.target == "t1"]
        summed = sum(total[1:], total[0])
        best = minimise(summed, inverse(X))
        np.testing.assert_allclose(solution.T_world_target["t1"], inverse(best), atol=1e-7)
        covariance = np.linalg.inv(summed.information(best))
        expected = adjoint(best) @ covariance @ adjoint(best).T
        np.testing.assert_allclose(solution.covariance(targets=["t1"]), expected, rtol=1e-5, atol=1e-12)
        np.testing.assert_array_equal(solution.covariance(["s1"]), np.zeros((6, 6)))
    else:
        graph = build(observations, known_targets=targets)
        assert not graph.target_keys
        solution = graph.solve()
        joint = solution.covariance(["s1"], ["t0"])
        assert (np.linalg.eigvalsh(joint[:6, :6]) > 0).all()
        assert not joint[6:].any()
    assert solution.converged
    assert max(np.abs(e).max() for e in errors(solution, lidars, targets).values()) < 0.1


def test_covariance_is_consistent():
    rng = np.random.default_rng(4)
    lidars, targets = scene(rng, scans=3, targets=2)
    nees, chi2 = [], []
    for _ in range(60):
        solution = build(observe(rng, lidars, targets, n=16)).solve()
        error = errors(solution, lidars, targets)
        x = np.concatenate([error[name] for name in ("s1", "s2", "t0", "t1")])
        nees.append(x @ np.linalg.solve(solution.covariance(["s1", "s2"], ["t0", "t1"]), x))
        chi2.append(2 * solution.error)
    # Means of 60 chi-squares: standard deviation sqrt(2 dof / 60), and four of them.
    assert np.mean(nees) == pytest.approx(24, abs=4 * np.sqrt(2 * 24 / 60))
    rows = 6 * 2 * 16
    assert np.mean(chi2) == pytest.approx(rows - 24, abs=4 * np.sqrt(2 * rows / 60))


def test_residuals_name_the_measurement_that_contradicts_the_others():
    rng = np.random.default_rng(5)
    lidars, targets = scene(rng)
    observations = observe(rng, lidars, targets)
    wrong = inverse(targets["t1"]) @ retract(lidars["s2"], np.array([0.05, 0.0, 0.0, 0.0, 0.1, 0.0]))
    at = next(i for i, o in enumerate(observations) if (o.scan, o.target) == ("s2", "t1"))
    observations[at] = Observation("s2", "t1", measure(rng, wrong))
    solution = build(observations).solve()
    worst = max(solution.residuals, key=lambda r: r.chi2_pose)
    assert (worst.scan, worst.target) == ("s2", "t1")
    assert worst.chi2_pose > 50
    assert sum(r.chi2 for r in solution.residuals) == pytest.approx(2 * solution.error)
    assert all(0 <= r.chi2_pose <= r.chi2 for r in solution.residuals)
    assert worst.n_rows == 80


def test_free_gauge_is_reported_and_refused():
    rng = np.random.default_rng(6)
    lidars, targets = scene(rng)
    solution = build(observe(rng, lidars, targets), known_lidars={}).solve()
    assert solution.converged
    assert len(solution.unobservable) == 6
    assert all(len(direction.motion) == 7 for direction in solution.unobservable)
    with pytest.raises(UnobservableError, match="not observable") as caught:
        solution.covariance(["s1"])
    assert len(caught.value.directions) == 6


def test_two_parts_that_nothing_connects():
    rng = np.random.default_rng(7)
    lidars, targets = scene(rng)
    apart = {(s, t) for s in ("s0", "s1") for t in ("t1", "t2")} | {(s, "t0") for s in ("s2", "s3")}
    solution = build(observe(rng, lidars, targets, skip=apart)).solve()
    assert solution.converged
    assert len(solution.unobservable) == 6
    assert {name for d in solution.unobservable for name in d.motion} == {
        "T_world_lidar[s2]",
        "T_world_lidar[s3]",
        "T_world_target[t1]",
        "T_world_target[t2]",
    }
    assert (np.linalg.eigvalsh(solution.covariance(["s1"], ["t0"])) > 0).all()


def test_one_visible_edge_slides_along_itself():
    rng = np.random.default_rng(8)
    lidars, targets = scene(rng, scans=1, targets=2)
    observations = observe(rng, lidars, targets)
    T = inverse(targets["t1"]) @ lidars["s0"]
    points, edge = edge_points(rng, inverse(T), 80, noise=SIGMA)
    seen = edge == 1
    A, r = edge_rows(points[seen], TARGET.normals[edge[seen]], TARGET.offsets[edge[seen]])
    P, s = plane_rows(points)
    rows = np.vstack([A, P]) / SIGMA, np.append(r, s) / SIGMA
    observations[1] = Observation("s0", "t1", TemplateMeasurement.from_rows(*rows, T))
    solution = build(observations).solve()
    assert solution.converged
    [direction] = solution.unobservable
    along = np.array([0.0, -TARGET.normals[1, 1], TARGET.normals[1, 0]])
    motion = direction.motion["T_world_target[t1]"]
    assert abs(motion[3:] @ along) / np.linalg.norm(motion) == pytest.approx(1.0, abs=1e-3)
    assert direction.text.startswith("T_world_target[t1]: translation along [0.00, ")
    assert str(direction) == direction.text
    with pytest.raises(UnobservableError, match="T_world_target\\[t1\\]: translation"):
        solution.covariance(targets=["t1"])
    # The other target is none the worse for it.
    np.testing.assert_allclose(
        solution.covariance(targets=["t0"]),
        build(observations[:1]).solve().covariance(targets=["t0"]),
        rtol=1e-4,
        atol=1e-12,
    )


SQUARE = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)], "square")


@settings(max_examples=10)
@given(seeds)
def test_symmetric_targets_agree_on_an_equivalent_pose(seed):
    rng = np.random.default_rng(seed)
    assert len(SQUARE.symmetries) == 4
    lidars, targets = scene(rng)
    turned = []
    for o in observe(rng, lidars, targets, template=SQUARE, noise=0.0):
        S = SQUARE.symmetry_transforms[rng.integers(4)]
        turned.append(Observation(o.scan, o.target, o.measurement.substituted(S), o.template))
    predicted = {name: retract(T, 0.02 * rng.normal(size=6)) for name, T in lidars.items()}
    origin = {"s0": np.eye(4)}
    for graph in (build(turned), build(turned, known_lidars=origin, predicted_lidars=predicted)):
        solution = graph.solve()
        assert solution.converged
        assert solution.error < 1e-9
        for name, T in lidars.items():
            np.testing.assert_allclose(solution.T_world_lidar[name], T, atol=1e-6)
        for name, T in targets.items():
            relative = inverse(T) @ solution.T_world_target[name]
            assert min(np.abs(relative[:3, :3] - S).max() for S in SQUARE.symmetry_transforms[:, :3, :3]) < 1e-6
            np.testing.assert_allclose(relative[:3, 3], 0.0, atol=1e-6)


def test_predictions_decide_what_the_measurements_leave_open():
    rng = np.random.default_rng(9)
    lidars, targets = scene(rng, scans=2, targets=1)
    observations = observe(rng, lidars, targets, template=SQUARE, noise=0.0)
    quarter = SQUARE.symmetry_transforms[1]
    observations[1] = Observation("s1", "t0", observations[1].measurement.substituted(quarter), SQUARE)
    predicted = {"s1": retract(lidars["s1"], 0.05 * rng.normal(size=6))}
    solution = build(observations, predicted_lidars=predicted).solve()
    np.testing.assert_allclose(solution.T_world_lidar["s1"], lidars["s1"], atol=1e-6)


def test_other_factors_join_in():
    rng = np.random.default_rng(10)
    lidars, targets = scene(rng)
    graph = build(observe(rng, lidars, targets), known_lidars={})
    others, more = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.001)
    others.push_back(gtsam.PriorFactorPose3(graph.target_keys["t0"], gtsam.Pose3(targets["t0"]), noise))
    others.push_back(gtsam.BetweenFactorPose3(graph.lidar_keys["s1"], B(0), gtsam.Pose3(), noise))
    more.insert(B(0), gtsam.Pose3(lidars["s1"]))
    solution = graph.solve(others, more)
    assert solution.converged
    assert not solution.unobservable
    np.testing.assert_allclose(solution.T_world_lidar["s1"], solution.values.atPose3(B(0)).matrix(), atol=1e-6)
    joint = solution.covariance(["s1"], keys=[B(0)])
    assert joint.shape == (12, 12)
    np.testing.assert_allclose(joint[6:, 6:], joint[:6, :6] + 1e-6 * np.eye(6), rtol=1e-4, atol=1e-9)
    assert max(np.abs(e).max() for e in errors(solution, lidars, targets).values()) < 0.1


def test_it_pickles_with_its_covariances():
    rng = np.random.default_rng(11)
    lidars, targets = scene(rng)
    solution = build(observe(rng, lidars, targets)).solve()
    before = solution.covariance(["s1"])
    copy = pickle.loads(pickle.dumps(solution))
    np.testing.assert_allclose(copy.covariance(["s1"]), before)


def test_bad_start_still_ends_at_the_minimum_or_says_so():
    rng = np.random.default_rng(12)
    lidars, targets = scene(rng)
    observations = observe(rng, lidars, targets)
    good = build(observations).solve()
    poor = {name: retract(T, 0.4 * rng.normal(size=6)) for name, T in lidars.items()}
    solution = build(observations, known_lidars={"s0": np.eye(4)}, predicted_lidars=poor).solve()
    assert solution.converged
    assert solution.error == pytest.approx(good.error, rel=1e-9)


def test_not_a_number_is_an_error_not_a_solution():
    rng = np.random.default_rng(13)
    lidars, targets = scene(rng, scans=2, targets=1)
    graph = build(observe(rng, lidars, targets))
    others = gtsam.NonlinearFactorGraph()
    broken = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
    others.push_back(gtsam.PriorFactorPose3(graph.target_keys["t0"], broken, gtsam.noiseModel.Isotropic.Sigma(6, 1.0)))
    with pytest.raises(EstimationError, match="not finite"):
        graph.solve(others)


def test_bad_input():
    rng = np.random.default_rng(14)
    lidars, targets = scene(rng, scans=2, targets=1)
    observations = observe(rng, lidars, targets)
    with pytest.raises(InputError, match="no observation"):
        build([])
    with pytest.raises(InputError, match="'t0' is observed 2 times from LiDAR pose 's0': fuse"):
        build([observations[0], *observations])
    with pytest.raises(InputError, match="LiDAR 's0': not a rigid"):
        build(observations, known_lidars={"s0": 2.0 * np.eye(4)})
    with pytest.raises(InputError, match="nothing to solve"):
        build(observations, known_lidars=lidars, known_targets=targets).solve()
    graph = build(observations)
    others = gtsam.NonlinearFactorGraph()
    others.push_back(gtsam.PriorFactorPose3(B(7), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6)))
    with pytest.raises(InputError, match="no initial value for variable b7"):
        graph.solve(others)
    hard = gtsam.NonlinearFactorGraph()
    key = graph.target_keys["t0"]
    hard.push_back(gtsam.PriorFactorPose3(key, gtsam.Pose3(), gtsam.noiseModel.Constrained.All(6)))
    with pytest.raises(InputError, match="hard constraint on l0"):
        graph.solve(hard)
    solution = graph.solve()
    with pytest.raises(InputError, match="'s9' is not in the graph; it holds s0, s1"):
        solution.covariance(["s9"])
    with pytest.raises(InputError, match="variable b7 is not in the graph"):
        solution.covariance(keys=[B(7)])


def test_observation_of_an_estimate():
    class Estimated:
        target = SQUARE
        status = "ambiguous"
        measurement = measure(np.random.default_rng(0), np.eye(4), target=SQUARE)

    class Failed(Estimated):
        status = "failed"

    observation = Observation.of("s0", Estimated())
    assert (observation.target, len(observation.template.symmetries)) == ("square", 4)
    assert Observation.of("s0", Estimated(), "door").target == "door"
    assert len(observation.equivalent_poses()) == 4
    with pytest.raises(InputError, match="'square' is failed"):
        Observation.of("s0", Failed())
