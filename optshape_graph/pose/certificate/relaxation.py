"""A lower bound on the cost of every pose, from the dual of a semidefinite relaxation.

With t eliminated, the cost of a measurement is a quadratic form in x = [vec R; 1]. The relaxation of Briales and
Gonzalez-Jimenez (CVPR 2017) replaces x x^T by any positive semidefinite X that satisfies the 21 quadratic
constraints of a rotation (rows and columns orthonormal, right-handed) and X_10,10 = 1. Its dual,

    maximise mu  subject to  Z = Q - mu E_10,10 - sum_i lambda_i A_i  positive semidefinite,

bounds the cost of every rotation from below. A multiplier that is not quite feasible still gives a bound: x^T Z x
is at least 4 min(0, lambda_min(Z)), since |x|^2 = 4 for every rotation. Where no pose is known, a solver finds the
multipliers; where a minimum is known, see `multipliers`.

The rotation constraints do not know on which side of the target the sensor is, and with few rings a pose seen from
behind, which is impossible, can cost as little. On the -x side, where t_x <= 0, every rotation has

    g = -t_x (1 - e_x^T R R*^T e_x) >= 0,

the product of two numbers that are not negative, quadratic in [vec R; t; 1]. Minus nu g, nu >= 0, joins the cost: no
pose in front costs more by it, one from behind costs 2 nu t_x more at half a turn, and at R*, where g and its slope
along rotations vanish, nothing changes. So the bound may stay tight at R* where that without g is not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product
from typing import Literal, get_args

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.errors import EstimationError, InputError, missing_extra
from optshape_graph.factors.measurement import TemplateMeasurement, refine
from optshape_graph.se3 import transform

Backend = Literal["closed-form", "clarabel", "cvxpy"]
"""What finds the multipliers: a few Newton steps beside what is written down, else Clarabel; Clarabel; Clarabel by
cvxpy."""

SQUARED_NORM = 4.0
"""Of x = [vec R; 1], for every rotation."""


@dataclass(frozen=True, eq=False, repr=False)
class Bound(Value):
    """What the dual of the relaxation says of a quadratic cost [vec R; t; 1]^T Q [vec R; t; 1].

    Attributes:
        bound: no pose costs less than this.
        second_eigenvalue: second smallest eigenvalue of Z, in the cost's unit: where it is positive and a pose's
            cost meets the bound, no other pose attains it.
        X: (10, 10) primal solution: x x^T of the best rotation where the relaxation is tight.
    """

    bound: float
    second_eigenvalue: float
    X: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Relaxation(Value):
    """The pose that the relaxation rounds to, and the bound on every pose.

    Attributes:
        T_target_lidar: (4, 4) a local minimum of the cost.
        cost: the cost there.
        bound: no pose costs less than this.
    """

    T_target_lidar: Floats
    cost: float
    bound: float


def rotation_constraints() -> Floats:
    """Return the 21 symmetric matrices (21, 10, 10) with x^T A_i x = 0 for x = [vec R; 1], R a rotation."""
    index = np.arange(9).reshape(3, 3).T  # index[i, j]: place of R_ij in the column-major vec R
    constraints = []

    def add(terms: dict[tuple[int, int], float]) -> None:
        A = np.zeros((10, 10))
        for (i, j), value in terms.items():
            A[i, j] += value / 2
            A[j, i] += value / 2
        constraints.append(A)

    for vectors in (index.T, index):  # columns, then rows
        for a in vectors:
            add({**{(i, i): 1.0 for i in a}, (9, 9): -1.0})
        for a, b in combinations(vectors, 2):
            add(dict.fromkeys(zip(a, b, strict=True), 1.0))
    for k, i in product(range(3), range(3)):  # column k x column k+1 = column k+2
        a, b, c = index[:, k], index[:, (k + 1) % 3], index[:, (k + 2) % 3]
        j, m = (i + 1) % 3, (i + 2) % 3
        add({(a[j], b[m]): 1.0, (a[m], b[j]): -1.0, (c[i], 9): -1.0})
    return np.array(constraints)


@lru_cache(maxsize=1)
def _dual_matrices() -> Floats:
    """(22, 10, 10): the constraints, and E_10,10."""
    last = np.zeros((1, 10, 10))
    last[0, 9, 9] = 1.0
    return np.concatenate([rotation_constraints(), last])


def _side_form(R: Floats) -> Floats:
    """(13, 13) form of g in [vec R; t; 1], for R* (3, 3): see the module."""
    form = np.zeros((13, 13))
    form[9, 12] = form[12, 9] = -0.5
    form[9, 0:9:3] = form[0:9:3, 9] = 0.5 * R[0]
    return form


def _triangle(n: int) -> tuple[Ints, Ints, Floats]:
    """Rows, columns and factors of a symmetric (n, n) matrix column by column, as Clarabel packs it."""
    j, i = np.tril_indices(n)
    return i, j, np.where(i == j, 1.0, np.sqrt(2.0))


def _solve_clarabel(Q: Floats, matrices: Floats, not_negative: int) -> tuple[Floats, Floats]:
    """Solve the dual: multipliers (K,) of matrices (K, n, n), the first few of them not negative; and X (n, n)."""
    import clarabel
    from scipy import sparse

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    n, k = len(Q), len(matrices)
    i, j, factor = _triangle(n)
    A = sparse.csc_matrix(np.vstack([(matrices[:, i, j] * factor).T, -np.eye(not_negative, k)]))
    b = np.concatenate([Q[i, j] * factor, np.zeros(not_negative)])
    objective = np.zeros(k)
    objective[-1] = -1.0
    cones = [clarabel.PSDTriangleConeT(n), clarabel.NonnegativeConeT(not_negative)][: 1 + (not_negative > 0)]
    solution = clarabel.DefaultSolver(sparse.csc_matrix((k, k)), objective, A, b, cones, settings).solve()
    X = np.zeros((n, n))
    X[i, j] = X[j, i] = np.array(solution.z)[: len(i)] / factor
    return np.array(solution.x), X


def _solve_cvxpy(Q: Floats, matrices: Floats, not_negative: int) -> tuple[Floats, Floats]:
    """Solve the primal by the modelling layer; arguments and results as of `_solve_clarabel`."""
    try:
        import cvxpy
    except ImportError as cause:
        raise missing_extra("cvxpy", "sdp", cause) from cause
    X = cvxpy.Variable(Q.shape, PSD=True)
    values = [cvxpy.sum(cvxpy.multiply(A, X)) for A in matrices]
    *equal, one = values[not_negative:]
    limits = [value >= 0 for value in values[:not_negative]]
    constraints = [*limits, *(value == 0 for value in equal), one == 1]
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum(cvxpy.multiply(Q, X))), constraints)
    problem.solve(solver=cvxpy.CLARABEL)
    if X.value is None:
        raise EstimationError("cvxpy found no solution of the relaxation")
    multipliers = np.array([float(constraint.dual_value) for constraint in constraints])
    return np.where(np.arange(len(multipliers)) < not_negative, multipliers, -multipliers), np.asarray(X.value)


def project_rotation(M: Floats) -> Floats:
    """Return the rotation (3, 3) nearest to a matrix (3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def eliminate_translation(Q: Floats, kept: Sequence[int] = ()) -> tuple[Floats, Floats]:
    """Minimise forms (..., 13, 13) in [vec R; t; 1] over t.

    Args:
        Q: (..., 13, 13) the forms, in the cost's unit.
        kept: components of t that stay.

    Returns:
        The forms (..., 10 + k, 10 + k) in x = [vec R; what is kept of t; 1], in that unit, and K with the best rest of
        t, K x.
    """
    gone = [9 + axis for axis in range(3) if axis not in kept]
    rest = [k for k in range(13) if k not in gone]
    B, C = Q[..., gone, :][..., gone], Q[..., gone, :][..., rest]
    # A direction that no row constrains takes t = 0 there: the smallest solution.
    K = -np.linalg.pinv(B, rcond=1e-13, hermitian=True) @ C
    form = Q[..., rest, :][..., rest] + np.swapaxes(C, -1, -2) @ K
    return 0.5 * (form + np.swapaxes(form, -1, -2)), np.asarray(K)


def lower_bound(Q: Floats, backend: Backend = "clarabel", R_in_front: Floats | None = None) -> Bound:
    """Bound a quadratic cost over rigid transforms from below: over all, or those with the sensor on the -x side.

    Args:
        Q: (13, 13) symmetric positive semidefinite, cost [z; 1]^T Q [z; 1], z = [vec R (column-major); t].
        backend: "cvxpy": the modelling layer above the same solver; any other: Clarabel, since no pose is known.
        R_in_front: (3, 3) rotation R* (no unit) of a pose with the sensor on the -x side: then only such poses are
            bounded, tightly where it is the best of them. None: all are.

    Raises:
        InputError: a backend that does not exist.
        EstimationError: the cost vanishes for every rotation, so there is nothing to estimate.
    """
    if backend not in get_args(Backend):
        raise InputError(f"backend is {backend!r}; expected one of {', '.join(map(repr, get_args(Backend)))}")
    form, _ = eliminate_translation(Q)
    scale = float(np.trace(form))
    if not (np.isfinite(scale) and scale > 0):
        raise EstimationError("the measurements constrain no rotation at all")
    solve = _solve_cvxpy if backend == "cvxpy" else _solve_clarabel
    if R_in_front is None:
        multipliers, X = solve(form / scale, _dual_matrices(), 0)
    else:
        side = _side_form(R_in_front)
        multipliers, X = _solve_in_front(Q / scale, side, solve)
        form, _ = eliminate_translation(Q - scale * multipliers[0] * side)
        multipliers = multipliers[1:]
    Z = form / scale - np.tensordot(multipliers, _dual_matrices(), axes=1)
    eigenvalues = np.linalg.eigvalsh(Z)
    bound = multipliers[-1] + SQUARED_NORM * min(0.0, eigenvalues[0])
    return Bound(bound * scale, float(eigenvalues[1]) * scale, X)


def _solve_in_front(
    Q: Floats, side: Floats, solve: Callable[[Floats, Floats, int], tuple[Floats, Floats]]
) -> tuple[Floats, Floats]:
    """Multipliers, nu first, and X (10, 10), of the relaxation that keeps t_x, in a unit in which it weighs like R."""
    form, _ = eliminate_translation(Q, kept=[0])
    rotation = [*range(9), 10]
    unit = np.ones(11)
    unit[9] = np.sqrt(max(np.trace(form[:9, :9]), 1e-300) / max(form[9, 9], 1e-300))
    embedded = np.zeros((22, 11, 11))
    embedded[np.ix_(range(22), rotation, rotation)] = _dual_matrices()
    g = np.outer(unit, unit) * np.delete(np.delete(side, [10, 11], axis=0), [10, 11], axis=1)
    size = np.abs(g).max()
    multipliers, X = solve(np.outer(unit, unit) * form, np.concatenate([g[None] / size, embedded]), 1)
    multipliers[0] = max(multipliers[0], 0.0) / size
    return multipliers, X[np.ix_(rotation, rotation)]


def solve_relaxation(Q: Floats, backend: Backend = "clarabel") -> Relaxation:
    """Minimise a quadratic cost over all rigid transforms by its relaxation; see `lower_bound`."""
    dual = lower_bound(Q, backend)
    _, K = eliminate_translation(Q)
    leading = np.linalg.eigh(dual.X)[1][:, -1]
    R = project_rotation((leading[:9] / leading[9]).reshape(3, 3).T)
    T = transform(R, K @ np.append(R.T.ravel(), 1.0))
    values, vectors = np.linalg.eigh(Q)
    measurement = TemplateMeasurement.from_stack(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T, 13, T)
    T = refine(measurement)
    return Relaxation(T, 2.0 * measurement.error(T), dual.bound)
