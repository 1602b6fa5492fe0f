"""The fit in a result: nothing to say of clean scans, and of broken ones what is broken."""

import json
from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import EstimationError, InputError, Scan
from optshape_graph.factors import SummaryFactor, fuse_static
from optshape_graph.graph import Observation
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.pose.fit import CUT_SHORT, cut_short
from tests.pose.clouds import recorded_cases
from tests.shared import needs_shared
from tests.statistics.violations import KINDS as ALL
from tests.statistics.violations import World, bent, by_simulator

WORLD = World(load_target("paper@0.7"), load_sensor("vlp32c"), (3.0, 8.0), by_simulator)

KINDS = {**ALL, "bent 8 cm": lambda trial, rng: bent(trial, rng, 0.08)}


def trial(kind: str = "", seed: int = 11):
    rng = np.random.default_rng(seed)
    drawn = WORLD.draw(rng)
    return KINDS[kind](drawn, rng) if kind else drawn


def estimate(kind: str = "", seed: int = 11):
    one = trial(kind, seed)
    return estimate_pose(one.scan, one.target)


def test_a_clean_scan_fits() -> None:
    found = estimate()
    fit = found.fit
    assert (found.status, fit.flags, fit.warnings) == ("ok", (), ())
    assert fit.plane_chi_square / fit.plane_freedom == pytest.approx(1.0, abs=0.3)
    assert fit.edge_chi_square / fit.edge_freedom < 1.7
    assert fit.expected_returns == pytest.approx(found.n_returns, rel=0.15)
    assert fit.ring_tilt is not None
    assert fit.ring_tilt < 1e-6
    assert (fit.duplicates, fit.missing_rings) == (0, 0)


@pytest.mark.parametrize(
    ("kind", "flag", "word"),
    [
        ("mixed pixels 1", "mixed ends", "off their ring"),
        ("hand 8 cm in front", "in front", "a hand or a bracket"),
        ("frame raised 3 cm", "raised frame", "a raised frame"),
        ("two scans 10 cm apart", "two sheets", "revolutions merged"),
        ("bent 8 cm", "surface", "isn't flat"),
        ("another frame", "frame", "sensor's own frame"),
        ("mirrored, no rings", "mirrored", "back to front"),
    ],
)
def test_what_is_broken_is_named(kind: str, flag: str, word: str) -> None:
    """Of ten scans, most poses that aren't failed are doubtful, for that reason first."""
    named, judged = 0, 0
    for seed in range(10):
        one = trial(kind, seed)
        try:
            found = estimate_pose(one.scan, one.target)
        except EstimationError:
            continue
        judged += found.status != "failed"
        if found.status == "doubtful":
            first = found.fit.flags[0]
            named += first.kind == flag and word in first.reason
            assert first.excess == max(one.excess for one in found.fit.flags) > 1
    assert named > judged / 2


def test_noise_and_bias_widen() -> None:
    """The distance, apart from what the target's brightness leaves open, is known half as well and worse."""
    brightness = (WORLD.sensor.brightness_bias * np.cos(np.radians(35.0))) ** 2  # at an incidence of up to so much
    clean, noisy, biased = estimate(), estimate("noise x 5"), estimate("ring bias x 5", 13)
    assert noisy.fit.noise_factor == pytest.approx(5.0, rel=0.2)
    assert biased.fit.bias_factor > 2.5
    for worse in (noisy, biased):
        assert worse.covariance[3, 3] - brightness > 2 * (clean.covariance[3, 3] - brightness)
        assert worse.fit.warnings


