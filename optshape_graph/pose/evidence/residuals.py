"""What the returns' distances from the plane say of noise, of rings' biases, and of a target that is not flat.

A return's distance from the plane is e = a + b y + c z + (bias of its ring) + noise, plus the shape of a surface that
is no plane. Ring biases look like a shape across the rings, so rows are whitened for them (`Whitening`): with biases
left free a fold would hide in them. Noise and biases are taken from the scan itself, so that a sensor file that is off
doesn't look like a shape, and shapes are judged by F tests. Scans lie side by side, and each is asked by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.factors.plane_returns import PlaneReturns
from optshape_graph.groups import Groups, Layout
from optshape_graph.plane import ReturnsPlane
from optshape_graph.pose.evidence.regression import Regression, Whitening, f_tails, least_squares, one_by_one, schur
from optshape_graph.target import Target

PRIOR_RINGS = 4
"""Rings that the sensor file's word on their biases is worth: a file is right to a third or so."""

OUTLYING = 4.0
"""Standard deviations from the median of its ring beyond which a return is none of the plane: of Gaussian noise one in
15,000 is, of mixed pixels most are."""

FEWEST_OF_RIM = 10
"""Returns on the rim and inside from which on the two are compared."""

PLANE, SECOND_ORDER = 3, 6
"""How many of `PlaneResiduals.terms` are a plane, and how many a surface of second order."""

_ANGLES = np.radians(np.arange(0.0, 180.0, 22.5))
_ACROSS, _AWAY = np.array([np.cos(_ANGLES), np.sin(_ANGLES)]), np.array([-0.6, -0.2, 0.2, 0.6])  # of hinges


