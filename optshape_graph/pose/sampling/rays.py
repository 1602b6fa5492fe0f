"""The likelihood of a scan, ray by ray: every firing near the target was tried, and returned or did not.

A beam whose axis passes outside the target's outline by an angle b returns with probability

    P = stray + (1 - stray - lost) clip(1/2 - o - b / w, 0, 1),

w being the beam's angle and o an offset that all firings of a scan share. No edge is assigned to a ring end, and
nothing is linearised: level edges and vertices are what they are. Firings are not all independent: where a ring ends, a
few may be lost together, or the last return may be a stray; and a whole ring may be lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.chords import chords, sight_planes
from optshape_graph.compiled import address, library, structure
from optshape_graph.edges import EdgePoints, relative_azimuth
from optshape_graph.scan import Scan

STRAY = 1e-4
"""Probability that a single firing outside returns."""

LOST = (0.02, 20.0)
"""What is known of lost firings before a scan: 0.02 of 20. Those well between a ring's ends are added."""

WINDOW = 4
"""Firings that are looked at beyond each end of a ring, and inside it."""

MISSED = 3
"""Rings without returns that are looked at above and below those with."""

PHASES = 4
"""Places of the firing grid within a step that are averaged over in a ring without returns."""

MOST_FIRINGS = 12
"""Firings of such a ring that are looked at one by one; where the target is wider, each stands for several."""

ANYWHERE = 0.01
"""Likelihood of an odd ring end that none of the explanations fits, in units of theirs."""


