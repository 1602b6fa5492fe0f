"""The certificate: a lower bound on the cost of every pose, from the dual of a semidefinite relaxation.

With t eliminated, the cost of a measurement is a quadratic form in x = [vec R; 1]. The relaxation of Briales and
Gonzalez-Jimenez (CVPR 2017) replaces x x^T by any positive semidefinite X that satisfies the 21 quadratic
constraints of a rotation (rows and columns orthonormal, right-handed) and X_10,10 = 1. Its dual,

    maximise mu  subject to  Z = Q - mu E_10,10 - sum_i lambda_i A_i  positive semidefinite,

bounds the cost of every rotation from below. A multiplier that is not quite feasible still gives a bound: x^T Z x
is at least 4 min(0, lambda_min(Z)), since |x|^2 = 4 for every rotation. Where a minimum is known, multipliers that are
tight there are written down; where they do not do, and where no pose is known, a solver finds them.

Written down, for a minimum R*:

1. R = W R* takes the cost to a form F in w = [vec W; 1], whose minimum is at W = I, and keeps the constraints.
2. Subtract the cost, and Gamma : (W^T W - I) with Gamma the symmetric part of the gradient at I. What is left, Z, and
   its gradient vanish at W = I. (W W^T serves as well as W^T W, and so does the mean of both.)
3. The points of a planar target lie in x = 0, so F says nothing of the first column of W. Two constraints that vanish
   on rotations, with zero gradient at I, lend it some of what F says of the other two columns:

       C = W_yx^2 + W_zx^2 - W_xy^2 - W_xz^2,    D = (W_xx - 1)^2 - (W_yy - W_zz)^2 - (W_yz + W_zy)^2.

   Z + c C + d D stays positive on those columns where c / c_max + d / d_max < 1; 0.45 of each is taken.
4. The smallest eigenvalue of the (10, 10) sum decides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product
from typing import Any, Literal, get_args

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.errors import EstimationError, InputError, missing_extra
from optshape_graph.factors.measurement import TemplateMeasurement, refine
from optshape_graph.se3 import rotation, transform

Backend = Literal["closed-form", "clarabel", "cvxpy"]
"""What finds the multipliers: closed-form where that certifies the pose, else Clarabel; Clarabel; Clarabel by cvxpy."""

BEHIND = 9.0
"""Excess of cost, in squared standard deviations, up to which a pose from behind counts as fitting as well."""

_SQUARED_NORM = 4.0  # of x = [vec R; 1], for every rotation
_UPPER = np.array([(i, j) for j in range(10) for i in range(j + 1)])  # column by column, as Clarabel packs

_SHARE = 0.45
"""Of c_max and d_max: the two together leave a tenth of what the form says of the last two columns of W."""

_TIGHT = 1e-11
"""Gap, relative to the trace of the form, below which other multipliers would gain nothing."""

_ROUNDING = 1e-12
"""Second eigenvalue, relative to the trace of the form, that is rounding."""

_I = np.append(np.eye(3).ravel(), 1.0)  # [vec W; 1] at W = I; W_ij is entry 3 j + i
_LAST_COLUMNS = np.array([3, 4, 5, 6, 7, 8])
_PLANE = np.zeros((10, 2))  # W_xy, W_xz
_PLANE[3, 0] = _PLANE[6, 1] = 1.0
_STRAIN = np.zeros((10, 2))  # W_yy - W_zz, W_yz + W_zy
_STRAIN[[4, 8, 5, 7], [0, 0, 1, 1]] = 1.0, -1.0, 1.0, 1.0
_FIRST = np.zeros(10)  # W_xx - 1
_FIRST[[0, 9]] = 1.0, -1.0
_C = np.diag([0.0, 1.0, 1.0, 0, 0, 0, 0, 0, 0, 0]) - _PLANE @ _PLANE.T
_D = np.outer(_FIRST, _FIRST) - _STRAIN @ _STRAIN.T


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


def _pack(matrices: Floats) -> Floats:
    """Pack symmetric (..., 10, 10) as (..., 55), off-diagonal entries scaled by sqrt 2."""
    i, j = _UPPER.T
    return np.asarray(matrices[..., i, j] * np.where(i == j, 1.0, np.sqrt(2.0)))


def _unpack(packed: Floats) -> Floats:
    X = np.zeros((10, 10))
    i, j = _UPPER.T
    X[i, j] = X[j, i] = packed / np.where(i == j, 1.0, np.sqrt(2.0))
    return X


@lru_cache(maxsize=1)
def _clarabel_problem() -> tuple[Any, Any, Any, Any]:
    import clarabel
    from scipy import sparse

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    A = sparse.csc_matrix(_pack(_dual_matrices()).T)
    return sparse.csc_matrix((22, 22)), A, [clarabel.PSDTriangleConeT(10)], settings


def _solve_clarabel(Q: Floats) -> tuple[Floats, Floats]:
    import clarabel

    P, A, cones, settings = _clarabel_problem()
    objective = np.zeros(22)
    objective[-1] = -1.0
    solution = clarabel.DefaultSolver(P, objective, A, _pack(Q), cones, settings).solve()
    return np.array(solution.x), _unpack(np.array(solution.z))


def _solve_cvxpy(Q: Floats) -> tuple[Floats, Floats]:
    try:
        import cvxpy
    except ImportError as cause:
        raise missing_extra("cvxpy", "sdp", cause) from cause
    X = cvxpy.Variable((10, 10), PSD=True)
    equations = [cvxpy.sum(cvxpy.multiply(A, X)) == 0 for A in rotation_constraints()] + [X[9, 9] == 1]
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum(cvxpy.multiply(Q, X))), equations)
    problem.solve(solver=cvxpy.CLARABEL)
    if X.value is None:
        raise EstimationError("cvxpy found no solution of the relaxation")
    return -np.array([float(equation.dual_value) for equation in equations]), np.asarray(X.value)


def project_rotation(M: Floats) -> Floats:
    """Return the rotation (3, 3) nearest to a matrix (3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)


