"""The likelihood of every ray, against loops that say the same one ray at a time."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from optshape_graph import Scan, Target
from optshape_graph.edges import extract_edge_points
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.pose.sampling import rays as module
from optshape_graph.pose.sampling.rays import STRAY, Rays
from optshape_graph.se3 import difference
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target

PAPER = load_target("paper")
VLP16 = load_sensor("vlp16")
ODD, LOST_RING = 0.02, 0.1


def scan_at(distance: float, seed: int, target: Target = PAPER) -> tuple[Scan, np.ndarray]:
    """A scan of real beams, and the true pose."""
    rng = np.random.default_rng(seed)
    T = pose_from_rpy([distance, *rng.uniform(-0.2, 0.2, 2)], rng.normal(0.0, 0.3, 3))
    return simulate_target(target, VLP16, T, noise=NoiseModel.of(VLP16), rng=rng), T


def rays_of(scan: Scan) -> Rays:
    ends = extract_edge_points(scan)
    ranges = np.linalg.norm(ends.points[::2], axis=1)
    beam = (VLP16.beam_aperture + VLP16.beam_divergence * ranges) / ranges
    return replace(Rays.of(scan, ends, beam, np.zeros(len(beam)), 2 * PAPER.circumradius, ODD), lost_ring=LOST_RING)


def corners_at(T: np.ndarray) -> np.ndarray:
    return np.asarray(PAPER.vertices @ T[:3, :3].T + T[:3, 3])


def outside(ray: np.ndarray, corners: np.ndarray) -> float:
    """Angle of a ray beyond the outline, rad, negative inside: of each edge, from the sensor's plane through it."""
    worst = -np.inf
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        m = np.cross(b, a)
        m *= -np.sign(m @ corners.mean(axis=0)) / np.linalg.norm(m)
        worst = max(worst, float(np.arcsin(m @ ray)))
    return worst


def returns(ray: np.ndarray, corners: np.ndarray, width: float, offset: float, lost: float) -> float:
    clear = min(max(0.5 - offset - outside(ray, corners) / width, 0.0), 1.0)
    return STRAY + (1 - STRAY - lost) * clear


@pytest.mark.parametrize("seed", range(4))
def test_against_a_loop(seed: int) -> None:
    """Rings with returns, at the truth and off it, by 2e-3 (an angle against its sine); those without left out."""
    scan, T = scan_at(9.0, seed)
    rays = replace(rays_of(scan), empty=np.zeros(0))
    assert scan.ring is not None
    step = rays.step
    for moved in (0.0, 0.03):
        off = T.copy()
        off[1, 3] += moved
        corners, offset, total = corners_at(off), 0.1, 0.0
        for number, ring in enumerate(np.unique(scan.ring)):
            points = scan.points[scan.ring == ring]
            azimuth = np.sort(np.arctan2(points[:, 1], points[:, 0]))
            elevation = VLP16.elevations[ring]
            width = rays.width[rays.last[2 * number]]
            slots = np.rint((azimuth - azimuth[0]) / step).astype(int)
            P = {}
            for k in range(-4, slots[-1] + 5):
                a = azimuth[0] + k * step
                ray = np.array([np.cos(elevation) * np.cos(a), np.cos(elevation) * np.sin(a), np.sin(elevation)])
                P[k] = returns(ray, corners, width, offset, rays.lost)
            near = [k for k in range(slots[-1] + 1) if k < 4 or k > slots[-1] - 4]
            total += sum(np.log(P[k] if k in slots else 1 - P[k]) for k in near)
            for last, beyond in ((0, [-1, -2, -3, -4]), (slots[-1], [slots[-1] + j for j in (1, 2, 3, 4)])):
                none = np.prod([1 - P[k] for k in beyond])
                odd = none * (1 - P[last]) / P[last] + module.ANYWHERE
                for j in (1, 2, 3):
                    odd += np.prod([P[k] for k in beyond[:j]]) * np.prod([1 - P[k] for k in beyond[j:]])
                total += np.log((1 - rays.odd_ends) * none + rays.odd_ends * odd / 4)
        ours = rays.log_likelihood(corners[None], np.array([offset]))[0]
        assert ours == pytest.approx(total, abs=2e-3 * abs(total) + 2e-2)


@pytest.mark.parametrize("seed", range(4))
def test_rings_without_returns_against_many_phases(seed: int) -> None:
    """The probability that nothing returns: a loop over 200 phases of the firings; 4 phases are as good to 0.08."""
    scan, T = scan_at(20.0, seed)
    rays = rays_of(scan)
    normals = module.sight_planes(corners_at(T)[None])
    ours = rays._unseen(normals, np.zeros(1))[0]
    width = float(np.median(rays.width))
    for elevation, unseen in zip(rays.empty, ours, strict=True):
        exact = []
        for phase in (np.arange(200) + 0.5) / 200:
            a = rays.reference_azimuth + (np.arange(-40, 41) + phase) * rays.step
            flat = np.cos(elevation)
            d = np.column_stack([flat * np.cos(a), flat * np.sin(a), np.full(81, np.sin(elevation))])
            clear = np.clip(0.5 - (d @ normals[0].T).max(axis=1) / width, 0.0, 1.0)
            exact.append(np.prod(1 - STRAY - (1 - STRAY - rays.lost) * clear))
        assert unseen == pytest.approx(np.mean(exact), abs=0.08)


