"""Residuals and derivatives of what the engine lacks: points, motion, motions of two sensors."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, V

from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.projection import project
from optshape_graph.calibration.rig.hand_eye import hand_eye
from optshape_graph.calibration.rig.points import Corners, Marked
from optshape_graph.calibration.rig.tracks import Smooth, Timed
from optshape_graph.evaluation.rigs import SimulatedRig, pattern, two_targets
from optshape_graph.graph import State
from optshape_graph.se3 import apply, exp, inverse
from tests.calibration.camera.support import BOARD, PINHOLE


def corners(free: bool) -> Corners:
    target = two_targets()["A"]
    points = pattern(target)
    T = SimulatedRig.drawn(np.random.default_rng(0)).T_base_sensor["left"]
    T_camera_target = inverse(T) @ exp([0.1, 0.2, 0.5, 3.2, 1.6, 0.2])
    pixels = project(PINHOLE, apply(T_camera_target, points))
    image = ImagePoints.of_pattern(points, pixels, 0.2)
    # Numbers of all points that images show, of which this one lacks the first.
    return Corners(image, PINHOLE, np.arange(len(points), 0, -1) if free else None), T_camera_target


def marked() -> tuple[Marked, np.ndarray]:
    T = exp([0.1, 0.2, 0.3, 2, 0.3, 0.4])
    body = 1e-6 * np.diag([1, 2, 3, 1, 1, 2.0])
    return Marked.of(apply(T, BOARD.vertices[1:]), BOARD.vertices[1:], np.arange(1, 4), 1e-3, body), T


def cases():
    for free in (False, True):
        seen, T = corners(free)
        yield f"corners {free}", seen, T, np.full(2 + (3 * (len(seen.points) + 1) + 8) * free, 0.001)
    seen, T = marked()
    yield "markers", seen, T, np.full(12, 0.004)
    seen, T = corners(False)
    yield "timed", Timed(seen, np.array([0.3, -0.2, 0.1, 0.5, 0.2, -0.6])), T, np.array([1e-3, -1e-3, 0.2])


@pytest.mark.parametrize(
    ("name", "seen", "T", "beta"), list(cases()), ids=lambda value: value if isinstance(value, str) else ""
)
def test_derivatives_of_points(name, seen, T, beta):
    T = T @ exp([0.01, 0, 0.01, 0.02, 0, 0.01])
    _, by_pose, by_beta = seen.whitened(T, beta)
    h = 1e-6

    def at(x, b):
        return seen.whitened(T @ exp(x), beta + b)[0]

    numeric = np.column_stack([(at(h * e, 0.0) - at(-h * e, 0.0)) / (2 * h) for e in np.eye(6)])
    assert np.allclose(numeric, by_pose, rtol=1e-5, atol=1e-5 * np.abs(by_pose).max())
    zero = np.zeros(6)
    numeric = np.column_stack([(at(zero, h * e) - at(zero, -h * e)) / (2 * h) for e in np.eye(len(beta))])
    assert np.allclose(numeric, by_beta, rtol=1e-4, atol=1e-5 * np.abs(by_beta).max())


def test_a_body_s_own_error_widens_what_its_markers_say():
    seen, T = marked()
    exact = Marked.of(seen.points, seen.near, seen.vertices, 1e-3, np.zeros((6, 6)))
    strong, weak = (np.linalg.eigvalsh(J.T @ J) for J in (one.whitened(T, np.zeros(12))[1] for one in (exact, seen)))
    assert (weak < strong).all()


def test_derivatives_of_motion():
    """To second order in what the twist changes by: a thousandth here."""
    rng = np.random.default_rng(0)
    T, twist = exp(rng.normal(size=6)), 0.5 * rng.normal(size=6)
    values = gtsam.Values()
    values.insert(L(0), gtsam.Pose3(T))
    values.insert(L(1), gtsam.Pose3(T @ exp(0.1 * twist + 0.01 * rng.normal(size=6))))
    values.insert(V(0), twist)
    values.insert(V(1), twist + 0.1 * rng.normal(size=6))
    term = Smooth.of([(L(0), L(1))], [(V(0), V(1))], np.array([0.1]), np.array([0.7, 0.3]))
    model = term.at(State.of(values))
    assert model.error == pytest.approx(0.5 * float((model.e**2).sum()))
    for key, block in zip(model.keys(0), model.blocks, strict=True):
        numeric = np.zeros((12, 6))
        for k in range(6):
            ends = []
            for sign in (1, -1):
                step = gtsam.VectorValues()
                for other in model.keys(0):
                    step.insert(other, sign * 1e-6 * np.eye(6)[k] if other == key else np.zeros(6))
                ends.append(term.at(State.of(values.retract(step))).e[0])
            numeric[:, k] = (ends[0] - ends[1]) / 2e-6
        assert np.abs(numeric - block[0]).max() < 2e-3 * np.abs(numeric).max()


def test_a_constant_twist_is_no_error():
    twist = np.array([0.2, -0.1, 0.4, 0.5, 0.3, -0.2])
    values = gtsam.Values()
    for k in (0, 1):
        values.insert(L(k), gtsam.Pose3(exp(k * 0.2 * twist)))
        values.insert(V(k), twist)
    term = Smooth.of([(L(0), L(1))], [(V(0), V(1))], np.array([0.2]), np.ones(2))
    assert term.at(State.of(values)).error < 1e-20


@pytest.mark.parametrize("seed", range(5))
def test_hand_eye_finds_where_two_sensors_are(seed):
    rng = np.random.default_rng(seed)
    X = exp(rng.normal(size=6))
    B = [exp(rng.normal(size=6) * [0.4, 0.4, 0.4, 1, 1, 1]) for _ in range(6)]
    pairs = [(X @ one @ inverse(X), one) for one in B]
    pairs[0] = (pairs[0][0] @ exp([0.5, 0, 0, 1, 0, 0]), pairs[0][1])  # one is wrong
    found = hand_eye(pairs)
    assert found is not None
    assert np.allclose(found.T_a_b, X, atol=1e-6)
    assert (found.agree, found.of) == (5, 6)


def test_turns_about_one_axis_do_not_tell():
    B = [exp([0, 0, turn, 1, 0, 0]) for turn in (0.3, 0.5, -0.4)]
    assert hand_eye([(one, one) for one in B]) is None
    assert hand_eye([]) is None
