"""Candidate poses worked out: each association of ring ends to edges once, and those next to a posterior's."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.compiled import library
from optshape_graph.pose.ends.compiled import propagate_compiled
from optshape_graph.pose.ends.posterior import Posterior
from optshape_graph.pose.ends.propagation import other_edges, propagate, with_what_is_left_out
from optshape_graph.pose.ends.ring_ends import RingEnds


def work_out(ends: RingEnds, scan: Ints, T: Floats, labels: Ints | None, sweeps: int) -> tuple[Ints, Posterior]:
    """Find the posterior about each of some poses, each association of a scan once, as first listed.

    Args:
        ends: of B scans.
        scan: (C,) that each pose is of, ascending.
        T: (C, 4, 4) T_target_lidar to start from.
        labels: (C, M) edge of each ring end; None, and -1: as `RingEnds.geometry` finds them.
        sweeps: of expectation propagation.

    Returns:
        The scan (K,) of each posterior, and the posteriors.
    """
    geometry = ends.geometry(T, labels, scan)
    once = firsts(scan, geometry.labels)
    scan, T, geometry = scan[once], T[once], geometry.select(once)
    functions = library()
    if functions is not None:
        return scan, propagate_compiled(functions, ends, scan, T, geometry, sweeps)
    ends = ends.take(scan)
    return scan, with_what_is_left_out(ends, propagate(ends, T, geometry, sweeps))


def firsts(scan: Ints, labels: Ints) -> Ints:
    """Indices (K,) at which each association, labels (C, M) in scans (C,), is listed first."""
    found: dict[tuple[int, bytes], int] = {}
    for k, (of, mine) in enumerate(zip(scan.tolist(), labels, strict=True)):
        found.setdefault((of, mine.tobytes()), k)
    return np.array(list(found.values()))


def alternative_labels(ends: RingEnds, posterior: Posterior, limit: int) -> list[Ints]:
    """Labels (V, M) of the associations that differ from a posterior's in one edge point near a vertex, for each of C.

    Args:
        ends: of the scan that each pose is of, or of the one that all are of.
        posterior: of C poses.
        limit: at most so many, those nearest to a vertex.
    """
    beyond, _ = other_edges(ends, posterior)
    nearest = beyond.argmax(axis=-1)
    reach = 0.5 * (np.abs(posterior.geometry.along) * ends.width + posterior.geometry.across)
    closeness = np.where(ends.there, -beyond.max(axis=-1) / (posterior.sigma + reach), np.inf)
    found = []
    for k, order in enumerate(np.argsort(closeness, axis=-1)[:, :limit]):
        order = order[closeness[k, order] < 1.0]
        labels = np.repeat(posterior.geometry.labels[k : k + 1], len(order), axis=0)
        labels[np.arange(len(order)), order] = nearest[k, order]
        found.append(labels)
    return found
