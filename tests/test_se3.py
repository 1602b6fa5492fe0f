"""Group axioms over batch shapes, near the identity, far from it and at half turns; GTSAM as the reference."""

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.se3 import (
    adjoint,
    angle,
    apply,
    as_transform,
    difference,
    exp,
    inverse,
    inverse_covariance,
    inverse_right_jacobian,
    log,
    right_jacobian,
    rotation,
    rotation_vector,
    transform,
    vec,
    vec_derivative,
)

seeds = st.integers(0, 2**32 - 1)
shapes = st.sampled_from([(), (1,), (3,), (2, 3), (0,), (2, 1, 2)])
angles = st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 0.1, 0.99, 1.01, 2.0, 3.0, np.pi - 1e-6, np.pi - 1e-9])
"""Lengths of rotation vectors, rad: what formulas for small angles, for large ones and at half turns are asked."""


def tangent(rng: np.random.Generator, shape: tuple[int, ...], length: float) -> np.ndarray:
    """Draw tangent vectors (*shape, 6) whose rotation has a length, rad, and whose translation is about 5 m."""
    w = rng.normal(size=(*shape, 3))
    return np.concatenate(
        [length * w / np.linalg.norm(w, axis=-1, keepdims=True), 5.0 * rng.normal(size=(*shape, 3))], -1
    )


@given(seeds, shapes, angles)
def test_log_undoes_exp(seed, shape, length):
    xi = tangent(np.random.default_rng(seed), shape, length)
    # The entries of a rotation hold pi - angle to 1e-16 / 1e-9 only.
    np.testing.assert_allclose(log(exp(xi)), xi, atol=1e-13 if length < 3.1 else 1e-6)
    np.testing.assert_allclose(exp(log(exp(xi))), exp(xi), atol=1e-13)


@given(seeds, shapes, angles)
def test_a_rotation_vector_tells_its_angle(seed, shape, length):
    w = tangent(np.random.default_rng(seed), shape, length)[..., :3]
    np.testing.assert_allclose(angle(rotation(w)), np.full(shape, length), atol=1e-13 if length < 3.1 else 1e-7)
    np.testing.assert_allclose(angle(transform(rotation(w))), angle(rotation(w)))


def test_half_turns_have_logarithms():
    for axis in (*np.eye(3), *-np.eye(3), [0.6, 0.8, 0.0], [0.6, -0.48, 0.64]):
        R = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(rotation(rotation_vector(R)), R, atol=1e-15)
        assert angle(R) == pytest.approx(np.pi, abs=1e-15)


@given(seeds, shapes, angles, angles)
def test_group_axioms(seed, shape, length, other):
    rng = np.random.default_rng(seed)
    A, B, C = exp(tangent(rng, shape, length)), exp(tangent(rng, shape, other)), exp(tangent(rng, (), 1.0))
    identity = np.broadcast_to(np.eye(4), A.shape)
    np.testing.assert_allclose(A @ inverse(A), identity, atol=1e-13)
    np.testing.assert_allclose(inverse(A) @ A, identity, atol=1e-13)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-12)
    np.testing.assert_allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=1e-12)
    np.testing.assert_allclose(adjoint(A @ B), adjoint(A) @ adjoint(B), atol=1e-11)
    np.testing.assert_allclose(A @ exp(difference(A, B)), B, atol=1e-12)


@given(seeds, shapes, angles)
def test_adjoint_moves_a_perturbation_to_the_other_side(seed, shape, length):
    rng = np.random.default_rng(seed)
    T, xi = exp(tangent(rng, shape, length)), tangent(rng, shape, 0.5)
    np.testing.assert_allclose(T @ exp(xi), exp((adjoint(T) @ xi[..., None])[..., 0]) @ T, atol=1e-11)


@given(seeds, shapes, angles)
def test_apply_is_the_homogeneous_product(seed, shape, length):
    rng = np.random.default_rng(seed)
    T, points = exp(tangent(rng, shape, length)), rng.normal(size=(4, 3))
    expected = np.concatenate([points, np.ones((4, 1))], axis=1) @ np.swapaxes(T, -1, -2)
    np.testing.assert_allclose(apply(T, points), expected[..., :3], atol=1e-14)
    np.testing.assert_allclose(apply(inverse(T), apply(T, points)), np.broadcast_to(points, (*shape, 4, 3)), atol=1e-13)