def test_a_surface_does_not_average_away() -> None:
    """Ten scans of a bent board are as sure of its distance as its shape allows, whatever their noise."""
    rng = np.random.default_rng(5)
    first = WORLD.draw(rng)
    scans = []
    for _ in range(10):
        again = replace(first, scan=WORLD.cast(first.target, WORLD.sensor, first.T, rng))
        scans.append(KINDS["bent 2 cm"](again, np.random.default_rng(1)).scan)
    found = [estimate_pose(scan, first.target) for scan in scans]
    seen = [one for one in found if one.fit.surface.size > 0]
    assert len(seen) >= 8
    fused = fuse_static([one.shared for one in seen if one.shared is not None], 1.0)
    T = seen[0].T_target_lidar
    information = fused.information(T)
    spread = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(information)).max())
    assert spread > min(one.fit.surface.size for one in seen)


def test_duplicates_are_dropped_and_counted() -> None:
    once, twice = estimate(), estimate("duplicates")
    assert twice.fit.duplicates == once.n_returns == twice.n_returns
    np.testing.assert_allclose(twice.T_lidar_target, once.T_lidar_target, atol=1e-9)
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-6)


def test_a_stray_turns_nothing() -> None:
    """One return beside the target, in each of twenty scans: within four standard deviations of the pose without."""
    for seed in range(20):
        drawn = trial(seed=seed)
        strayed = KINDS["1 stray"](drawn, np.random.default_rng(seed))
        before, after = (estimate_pose(one.scan, one.target) for one in (drawn, strayed))
        moved = np.linalg.inv(before.T_lidar_target) @ after.T_lidar_target
        turn = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1, 1))
        assert turn < 4 * before.sigma_rad, seed
        assert np.linalg.norm(moved[:3, 3]) < 4 * after.sigma_m, seed


def test_a_doubtful_pose_makes_no_factor() -> None:
    found = estimate("ends 30 cm behind")
    assert found.status == "doubtful"
    assert not found.usable
    with pytest.raises(InputError, match="doubtful"):
        SummaryFactor(found, 0, 1)
    with pytest.raises(InputError, match="doubtful"):
        Observation.of("scan", found)


def test_it_is_plain_data() -> None:
    found = estimate("mixed pixels 1")
    written = json.loads(json.dumps(found.to_dict()))["fit"]
    assert written["summary"] == found.fit.flags[0].kind
    assert written["flags"][0]["reason"] == found.fit.flags[0].reason


@needs_shared
def test_recordings_are_not_flagged() -> None:
    for scan, target in recorded_cases():
        found = estimate_pose(scan, target)
        assert (found.status, found.fit.flags) == ("ok", ()), scan.name


def test_too_few_returns_to_judge() -> None:
    one = trial()
    ring = one.scan.ring
    assert ring is not None
    few = one.scan.select(np.flatnonzero(np.isin(ring, np.unique(ring)[:2])))
    found = estimate_pose(Scan(few.points, few.ring, sensor=few.sensor), one.target)
    assert found.status != "ok"


def test_a_view_that_is_cut_ends_short_in_one_column() -> None:
    """Two ends of the outermost column, 3 and 4 standard deviations short: 5; one alone is an odd end: 0."""
    azimuth = np.array([0.0, 1.0, 3.0, 3.1, 3.0])
    assert cut_short(azimuth, np.array([0.5, -4.0, -3.0, -4.0, 1.0]), 1.0) == pytest.approx(5.0)
    assert cut_short(azimuth, np.array([0.5, -4.0, -3.0, 0.0, 1.0]), 1.0) == 0.0


def test_an_edge_along_a_column_of_firings_is_no_cut() -> None:
    """Many rings end in that column, and a few of them lie short of the edge by chance; a cut takes most of them."""
    azimuth, step = np.full(12, 0.1), 0.003
    by_chance = np.array([-2.2, -2.1, *np.linspace(-1.2, 1.5, 10)])
    assert cut_short(azimuth, by_chance, step) == 0.0
    assert cut_short(azimuth[:3], np.array([-2.2, -2.3, -0.5]), step) > CUT_SHORT
    assert cut_short(azimuth[:3], np.array([-2.9, 0.2, -0.5]), step) == 0.0
