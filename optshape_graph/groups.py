"""Consecutive rows of arrays, in groups: the returns of each ring, those of each scan, the rings of each scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value

Rows = TypeVar("Rows", Floats, Ints, Bools)


@dataclass(frozen=True, eq=False, repr=False)
class Groups(Value):
    """How many rows of an array (N, ...) belong to each of G groups, one group after the other.

    Attributes:
        counts: (G,) rows of each group, at least one.
    """

    counts: Ints

    @classmethod
    def of(cls, arrays: Sequence[Floats] | Sequence[Ints]) -> Groups:
        """Return the groups of rows of arrays (N_g, ...), numbers, that are stacked."""
        return cls(np.array([len(array) for array in arrays], dtype=np.int64))

    def __len__(self) -> int:
        return len(self.counts)

    @cached_property
    def first(self) -> Ints:
        """(G,) first row of each group."""
        return np.asarray(self.counts.cumsum() - self.counts)

    @cached_property
    def last(self) -> Ints:
        """(G,) last row of each group."""
        return np.asarray(self.first + self.counts - 1)

    @cached_property
    def of_row(self) -> Ints:
        """(N,) number of the group of each row."""
        return self.each(np.arange(len(self)))

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of each group."""
        return [slice(first, last + 1) for first, last in zip(self.first.tolist(), self.last.tolist(), strict=True)]

    def each(self, values: Rows) -> Rows:
        """Return numbers (G, ...) of groups for each of their rows (N, ...)."""
        return values.repeat(self.counts, axis=0)

    def sum(self, values: Floats | Bools) -> Floats:
        """Return the sums (G, ...) of numbers (N, ...) over groups."""
        return np.add.reduceat(values, self.first, axis=0, dtype=float)

    def mean(self, values: Floats | Bools) -> Floats:
        """Return the means (G,) of numbers (N,) over groups."""
        return np.asarray(self.sum(values) / self.counts)

    def median(self, values: Floats, among: Bools | None = None) -> Floats:
        """Return the medians (G,) of numbers (N,) in groups, among some (N,) of them; infinite where there are none."""
        ordered = values.copy() if among is None else np.where(among, values, np.inf)
        counts = self.counts if among is None else np.asarray(self.sum(among), dtype=np.int64)
        for rows in self.slices:
            ordered[rows].sort()
        lower, upper = self.first + np.maximum(counts - 1, 0) // 2, np.minimum(self.first + counts // 2, self.last)
        return np.where(counts > 0, 0.5 * (ordered[lower] + ordered[upper]), np.inf)

    def products(self, a: Floats, b: Floats) -> Floats:
        """Return a^T b (G, J, K) of each group, of rows of numbers a (N, J) and b (N, K)."""
        return np.stack([a[rows].T @ b[rows] for rows in self.slices])


@dataclass(frozen=True, eq=False, repr=False)
class Layout(Value):
    """How the rows of returns lie in arrays: scan by scan, and ring by ring within each.

    Attributes:
        rings: the returns of each ring.
        rings_of_scan: the rings of each scan.
    """

    rings: Groups
    rings_of_scan: Groups

    @classmethod
    def side_by_side(cls, layouts: Sequence[Layout]) -> Layout:
        """Return the layout of the rows of several, one after the other."""
        if len(layouts) == 1:
            return layouts[0]
        rings, scans = zip(*((one.rings.counts, one.rings_of_scan.counts) for one in layouts), strict=True)
        return cls(Groups(np.concatenate(rings)), Groups(np.concatenate(scans)))

    def __len__(self) -> int:
        return len(self.rings_of_scan)

    def of_scan(self, scan: int) -> Layout:
        """Return the layout of one of the scans."""
        if len(self) == 1:
            return self
        rings = self.rings.counts[self.rings_of_scan.slices[scan]]
        return Layout(Groups(rings), Groups(self.rings_of_scan.counts[scan : scan + 1]))

    @cached_property
    def scans(self) -> Groups:
        """The returns of each scan."""
        return Groups(np.add.reduceat(self.rings.counts, self.rings_of_scan.first))
