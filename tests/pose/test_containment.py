"""Poses in the plane that contain the returns."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import Target
from optshape_graph.io import load_target
from optshape_graph.pose.containment import Beam, containing_poses

FINE = Beam(1e-3, 1e-3)


def inside(target: Target, count: int, seed: int) -> np.ndarray:
    """Points drawn evenly from a target's inside (count, 2), metres."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-target.circumradius, target.circumradius, (20 * count, 2))
    return drawn[target.contains(drawn)][:count]


@settings(max_examples=20, deadline=None)
@given(angle=st.floats(-3.1, 3.1), seed=st.integers(0, 1000), name=st.sampled_from(["paper", "optimal5", "triangle"]))
def test_the_true_pose_is_within_what_is_said_of_it(angle: float, seed: int, name: str) -> None:
    """A chi-square of 3 degrees of freedom exceeds 27 once in 200,000."""
    target = load_target(name)
    c, s = np.cos(angle), np.sin(angle)
    y = inside(target, 600, seed)
    q = (y - [0.03, -0.05]) @ np.array([[c, -s], [s, c]])  # y = C q + t
    best = containing_poses(q, FINE, target)[0]
    turns = angle - np.array(target.symmetries)
    off = [np.angle(np.exp(1j * (best.mean[0] - turn))) for turn in turns]
    k = int(np.abs(off).argmin())
    c, s = np.cos(-target.symmetries[k]), np.sin(-target.symmetries[k])
    error = np.array([off[k], *(best.mean[1:] - np.array([[c, -s], [s, c]]) @ [0.03, -0.05])])
    assert error @ np.linalg.solve(best.covariance, error) < 27


def test_more_returns_say_more() -> None:
    target = load_target("paper")
    few, many = (containing_poses(inside(target, n, 0), FINE, target)[0] for n in (100, 1600))
    assert np.trace(many.covariance) < 0.3 * np.trace(few.covariance)


def test_sets_of_poses_are_separate_and_ordered() -> None:
    """A rectangle that is nearly a square: a quarter of a turn is possible, half a turn is a symmetry."""
    target = Target.from_polygon([[0, 0], [1, 0], [1, 1.04], [0, 1.04]])
    found = containing_poses(inside(target, 60, 4), FINE, target)
    assert len(found) == 2
    assert abs(abs(found[1].mean[0] - found[0].mean[0]) - np.pi / 2) < 0.2
    assert np.all(np.diff([one.log_mass for one in found]) <= 0)


def test_symmetric_poses_are_listed_once() -> None:
    target = load_target("square")
    found = containing_poses(inside(target, 800, 1), FINE, target)
    assert len(found) == 1
    assert abs(found[0].mean[0]) < np.pi / 4


def test_nothing_contains_what_is_too_large() -> None:
    target = load_target("square@1")
    assert containing_poses(1.2 * inside(target, 800, 1), FINE, target) == []


def test_a_disc_like_target_may_be_turned_anyhow() -> None:
    target = load_target("circle")
    best = containing_poses(0.9 * inside(target, 50, 1), FINE, target)[0]
    assert best.covariance[0, 0] == pytest.approx((2 * np.pi / len(target.symmetries)) ** 2 / 12, rel=0.3)