@dataclass(frozen=True, eq=False, repr=False)
class Rays(Value):
    """The firings of one scan near one target.

    Attributes:
        direction: (F, 3) unit vectors, LiDAR frame.
        width: (F,) angle of each beam, rad, blurred by what its direction may be off.
        share: (F,) of it that is the beam's.
        inside: (I,) firings with returns.
        gaps: (G,) firings without, between returns.
        last: (E,) the last return at each end of a ring.
        beyond: (E, WINDOW) firings beyond it, from the nearest outwards.
        empty: (O,) elevations of rings without returns that may meet the target, rad.
        step: azimuth between two firings, rad.
        reference_azimuth: of the target's returns, rad.
        lost: probability that a single firing inside does not return.
        odd_ends: probability that a ring's end is not what it seems: the last return a stray, or some lost beyond it.
        lost_ring: probability that a ring returns nothing wherever the target is.
    """

    direction: Floats
    width: Floats
    share: Floats
    inside: Ints
    gaps: Ints
    last: Ints
    beyond: Ints
    empty: Floats
    step: float
    reference_azimuth: float
    lost: float
    odd_ends: float
    lost_ring: float

    @classmethod
    def of(cls, scan: Scan, ends: EdgePoints, beam: Floats, off: Floats, extent: float, odd_ends: float) -> Rays:
        """Collect the firings of a scan.

        Args:
            scan: the returns of one target, with rings.
            ends: both ends of each ring, on the grid of firings.
            beam: (R,) angle of the beam at the target, rad, of each ring with returns.
            off: (R,) standard deviation of how far each of these rings looks elsewhere, across any edge, rad.
            extent: largest diameter of the target, metres.
            odd_ends: share of ring ends that are not what they seem, single lost firings apart.
        """
        assert scan.ring is not None
        step = ends.azimuth_step
        azimuth, reference = relative_azimuth(scan.points)
        heights = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
        # An angle that may be off blurs what its firing says: a ramp as wide as a uniform density of that variance is
        # added. Firings of a ring are off alike; but hardly more than one of them is within the ramp.
        width = np.sqrt(beam**2 + 12 * (ends.shift[::2] ** 2 + ends.scatter[::2] ** 2 + off**2))
        table: list[Floats] = []  # azimuth in steps, elevation, width and the beam's share in it, of every firing
        inside, gaps, last, beyond = [], [], [], []
        count, tried, missing = 0, 0, 0
        for r, ring in enumerate(ends.ring[::2]):
            mine = scan.ring == ring
            elevation = float(heights[mine].mean())
            on_grid = ends.shift[2 * r] > 0
            seen = (
                np.arange(ends.azimuth[2 * r + 1], ends.azimuth[2 * r] + step / 2, step) if on_grid else azimuth[mine]
            )
            for train in _trains(seen / step, int(ends.revolutions[2 * r])):
                slots = np.concatenate([[0], np.cumsum(np.rint(np.diff(train)).astype(int))])
                place = np.arange(-WINDOW, slots[-1] + WINDOW + 1, dtype=float)
                place += np.interp(place, slots, train - slots)  # firings drift against the nominal step
                returned = np.zeros(len(place), dtype=bool)
                returned[slots + WINDOW] = True
                deep = returned[2 * WINDOW : -2 * WINDOW]  # where no edge is to blame
                tried, missing = tried + len(deep), missing + len(deep) - deep.sum()
                near = np.arange(len(place))
                near = near[(near < 2 * WINDOW) | (near >= len(place) - 2 * WINDOW)]
                index = count + np.arange(len(near))
                table.append(
                    np.column_stack([place[near], np.full((len(near), 3), [elevation, width[r], beam[r] / width[r]])])
                )
                core = (near >= WINDOW) & (near < len(place) - WINDOW)
                inside.append(index[core & returned[near]])
                gaps.append(index[core & ~returned[near]])
                last += [index[WINDOW], index[-1 - WINDOW]]
                beyond += [index[:WINDOW][::-1], index[-WINDOW:]]
                count += len(near)
        steps, elevations, widths, shares = np.vstack(table).T
        lost = (missing + LOST[0]) / (tried + LOST[1])
        return cls(
            direction=_unit_vectors(steps * step + reference, elevations),
            width=widths,
            share=shares,
            inside=np.concatenate(inside),
            gaps=np.concatenate(gaps),
            last=np.array(last),
            beyond=np.array(beyond),
            empty=_empty_rings(scan, extent),
            step=step,
            reference_azimuth=reference,
            lost=lost,
            odd_ends=min(odd_ends + lost, 0.5),
            lost_ring=ends.lost_rings,
        )

    def log_likelihood(self, corners: Floats, offset: Floats) -> Floats:
        """Return the logarithm (S,) of the probability of which firings returned and which did not.

        Args:
            corners: (S, n, 3) the target's vertices, LiDAR frame, metres.
            offset: (S,) o, in beam widths, those of the beam itself.
        """
        compiled = library()
        if compiled is not None:
            total, laid = np.empty(len(corners)), self._laid_out(corners.shape[1])
            kept = [np.ascontiguousarray(array) for array in (corners, np.broadcast_to(offset, len(corners)))]
            if compiled.rays_log_likelihood(address(laid[0]), len(corners), *map(address, kept), address(total)):
                raise MemoryError
            return total
        normals = sight_planes(corners)
        outside = (normals.reshape(-1, 3) @ self.direction.T).reshape(*normals.shape[:2], -1).max(axis=1)
        P = self._returns(outside / self.width + offset[:, None] * self.share)
        total = np.log(P[:, self.inside]).sum(axis=1) + np.log1p(-P[:, self.gaps]).sum(axis=1)
        out, last = P[:, self.beyond], P[:, self.last]
        silent = 1.0 - out
        usual = silent.prod(axis=-1)
        odd = (
            usual * (1.0 - last) / last + ANYWHERE
        )  # the last return is a stray, or 1, 2, 3 firings beyond it are lost
        for lost in range(1, WINDOW):
            odd += out[..., :lost].prod(axis=-1) * silent[..., lost:].prod(axis=-1)
        total += np.log((1.0 - self.odd_ends) * usual + self.odd_ends / WINDOW * odd).sum(axis=1)
        if len(self.empty):
            total += np.log(self.lost_ring + (1.0 - self.lost_ring) * self._unseen(normals, offset)).sum(axis=1)
        return np.asarray(total)

    def _laid_out(self, edges: int) -> tuple[Ints, list[NDArray[Any]]]:
        """Return the firings as the compiled library has them, for polygons of n edges, and its arrays."""
        firings = (self.direction.T, self.width, self.share, self.inside, self.gaps, self.last, self.beyond, self.empty)
        arrays = [np.ascontiguousarray(array) for array in firings]
        counts = [len(array) for array in (self.direction, self.inside, self.gaps, self.last, self.empty)]
        middle = float(np.median(self.width)), float(np.median(self.share))
        chances = (float(self.lost), float(self.odd_ends), float(self.lost_ring), STRAY, ANYWHERE)
        return structure(*counts, edges, *arrays, self.step, self.reference_azimuth, *chances, *middle), arrays

    def _returns(self, outside: Floats) -> Floats:
        """Probability of a return at an angle outside the outline, the common offset added, in beam widths."""
        return np.asarray(STRAY + (1.0 - STRAY - self.lost) * np.clip(0.5 - outside, 0.0, 1.0))

    def _unseen(self, normals: Floats, offset: Floats) -> Floats:
        """(S, O) probability that no firing of each ring without returns returns, wherever in a step they are."""
        width, offset = float(np.median(self.width)), offset * float(np.median(self.share))
        right, left = chords(normals, self.empty, self.reference_azimuth, width * (0.5 - offset))
        sure_right, sure_left = chords(normals, self.empty, self.reference_azimuth, -width * (0.5 + offset))
        unseen = np.where(left > right, 0.0, 1.0)
        s, o = np.nonzero((left > right) & (sure_left - sure_right < self.step))
        spacing = np.maximum((left - right)[s, o] / MOST_FIRINGS, self.step)
        place = (np.arange(PHASES)[:, None] + 0.5) / PHASES + np.arange(MOST_FIRINGS)
        azimuth = right[s, o][:, None, None] + place * spacing[:, None, None] + self.reference_azimuth
        rays = _unit_vectors(azimuth, self.empty[o][:, None, None])
        outside = np.einsum("qki,qhfi->qkhf", normals[s], rays, optimize=True).max(axis=1)
        returns = self._returns(outside / width + offset[s, None, None])
        unseen[s, o] = ((1.0 - returns).prod(axis=-1) ** (spacing / self.step)[:, None]).mean(axis=-1)
        return unseen