def eliminate_translation(Q: Floats) -> tuple[Floats, Floats]:
    """Minimise a form (13, 13) in [vec R; t; 1] over t.

    Returns:
        The form (10, 10) in x = [vec R; 1], and K (3, 10) with the best t = K x.
    """
    rest = np.r_[0:9, 12]
    B = Q[9:12, 9:12]
    # A direction that no row constrains takes t = 0 there: the smallest solution.
    K = -np.linalg.lstsq(B, Q[9:12][:, rest], rcond=1e-13)[0]
    form = Q[np.ix_(rest, rest)] + Q[rest][:, 9:12] @ K
    return 0.5 * (form + form.T), np.asarray(K, dtype=np.float64)


def lower_bound(Q: Floats, backend: Backend = "clarabel") -> Bound:
    """Bound a quadratic cost over all rigid transforms from below.

    Args:
        Q: (13, 13) symmetric positive semidefinite, cost [z; 1]^T Q [z; 1], z = [vec R (column-major); t].
        backend: "cvxpy": the modelling layer above the same solver; any other: Clarabel, since no pose is known.

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
    scaled = form / scale
    multipliers, X = (_solve_cvxpy if backend == "cvxpy" else _solve_clarabel)(scaled)
    Z = scaled - np.tensordot(multipliers, _dual_matrices(), axes=1)
    eigenvalues = np.linalg.eigvalsh(Z)
    bound = multipliers[-1] + _SQUARED_NORM * min(0.0, eigenvalues[0])
    return Bound(bound * scale, float(eigenvalues[1]) * scale, X)


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


def closed_form_bounds(forms: Floats, rotations: Floats) -> tuple[Floats, Floats]:
    """Bound quadratic costs over all rotations from below, by multipliers that are tight at known minima.

    Args:
        forms: (B, 10, 10) costs x^T F x of x = [vec R (column-major); 1].
        rotations: (B, 3, 3) rotations, a minimum of each cost; elsewhere the bound still holds, but is far below.

    Returns:
        The bounds (B,), -inf where the form leaves the last two columns of W undetermined; and the second smallest
        eigenvalue (B,) of the dual's matrix, in the cost's unit, 0 where it is rounding.
    """
    count = len(forms)
    scale = np.trace(forms, axis1=1, axis2=2)
    to_identity = np.zeros((count, 10, 10))
    to_identity[:, :9, :9] = _kronecker(np.swapaxes(rotations, 1, 2), np.eye(3)[None])
    to_identity[:, 9, 9] = 1.0
    F = np.swapaxes(to_identity, 1, 2) @ (forms / scale[:, None, None]) @ to_identity
    gradient = F @ _I
    cost = gradient @ _I
    by_entry = gradient[:, :9].reshape(count, 3, 3)
    Gamma = 0.5 * (by_entry + np.swapaxes(by_entry, 1, 2))

    bound, second = np.full(count, -np.inf), np.zeros(count)
    for of_columns in (1.0, 0.0, 0.5):  # W^T W, W W^T, the mean of both
        left = np.flatnonzero(cost - bound > _TIGHT)
        if not len(left):
            break
        Z = F[left] - _gram(Gamma[left], of_columns)
        Z[:, 9, 9] -= cost[left]
        lent, determined = _lent(Z)
        eigenvalues = np.linalg.eigvalsh(Z + lent)
        found = np.where(determined, cost[left] + 4.0 * np.minimum(0.0, eigenvalues[:, 0]), -np.inf)
        better = found > bound[left]
        bound[left[better]] = found[better]
        second[left[better]] = np.where(eigenvalues[better, 1] > _ROUNDING, eigenvalues[better, 1], 0.0)
    return bound * scale, second * scale


def _kronecker(A: Floats, B: Floats) -> Floats:
    """Return the Kronecker products (K, 9, 9) of matrices (K, 3, 3)."""
    return np.asarray((A[:, :, None, :, None] * B[:, None, :, None, :]).reshape(-1, 9, 9))


def _gram(Gamma: Floats, of_columns: float) -> Floats:
    """Return the forms (K, 10, 10) of Gamma : (G - I), G = W^T W for a share `of_columns` and W W^T for the rest."""
    one = np.eye(3)[None]
    form = np.zeros((len(Gamma), 10, 10))
    form[:, :9, :9] = of_columns * _kronecker(Gamma, one) + (1.0 - of_columns) * _kronecker(one, Gamma)
    form[:, 9, 9] = -np.trace(Gamma, axis1=1, axis2=2)
    return form


def _lent(Z: Floats) -> tuple[Floats, Bools]:
    """Return c C + d D (K, 10, 10) for forms Z (K, 10, 10), and where Z determines the last two columns of W (K,)."""
    block = Z[:, _LAST_COLUMNS[:, None], _LAST_COLUMNS]
    values, vectors = np.linalg.eigh(block)
    determined = values[:, 0] > 1e-12 * values[:, -1]
    inverse = (vectors / np.where(determined[:, None], values, 1.0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    share = [_SHARE / _largest(A[_LAST_COLUMNS].T @ inverse @ A[_LAST_COLUMNS]) for A in (_PLANE, _STRAIN)]
    return share[0][:, None, None] * _C + share[1][:, None, None] * _D, determined


def _largest(A: Floats) -> Floats:
    """Return the largest eigenvalues (K,) of symmetric matrices (K, 2, 2)."""
    half = 0.5 * (A[:, 0, 0] - A[:, 1, 1])
    return np.asarray(0.5 * (A[:, 0, 0] + A[:, 1, 1]) + np.hypot(half, A[:, 0, 1]))


@dataclass(frozen=True)
class Certificate:
    """How far a pose can be from the best one, for the association and the weights it was estimated with.

    Attributes:
        certified: the pose is the global minimum: its gap is small enough, by default (0.1 mm)^2 a residual, and the
            second eigenvalue says that there is no other.
        gap_m2: (cost of the pose - lower bound on the cost of every pose) / number of residual rows, weights
            normalised to mean 1, square metres.
        second_eigenvalue: second smallest eigenvalue of the dual's matrix, normalised alike, square metres.
    """

    certified: bool
    gap_m2: float
    second_eigenvalue: float


def certify(
    measurement: TemplateMeasurement,
    T_target_lidar: Floats,
    total_weight: float,
    backend: Backend = "closed-form",
    largest_gap: float = 1e-4,
) -> Certificate:
    """Certify a pose against every other one.

    Args:
        measurement: the whitened rows.
        T_target_lidar: (4, 4) the pose in question.
        total_weight: sum over rows of 1 / sigma^2, 1/m2: the gap is in whitened units before it is divided by it.
        backend: what finds the multipliers of the dual.
        largest_gap: metres a residual: root of the gap up to which the pose is certified.

    Raises:
        InputError: a backend that does not exist.
        EstimationError: the measurement constrains no rotation at all.
    """
    Q = measurement.quadratic()

    def judged(bound: float, second_eigenvalue: float) -> Certificate:
        gap = max(0.0, 2.0 * measurement.error(T_target_lidar) - bound) / total_weight
        second = second_eigenvalue / total_weight
        return Certificate(bool(gap <= largest_gap**2 and second > 0), gap, second)

    if backend == "closed-form":
        form, _ = eliminate_translation(Q)
        if np.trace(form) > 0:
            bound, second = closed_form_bounds(form[None], T_target_lidar[None, :3, :3])
            certificate = judged(float(bound[0]), float(second[0]))
            if certificate.certified:
                return certificate
    dual = lower_bound(Q, backend)
    return judged(dual.bound, dual.second_eigenvalue)


def why_not_certified(measurement: TemplateMeasurement) -> str:
    """Say in words what keeps a minimum, where the measurement was taken, from being certified as the only one.

    The relaxation does not know on which side of the target the sensor is: a pose from behind stops it like any other.
    """
    T, cost = measurement.T_target_lidar, 2.0 * measurement.error(measurement.T_target_lidar)
    for axis in np.eye(3)[1:]:
        behind = refine(measurement.at(transform(rotation(np.pi * axis)) @ T))
        if behind[0, 3] > 0 and 2.0 * measurement.error(behind) < cost + BEHIND:
            return "not certified: a pose seen from behind the target, which is impossible, fits these matches as well"
    return "not certified: the bound on other poses of these matches is not tight"