@given(seeds, angles)
def test_matches_gtsam(seed, length):
    xi = tangent(np.random.default_rng(seed), (), length)
    T, pose = exp(xi), gtsam.Pose3.Expmap(xi)
    # GTSAM's own small-angle branches are good to 1e-8 near their thresholds.
    np.testing.assert_allclose(T, pose.matrix(), atol=1e-7)
    np.testing.assert_allclose(inverse(T), pose.inverse().matrix(), atol=1e-7)
    np.testing.assert_allclose(adjoint(T), pose.AdjointMap(), atol=1e-6)
    if length < 3.1:
        np.testing.assert_allclose(log(T), gtsam.Pose3.Logmap(gtsam.Pose3(T)), atol=1e-6)
        np.testing.assert_allclose(right_jacobian(xi), gtsam.Pose3.ExpmapDerivative(xi), atol=1e-6)
        np.testing.assert_allclose(inverse_right_jacobian(xi), gtsam.Pose3.LogmapDerivative(xi), atol=1e-5)


@given(seeds, shapes, angles)
def test_right_jacobian_is_the_derivative_of_exp(seed, shape, length):
    xi = tangent(np.random.default_rng(seed), shape, length)
    step = 1e-5  # central differences: truncation and rounding both about 1e-9 at entries of 10 m
    numerical = np.stack([difference(exp(xi - step * e), exp(xi + step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(right_jacobian(xi), numerical, atol=1e-7)
    if length < 3.1:
        np.testing.assert_allclose(
            inverse_right_jacobian(xi) @ right_jacobian(xi), np.broadcast_to(np.eye(6), (*shape, 6, 6)), atol=1e-10
        )


@given(seeds, shapes, angles)
def test_derivative_of_vec(seed, shape, length):
    T = exp(tangent(np.random.default_rng(seed), shape, length))
    step = 1e-5
    numerical = np.stack([(vec(T @ exp(step * e)) - vec(T @ exp(-step * e))) / (2 * step) for e in np.eye(6)], -1)
    np.testing.assert_allclose(vec_derivative(T), numerical, atol=1e-8)
    np.testing.assert_allclose(np.swapaxes(vec(T)[..., :9].reshape(*shape, 3, 3), -1, -2), T[..., :3, :3])


@given(seeds, shapes)
def test_batches_are_stacks_of_single_ones(seed, shape):
    xi = tangent(np.random.default_rng(seed), shape, 1.0)
    T = exp(xi)
    for function, values in (
        (exp, xi), (right_jacobian, xi), (inverse_right_jacobian, xi), (log, T), (inverse, T), (adjoint, T), (vec, T),
        (vec_derivative, T), (angle, T),
    ):  # fmt: skip
        batch = function(values)
        for i in np.ndindex(shape):
            np.testing.assert_allclose(batch[i], function(values[i]), atol=1e-14)


def test_inverse_covariance_against_scatter():
    rng = np.random.default_rng(1)
    T = exp(tangent(rng, (), 1.0))
    factor = rng.normal(size=(6, 6)) * 1e-3
    samples = difference(inverse(T), inverse(T @ exp(rng.normal(size=(4000, 6)) @ factor.T)))
    expected = inverse_covariance(T, factor @ factor.T)
    # A sample covariance of 4000 has entries within 5 / sqrt(4000) = 8 % of the axes' product, at five sigma.
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(np.cov(samples.T) - expected) / scale).max() < 0.12
    np.testing.assert_allclose(inverse_covariance(inverse(T), expected), factor @ factor.T, atol=1e-12 * scale.max())


def test_a_pose_is_taken_as_an_array_or_as_gtsam_s():
    T = exp([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    for given_as in (T, T.tolist(), gtsam.Pose3(T)):
        np.testing.assert_allclose(as_transform(given_as), T, atol=1e-15)
    assert not as_transform(T).flags.writeable


@pytest.mark.parametrize(
    ("T", "found"),
    [
        (np.eye(3), "shape (3, 3)"),
        (np.full((4, 4), np.nan), "finite"),
        ("pose", "expected a pose as 4 x 4 numbers, found 'pose'"),
        ([[1.0], [2.0, 3.0]], "4 x 4 numbers"),
        (2 * np.eye(4), "not a rigid transform"),
        (np.diag([-1.0, 1.0, 1.0, 1.0]), "not a rigid transform"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "not a rigid transform"),
    ],
)
def test_what_is_no_pose_is_named(T, found):
    with pytest.raises(InputError, match="extrinsic: ") as caught:
        as_transform(T, "extrinsic")
    assert found in str(caught.value)
