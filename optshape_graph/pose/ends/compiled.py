"""Expectation propagation by the compiled library: what `propagation` is in NumPy, in one call for all candidates."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Ints
from optshape_graph.beam import Beam, outermost_table
from optshape_graph.compiled import address, library, structure
from optshape_graph.pose.ends.posterior import Posterior
from optshape_graph.pose.ends.propagation import DAMPING, GRAZING, INWARDS, LARGEST_STEP, WEAK_PRIOR
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, RingEnds

_ENDS = (
    "there", "points", "sweep", "leftward", "upward", "beam", "lower", "width", "step", "scatter", "elevation_sd",
    "azimuth_sd", "by_shift", "plane", "normals", "offsets", "vertices", "flatness", "beam_offset", "offset_sd",
    "lost_ends", "lost_span", "azimuth_step", "reference_azimuth", "beam_angle", "lost_rings", "silent", "elevations",
    "slowest",
)  # fmt: skip
"""Arrays of `RingEnds` in the order of the library's structure."""

_GEOMETRY = tuple(field.name for field in fields(EdgeGeometry))


@dataclass(frozen=True)
class Compiled:
    """The ring ends of B scans as the library has them.

    Attributes:
        library: the functions.
        shape: number of ring ends of each scan, padding included.
        ends: the structure, and
        model: the model's constants.
        kept: the arrays that both point to.
    """

    library: ctypes.CDLL
    shape: int
    ends: Ints
    model: Ints
    kept: tuple[NDArray[Any], ...]

    @classmethod
    def of(cls, ends: RingEnds) -> Self | None:
        """Hand over ring ends; None where there is no library."""
        functions = library()
        if functions is None:
            return None
        table = outermost_table()
        arrays = tuple(np.ascontiguousarray(getattr(ends, name)) for name in _ENDS)
        counts = (*ends.there.shape, ends.normals.shape[1], ends.by_shift.shape[2], ends.silent.shape[1])
        constants = (INWARDS, GRAZING, LARGEST_STEP, DAMPING, float(Beam.OWN), *np.diag(WEAK_PRIOR).tolist())
        model = structure(*constants, len(table[0]), *table)
        return cls(functions, ends.there.shape[1], structure(*counts, *arrays), model, (*arrays, *table))

    def geometry(self, scan: Ints, T: Floats, labels: Ints | None) -> EdgeGeometry:
        """Look at the ring ends of scans (C,) from poses (C, 4, 4), as `RingEnds.geometry` does."""
        shape = (len(T), self.shape)
        made = {name: np.empty((*shape, 3) if name == "direction" else shape) for name in _GEOMETRY[1:]}
        geometry = EdgeGeometry(np.full(shape, -1) if labels is None else labels.astype(np.int64), **made)
        self._call("edge_geometry", scan, T, geometry)
        return geometry

    def posterior(self, scan: Ints, T: Floats, geometry: EdgeGeometry, sweeps: int) -> Posterior:
        """Find the posterior about each of C poses (C, 4, 4) of scans (C,), with what `propagate` leaves out."""
        count, ends = len(T), (len(T), self.shape)
        posterior = Posterior(
            T_target_lidar=np.empty((count, 4, 4)),
            covariance=np.empty((count, 6, 6)),
            joint=np.empty((count, 7, 7)),
            offset=np.empty(count),
            geometry=geometry,
            inset=np.empty(ends),
            shift=np.empty(ends),
            sigma=np.empty(ends),
            log_likelihood=np.empty(count),
        )
        arrays = [value for value in vars(posterior).values() if value is not geometry]
        if self._call("propagate", scan, T, geometry, sweeps, structure(*arrays)):
            raise MemoryError
        return posterior

    def _call(self, name: str, scan: Ints, T: Floats, geometry: EdgeGeometry, *more: int | Ints) -> int:
        """Call a function of the library for candidates; its result."""
        laid = [
            self.ends,
            self.model,
            len(T),
            scan,
            np.ascontiguousarray(T),
            structure(*vars(geometry).values()),
            *more,
        ]
        arguments = [address(one) if isinstance(one, np.ndarray) else one for one in laid]
        return int(getattr(self.library, name)(*arguments))
