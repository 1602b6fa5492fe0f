"""A failed update changes nothing; a lag forgets poses and keeps what they said."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import L, X

from optshape_graph.errors import EstimationError
from optshape_graph.mapping.smoother import RELINEARISE, Smoother

NOISE = gtsam.noiseModel.Isotropic.Sigma(6, 0.01)


def run(smoother: Smoother, n: int, seed: int = 0, disturb=None) -> None:
    """Drive n poses on the spot, each of which sees one landmark."""
    rng = np.random.default_rng(seed)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3())
    values.insert(L(0), gtsam.Pose3())
    prior = gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), NOISE)
    seen = gtsam.BetweenFactorPose3(X(0), L(0), gtsam.Pose3(), NOISE)
    smoother.update([prior, seen], values, stamps={X(0): 0.0})
    for i in range(1, n):
        motion, sight = (gtsam.Pose3.Expmap(0.01 * rng.normal(size=6)) for _ in range(2))
        values = gtsam.Values()
        values.insert(X(i), gtsam.Pose3())
        factors = [
            gtsam.BetweenFactorPose3(X(i - 1), X(i), motion, NOISE),
            gtsam.BetweenFactorPose3(X(i), L(0), sight, NOISE),
        ]
        smoother.update(factors, values, stamps={X(i): float(i)})
        if disturb is not None and i == n // 2:
            disturb(smoother, i)


def undetermined(smoother: Smoother, i: int) -> None:
    values = gtsam.Values()
    values.insert(L(7), gtsam.Pose3())
    half = gtsam.noiseModel.Gaussian.SqrtInformation(np.diag([1.0, 1, 1, 1, 1, 0]), False)
    with pytest.raises(EstimationError, match="do not determine"):
        smoother.update([gtsam.BetweenFactorPose3(X(i), L(7), gtsam.Pose3(), half)], values)
    assert L(7) not in smoother


def not_finite(smoother: Smoother, i: int) -> None:
    broken = gtsam.Pose3(gtsam.Rot3(), np.array([np.nan, 0.0, 0.0]))
    with pytest.raises(EstimationError, match="not finite"):
        smoother.update([gtsam.BetweenFactorPose3(X(i), L(0), broken, NOISE)], gtsam.Values())


@pytest.mark.parametrize("lag", [None, 8.0])
@pytest.mark.parametrize("disturb", [undetermined, not_finite])
def test_what_fails_leaves_no_trace(lag, disturb):
    disturbed, calm = Smoother(lag), Smoother(lag)
    run(disturbed, 30, disturb=disturb)
    run(calm, 30)
    # The smoother made again starts from other linearisation points, second order in angles of 0.02 rad.
    np.testing.assert_allclose(disturbed.pose(X(29)), calm.pose(X(29)), atol=1e-4)
    np.testing.assert_allclose(
        disturbed.covariance([X(29), L(0)]), calm.covariance([X(29), L(0)]), atol=1e-3 * NOISE.sigma() ** 2
    )


def test_a_lag_marginalises_what_is_old():
    windowed, full = Smoother(5.0), Smoother()
    run(windowed, 40)
    run(full, 40)
    full.relinearise()  # else it is linearised again in every tenth update only
    assert X(0) not in windowed
    assert X(35) in windowed
    # Marginalised, not dropped: estimates and covariances are those of all poses, linearised up to RELINEARISE apart.
    np.testing.assert_allclose(windowed.pose(L(0)), full.pose(L(0)), atol=2e-4)
    apart = RELINEARISE * NOISE.sigma() ** 2
    np.testing.assert_allclose(windowed.covariance([L(0)]), full.covariance([L(0)]), atol=apart)
    assert len(windowed._factors) < 20


def test_removed_factors_count_no_more():
    smoother = Smoother()
    run(smoother, 5)
    before = smoother.pose(L(0))
    wrong = gtsam.BetweenFactorPose3(X(4), L(0), gtsam.Pose3(gtsam.Rot3(), np.array([0.1, 0.0, 0.0])), NOISE)
    [handle] = smoother.update([wrong], gtsam.Values())
    assert np.abs(smoother.pose(L(0)) - before).max() > 1e-3
    smoother.update([], gtsam.Values(), [handle])
    # Back to the same solution, linearised elsewhere: second order in the hundredths of a radian between.
    np.testing.assert_allclose(smoother.pose(L(0)), before, atol=1e-4)


def test_an_unknown_variable_is_named():
    with pytest.raises(EstimationError, match="no initial value for variable x0"):
        Smoother().update([gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), NOISE)], gtsam.Values())
