"""Returns of several scans side by side, ring by ring: sorted once, for all that asks about rings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.groups import Groups, Layout
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel


@dataclass(frozen=True, eq=False, repr=False)
class RingReturns(Value):
    """N returns on R rings of B scans: by scan, by ring from the lowest up, and from the left to the right.

    Attributes:
        points: (N, 3) metres, LiDAR frame.
        azimuth: (N,) relative to `reference`, falling within each ring, rad.
        row: (N,) of each return in its scan.
        ring: (R,) number of each ring in its scan.
        reference: (B,) azimuth of the mean direction of each scan's returns, rad.
        layout: which of them are of which ring, and of which scan.
        made_from: (B,) the scans.
    """

    points: Floats
    azimuth: Floats
    row: Ints
    ring: Ints
    reference: Floats
    layout: Layout
    made_from: tuple[Scan, ...]

    @classmethod
    def of(cls, scans: Sequence[Scan], rings: Sequence[Ints] | None = None) -> RingReturns:
        """Sort the returns of scans.

        Args:
            scans: (B,) each with a return at least.
            rings: (B,) what stands for the ring of each return, (N_b,); None: the rings that the scans have.
        """
        if rings is None:
            rings = [scan.ring for scan in scans if scan.ring is not None]
        points, in_scan = np.concatenate([scan.points for scan in scans]), Groups.of(rings)
        azimuth, reference = relative_azimuths(points, in_scan)
        ring = np.concatenate(rings)
        many = int(ring.max()) + 1
        key = in_scan.of_row * many + ring
        order = np.lexsort((-azimuth, key))
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        scan, number = np.divmod(key[order[first]], many)
        return cls(
            points=points[order],
            azimuth=azimuth[order],
            row=order - in_scan.each(in_scan.first),
            ring=number,
            reference=reference,
            layout=Layout(Groups(np.diff(first, append=len(key))), Groups(np.bincount(scan, minlength=len(scans)))),
            made_from=tuple(scans),
        )

    @property
    def rings(self) -> Groups:
        """The returns of each ring."""
        return self.layout.rings

    @property
    def rings_of_scan(self) -> Groups:
        """The rings of each scan."""
        return self.layout.rings_of_scan

    @property
    def scans(self) -> Groups:
        """The returns of each scan."""
        return self.layout.scans

    @property
    def sensors(self) -> list[SensorModel | None]:
        """(B,) that made the scans, None where it is unknown."""
        return [scan.sensor for scan in self.made_from]

    @cached_property
    def elevation(self) -> Floats:
        """(N,) rad."""
        return np.arctan2(self.points[:, 2], np.hypot(self.points[:, 0], self.points[:, 1]))

    @cached_property
    def gap(self) -> Floats:
        """(N,) azimuth from each return to the next one on its ring, rad; 0 from the last one."""
        gap = self.azimuth.copy()
        gap[:-1] -= self.azimuth[1:]
        gap[self.rings.last] = 0.0
        return gap

    def of_scan(self, scan: int) -> RingReturns:
        """Return those of one of the scans."""
        if len(self.layout) == 1:
            return self
        rows, rings, one = self.scans.slices[scan], self.rings_of_scan.slices[scan], slice(scan, scan + 1)
        return RingReturns(
            points=self.points[rows], azimuth=self.azimuth[rows], row=self.row[rows], ring=self.ring[rings],
            reference=self.reference[one], layout=self.layout.of_scan(scan), made_from=self.made_from[one],
        )  # fmt: skip

    def moved(self, points: Floats) -> RingReturns:
        """Return them at other places (N, 3), metres, in the same order within rings."""
        azimuth, reference = relative_azimuths(points, self.scans)
        return replace(self, points=points, azimuth=azimuth, reference=reference)

    def sorted_scans(self) -> list[Scan]:
        """Return the scans with their returns where and in the order in which they are here."""
        return [
            scan.select(self.row[rows], self.points[rows])
            for scan, rows in zip(self.made_from, self.scans.slices, strict=True)
        ]


def relative_azimuths(points: Floats, scans: Groups) -> tuple[Floats, Floats]:
    """Return the azimuths of returns relative to their scan's mean direction; correct across the +-180 degree seam.

    Args:
        points: (N, 3) metres, LiDAR frame.
        scans: the returns of each of B scans.

    Returns:
        (N,) rad in [-pi, pi], and the azimuths (B,) of the mean directions, rad.
    """
    x, y, _ = points.T
    flat = np.maximum(np.hypot(x, y), 1e-12)
    reference = np.arctan2(scans.sum(y / flat), scans.sum(x / flat))
    c, s = scans.each(np.cos(reference)), scans.each(np.sin(reference))
    return np.arctan2(c * y - s * x, c * x + s * y), reference