@dataclass(frozen=True, eq=False, repr=False)
class PlaneResiduals(Value):
    """Distances of returns from planes near theirs, those that are none of it left out of what is asked of them.

    They are the N returns of B scans in the order of `RingReturns`: ring by ring, from the left.

    Attributes:
        e: (N,) metres, positive behind.
        yz: (N, 2) where the ray meets the plane, from the middle of the returns, in units of the target's radius.
        rest: (N,) metres, less what a surface of second order and the median of the ring explain.
        usual: (N,) whether it is within OUTLYING standard deviations of its ring.
        noise: (B,) standard deviation within rings, metres off the plane: of the scan, or of the sensor file if larger.
        bias: (B,) standard deviation over rings, metres off the plane, likewise.
        file_noise: (B,) the noise of the sensor file, metres off the plane.
        file_bias: (B,) the bias of the sensor file, metres off the plane.
        layout: which of them are of which ring, and of which scan.
    """

    e: Floats
    yz: Floats
    rest: Floats
    usual: Bools
    noise: Floats
    bias: Floats
    file_noise: Floats
    file_bias: Floats
    layout: Layout

    @classmethod
    def of(
        cls,
        returns: Sequence[PlaneReturns],
        planes: Sequence[ReturnsPlane],
        targets: Sequence[Target],
        layout: Layout,
    ) -> PlaneResiduals:
        """Take noise and biases from the scans, never less than those of the sensor files.

        Args:
            returns: (B,) against the planes, each with one bias, noise and bias as the sensor file has them.
            planes: (B,) near theirs.
            targets: (B,) their sizes are the units of places.
            layout: of the returns.
        """
        rings, rings_of_scan, scans = layout.rings, layout.rings_of_scan, layout.scans
        n_rings = rings_of_scan.counts
        e = -np.concatenate([one.offset for one in returns])
        yz = np.concatenate([
            (one.points - plane.centre) @ plane.axes[1:].T / target.gyration
            for one, plane, target in zip(returns, planes, targets, strict=True)
        ])  # fmt: skip
        sigma, moved = (
            np.concatenate(parts) for parts in zip(*((one.sigma, one.moved) for one in returns), strict=True)
        )
        noise, bias = np.sqrt(scans.mean(sigma**2)), np.maximum(scans.mean(moved[:, 0] * sigma), 1e-6)
        terms = second_order(yz)
        freedom = np.maximum(scans.counts - n_rings - (SECOND_ORDER - 1), 1)
        usual, seen_noise = np.ones(len(e), dtype=bool), noise
        for _ in range(2):
            columns = np.column_stack([terms, e]) * usual[:, None]
            G, _ = Whitening.of(layout, usual, seen_noise, bias).products(columns, columns)
            x = least_squares(G[:, :-1, :-1], G[:, :-1, -1:], 1e-9)[..., 0]
            left = e - np.einsum("nk,nk->n", terms, scans.each(x))
            medians = rings.median(left)
            rest = left - rings.each(medians)
            within = 1.4826 * scans.median(np.abs(rest)) * np.sqrt(scans.counts / freedom)
            seen_noise = np.maximum(noise, within)
            usual = np.abs(rest) <= OUTLYING * scans.each(seen_noise)
        own = np.pi / 2 * within**2 * rings_of_scan.mean(1 / rings.counts)  # variance of a median of so many
        freedom = np.maximum(n_rings - 4, 0)
        square = rings_of_scan.sum((medians - rings_of_scan.each(rings_of_scan.mean(medians))) ** 2) - freedom * own
        seen = np.sqrt(np.maximum(PRIOR_RINGS * bias**2 + square, 0.0) / (PRIOR_RINGS + freedom)) * (freedom > 0)
        return cls(e, yz, rest, usual, seen_noise, np.maximum(bias, seen), noise, bias, layout)

    @classmethod
    def side_by_side(cls, scans: Sequence[PlaneResiduals]) -> PlaneResiduals:
        """Return the residuals of several scans."""
        if len(scans) == 1:
            return scans[0]
        names = [field.name for field in fields(cls) if field.name != "layout"]
        arrays = {name: np.concatenate([getattr(scan, name) for scan in scans]) for name in names}
        return cls(**arrays, layout=Layout.side_by_side([scan.layout for scan in scans]))

    def of_scan(self, scan: int) -> PlaneResiduals:
        """Return the residuals of one of the scans."""
        if len(self.layout) == 1:
            return self
        rows, one = self.scans.slices[scan], slice(scan, scan + 1)
        return PlaneResiduals(
            e=self.e[rows], yz=self.yz[rows], rest=self.rest[rows], usual=self.usual[rows], noise=self.noise[one],
            bias=self.bias[one], file_noise=self.file_noise[one], file_bias=self.file_bias[one],
            layout=self.layout.of_scan(scan),
        )  # fmt: skip

    @property
    def rings(self) -> Groups:
        """The returns of each ring."""
        return self.layout.rings

    @property
    def scans(self) -> Groups:
        """The returns of each scan."""
        return self.layout.scans

    @property
    def excess(self) -> Floats:
        """(B,) error of ranges, metres off the plane, that no noise of the file explains; 0 where chance does.

        Something moves single returns by so much: dark and bright squares, say. Their mean is then as uncertain.
        """
        chance = 3 * 1.17 / np.sqrt(self.scans.counts)  # of the median absolute deviation
        beyond = np.sqrt(np.maximum(self.noise**2 - self.file_noise**2, 0.0))
        return np.where(self.noise > (1 + chance) * self.file_noise, beyond, 0.0)

    @cached_property
    def terms(self) -> Floats:
        """(N, 6) what a plane and a surface of second order explain: 1, y, z, y^2, yz, z^2."""
        return second_order(self.yz)

    def beyond(self, base: int, more: Floats, among: Bools | None = None) -> Regression:
        """Ask what columns (N, K) explain beyond the first `base` of `terms`, among the usual returns or those (N,)."""
        among = self.usual if among is None else among
        columns = np.column_stack([self.terms[:, :base], more, self.e]) * among[:, None]
        whitened, plain = self._whitening(among).products(columns, columns)
        count = self.scans.sum(among)
        mean = schur(plain[:, :-1, :-1], base) / np.maximum(count, 1)[:, None, None]
        return Regression(schur(whitened, base), mean, count - base)

    def surfaces(self, seen: float) -> list[Surface]:
        """Look for a bend and for a fold in each scan: of a probability below `seen`, or of no size."""
        bends, _, sizes = self.beyond(PLANE, self.terms[:, PLANE:]).together()
        found = []
        for bend_p, bend, fold_p, fold in zip(bends, sizes, *self._folds(), strict=True):
            shape, p, size = ("bend", bend_p, bend) if bend_p <= fold_p else ("fold", fold_p, fold)
            found.append(Surface(shape, float(size) if p < seen else 0.0, float(p)))
        return found

    def _folds(self) -> tuple[Floats, Floats]:
        """F tests of the best of many hinges: probability (B,) for as many looks, and rms (B,), metres.

        Of a hinge's products, those with the terms of a plane, the residuals and itself are enough.
        """
        usual, whitening = self.usual[:, None], self._whitening(self.usual)
        hinges = np.abs((self.yz @ _ACROSS)[:, :, None] - _AWAY).reshape(len(usual), -1)
        hinges *= usual
        columns = np.column_stack([self.terms[:, :PLANE], self.e]) * usual
        products, squares = whitening.products(columns, np.column_stack([columns, hinges])), whitening.squares(hinges)
        (left, product, square), (_, _, plain) = map(one_by_one, products, squares)
        square, count = np.maximum(square, 1e-12), self.scans.sum(self.usual)
        gains, scan, freedom = product**2 / square, np.arange(len(left)), count - PLANE
        best = scan, gains.argmax(axis=1)
        F = gains[best] / np.maximum(left - gains[best], 1e-30) * (freedom - 1)
        p = np.minimum(1.0, f_tails(F, np.ones(len(F)), freedom - 1) * gains.shape[1])
        return p, np.abs(product / square)[best] * np.sqrt(np.maximum(plain[best] / np.maximum(count, 1), 0.0))

    def sheets(self, azimuth: Floats, row: Ints) -> list[Sheets]:
        """Look for two revolutions, by neighbours in azimuth and by the order in which the returns were recorded.

        Args:
            azimuth: (N,) of each return, rad.
            row: (N,) its place in the recording of its scan.
        """
        r = np.where(self.usual, self.rest, 0.0)
        product = r * np.append(r[1:], 0.0)
        product[self.rings.last] = 0.0
        correlation = self.scans.sum(product) / np.maximum(self.scans.sum(r**2), 1e-30)
        pairs = self.scans.counts - self.layout.rings_of_scan.counts
        score = correlation * np.sqrt(pairs)
        ahead = np.append(np.diff(row) > 0, False)
        ahead[self.rings.last] = False
        forward = self.scans.sum(ahead)
        found = []
        for scan, rows in enumerate(self.scans.slices):
            apart, p = 0.0, 1.0
            if 0 < forward[scan] < pairs[scan]:  # else all rings were recorded from one side to the other
                apart, p = self.of_scan(scan)._passes_apart(azimuth[rows], row[rows])
            found.append(Sheets(float(correlation[scan]), float(score[scan]), apart, p))
        return found

    def _passes_apart(self, azimuth: Floats, row: Ints) -> tuple[float, float]:
        """Rms distance, metres, of what was recorded in a second revolution of one scan, and its chance."""
        again = _second_pass(self.rings, azimuth, row)
        if again is None:
            return 0.0, 1.0
        p, _, apart = self.beyond(SECOND_ORDER, again[:, None] * self.terms[:, :PLANE]).together()
        return float(apart[0]), float(p[0])

    def in_front(self) -> tuple[Ints, Floats]:
        """Look for something before the target: neighbours in a ring that both stand off the plane, towards the sensor.

        Returns:
            How many returns of each scan do (B,), and how far in the middle (B,), metres.
        """
        off = ~self.usual & (self.rest < 0)
        both = off & np.append(off[1:], False)
        both[self.rings.last] = False
        found = both | np.append(False, both[:-1])
        count = self.scans.sum(found).astype(int)
        return count, np.where(count > 0, -self.scans.median(self.rest, found), 0.0)

    def rim_step(self, rim: Bools, inner: Bools) -> tuple[Floats, Floats]:
        """How far the rim stands off what else a surface of second order explains, metres (B,), and its chance (B,).

        Args:
            rim: (N,) whether each is of the rim.
            inner: (N,) those that are asked: without the outermost of each ring, which may be mixed.
        """
        p, x, _ = self.beyond(SECOND_ORDER, rim[:, None].astype(float), inner).together()
        few = np.minimum(self.scans.sum(rim & inner), self.scans.sum(~rim & inner)) < FEWEST_OF_RIM
        return np.where(few, 0.0, x[:, 0]), np.where(few, 1.0, p)

    def _whitening(self, among: Bools) -> Whitening:
        return Whitening.of(self.layout, among, self.noise, self.bias)


