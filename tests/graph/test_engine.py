"""The engine: chains and terms against numerical derivatives, and what they make of unknown extrinsics."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, E, L, X
from hypothesis import given, settings
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.factors import BiasedMeasurement, SharedError
from optshape_graph.graph import Chains, Inverse, JointPoses, SharedErrors, State, Templates, add_rows, solve
from optshape_graph.se3 import difference, exp, inverse
from tests.factors.support import measure, seeds

KEYS = [X(0), X(1), L(0), E(0)]


def drawn(rng, scale=0.5):
    values = gtsam.Values()
    for key in KEYS:
        values.insert(key, gtsam.Pose3(exp(scale * rng.normal(size=6))))
    return values


def moved(values, key, xi):
    result = gtsam.Values(values)
    result.update(key, gtsam.Pose3(values.atPose3(key).matrix() @ exp(xi)))
    return State.of(result)


steps = st.lists(st.sampled_from([*KEYS, *map(Inverse, KEYS), "known"]), max_size=5)


@settings(max_examples=60)
@given(st.lists(steps, min_size=1, max_size=4), seeds)
def test_chains_are_products_and_move_as_their_derivatives_say(parts, seed):
    rng = np.random.default_rng(seed)
    values = drawn(rng)
    state = State.of(values)
    lists = [[exp(rng.normal(size=6)) if part == "known" else part for part in chain] for chain in parts]
    chains = Chains(lists)
    for chain, found in zip(lists, chains.at(state), strict=True):
        expected = np.eye(4)
        for part in chain:
            if isinstance(part, Inverse):
                expected = expected @ inverse(values.atPose3(part.key).matrix())
            else:
                expected = expected @ (values.atPose3(part).matrix() if isinstance(part, int) else part)
        np.testing.assert_allclose(found, expected, atol=1e-12)
    derivatives = chains.derivatives(np.broadcast_to(np.eye(6), (len(lists), 6, 6)), state)
    for n, (keys, blocks) in enumerate(zip(chains.keys, derivatives, strict=True)):
        for key in set(keys):
            step, total = 1e-6, sum(block for k, block in zip(keys, blocks, strict=True) if k == key)
            columns = [
                difference(
                    chains.at(moved(values, key, -step * e))[n], chains.at(moved(values, key, step * e))[n]
                ) / (2 * step)
                for e in np.eye(6)
            ]  # fmt: skip
            np.testing.assert_allclose(total, np.stack(columns, axis=1), atol=1e-7)


def gradient_agrees(term, values, keys, atol):
    """Check a model's error and gradient against the exact error nearby."""
    model = term.at(State.of(values))
    linear = gtsam.GaussianFactorGraph()
    model.add_to(linear)
    found = linear.gradientAtZero()
    for key in keys:
        step = 1e-6
        numerical = [
            (term.at(moved(values, key, step * e)).error - term.at(moved(values, key, -step * e)).error) / (2 * step)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(found.at(key), numerical, rtol=1e-5, atol=atol)


@settings(max_examples=20)
@given(seeds, st.sampled_from([np.inf, 3.0]))
def test_templates_have_the_exact_error_and_its_gradient(seed, loss):
    rng = np.random.default_rng(seed)
    values = drawn(rng, 0.1)
    lists = [[Inverse(L(0)), X(0), E(0)], [Inverse(L(0)), X(1)], [exp(0.1 * rng.normal(size=6)), X(1), E(0)]]
    H = Chains(lists).at(State.of(values))
    measurements = [measure(rng, T @ exp(0.02 * rng.normal(size=6))) for T in H]
    term = Templates.of(measurements, lists, loss)
    model = term.at(State.of(values))
    if np.isinf(loss):
        assert model.error == pytest.approx(sum(m.error(T) for m, T in zip(measurements, H, strict=True)), rel=1e-9)
    for m, T, chi2, floor in zip(measurements, H, model.chi2, model.floor, strict=True):
        assert chi2 + floor == pytest.approx(2 * m.error(T), rel=1e-9)
    # Numerical derivatives of a cost of a thousand by steps of 1e-6: rounding of 1e-6. Huber's floor moves, which the
    # Gauss-Newton model leaves out: to second order of what no pose takes away.
    if np.isinf(loss):
        gradient_agrees(term, values, KEYS, atol=1e-4 * model.error)


def test_joint_poses_are_a_gaussian_of_all_together():
    rng = np.random.default_rng(0)
    values = drawn(rng, 0.3)
    lists = [[X(0)], [Inverse(E(0)), L(0)], [X(0), E(0)], [X(1), L(0), E(0), X(0)]]
    root = np.triu(rng.normal(size=(24, 24)))
    measured = Chains(lists).at(State.of(values)) @ exp(0.1 * rng.normal(size=(4, 6)))
    term = JointPoses(Chains(lists), measured, root)
    xi = difference(measured, Chains(lists).at(State.of(values))).ravel()
    assert term.at(State.of(values)).error == pytest.approx(0.5 * np.square(root @ xi).sum())
    gradient_agrees(term, values, KEYS, atol=1e-5)


def test_more_than_three_variables_are_one_factor():
    rng = np.random.default_rng(1)
    blocks, b = [rng.normal(size=(8, d)) for d in (6, 2, 6, 3, 6)], rng.normal(size=8)
    keys = [X(0), B(0), X(1), B(1), X(0)]
    linear = gtsam.GaussianFactorGraph()
    add_rows(linear, keys, blocks, b)
    order = gtsam.Ordering()
    for key in keys[:4]:
        order.push_back(key)
    A = np.hstack([blocks[0] + blocks[4], *blocks[1:4]])
    information, vector = linear.hessian(order)
    np.testing.assert_allclose(information, A.T @ A, atol=1e-12)
    np.testing.assert_allclose(vector, A.T @ b, atol=1e-12)


def test_a_mounting_and_the_world_are_found_together():
    rng = np.random.default_rng(2)
    mounting, targets = exp([0.1, -0.2, 0.3, 0.4, 0.1, 0.6]), exp(0.3 * rng.normal(size=(3, 6)))
    targets[:, :3, 3] += [6.0, 0.0, 0.0]
    bodies = exp(np.hstack([0.3 * rng.normal(size=(8, 3)), rng.normal(size=(8, 3))]))
    seen = [(i, j) for i in range(8) for j in range(3)]
    term = Templates.of(
        [measure(rng, inverse(targets[j]) @ bodies[i] @ mounting) for i, j in seen],
        [[Inverse(L(j)), bodies[i], E(0)] for i, j in seen],
    )
    values = gtsam.Values()
    values.insert(E(0), gtsam.Pose3(mounting @ exp(0.1 * rng.normal(size=6))))
    for j in range(3):
        values.insert(L(j), gtsam.Pose3(targets[j] @ exp(0.1 * rng.normal(size=6))))
    solution = solve(values, [term], names={E(0): "T_body_lidar"})
    assert solution.converged
    assert not solution.unobservable
    error = np.concatenate([difference(solution.pose(E(0)), mounting), difference(solution.pose(L(1)), targets[1])])
    covariance = solution.covariance([E(0), L(1)])
    # 99.99 % of chi-square with 12 degrees of freedom.
    assert error @ np.linalg.solve(covariance, error) < 39.1
    T, C = solution.relative([L(1), Inverse(E(0))])
    np.testing.assert_allclose(T, solution.pose(L(1)) @ inverse(solution.pose(E(0))), atol=1e-12)
    assert (np.linalg.eigvalsh(C) > 0).all()
    # A body that turns about one axis only leaves the mounting's height and the targets' free, together.
    flat = exp(np.hstack([np.zeros((8, 2)), rng.normal(size=(8, 1)), rng.normal(size=(8, 2)), np.zeros((8, 1))]))
    term = Templates.of(
        [measure(rng, inverse(targets[j]) @ flat[i] @ mounting) for i, j in seen],
        [[Inverse(L(j)), flat[i], E(0)] for i, j in seen],
    )
    solution = solve(values, [term], names={E(0): "T_body_lidar"})
    assert solution.converged
    [direction] = solution.unobservable
    assert direction.motion["T_body_lidar"][:3] == pytest.approx(0.0, abs=1e-3)
    assert "T_body_lidar" in direction.text


def test_shared_errors_are_one_variable_for_all_measurements():
    """Against rows stacked by hand: two measurements of two targets from a known pose, with two shared errors."""
    rng = np.random.default_rng(3)
    poses = exp(0.2 * rng.normal(size=(2, 6)))
    stacks = []
    for T in poses:
        m = measure(rng, T)
        B_columns = 3.0 * rng.normal(size=(13, 2))
        stacks.append(
            BiasedMeasurement.from_rows(
                m.stack[:, :12],
                B_columns,
                m.stack[:, 12],
                T,
                (SharedError("range bias", 0), SharedError("edge offset")),
            )
        )
    term = SharedErrors.of(stacks, [[Inverse(L(0))], [Inverse(L(1))]], [B(0), B(0)])
    values = gtsam.Values()
    for j, T in enumerate(poses):
        values.insert(L(j), gtsam.Pose3(inverse(T)))
    term.insert(values)
    solution = solve(values, [term])
    assert solution.converged
    beta = solution.values.atVector(B(0))

    def cost(beta, a, b):
        z = [
            m.stack @ np.concatenate([beta, inverse(T)[:3].T.ravel(), [1.0]])
            for m, T in zip(stacks, (a, b), strict=True)
        ]
        return 0.5 * sum(float(r @ r) for r in z) + 0.5 * float(beta @ beta)

    placed = solution.pose(L(0)), solution.pose(L(1))
    assert cost(beta, *placed) == pytest.approx(solution.error, rel=1e-9)
    for step in 1e-3 * rng.normal(size=(20, 14)):
        assert cost(beta + step[:2], placed[0] @ exp(step[2:8]), placed[1] @ exp(step[8:])) > solution.error
    # The errors tie targets together that no pose links.
    joint = solution.covariance([L(0), L(1)])
    assert np.abs(joint[:6, 6:]).max() > 0.01 * np.abs(joint).max()


def test_what_is_no_pose_in_a_chain_is_named():
    with pytest.raises(InputError, match="known part of a chain"):
        Chains([[X(0), np.eye(3)]])


class Rough:
    """A term whose cost has ripples that its linearisation does not know of, as robust losses have.

    Args:
        height: of the ripples, in half a chi-square.
    """

    def __init__(self, height, state=None):
        self.height, self.state = height, state

    def at(self, state):
        return Rough(self.height, state)

    @property
    def x(self):
        return np.asarray(self.state.values.atVector(X(0)))

    @property
    def error(self):
        far = float(np.linalg.norm(self.x - 1.0))
        return 0.5 * far**2 + self.height * np.cos(min(far / 0.09, 1.0) * np.pi)

    def add_to(self, linear):
        linear.add(X(0), np.eye(2), 1.0 - self.x, gtsam.noiseModel.Unit.Create(2))


@pytest.mark.parametrize(("height", "there"), [(3e-3, True), (3e-2, False)])
def test_a_cost_that_no_step_lowers_has_converged_near_its_minimum(height, there):
    """Within a tenth of a standard deviation of where the linearisation points; farther away it has not."""
    values = gtsam.Values()
    values.insert(X(0), 1.0 + np.array([0.06, 0.0]) * (1.0 if there else 2.0))
    solution = solve(values, [Rough(height)])
    assert solution.converged == there
    assert np.linalg.norm(solution.values.atVector(X(0)) - 1.0) < (0.1 if there else 0.2)
