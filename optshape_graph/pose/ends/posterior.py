"""Gaussian posteriors of the poses of targets, and the ring ends about them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, Padding


@dataclass(frozen=True, eq=False, repr=False)
class Posterior(Value):
    """Gaussian posteriors about C poses.

    Attributes:
        T_target_lidar: (C, 4, 4).
        covariance: (C, 6, 6) of the right perturbation of T_target_lidar, rotation first.
        joint: (C, 7, 7) of that and the offset, in beam widths.
        offset: (C,) common offset across the edges, in units of the beam's width; positive: the returns lie further in.
        geometry: edge points at these poses.
        inset: (C, M) distance along the ring from each edge point to the boundary, rad, offset and shift apart.
        shift: (C, M) outward motion of each edge point with its ring, where azimuths are noisy, and by blooming, rad.
        sigma: (C, M) standard deviation across the edge, metres, that stands for each interval.
        log_likelihood: (C,) logarithm of the probability of the edge points, and of what else of the scan was taken
            into account, up to a constant of the scan.
    """

    T_target_lidar: Floats
    covariance: Floats
    joint: Floats
    offset: Floats
    geometry: EdgeGeometry
    inset: Floats
    shift: Floats
    sigma: Floats
    log_likelihood: Floats

    def select(self, index: Ints | slice, ends: int | None = None) -> Posterior:
        """Return some of the posteriors, of some of the edge points.

        Args:
            index: a slice of the posteriors, or (K,).
            ends: number of edge points, where those after are padding; None: all.
        """
        return _made(lambda values: values[0][index, :ends], lambda values: values[0][index], [self])


def concatenate(posteriors: Sequence[Posterior]) -> Posterior:
    """Return the posteriors of all, padded to as many edge points."""
    if len(posteriors) == 1:
        return posteriors[0]
    padding = Padding.of([one.inset.shape[1] for one in posteriors for _ in one.inset])

    def of_ends(values: Sequence[Floats]) -> Floats:
        return padding.padded([value.reshape(-1, *value.shape[2:]) for value in values])

    return _made(np.concatenate if padding.there.all() else of_ends, np.concatenate, posteriors)


_OF_ENDS = ("inset", "shift", "sigma")
_Make = Callable[[Sequence[Floats]], Floats]


def _made(of_ends: _Make, of_poses: _Make, posteriors: Sequence[Posterior]) -> Posterior:
    """Make each array of a posterior of the same arrays of some others, those of edge points (C, M, ...) in one way."""

    def arrays(names: Iterable[str], records: Sequence[Any], make: _Make) -> dict[str, Any]:
        return {name: make([getattr(record, name) for record in records]) for name in names}

    names = [name for name in vars(posteriors[0]) if name not in (*_OF_ENDS, "geometry")]
    geometries = [posterior.geometry for posterior in posteriors]
    return Posterior(
        geometry=EdgeGeometry(**arrays(vars(geometries[0]), geometries, of_ends)),
        **arrays(_OF_ENDS, posteriors, of_ends),
        **arrays(names, posteriors, of_poses),
    )
