"""The likelihood of a scan at a pose, against the process that makes scans."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from optshape_graph import Scan
from optshape_graph.azimuth_grid import level_rings, place_on_firings
from optshape_graph.chords import chords, sight_planes
from optshape_graph.edges import EdgePoints, extract_edge_points
from optshape_graph.io import load_target
from optshape_graph.pose import PoseOptions
from optshape_graph.pose.sampling.firings import Firings
from optshape_graph.ring_returns import RingReturns
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target
from optshape_graph.simulation.reference import reference_sensor

TARGET = load_target("paper")
OPTIONS = PoseOptions()
LOST = OPTIONS.lost_ends_of_rays


def of(scan: Scan, ends: EdgePoints) -> Firings:
    return Firings.of(scan, ends, OPTIONS.flatness, OPTIONS.lost_ends_of_rays, OPTIONS.lost_span)


def firings_of(level: int, distance: float, seed: int) -> tuple[Firings, np.ndarray, Scan]:
    """What a scan says, and the corners of the target at a few poses about its own."""
    rng = np.random.default_rng(seed)
    T = pose_from_rpy([distance, 0.1, 0.02], [0.1, 0.2, 0.0])
    sensor = replace(reference_sensor(), range_noise=0.01)
    scan = simulate_target(TARGET, sensor, T, noise=NoiseModel.level(level).jittered(), rng=rng)
    returns, (noise,) = level_rings(RingReturns.of([scan]))
    (scan,) = returns.sorted_scans()
    ends = place_on_firings(extract_edge_points(scan), returns, noise)
    poses = [T @ pose_from_rpy([0, *rng.normal(0, 0.02, 2)], [rng.normal(0, 0.03), 0, 0]) for _ in range(200)]
    corners = np.array([TARGET.vertices @ M[:3, :3].T + M[:3, 3] for M in poses])
    return of(scan, ends), corners, scan


def brute(firings: Firings, corners: np.ndarray, common: bool, places: int = 960) -> np.ndarray:
    """Each ring's likelihood at every place of the grid; averaged over places ring by ring, or together."""
    place = (np.arange(places) + 0.5) / places
    elevations = np.append(firings.elevations, firings.empty)
    right, left = (
        a[..., None] / firings.step for a in chords(sight_planes(corners), elevations, firings.reference_azimuth)
    )
    n = len(firings.left)
    with np.errstate(invalid="ignore"):
        fired = np.floor(left - place) >= np.ceil(right - place)
    likelihood = np.where(fired, firings.lost_ring, 1.0)
    total = np.zeros((len(corners), n, places))
    for whole in range(-6, 7):
        shift = place + np.floor(firings.left[:, None]) + whole - firings.left[:, None]
        density = norm.pdf(shift, 0.0, firings.shift[:, None])
        for beyond in (
            left[:, :n] - firings.left[:, None] - shift,
            firings.right[:, None] - right[:, :n] + shift,
        ):
            inside, near = (beyond >= 0) & (beyond < 1), (beyond >= -1) & (beyond < 3)
            density = density * ((1 - LOST) * inside + LOST / 4 * near)
        total += density
    likelihood[:, :n] = total + (0.1 * LOST) ** 2
    if common:
        return np.asarray(logsumexp(np.log(likelihood).sum(axis=1), axis=1) - np.log(places))
    return np.asarray(np.log(likelihood.mean(axis=2)).sum(axis=1))


@pytest.mark.parametrize(("level", "distance"), [(1, 30.0), (3, 30.0)])
def test_against_a_loop_over_places_of_the_grid(level: int, distance: float) -> None:
    """Up to a constant: one grid or a grid for each ring, each as likely."""
    firings, corners, _ = firings_of(level, distance, 5)
    ours = firings.log_likelihood(corners)
    exact = np.logaddexp(brute(firings, corners, True), brute(firings, corners, False))
    # 24 places of the grid in a likelihood with corners, 2 to 8 % of each of six rings' own width: exact on average
    # over poses, which is what evidence takes.
    assert np.mean(np.exp(ours - exact)) == pytest.approx(1.0, abs=0.15)
    assert np.median(np.abs(ours - exact)) < 0.25


def test_the_truth_is_likely_and_a_shift_by_two_steps_is_not() -> None:
    firings, _, _ = firings_of(1, 20.0, 2)
    T = pose_from_rpy([20.0, 0.1, 0.02], [0.1, 0.2, 0.0])
    moved = T.copy()
    moved[1, 3] += 2 * firings.step * 20.0
    true, wrong = firings.log_likelihood(np.array([TARGET.vertices @ M[:3, :3].T + M[:3, 3] for M in (T, moved)]))
    assert true > wrong + 20


def test_exact_azimuths_say_where_the_grid_is() -> None:
    """A ring above the target whose chord holds none of the grid's azimuths is no surprise; one that does, is."""
    T = pose_from_rpy([20.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    scan = simulate_target(TARGET, reference_sensor(), T)
    firings = of(scan, extract_edge_points(scan))
    corners = (TARGET.vertices @ T[:3, :3].T + T[:3, 3])[None]
    own = replace(firings, offset=firings.offset + np.arange(len(firings.offset)) * 0.37)
    assert firings.log_likelihood(corners)[0] >= own.log_likelihood(corners)[0]
    assert firings._seen_place() is not None
    assert own._seen_place() is None
