"""Expectation propagation by the compiled library: what `propagation` does in NumPy, in one call for all candidates."""

from __future__ import annotations

from ctypes import CDLL

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.compiled import address, structure
from optshape_graph.pose.ends.posterior import Posterior
from optshape_graph.pose.ends.propagation import DAMPING, GRAZING, INWARDS, LARGEST_STEP, WEAK_PRIOR
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, RingEnds

_MODEL = structure(INWARDS, GRAZING, LARGEST_STEP, DAMPING, *np.diag(WEAK_PRIOR).tolist())


def propagate_compiled(
    functions: CDLL, ends: RingEnds, scan: Ints, T: Floats, geometry: EdgeGeometry, sweeps: int
) -> Posterior:
    """Find the posterior about each of C poses, as `propagate` does, with what it leaves out.

    Args:
        functions: the library.
        ends: of B scans.
        scan: (C,) of each pose.
        T: (C, 4, 4) T_target_lidar to start from.
        geometry: of the ring ends there.
        sweeps: updates of all edge points.
    """
    count, of_ends = len(T), (len(T), ends.there.shape[1])
    posterior = Posterior(
        T_target_lidar=np.empty((count, 4, 4)),
        covariance=np.empty((count, 6, 6)),
        joint=np.empty((count, 7, 7)),
        offset=np.empty(count),
        geometry=geometry,
        inset=np.empty(of_ends),
        shift=np.empty(of_ends),
        sigma=np.empty(of_ends),
        log_likelihood=np.empty(count),
    )
    poses, seen = np.ascontiguousarray(T), structure(*vars(geometry).values())
    out = structure(*(value for value in vars(posterior).values() if value is not geometry))
    before = (*map(address, (ends.laid_out[0], _MODEL)), count, *map(address, (scan, poses, seen)))
    if functions.propagate(*before, sweeps, address(out)):
        raise MemoryError
    return posterior
