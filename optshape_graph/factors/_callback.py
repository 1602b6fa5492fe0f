"""Python callbacks as GTSAM factors, checked: GTSAM itself crashes or errs silently on what is refused here."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError
from optshape_graph.factors._rows import checked_keys
from optshape_graph.se3 import adjoint, inverse

Residual = Callable[[gtsam.Values], tuple[Floats, Sequence[Floats]]]
"""Values to a whitened residual (m,) and its Jacobians (m, d_i), one per key."""


def CheckedFactor(function: Residual, n_rows: int, keys: Sequence[int], dims: Sequence[int]) -> gtsam.CustomFactor:
    """Return a factor that evaluates `function`, whose shapes and finiteness are checked at every call.

    A Jacobian of the wrong height or rank crashes GTSAM, one of the wrong width is silently wrong, and a NaN makes
    its optimisers return the initial values: here each raises, before anything is handed over.

    Args:
        function: values to the whitened residual and its Jacobians. It must not refer to the factor itself.
        n_rows: m, the residual's length.
        keys: the variables.
        dims: tangent dimension of each variable.

    Raises:
        InputError: keys that are no keys, or the same twice.
        EstimationError: at evaluation, when the function returns what GTSAM cannot take.
    """
    checked_keys(*keys)
    shapes = [(n_rows, dim) for dim in dims]

    def evaluate(this: gtsam.CustomFactor, values: gtsam.Values, H: gtsam.JacobianVector | None) -> Floats:
        residual, jacobians = function(values)
        found = [np.shape(J) for J in jacobians]
        if np.shape(residual) != (n_rows,) or found != shapes:
            raise EstimationError(
                f"factor on {_names(this.keys())}: residual {np.shape(residual)} with Jacobians {found}; "
                f"expected ({n_rows},) with {shapes}"
            )
        if not (np.isfinite(residual).all() and all(np.isfinite(J).all() for J in jacobians)):
            raise EstimationError(f"factor on {_names(this.keys())}: its residual or Jacobian is not finite")
        if H is not None:
            for i, J in enumerate(jacobians):
                H[i] = J
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(n_rows), list(keys), evaluate)


def relative_pose(values: gtsam.Values, keys: Sequence[int]) -> tuple[Floats, list[Floats]]:
    """Return H = T_target_lidar and its derivatives (6, 6) by the poses of `keys`.

    Args:
        values: the current values.
        keys: (k,), k holding T_target_lidar itself, or (k_target, k_lidar), the poses T_world_target and
            T_world_lidar. With H = X^-1 T, dH/dT = I and dH/dX = -Ad(H^-1).
    """
    if len(keys) == 1:
        return values.atPose3(keys[0]).matrix(), [np.eye(6)]
    H = values.atPose3(keys[0]).between(values.atPose3(keys[1])).matrix()
    return H, [-adjoint(inverse(H)), np.eye(6)]


def _names(keys: Sequence[int]) -> str:
    return ", ".join(gtsam.DefaultKeyFormatter(key) for key in keys)