@dataclass(frozen=True, eq=False, repr=False)
class Surface(Value):
    """A shape in the distances from the plane.

    Attributes:
        shape: "bend" (of second order) or "fold" (a hinge), whichever explains more.
        size: root mean square of the distances that it explains, metres; 0 where no test sees one.
        probability: of so large a shape by chance.
    """

    shape: str
    size: float
    probability: float


@dataclass(frozen=True, eq=False, repr=False)
class Sheets(Value):
    """Signs of two revolutions, the target moved in between.

    Attributes:
        correlation: of neighbouring returns of a ring; below zero where they belong to either in turn.
        score: it in standard deviations of chance.
        apart: rms distance of two parts of the scan, one recorded after the other, metres; 0 where there is one.
        probability: of so much by chance.
    """

    correlation: float
    score: float
    apart: float
    probability: float


def _second_pass(rings: Groups, azimuth: Floats, row: Ints) -> Floats | None:
    """(N,) -1 for returns recorded in a first revolution, 1 for those of a second; None where there is but one.

    A ring's azimuths run one way in a revolution, so they turn back where the second begins.
    """
    column = rings.of_row
    order = np.lexsort((row, column))
    same = np.diff(column[order]) == 0
    turns = np.diff(azimuth[order])
    back = same & (np.sign(turns) == -np.sign(np.sum(np.sign(turns[same])))) & (np.abs(turns) > 0)
    starts = np.bincount(column[order][1:][back], minlength=len(rings))
    if np.mean(starts == 1) < 0.5 or starts.max() > 1:
        return None
    passed = np.cumsum(np.concatenate([[0], back]))
    first = np.concatenate([[0], np.cumsum(starts)])[column[order]]
    signs = np.empty(len(column))
    signs[order] = np.where(passed - first > 0, 1.0, -1.0)
    return signs


def second_order(yz: Floats) -> Floats:
    """(N, 6) 1, y, z, y^2, yz, z^2 of places (N, 2), in units of the target's radius."""
    y, z = yz.T
    return np.column_stack([np.ones(len(y)), y, z, y * y, y * z, z * z])
