"""ISAM2, with or without a lag, that survives what it is given.

A factor that is not finite, or a variable that nothing determines, makes `ISAM2.update` raise and leaves it unusable.
So new factors are linearised first, and the smoother keeps the factors that it holds: if an update fails all the same,
it is made again from those, and the caller gets an error and the smoother it had.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, frozen
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors._rows import gaussian
from optshape_graph.graph.linear import LinearSystem

RELINEARISE = 0.005
"""Step, metres or rad, beyond which a variable is linearised again."""

RELINEARISE_EVERY = 10
"""Updates between looks at what is to be linearised again: after a loop was closed, a look costs as much as a batch."""

DETERMINED = 1e-7
"""Ratio of the least to the largest singular value of the factors of a new variable, below which they leave it open."""


class Smoother:
    """Incremental smoothing and mapping (Kaess et al., ISAM2, IJRR 2012) of poses, all of them or the latest.

    Attributes:
        lag: seconds after which a variable with a stamp is marginalised; None: never. What is marginalised stays in
            force as a prior on what is left.
        worked: number of variables that updates have eliminated again: after so much work estimates may have moved.
    """

    def __init__(self, lag: float | None = None) -> None:
        self.lag = lag
        self.worked = 0
        self._isam = _new_isam(lag)
        self._factors: dict[int, gtsam.NonlinearFactor] = {}  # by handle, which outlives ISAM2's slots
        self._slots: dict[int, int] = {}
        self._handles = itertools.count()
        self._stamps: dict[int, float] = {}

    def __contains__(self, key: int) -> bool:
        return bool(self._isam.valueExists(key))

    def update(
        self,
        factors: Sequence[gtsam.NonlinearFactor],
        values: gtsam.Values,
        remove: Iterable[int] = (),
        stamps: Mapping[int, float] | None = None,
        finite: bool = False,
    ) -> list[int]:
        """Add factors and variables, remove factors, and improve the estimate by one step.

        Args:
            factors: to add.
            values: initial values of the variables that are new.
            remove: handles of factors to remove; those that a lag has marginalised are gone, and ignored.
            stamps: seconds, of the variables that the lag marginalises; the others stay for ever.
            finite: the factors are known to be finite, and their variables to be there: they are not looked at.

        Returns:
            A handle for each new factor.

        Raises:
            EstimationError: a factor is not finite, or the variables are not determined; nothing has changed then.
        """
        if not finite:
            self.check(factors, values)
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        removed = [handle for handle in remove if handle in self._factors]
        try:
            slots = [self._slots[handle] for handle in removed]
            result = self._isam.update(graph, values, slots)
        except RuntimeError as error:
            self._restore(values)
            raise EstimationError(f"the factors do not determine the variables: {error}") from error
        for handle in removed:
            del self._factors[handle], self._slots[handle]
        self.worked += result.getVariablesReeliminated()
        handles = self._hold(factors, result.getNewFactorsIndices())
        if self.lag is not None:
            self._stamps.update(stamps or {})
            self._marginalise(self.lag)
        return handles

    def check(self, factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values) -> None:
        """Look at factors that are to be added, and at the variables that are new with them.

        Raises:
            EstimationError: a factor is not finite, or the factors leave a new variable open.
        """
        touched = gtsam.Values(values)
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        for key in graph.keyVector():
            if not touched.exists(key):
                if key not in self:
                    raise EstimationError(f"no initial value for variable {gtsam.DefaultKeyFormatter(key)}")
                touched.insert(key, self._isam.calculateEstimatePose3(key))
        rows: dict[int, list[Floats]] = {key: [] for key in values.keys()}  # noqa: SIM118 - not a mapping
        linear = graph.linearize(touched)
        for linearised in (linear.at(i) for i in range(linear.size())):
            augmented = linearised.augmentedJacobian()
            if not math.isfinite(np.vdot(augmented, augmented)):
                raise EstimationError("a new factor's residual or Jacobian is not finite")
            for n, key in enumerate(linearised.keys()):
                if key in rows:
                    rows[key].append(augmented[:, 6 * n : 6 * n + 6])
        # QR takes what is singular without a word.
        for key, blocks in rows.items():
            if not blocks or np.linalg.matrix_rank(np.vstack(blocks), rtol=DETERMINED) < 6:
                name = gtsam.DefaultKeyFormatter(key)
                raise EstimationError(f"the factors do not determine the variables: {name} is left open")

    def pose(self, key: int) -> Floats:
        """Return the estimate (4, 4) of a pose."""
        return np.asarray(self._isam.calculateEstimatePose3(key).matrix())

    def values(self) -> gtsam.Values:
        """Return the estimates of all variables that are left."""
        return gtsam.Values(self._isam.calculateBestEstimate())

    def system(self) -> LinearSystem:
        """Return all factors, linearised at the estimate, as matrices."""
        graph, values = gtsam.NonlinearFactorGraph(), self.values()
        for factor in self._factors.values():
            graph.push_back(factor)
        return LinearSystem.of(graph.linearize(values), values)

    def covariance(self, keys: Sequence[int]) -> Floats:
        """Return the joint covariance (d, d) of variables, in their order; of poses rotation (rad) first."""
        if len(keys) == 1:
            return np.asarray(self._isam.marginalCovariance(keys[0]))
        return np.asarray(self._isam.jointMarginalCovariance(list(keys)).fullMatrix())

    def _hold(self, factors: Sequence[gtsam.NonlinearFactor], slots: Sequence[int]) -> list[int]:
        handles = [next(self._handles) for _ in factors]
        self._factors.update(zip(handles, factors, strict=True))
        self._slots.update(zip(handles, slots, strict=True))
        return handles

    def relinearise(self) -> None:
        """Linearise all factors at the estimate, and improve it by one step: as much work as a batch."""
        self._make_again(self.values())

    def _restore(self, failed: gtsam.Values) -> None:
        """Make the smoother again from the factors it held, without the variables of a failed update."""
        values = gtsam.Values(self._isam.getLinearizationPoint())
        for key in failed.keys():  # noqa: SIM118 - not a mapping
            if values.exists(key):
                values.erase(key)
        self._make_again(values)

    def _make_again(self, values: gtsam.Values) -> None:
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors.values():
            graph.push_back(factor)
        self._isam = _new_isam(self.lag)
        result = self._isam.update(graph, values)
        self._slots = dict(zip(self._factors, result.getNewFactorsIndices(), strict=True))

    def _marginalise(self, lag: float) -> None:
        newest = max(self._stamps.values(), default=0.0)
        old = [key for key, stamp in self._stamps.items() if stamp < newest - lag]
        if not old:
            return
        # Only leaves can be marginalised: what is old is eliminated first, which means eliminating the window again.
        groups, window, leaves = gtsam.KeyGroupMap(), gtsam.KeyList(), gtsam.KeyList()
        for key in self._isam.getLinearizationPoint().keys():  # noqa: SIM118 - not a mapping
            groups.insert2(key, 0 if key in old else 1)
            window.push_back(key)
        self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], groups, gtsam.KeyList(), window)
        for key in old:
            leaves.push_back(key)
            del self._stamps[key]
        added, deleted = self._isam.marginalizeLeavesWithIndices(leaves)
        gone = set(deleted)
        for handle in [handle for handle, slot in self._slots.items() if slot in gone]:
            del self._factors[handle], self._slots[handle]
        held = self._isam.getFactorsUnsafe()
        self._hold([held.at(slot) for slot in added], added)


def _new_isam(lag: float | None) -> gtsam.ISAM2:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(RELINEARISE)
    parameters.relinearizeSkip = RELINEARISE_EVERY if lag is None else 1  # what is marginalised stays as it was
    parameters.setFactorization("QR")  # squares of long open drives have lost the digits that Cholesky needs
    return gtsam.ISAM2(parameters)


def joint_prior(keys: Sequence[int], poses: Sequence[Floats], covariance: Floats) -> list[gtsam.NonlinearFactor]:
    """Return the factors of a joint Gaussian prior of poses.

    Independent poses take a prior each. Otherwise it is one factor, linear in the poses' local coordinates.

    Args:
        keys: (m,) of the poses.
        poses: (m,) of (4, 4) means.
        covariance: (6 m, 6 m) of their right perturbations, rotation first, in the order of the keys.
    """
    m = len(keys)
    blocks = covariance.reshape(m, 6, m, 6).swapaxes(1, 2)
    off_diagonal = blocks[~np.eye(m, dtype=bool)]
    if not off_diagonal.size or np.abs(off_diagonal).max() == 0.0:
        return [
            gtsam.PriorFactorPose3(key, gtsam.Pose3(T), gaussian(sqrt_information(blocks[k, k])))
            for k, (key, T) in enumerate(zip(keys, poses, strict=True))
        ]
    R = sqrt_information(covariance)
    information = (R.T @ R).reshape(m, 6, m, 6).swapaxes(1, 2)
    # Pairs of variables are what GTSAM's Hessian takes from Python; added up they are one factor of all of them.
    quadratic, zero = gtsam.GaussianFactorGraph(), np.zeros(6)
    for i in range(m):
        quadratic.push_back(gtsam.HessianFactor(keys[i], information[i, i], zero, 0.0))
        for j in range(i + 1, m):
            nothing = np.zeros((6, 6))
            pair = gtsam.HessianFactor(keys[i], keys[j], nothing, information[i, j], zero, nothing, zero, 0.0)
            quadratic.push_back(pair)
    means = gtsam.Values()
    for key, T in zip(keys, poses, strict=True):
        means.insert(key, gtsam.Pose3(T))
    return [gtsam.LinearContainerFactor(gtsam.HessianFactor(quadratic), means)]


def sqrt_information(covariance: Floats) -> Floats:
    """Return R (d, d), upper triangular, with R^T R the inverse of a covariance matrix (d, d).

    Raises:
        numpy.linalg.LinAlgError: the covariance is not positive definite.
    """
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def root_of(covariance: Floats, what: str) -> Floats:
    """Return the square root information (6, 6) of a pose's covariance.

    Raises:
        InputError: the covariance is not 6 x 6, finite and positive definite.
    """
    C = np.asarray(covariance, float)
    if C.shape == (6, 6):
        with suppress(np.linalg.LinAlgError):
            root = _root(C.tobytes())
            if math.isfinite(np.vdot(root, root)):
                return root
    raise InputError(f"{what} covariance: expected 6 x 6, positive definite; found shape {C.shape}: {C.tolist()}")


@lru_cache(maxsize=1)
def _root(covariance: bytes) -> Floats:
    """Square root information of a (6, 6) covariance; odometry often has the same one again and again."""
    return frozen(sqrt_information(np.frombuffer(covariance).reshape(6, 6)))
