"""The likelihood of a scan by beams without width: no edge assigned, nothing linearised.

A ring of a convex polygon is a chord. In units of the azimuth step, it holds the firings of a grid from the first
beyond its right end to the last before its left end. The returns' mean azimuth says where those firings are, up to one
Gaussian error for the ring; where the grid lies is unknown, and uniform beforehand. So a ring with n returns has, at
a grid's place g, the density N(mean; g, sigma^2 / n) if the chord ends within one step beyond the outermost firings
(or, with a small probability, elsewhere: a return lost or too many), and a ring without returns has a chord that
fits between two firings, or was lost.

If the lasers fire on one grid, its place is common: rings are independent given it, and it is averaged over. If
they do not, each ring has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.chords import chords, sight_planes
from optshape_graph.compiled import address, library, structure
from optshape_graph.edges import EdgePoints
from optshape_graph.gaussian import logsumexp, ndtr
from optshape_graph.scan import Scan

_PLACES = 24  # of the grid within a step that are averaged over
_SEEN = 0.05  # a ring's place counts as known below this, in steps
_REACH = 3.5  # standard deviations of a ring's place that count
_OWN, _COMMON, _COMMON_AND_SEEN = range(3)  # whose grid firings are on, as the compiled library has it


@dataclass(frozen=True, eq=False, repr=False)
class Firings(Value):
    """What a scan says of chords, in azimuth steps.

    Attributes:
        left: (R,) last firing to the left of each ring that returned, number from the reference azimuth.
        right: (R,) last to the right, number likewise.
        shift: (R,) standard deviation of where they are, in units of steps.
        offset: (R,) azimuth of each ring's laser relative to the sensor's, in units of steps.
        elevations: (R,) of those rings, rad.
        empty: (O,) elevations of rings above and below them, that returned nothing, rad.
        empty_offset: (O,) azimuth of their lasers, in units of steps.
        lost_ends: probability that a ring's end is not where its last return says.
        lost_span: where it is then, in steps beyond the last firing.
        lost_ring: probability that a ring returns nothing whatever its chord.
        step: rad.
        reference_azimuth: rad.
    """

    left: Floats
    right: Floats
    shift: Floats
    offset: Floats
    elevations: Floats
    empty: Floats
    empty_offset: Floats
    lost_ends: float
    lost_span: tuple[float, float]
    lost_ring: float
    step: float
    reference_azimuth: float

    @classmethod
    def of(
        cls, scan: Scan, ends: EdgePoints, flatness: float, lost_ends: float, lost_span: tuple[float, float]
    ) -> Firings:
        """Collect it from a scan, and from its sensor's table.

        Args:
            scan: the returns of one target, with rings.
            ends: both ends of each ring, on the grid of firings.
            flatness: how far points of the target are where its drawing says, standard deviation, metres.
            lost_ends: probability that a ring's end is not where its last return says.
            lost_span: where it is then, in steps beyond the last firing.
        """
        step, rings = ends.azimuth_step, ends.ring[::2]
        x, y, z = ends.points[::2].T
        table = np.zeros(0) if scan.sensor is None else scan.sensor.elevations
        offsets = None if scan.sensor is None else scan.sensor.azimuth_offsets
        offsets = np.zeros(max(len(table), rings[-1] + 1)) if offsets is None else offsets / step
        outer = np.r_[: rings[0], rings[-1] + 1 : len(table)]
        return cls(
            left=ends.azimuth[::2] / step,
            right=ends.azimuth[1::2] / step,
            shift=np.maximum(ends.shift[::2], flatness / np.linalg.norm(ends.points[::2], axis=1)) / step,
            offset=offsets[rings],
            elevations=np.arctan2(z, np.hypot(x, y)),
            empty=table[outer],
            empty_offset=offsets[outer],
            lost_ends=lost_ends,
            lost_span=lost_span,
            lost_ring=ends.lost_rings,
            step=step,
            reference_azimuth=ends.reference_azimuth,
        )

    def log_likelihood(self, corners: Floats, offset: Floats | float = 0.0) -> Floats:
        """Logarithm (S,) of the likelihood of polygons (S, n, 3), LiDAR frame, metres; no width, so no offset."""
        compiled = library()
        if compiled is not None:
            total, laid = np.empty(len(corners)), self._laid_out(corners)
            kept = np.ascontiguousarray(corners)
            if compiled.firings_log_likelihood(address(laid[0]), len(corners), address(kept), address(total)):
                raise MemoryError
            return total
        right, left = self._chords(corners, self.elevations)
        beyond_left, beyond_right = left - self.left, self.right - right
        # A ring far above or below no polygon meets has nothing to say: most of the sensor's.
        met = self._may_be_met(corners)
        empty_right, empty_left = self._chords(corners, self.empty[met])
        rings = self._own_grids(beyond_left, beyond_right)
        own = rings + self._missed(np.clip(1.0 - (empty_left - empty_right), 0.0, 1.0)).sum(axis=-1)
        offset = self.empty_offset[met]
        if self.shift.min() > _SEEN:
            common = self._common_grid(beyond_left, beyond_right, empty_left, empty_right, offset)
            return np.asarray(np.logaddexp(own, common))
        place = self._seen_place()
        if place is None:
            return np.asarray(own)
        return np.asarray(rings + self._missed(~_fired(empty_left, empty_right, place + offset)).sum(axis=-1))

    def _laid_out(self, corners: Floats) -> tuple[Ints, list[Floats]]:
        """Return the firings as the compiled library has them, for some polygons, and the arrays that it holds."""
        met = self._may_be_met(corners)
        place = None if self.shift.min() > _SEEN else self._seen_place()
        grid = _COMMON if self.shift.min() > _SEEN else _OWN if place is None else _COMMON_AND_SEEN
        off, density = self._places(int(np.ceil(_REACH * self.shift.max())) if grid == _COMMON else 0)
        rings, empty = self.elevations, self.empty[met]
        angles = [function(elevation) for elevation in (rings, empty) for function in (np.sin, np.cos)]
        arrays = [self.left, self.right, self.shift, *angles, self.empty_offset[met], off, density]
        arrays = [np.ascontiguousarray(array) for array in arrays]
        chances = (*self.lost_span, self.lost_ends, self.lost_ring, self.step, self.reference_azimuth, place or 0.0)
        counts = (len(rings), len(empty), corners.shape[1], off.shape[1], grid)
        return structure(*counts, *arrays, *map(float, chances)), arrays

    def _places(self, most: int) -> tuple[Floats, Floats]:
        """How far left of its likeliest place each ring's last firing is (R, W, _PLACES), and the density of that.

        If the grid is at a place within a step, and the ring off by whole steps, W = 2 most + 1; those beyond _REACH
        standard deviations have no density.
        """
        place, whole = (np.arange(_PLACES) + 0.5) / _PLACES, np.arange(-most, most + 1.0)[:, None]
        shift = self.shift[:, None, None]
        e = ((place + (self.offset - self.left)[:, None] + 0.5) % 1.0 - 0.5)[:, None] + whole
        density = np.exp(-0.5 * (e / shift) ** 2) / (shift * np.sqrt(2 * np.pi))
        return e, np.where(np.abs(whole) <= np.ceil(_REACH * shift), density, 0.0)

    def _seen_place(self) -> float | None:
        """Place of the common grid where each ring's is all but known; None where they differ."""
        place = self.left - self.offset
        off = (place - place[0] + 0.5) % 1.0 - 0.5
        mean = float(np.average(off, weights=self.shift**-2))
        return None if (np.abs(off - mean) > 4 * self.shift).any() else float(place[0]) + mean

    def _missed(self, unseen: Floats | Bools) -> Floats:
        """Logarithm of the probability of a ring without returns, from that of firing past its chord."""
        return np.log(unseen * (1 - self.lost_ring) + self.lost_ring)

    def _chords(self, corners: Floats, elevations: Floats) -> tuple[Floats, Floats]:
        """Right and left ends (S, R) in steps; a ring that misses has its left end right of its right end."""
        right, left = chords(sight_planes(corners), elevations, self.reference_azimuth)
        right, left = np.minimum(right, 4.0) / self.step, np.maximum(left, -4.0) / self.step
        return right, left

    def _may_be_met(self, corners: Floats) -> Ints:
        elevation = np.arctan2(corners[..., 2], np.hypot(corners[..., 0], corners[..., 1]))
        # Lines between corners rise above them in elevation, but by less than a tenth of their extent.
        low, high = elevation.min(), elevation.max()
        slack = 0.1 * (high - low)
        return np.flatnonzero((self.empty > low - slack) & (self.empty < high + slack))

    def _own_grids(self, beyond_left: Floats, beyond_right: Floats) -> Floats:
        """Logarithm (S,) of the likelihood of the rings that returned, each on a grid of its own."""
        total = np.zeros(beyond_left.shape)
        for low_left, high_left, density_left in self._intervals:
            for low_right, high_right, density_right in self._intervals:
                # With firings farther left by e, the chord ends less far beyond the left one, farther beyond the right.
                first = np.maximum(beyond_left - high_left, low_right - beyond_right) / self.shift
                last = np.minimum(beyond_left - low_left, high_right - beyond_right) / self.shift
                some = np.nonzero(last > first)
                total[some] += density_left * density_right * _mass(first[some], last[some])
        return np.asarray(np.log(total + self._floor).sum(axis=-1))

    def _common_grid(
        self, beyond_left: Floats, beyond_right: Floats, empty_left: Floats, empty_right: Floats, offset: Floats
    ) -> Floats:
        """Logarithm (S,) of the likelihood of all rings, averaged over the place of one grid."""
        log = np.zeros((len(beyond_left), _PLACES))
        for k, (e, density) in enumerate(zip(*self._places(int(np.ceil(_REACH * self.shift.max()))), strict=True)):
            at_left = self._end_density(beyond_left[:, k, None, None] - e)
            at_right = self._end_density(beyond_right[:, k, None, None] + e)
            log += np.log((at_left * at_right * density).sum(axis=1) + self._floor)
        place = (np.arange(_PLACES) + 0.5) / _PLACES
        fired = _fired(empty_left[..., None], empty_right[..., None], place + offset[:, None])
        log += self._missed(~fired).sum(axis=1)
        return np.asarray(logsumexp(log, axis=1) - np.log(_PLACES))

    def _end_density(self, beyond: Floats) -> Floats:
        """Probability density, per step, of how far beyond a ring's last firing its chord ends."""
        (low, high, density), (low_lost, high_lost, density_lost) = self._intervals
        proper, lost = (beyond >= low) & (beyond < high), (beyond >= low_lost) & (beyond < high_lost)
        return np.asarray(density * proper + density_lost * lost)

    @property
    def _intervals(self) -> tuple[tuple[float, float, float], ...]:
        """Ends, in steps, and densities of where a chord may end beyond a ring's last firing."""
        low, high = self.lost_span
        share = self.lost_ends
        return (0.0, 1.0, 1 - share), (low, high, share / (high - low))

    @property
    def _floor(self) -> float:
        """Density of a ring neither of whose ends is near where it should be."""
        return (0.1 * self.lost_ends) ** 2


def _mass(low: Floats, high: Floats) -> Floats:
    """Probability (N,) that a standard normal variable is between bounds, by the tail that keeps all digits."""
    above = low > 0
    return ndtr(np.where(above, -low, high)) - ndtr(np.where(above, -high, low))


def _fired(left: Floats, right: Floats, place: Floats) -> Bools:
    """Whether a grid at a place has a firing between the ends of chords, all in steps."""
    return np.asarray(np.floor(left - place) >= np.ceil(right - place))