def _unit_vectors(azimuth: Floats, elevation: Floats) -> Floats:
    flat, up = np.cos(elevation), np.sin(elevation)
    return np.stack(np.broadcast_arrays(flat * np.cos(azimuth), flat * np.sin(azimuth), up), axis=-1)


def _trains(steps: Floats, revolutions: int) -> list[Floats]:
    """Azimuths in steps, each train's rising by whole steps: those of one revolution; exact duplicates once."""
    steps = np.sort(steps)
    if revolutions == 1:
        kept = np.concatenate([[True], np.rint(np.diff(steps)) > 0])
        return [steps[kept]]
    phase = steps % 1.0
    order = np.argsort(phase)
    jumps = np.diff(phase[order], append=phase[order[0]] + 1.0)
    cuts = np.sort(np.argsort(-jumps)[:revolutions]) + 1
    groups = np.split(np.roll(order, -cuts[-1]), (cuts - cuts[-1])[:-1] % len(order)) if len(order) > 1 else [order]
    return [train for group in groups if len(group) for train in _trains(steps[group], 1)]


def _empty_rings(scan: Scan, extent: float) -> Floats:
    """(O,) elevations, rad, of rings without returns that a target of an extent, metres, may reach."""
    if scan.sensor is None or scan.ring is None:
        return np.zeros(0)
    table, ring = scan.sensor.elevations, np.unique(scan.ring)
    missing = np.setdiff1d(np.arange(max(ring[0] - MISSED, 0), min(ring[-1] + MISSED + 1, len(table))), ring)
    angle = extent / float(np.linalg.norm(scan.points, axis=1).min())
    return np.asarray(table[missing[np.abs(table[missing][:, None] - table[ring]).min(axis=1) < angle]])
