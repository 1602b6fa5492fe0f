"""The biases that a LiDAR's rings keep: marginalised once over all scans, not once in each."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.evaluation.trajectories import pose_nees
from optshape_graph.factors import SharedError, fuse_static, inverse_covariance
from optshape_graph.factors.static import RANGE_BIAS, SURFACE
from optshape_graph.graph.shared import gain
from optshape_graph.mapping import MappingProblem, Match, Odometry, Sighting, Start, Track, solve_batch
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import inverse
from optshape_graph.simulation import NoiseModel, simulate_target
from tests.factors.support import log, random_pose
from tests.mapping.driving import PAPER, SENSOR
from tests.mapping.support import at

NOISE = NoiseModel.of(SENSOR)
FIXED = 1e-12 * np.eye(6)


def estimates(T, n, seed, moved=0.0):
    """Return poses of a LiDAR, about the origin, and its estimates of a target at T in a scan from each."""
    rng = np.random.default_rng(seed)
    kept = {
        "range_bias": NOISE.draw_range_bias(SENSOR.n_rings, rng),
        "angle_errors": NOISE.draw_angle_errors(SENSOR.n_rings, rng),
    }
    poses = [at(*(moved * rng.normal(size=2)), 0.2 * moved * rng.normal(), moved * rng.normal()) for _ in range(n)]
    scans = (simulate_target(PAPER, SENSOR, inverse(P) @ T, noise=NOISE, rng=rng, **kept) for P in poses)
    return np.array(poses), [estimate_pose(scan, PAPER) for scan in scans]


def known(poses, found):
    """Return the problem of a LiDAR whose poses are known exactly."""
    matches = tuple(Match(k, "a", Sighting.of(e, "a"), 0) for k, e in enumerate(found))
    steps = inverse(poses[:-1]) @ poses[1:]
    odometry = tuple(Odometry(k, k + 1, step, FIXED) for k, step in enumerate(steps))
    track = Track("one", np.arange(float(len(found))), poses, odometry, matches, Start(poses[0], FIXED))
    return MappingProblem((track,), {"a": PAPER}, {"a": poses[0] @ found[0].T_lidar_target})


def test_one_scan_says_the_same_whether_its_biases_are_marginalised_before_or_after():
    poses, found = estimates(at(7.0, 1.0, 0.3, 0.2), 1, 0)
    sighting = Sighting.of(found[0], "a")
    before = replace(sighting, measurements=(sighting.biased.marginal(1.0),), biased=None)
    plain, after = (
        solve_batch(replace_sightings(known(poses, found), [one]), robust=False) for one in (before, sighting)
    )
    apart = log(inverse(plain.landmarks["a"]) @ after.landmarks["a"])
    assert apart @ np.linalg.solve(plain.covariance(["a"]), apart) < 1e-6
    np.testing.assert_allclose(np.diag(after.covariance(["a"])), np.diag(plain.covariance(["a"])), rtol=1e-3)


def replace_sightings(problem, sightings):
    [track] = problem.tracks
    matches = tuple(Match(m.pose, m.landmark, s, 0) for m, s in zip(track.matches, sightings, strict=True))
    return replace(problem, tracks=(replace(track, matches=matches),))


def test_many_scans_at_rest_are_those_of_fuse_static():
    poses, found = estimates(at(7.0, 1.0, 0.3, 0.2), 10, 3)
    solution = solve_batch(known(poses, found), robust=False)
    kept = [Sighting.of(e).biased for e in found]
    shared = [m.without([error for error in m.shared if error.kind != RANGE_BIAS]) for m in kept]
    fused = fuse_static(shared, 1.0)
    H = inverse(solution.landmarks["a"])
    J = fused.jacobian(H)
    np.testing.assert_allclose(J.T @ fused.residual(H), 0.0, atol=1e-3 * np.linalg.norm(J))
    expected = inverse_covariance(H, np.linalg.inv(J.T @ J))
    found = solution.solution.covariance([solution.keys.landmarks["a"]])
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    # What else the LiDAR keeps makes it no better known.
    assert (np.linalg.eigvalsh(solution.covariance(["a"]) - found) > -1e-9).all()


def test_a_landmark_seen_often_is_no_better_known_than_the_biases_allow():
    """From poses a hand apart: from one and the same, rings would meet the edges in the same places each time."""
    nees = {False: [], True: []}
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        azimuth = rng.uniform(-np.pi, np.pi)
        T = at(6.0 * np.cos(azimuth), 6.0 * np.sin(azimuth), azimuth + rng.normal(0.0, 0.3), 0.2)
        problem = known(*estimates(T, 12, seed, moved=0.1))
        for wanted, values in nees.items():
            solution = solve_batch(problem, ring_biases=wanted)
            values.append(float(pose_nees(solution.landmarks["a"][None], T[None], solution.covariance(["a"])[None])[0]))
    assert np.mean(nees[False]) / 6 > 2.5
    assert 0.55 < np.mean(nees[True]) / 6 < 1.6  # of chi-square with 72 degrees, 99.9 % are between


def test_sightings_are_moved_and_renamed_with_their_biases():
    rng = np.random.default_rng(0)
    _, [found] = estimates(at(7.0, 1.0, 0.3, 0.2), 1, 4)
    sighting = Sighting.of(found)
    T = random_pose(rng)
    moved, H = sighting.moved(T), random_pose(rng)
    assert moved.biased.marginal(1.0).error(H) == pytest.approx(sighting.biased.marginal(1.0).error(H @ T), rel=1e-9)
    assert Sighting.of(found, biases=False).biased is None


def test_what_a_sighting_says_is_what_is_left_when_its_biases_are_marginalised():
    """Also where the scan shows larger biases than the file: else a map's covariance may come out negative."""
    _, [found] = estimates(at(7.0, 1.0, 0.3, 0.2), 1, 4)
    wider = replace(found, fit=replace(found.fit, bias_factor=2.0))
    sighting, H = Sighting.of(wider), found.T_target_lidar
    J = sighting.measurements[0].jacobian(H)
    errors = gain(sighting.biased, H, sighting.biased.shared)
    assert np.linalg.eigvalsh(J.T @ J - errors @ errors.T).min() > -1e-6 * np.linalg.norm(J) ** 2
    np.testing.assert_allclose(
        J.T @ J, sighting.biased.marginal(1.0).information(H), rtol=1e-6, atol=1e-6 * (J**2).sum()
    )


@pytest.mark.parametrize("bends", [False, True])
def test_a_board_that_is_not_flat_does_not_average_away(bends):
    """Its error is the landmark's, in all sightings of it: twelve know its turn no better than the board lets them."""
    poses, found = estimates(at(6.0, 1.0, 0.3, 0.2), 12, 3, moved=0.5)
    error, tilt = SharedError(SURFACE[0]), 0.02
    effect = np.eye(6)[:, [1]] * tilt
    bent = [
        replace(one, shared=one.shared.displaced([error], effect, one.T_target_lidar)) if bends else one
        for one in found
    ]
    problem = known(poses, bent)
    solution = solve_batch(problem, robust=False)
    sd = np.sqrt(np.diag(solution.covariance(["a"])))[1]
    assert sd > 0.95 * tilt if bends else sd < 0.5 * tilt
