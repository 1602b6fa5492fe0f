"""Modes: none is missed, their masses decide, and a pose that is called ok is not another."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import Scan, Target
from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation
from optshape_graph.factors.measurement import refine
from optshape_graph.factors.static import AZIMUTH, ELEVATION, BiasedMeasurement, SharedError
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import PoseOptions, estimate_pose, modes
from optshape_graph.pose.ends import work_out
from optshape_graph.pose.evidence import Evidence, ends_of, measure
from optshape_graph.pose.modes import compare_modes, find_candidates
from optshape_graph.pose.sampling.sampled import sampled_measurement
from optshape_graph.se3 import difference, inverse, rotation_vector
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target
from tests.pose.clouds import errors

LEGAL = {
    "a": ("paper", 1.0, "vlp16", 13.5, (-31, -25, -10), 140),
    "b": ("paper", 0.5, "vlp16", 11.9, (-22, 34, -28), 147),
    "c": ("paper", 1.0, "os1-64", 23.3, (-19, 7, -34), 56),
    "d": ("built", None, "vlp32c", 29.2, (35, -34, -3), 31),
}
"""Legal scans that were flipped, ok and certified: target, area, sensor, range, roll-pitch-yaw, seed."""


@pytest.mark.parametrize("name", LEGAL)
def test_flipped_once(name: str) -> None:
    """Not ok, or right: within 25 deg."""
    shape, area, sensor_name, distance, rpy, seed = LEGAL[name]
    target, sensor = load_target(shape), load_sensor(sensor_name)
    target = target.scaled_to_area(area) if area else target
    T = pose_from_rpy([distance, 0.0, 0.0], np.radians(rpy))
    scan = simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=seed)
    estimate = estimate_pose(scan, target)
    print(name, estimate.status, errors(estimate, T), estimate.ambiguity.margin)
    assert estimate.status != "ok" or errors(estimate, T)[1] < 25


@pytest.mark.slow
def test_a_flip_is_never_ok(tmp_path) -> None:
    """At noise level 3 (0.3 deg), 24 and 36 m, 4 to 9 rings: no flip is ok; most scans are, and are right."""
    sweep = SimulationSweep(load_target("paper"), None, ("global",), (24.0, 36.0), noise=("3",), draws=10, seed=3)
    rows = run_simulation(sweep, tmp_path)
    e_r = np.array([row["e_r_deg"] for row in rows], dtype=float)
    ok = np.array([row["status"] == "ok" for row in rows])
    assert not (ok & (e_r > 90)).any()
    assert ok.mean() >= 0.6
    assert np.mean(e_r > 90) < 0.15


def far_scan(seed: int) -> tuple[Scan, Target]:
    """Three or four rings of a VLP-16 on a square metre."""
    target, sensor = load_target("paper"), load_sensor("vlp16")
    rng = np.random.default_rng(seed)
    T = pose_from_rpy([9.0, *rng.uniform(-0.2, 0.2, 2)], rng.normal(0.0, 0.3, 3))
    return simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=rng), target


@pytest.mark.parametrize("seed", range(4))
def test_what_was_sampled_is_what_the_measurement_says(seed: int) -> None:
    """Its minimum, within 0.05 standard deviations, and its covariance; and half a turn costs over 50.

    Samples may scatter more than the returns of the plane allow, by chance: one scan in six by more than 10 %, in one
    direction. (Rings'
    errors move plane and edges together, which samples don't know: here they move each for itself.)
    """
    scan, target = far_scan(seed)
    (evidence,) = measure([scan], [target], PoseOptions())
    sampled = compare_modes(find_candidates([evidence])[0], evidence).sampled
    assert sampled is not None
    problem = evidence.problem
    offset_sd = problem.beam.offset_of_rays(np.linalg.norm(problem.edges.points, axis=1))
    on_plane = evidence.on_plane.without([e for e in evidence.on_plane.shared if e.kind in (ELEVATION, AZIMUTH)])
    shared, _ = sampled_measurement(sampled, on_plane, offset_sd)
    measurement = shared.of_one_scan().at(sampled.T_target_lidar)
    covariance = sampled.covariance[:6, :6]
    T = refine(measurement)
    xi = difference(sampled.T_target_lidar, T)
    assert xi @ np.linalg.solve(covariance, xi) < 0.05**2
    whitened = np.linalg.solve(covariance, np.linalg.inv(measurement.at(T).information()))
    *others, largest = np.sort(np.abs(np.linalg.eigvals(whitened).real - 1.0))
    assert max(others) < 0.05
    assert largest < 0.2
    turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ T
    assert measurement.error(turned) > measurement.error(T) + 50


@pytest.mark.parametrize("seed", range(4))
def test_what_was_sampled_says_what_scans_share(seed: int) -> None:
    """Angles of rings turn the target in its plane; a hundred scans like this one are no surer than they allow."""
    scan, target = far_scan(seed)
    shared = estimate_pose(scan, target).shared
    rings = np.unique(scan.ring)
    assert {SharedError(kind, ring=int(ring)) for kind in (ELEVATION, AZIMUTH) for ring in rings} <= set(shared.shared)

    def turn_variance(measurement: BiasedMeasurement) -> float:
        exact = measurement.of_one_scan()
        return float(np.linalg.inv(exact.at(refine(exact.at(shared.T_target_lidar))).information())[0, 0])

    many = replace(shared, stack=10.0 * shared.stack)
    angles_exact = many.rescaled(ELEVATION, 1e-6).rescaled(AZIMUTH, 1e-6)
    assert 1.5 * turn_variance(angles_exact) < turn_variance(many) < turn_variance(shared)


@pytest.mark.parametrize("name", ["paper", "square", "triangle"])
def test_lookalikes_bring_the_shape_nearest_to_itself(name: str) -> None:
    """Half a turn is among them; of symmetric shapes all are the pose itself, its z axis up."""
    target = load_target(name)
    T = inverse(pose_from_rpy([9.0, 0.5, 0.2], [0.1, 0.2, -0.1]))[None]
    turned = modes._upright(target.lookalike_transforms @ T, target)
    angles = np.degrees(rotation_vector(turned[:, :3, :3] @ T[0, :3, :3].T)[:, 0])
    np.testing.assert_allclose(rotation_vector(turned[:, :3, :3] @ T[0, :3, :3].T)[:, 1:], 0.0, atol=1e-9)
    if name == "paper":
        assert np.isclose(np.abs(angles), 180.0).any()
        assert len(turned) == len(target)
    if name == "square":
        np.testing.assert_allclose(angles, 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", [15, 17, 41])
def test_no_association_that_the_best_pose_has_is_likelier(seed: int) -> None:
    """Ring ends about vertices are given to the edges on which they end at the pose, as far as half a unit goes."""
    rng = np.random.default_rng([5, seed])
    sensor, target = load_sensor("vlp32c"), load_target("paper")
    T = pose_from_rpy([rng.uniform(3, 6), 0, 0], [rng.uniform(-np.pi, np.pi), *rng.uniform(-0.5, 0.5, 2)])
    scan = simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=rng)
    (evidence,) = measure([scan], [target], PoseOptions())
    assert isinstance(evidence, Evidence)
    found = find_candidates([evidence])[0]
    _, own = work_out(ends_of([evidence]), np.zeros(1, int), found.T_target_lidar[:1], None, sweeps=4)
    assert own.log_likelihood[0] < found.log_likelihood[0] + 0.5
