"""The linearised graph as sparse matrices: what it determines, how well, and what it does not.

A direction whose standard deviation exceeds LOOSEST (1 km or 1000 rad) counts as not observable. Covariances are taken
with a vanishing prior, far looser still, on everything, so that those of what is observable exist although something
else is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, eigsh, splu

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import EstimationError

LOOSEST = 1e3
"""Standard deviation, metres or radians, beyond which a direction counts as not observable."""

DENSE_LIMIT = 600
"""Number of unknowns up to which all eigenvalues are taken, not only the smallest ones."""

FEW_DIRECTIONS, MOST_DIRECTIONS = 7, 24
"""How many unobservable directions a large graph is searched for: at first, and if all of those are not observable."""

VANISHING = 1e-14
"""Information of the prior, in units of each unknown's own."""


RANK = 1e-13
"""Eigenvalue, in units of each unknown's own information, under which a factor in information form has no row."""


def stacked(
    linear: gtsam.GaussianFactorGraph, dims: Mapping[int, int]
) -> tuple[sparse.csc_matrix[np.float64], dict[int, slice]]:
    """Return the rows [A b] (m, n + 1) of a linear graph, and the columns of each variable by key.

    GTSAM's own rows of a factor in information form come of a Cholesky factorisation, which some that are singular, as
    few rows on many unknowns are, make fail: here they are of the eigenvalues.

    Args:
        linear: the graph.
        dims: of all variables, by key. What no factor touches has empty columns.
    """
    columns, n = {}, 0
    for key in sorted(dims):
        columns[key] = slice(n, n + dims[key])
        n += dims[key]
    rows, plain = [], gtsam.GaussianFactorGraph()
    for factor in (linear.at(i) for i in range(linear.size())):
        if not isinstance(factor, gtsam.HessianFactor):
            plain.push_back(factor)
            continue
        M = factor.augmentedInformation()
        scale = np.sqrt(np.maximum(np.diag(M), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(M / np.outer(scale, scale))
        kept = values > RANK
        R = np.sqrt(values[kept])[:, None] * vectors[:, kept].T * scale
        keys = list(factor.keys())
        where = np.concatenate([*(np.arange(columns[key].start, columns[key].stop) for key in keys), [n]])
        i, j = np.indices(R.shape)
        rows.append(sparse.csc_matrix((R.ravel(), (i.ravel(), where[j.ravel()])), shape=(len(R), n + 1)))
    # GTSAM numbers columns by sorted key, from 1, over the variables its factors touch; the last one is b.
    touched = sorted(set(plain.keyVector()))
    where = np.concatenate([*(np.arange(columns[key].start, columns[key].stop) for key in touched), [n]])
    row, column, entry = plain.sparseJacobian_()
    i, j = row.astype(int) - 1, where[column.astype(int) - 1].astype(int)
    m = int(i.max()) + 1 if len(i) else 0
    rows.append(sparse.csc_matrix((entry, (i, j)), shape=(m, n + 1)))
    return sparse.csc_matrix(sparse.vstack(rows)), columns


@dataclass(frozen=True, eq=False, repr=False)
class LinearSystem(Value):
    """A linearised graph: 1/2 ||A x - b||^2 over the tangent vectors of its variables.

    Attributes:
        A: (m, n) sparse whitened Jacobian.
        b: (m,) whitened.
        columns: the columns of each variable's tangent vector, by key.
    """

    A: sparse.csr_matrix[np.float64]
    b: Floats
    columns: dict[int, slice]

    @classmethod
    def of(cls, linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> LinearSystem:
        """Return a linear graph as matrices. A variable that no factor touches has empty columns.

        Args:
            linear: the graph.
            values: of all variables, for their dimensions.

        Raises:
            EstimationError: a factor's residual or Jacobian is not finite.
        """
        # The sparse entries leave out what is not finite; the gradient does not.
        if not np.isfinite(linear.gradientAtZero().norm()):
            raise EstimationError("a factor's residual or Jacobian is not finite")
        augmented, columns = stacked(linear, values.dims())
        return cls(sparse.csr_matrix(augmented[:, :-1]), augmented[:, [-1]].toarray().ravel(), columns)

    @cached_property
    def information(self) -> sparse.csc_matrix[np.float64]:
        """(n, n) sparse A^T A."""
        return sparse.csc_matrix(self.A.T @ self.A)

    @cached_property
    def _scale(self) -> Floats:
        """(n,) D: in units of what each unknown's own rows leave it, information is between 0 and 1 everywhere."""
        return np.asarray(1.0 / np.sqrt(np.maximum(self.information.diagonal(), 1e-6 / LOOSEST**2)))

    @cached_property
    def _scaled(self) -> sparse.csc_matrix[np.float64]:
        D = sparse.diags_array(self._scale)
        return sparse.csc_matrix(D @ self.information @ D)

    @cached_property
    def _factor(self) -> SuperLU:
        """Of the scaled information, with a vanishing prior."""
        prior = VANISHING * sparse.identity(len(self._scale))
        options = {"SymmetricMode": True}
        return splu(sparse.csc_matrix(self._scaled + prior), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def _solve(self, vectors: Floats) -> Floats:
        """The inverse information times vectors (n, ...)."""
        D = self._scale.reshape(-1, *[1] * (vectors.ndim - 1))
        return np.asarray(D * self._factor.solve(D * vectors))

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in self.__dict__.items() if name != "_factor"}  # SuperLU does not pickle

    @cached_property
    def decrement(self) -> float:
        """Half the squared Newton decrement: by how much a Gauss-Newton step would lower the cost, to first order.

        A cost is half a chi-square, so 1e-6 means a step of a thousandth of a standard deviation.
        """
        gradient: Floats = np.asarray(self.A.T @ self.b)
        return 0.5 * float(gradient @ self._solve(gradient))

    def columns_of_covariance(self, keys: Sequence[int]) -> Floats:
        """Return the covariance (n, d) matrix of all unknowns with those of some variables, in their order."""
        index = self.index(keys)
        unit = np.zeros((self.A.shape[1], len(index)))
        unit[index, np.arange(len(index))] = 1.0
        return self._solve(unit)

    def covariance(self, keys: Sequence[int]) -> Floats:
        """Return the joint covariance (d, d) of variables, in their order; of a pose, rotation (rad) first."""
        covariance = self.columns_of_covariance(keys)[self.index(keys)]
        return np.asarray(0.5 * (covariance + covariance.T))

    def index(self, keys: Sequence[int]) -> Ints:
        """Return the numbers (d,) of the unknowns of some variables, in their order."""
        return np.concatenate([np.arange(self.columns[key].start, self.columns[key].stop) for key in keys])

    @cached_property
    def unobservable(self) -> Floats:
        """(n, k) directions that are not observable, each moving a coordinate of its own by one unit."""
        n = self.A.shape[1]
        if n <= DENSE_LIMIT:
            null = self._null(*np.linalg.eigh(self._scaled.toarray()))
        else:
            for k in (FEW_DIRECTIONS, MOST_DIRECTIONS):
                inverse = LinearOperator((n, n), matvec=self._factor.solve, dtype=np.float64)
                start = np.random.default_rng(0).normal(size=n)
                null = self._null(*eigsh(self._scaled, k=k, sigma=0.0, which="LM", OPinv=inverse, v0=start))
                if null.shape[1] < k:
                    break
        if not null.shape[1]:
            return null
        # Any basis of the null space would do; this one reads best.
        _, pivots = scipy.linalg.qr(null.T, mode="r", pivoting=True)
        return np.asarray(null @ np.linalg.inv(null[pivots[: null.shape[1]]]))

    def _null(self, eigenvalues: Floats, vectors: Floats) -> Floats:
        """Of the scaled information's eigenvectors (n, k), those that are not observable, unscaled and orthonormal."""
        n = len(self._scale)
        directions = self._scale[:, None] * vectors
        loose = eigenvalues < np.maximum(np.square(directions).sum(axis=0) / LOOSEST**2, 4 * n * np.finfo(float).eps)
        return np.asarray(np.linalg.qr(directions[:, loose])[0]) if loose.any() else np.zeros((n, 0))