def test_of_many_poses_at_once() -> None:
    """Each pose is on its own, whatever the others: equal to rounding."""
    scan, T = scan_at(12.0, 0)
    rays, rng = rays_of(scan), np.random.default_rng(0)
    many = corners_at(T) + rng.normal(0.0, 0.05, (20, 1, 3))
    offset = rng.uniform(-0.5, 0.5, 20)
    together = rays.log_likelihood(many, offset)
    alone = [rays.log_likelihood(c[None], o[None])[0] for c, o in zip(many, offset, strict=True)]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_the_truth_is_likelier_than_what_is_off() -> None:
    """Moved by 0.2 m along the rings: over 5 in log likelihood in each of ten scans at 9 m."""
    for seed in range(10):
        scan, T = scan_at(9.0, seed)
        off = T.copy()
        off[1, 3] += 0.2
        true, wrong = rays_of(scan).log_likelihood(np.array([corners_at(T), corners_at(off)]), np.zeros(2))
        assert true > wrong + 5


def test_revolutions_are_told_apart_and_duplicates_dropped() -> None:
    """Two revolutions merged, one of them a third of a step on, a return twice."""
    first, second = np.array([0.0, 1.0, 2.0, 4.0]), np.array([0.33, 1.33, 3.33])
    trains = module._trains(np.concatenate([first, second, [1.0]]) - 0.7, 2)
    assert sorted(len(train) for train in trains) == [3, 4]
    np.testing.assert_allclose(min(trains, key=len), second - 0.7)
    (only,) = module._trains(np.array([0.0, 1.02, 1.02, 2.0]), 1)
    np.testing.assert_allclose(only, [0.0, 1.02, 2.0])


def test_lost_firings_are_learnt_from_the_scan() -> None:
    """One in ten of the returns taken out: the probability of a lost firing, within 0.05; of a whole scan, 0.001."""
    rng = np.random.default_rng(0)
    sensor = load_sensor("vlp32c")
    T = pose_from_rpy([6.0, 0.0, 0.0], [0.1, 0.2, 0.1])
    scan = simulate_target(PAPER, sensor, T, noise=NoiseModel.of(sensor), rng=rng)
    assert rays_of(scan).lost < 1e-3
    assert rays_of(scan.select(rng.uniform(size=len(scan)) > 0.1)).lost == pytest.approx(0.1, abs=0.05)


def at_nine_metres(odd_ends: float, seed: int) -> tuple[Scan, np.ndarray]:
    """Three or four rings of a VLP-16 whose file says how many ring ends are odd, and which has so many."""
    sensor, rng = replace(VLP16, odd_ends=odd_ends), np.random.default_rng(seed)
    T = pose_from_rpy([9.0, *rng.uniform(-0.2, 0.2, 2)], rng.normal(0.0, 0.3, 3))
    return simulate_target(PAPER, sensor, T, noise=NoiseModel.of(sensor), rng=rng), T


@pytest.mark.parametrize("share", [1e-4, 0.3])
def test_the_margin_is_the_smaller_the_more_ends_are_odd(share: float) -> None:
    """Few rings: a half turn differs from the pose by some ring ends, and is the likelier the more of them are odd."""
    margins = []
    for seed in range(6):
        scan, _ = at_nine_metres(0.01, seed)
        told = [replace(scan, sensor=replace(VLP16, odd_ends=s)) for s in (share, 0.01)]
        margins.append([estimate_pose(one, PAPER).ambiguity.margin for one in told])
    ours, usual = np.array(margins).clip(max=50.0).T
    assert (np.mean(ours) > np.mean(usual)) == (share < 0.01)


def test_odd_ends_that_the_file_knows_turn_no_pose() -> None:
    """Three in ten of some seven rings: of 25 poses most are ok, and all of these within the 99.9 % region."""
    sensor, ok = replace(VLP16, odd_ends=0.3), 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        T = pose_from_rpy([4.5, *rng.uniform(-0.2, 0.2, 2)], rng.normal(0.0, 0.3, 3))
        scan = simulate_target(PAPER, sensor, T, noise=NoiseModel.of(sensor), rng=rng)
        estimate = estimate_pose(scan, PAPER)
        if estimate.status == "ok":
            xi = difference(estimate.T_lidar_target, T)
            assert xi @ np.linalg.solve(estimate.covariance, xi) < chi2.ppf(0.999, 6)
            ok += 1
    assert ok >= 20
