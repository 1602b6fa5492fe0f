"""Importance sampling over poses, against integrals that are known."""

import gtsam
import numpy as np
import pytest

from optshape_graph.pose.sampling.mixture import Components, sample
from optshape_graph.se3 import difference, exp, inverse
from optshape_graph.simulation import pose_from_rpy

ALONE = np.eye(4)[None]
SD = np.array([0.05, 0.01, 0.02, 0.01, 0.03, 0.002])


def gaussian(T0: np.ndarray, covariance: np.ndarray):
    """Logarithm of an unnormalised Gaussian about a pose, and of the scalar, of unit variance."""
    information = np.linalg.inv(covariance)

    def log_density(T: np.ndarray, scalar: np.ndarray) -> np.ndarray:
        xi = difference(T0, T)
        return -0.5 * np.einsum("si,ij,sj->s", xi, information, xi) - 0.5 * scalar**2

    return log_density


def log_volume(covariance: np.ndarray) -> float:
    return float(0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1] + 0.5 * np.log(2 * np.pi))


def components(poses: list[np.ndarray], covariance: np.ndarray) -> Components:
    joint = np.zeros((len(poses), 7, 7))
    joint[:, :6, :6], joint[:, 6, 6] = covariance, 1.0
    return Components(np.stack(poses), np.zeros((len(poses), 7)), joint, np.full(len(poses), 1 / len(poses)))


@pytest.mark.parametrize("off", [0.0, 1.5])
def test_of_a_gaussian(off: float) -> None:
    """Even from a covariance that is four times too wide, and a mean that is off by some standard deviations."""
    truth = pose_from_rpy([9.0, 1.0, 0.5], [0.4, -0.3, 2.0])
    mixing = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    covariance = (mixing * SD**2) @ mixing.T * 0.1 + np.diag(SD**2)
    start = components([truth @ exp(off * SD)], 4 * covariance)
    samples = sample(gaussian(truth, covariance), start, ALONE, np.random.default_rng(0))
    assert samples.log_integral == pytest.approx(log_volume(covariance), abs=0.15)
    assert samples.effective > 200
    xi = difference(truth, samples.T)
    mean = samples.weight @ xi
    assert np.abs(mean / np.sqrt(np.diag(covariance))).max() < 0.3
    spread = np.sqrt(samples.weight @ (xi - mean) ** 2)
    np.testing.assert_allclose(spread, np.sqrt(np.diag(covariance)), rtol=0.2)
    again = sample(gaussian(truth, covariance), start, ALONE, np.random.default_rng(0))
    assert again.log_integral == samples.log_integral


def test_masses_of_two_modes() -> None:
    """One to nine, a half turn apart, where the components say nothing of it: within 0.03."""
    first = pose_from_rpy([9.0, 1.0, 0.5], [0.4, -0.3, 2.0])
    second = first @ pose_from_rpy([0.0, 0.2, 0.0], [np.pi, 0.0, 0.0])
    one, two = gaussian(first, np.diag(SD**2)), gaussian(second, np.diag(SD**2))
    samples = sample(
        lambda T, o: np.logaddexp(np.log(0.9) + one(T, o), np.log(0.1) + two(T, o)),
        components([first, second], 2 * np.diag(SD**2)),
        ALONE,
        np.random.default_rng(1),
    )
    turned = np.array([np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3((inverse(first) @ T)[:3, :3]))) for T in samples.T])
    assert samples.weight[turned > 1.5].sum() == pytest.approx(0.1, abs=0.03)
    assert samples.log_integral == pytest.approx(log_volume(np.diag(SD**2)), abs=0.1)


def test_what_no_component_covers_becomes_one() -> None:
    """A density half as wide as the component, four of its standard deviations away: found, to 0.3 in the logarithm."""
    truth = pose_from_rpy([9.0, 1.0, 0.5], [0.4, -0.3, 2.0])
    start = components([truth @ exp(np.array([0.0, 0.0, 0.0, 0.0, 4 * SD[4], 0.0]))], np.diag(SD**2))
    samples = sample(gaussian(truth, np.diag(SD**2) / 4), start, ALONE, np.random.default_rng(0))
    assert samples.effective > 50
    assert samples.log_integral == pytest.approx(log_volume(np.diag(SD**2) / 4), abs=0.3)
