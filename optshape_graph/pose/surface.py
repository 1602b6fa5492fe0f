"""What the returns' distances from the plane say of noise, of rings' biases, and of a target that is not flat.

A return's distance from the plane is e = a + b y + c z + (bias of its ring) + noise, plus the shape of a surface that
is no plane. Ring biases look like a shape across the rings, so rows are whitened by partial demeaning of each ring (the
random-effects transform of panel regression; Fuller and Battese, J. Econometrics 2, 1974): with biases left free a fold
would hide in them. Noise and biases are taken from the scan itself, so that a sensor file that is off doesn't look like
a shape, and shapes are judged by F tests.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.factors.plane_returns import PlaneReturns
from optshape_graph.gaussian import f_tail
from optshape_graph.plane import ReturnsPlane
from optshape_graph.target import Target

PRIOR_RINGS = 4
"""Rings that the sensor file's word on their biases is worth: a file is right to a third or so."""

OUTLYING = 4.0
"""Standard deviations from the median of its ring beyond which a return is none of the plane: of Gaussian noise one in
15,000 is, of mixed pixels most are."""

FEWEST_OF_RIM = 10
"""Returns on the rim and inside from which on the two are compared."""

_ANGLES = np.radians(np.arange(0.0, 180.0, 22.5))
_ACROSS, _AWAY = np.array([np.cos(_ANGLES), np.sin(_ANGLES)]), np.array([-0.6, -0.2, 0.2, 0.6])  # of hinges


@dataclass(frozen=True, eq=False, repr=False)
class PlaneResiduals(Value):
    """Distances of returns from a plane near theirs, those that are none of it left out of what is asked of them.

    Attributes:
        e: (N,) metres, positive behind.
        yz: (N, 2) where the ray meets the plane, from the middle of the returns, in units of the target's radius.
        column: (N,) index of each return's ring, 0 to R - 1.
        rest: (N,) metres, less what a surface of second order and the median of the ring explain.
        usual: (N,) whether it is within OUTLYING standard deviations of its ring.
        noise: standard deviation within rings, metres off the plane: of the scan, or of the sensor file if larger.
        bias: standard deviation over rings, metres off the plane, likewise.
        file_noise: the noise of the sensor file, metres off the plane.
        file_bias: the bias of the sensor file, metres off the plane.
    """

    e: Floats
    yz: Floats
    column: Ints
    rest: Floats
    usual: Bools
    noise: float
    bias: float
    file_noise: float
    file_bias: float

    @classmethod
    def of(cls, returns: PlaneReturns, plane: ReturnsPlane, target: Target, ring: Ints) -> PlaneResiduals:
        """Take noise and biases from the scan, never less than those of the sensor file.

        Args:
            returns: against the plane, each with one bias, noise and bias as the sensor file has them.
            plane: near theirs.
            target: its size is the unit of places.
            ring: (N,) of each return.
        """
        e, yz = -returns.offset, (returns.points - plane.centre) @ plane.axes[1:].T / target.gyration
        noise = float(np.sqrt(np.mean(returns.sigma**2)))
        bias = max(float(np.mean(returns.moved[:, 0] * returns.sigma)), 1e-6)
        _, column, counts = np.unique(ring, return_inverse=True, return_counts=True)
        terms = second_order(yz)
        freedom = max(len(e) - len(counts) - 5, 1)
        usual, within = np.ones(len(e), dtype=bool), noise
        for _ in range(2):
            G = whitened_gram(np.column_stack([terms, e])[usual], column[usual], max(noise, within), bias)
            left = e - terms @ np.linalg.lstsq(G[:-1, :-1], G[:-1, -1], rcond=1e-9)[0]
            medians = _medians(left, column, counts)
            rest = left - medians[column]
            within = 1.4826 * float(np.median(np.abs(rest))) * np.sqrt(len(e) / freedom)
            usual = np.abs(rest) <= OUTLYING * max(noise, within)
        own = float(np.mean(np.pi / 2 * within**2 / counts))  # variance of a median of so many
        freedom = max(len(counts) - 4, 0)
        square = float(np.sum((medians - medians.mean()) ** 2)) - freedom * own
        seen = np.sqrt(max(PRIOR_RINGS * bias**2 + square, 0.0) / (PRIOR_RINGS + freedom)) if freedom else 0.0
        return cls(e, yz, column, rest, usual, max(noise, within), max(bias, float(seen)), noise, bias)

    @property
    def excess(self) -> float:
        """Error of ranges, metres off the plane, that the sensor file has no noise for; 0 where chance explains it.

        Something moves single returns by so much: dark and bright squares, say. Their mean is then as uncertain.
        """
        chance = 3 * 1.17 / np.sqrt(len(self.e))  # of the median absolute deviation
        return (
            float(np.sqrt(self.noise**2 - self.file_noise**2)) if self.noise > (1 + chance) * self.file_noise else 0.0
        )

    @cached_property
    def terms(self) -> Floats:
        """(N, 6) what a plane and a surface of second order explain: 1, y, z, y^2, yz, z^2."""
        return second_order(self.yz)

    def beyond(self, base: int, more: Floats, among: Bools | None = None) -> Regression:
        """Ask what columns (N, K) explain beyond the first `base` of `terms`, among the usual returns or those (N,)."""
        chosen = self.usual if among is None else among
        columns = np.column_stack([self.terms[:, :base], more, self.e])[chosen]
        return Regression(
            _schur(whitened_gram(columns, self.column[chosen], self.noise, self.bias), base),
            _schur(columns[:, :-1].T @ columns[:, :-1], base) / max(len(columns), 1),
            len(columns) - base,
        )

    def as_seen(self, returns: PlaneReturns) -> PlaneReturns:
        """Return what is of the plane, with noise and biases as large as they are seen."""
        return returns.widened(self.noise / self.file_noise, self.bias / self.file_bias).select(self.usual)

    def surface(self, seen: float) -> Surface:
        """Look for a bend and for a fold: of a probability below `seen`, or of no size."""
        bend_p, _, bend = self.beyond(3, self.terms[:, 3:]).together()
        hinges = np.abs((self.yz @ _ACROSS)[:, :, None] - _AWAY).reshape(len(self.yz), -1)
        fold_p, fold = self.beyond(3, hinges).best()
        shape, p, size = ("bend", bend_p, bend) if bend_p <= fold_p else ("fold", fold_p, fold)
        return Surface(shape, size if p < seen else 0.0, p)

    def sheets(self, azimuth: Floats) -> Sheets:
        """Look for two revolutions, by neighbours in azimuth and by the order in which the returns were recorded.

        Args:
            azimuth: (N,) of each return, in the order of recording, rad.
        """
        order = np.lexsort((azimuth, self.column))
        same = np.diff(self.column[order]) == 0
        r = np.where(self.usual, self.rest, 0.0)[order]
        product = float((r[1:] * r[:-1])[same].sum() / max(float((r**2).sum()), 1e-30))
        again = _second_pass(self.column, azimuth)
        if again is None:
            return Sheets(product, product * float(np.sqrt(same.sum())), 0.0, 1.0)
        p, _, apart = self.beyond(6, again[:, None] * self.terms[:, :3]).together()
        return Sheets(product, product * float(np.sqrt(same.sum())), apart, p)

    def in_front(self, azimuth: Floats) -> tuple[int, float]:
        """Look for something before the target: neighbours in a ring that both stand off the plane, towards the sensor.

        Args:
            azimuth: (N,) of each return, rad.

        Returns:
            How many returns do, and how far in the middle, metres.
        """
        order = np.lexsort((azimuth, self.column))
        rest = self.rest[order]
        off = ~self.usual[order] & (rest < 0)
        both = off[1:] & off[:-1] & (np.diff(self.column[order]) == 0)
        found = np.append(both, False) | np.append(False, both)
        return int(found.sum()), -float(np.median(rest[found])) if found.any() else 0.0

    def rim_step(self, rim: Bools, inner: Bools) -> tuple[float, float]:
        """How far the rim stands off what else a surface of second order explains, metres, and its chance.

        Args:
            rim: (N,) whether each is of the rim.
            inner: (N,) those that are asked: without the outermost of each ring, which may be mixed.
        """
        if min((rim & inner).sum(), (~rim & inner).sum()) < FEWEST_OF_RIM:
            return 0.0, 1.0
        p, x, _ = self.beyond(6, rim[:, None].astype(float), inner).together()
        return float(x[0]), p


@dataclass(frozen=True, eq=False, repr=False)
class Regression(Value):
    """Columns and residuals after the base columns have been taken out of both.

    Attributes:
        gram: (K + 1, K + 1) of the whitened columns and residuals.
        plain: (K, K) mean squares and products of the columns themselves.
        freedom: number of residuals less that of base columns.
    """

    gram: Floats
    plain: Floats
    freedom: int

    def together(self) -> tuple[float, Floats, float]:
        """F test of all columns: probability by chance, coefficients (K,), rms of what they explain, metres."""
        A, b, k = self.gram[:-1, :-1], self.gram[:-1, -1], len(self.plain)
        x = np.asarray(np.linalg.lstsq(A, b, rcond=1e-9)[0], dtype=float)
        gain = float(b @ x)
        left = max(float(self.gram[-1, -1]) - gain, 1e-30)
        p = f_tail(gain / k / left * (self.freedom - k), k, self.freedom - k)
        return p, x, float(np.sqrt(max(float(x @ self.plain @ x), 0.0)))

    def best(self) -> tuple[float, float]:
        """F test of the best single column, for as many looks as there are columns: probability, rms, metres."""
        squares = np.maximum(np.diag(self.gram)[:-1], 1e-12)
        gains = self.gram[:-1, -1] ** 2 / squares
        k = int(gains.argmax())
        left = max(float(self.gram[-1, -1] - gains[k]), 1e-30)
        p = f_tail(float(gains[k]) / left * (self.freedom - 1), 1, self.freedom - 1)
        slope = float(self.gram[k, -1] / squares[k])
        return min(1.0, p * len(gains)), abs(slope) * float(np.sqrt(max(self.plain[k, k], 0.0)))


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


def _second_pass(column: Ints, azimuth: Floats) -> Floats | None:
    """(N,) -1 for returns recorded in a first revolution, 1 for those of a second; None where there is but one.

    A ring's azimuths run one way in a revolution, so they turn back where the second begins.
    """
    order = np.argsort(column, kind="stable")
    same = np.diff(column[order]) == 0
    turns = np.diff(azimuth[order])
    back = same & (np.sign(turns) == -np.sign(np.sum(np.sign(turns[same])))) & (np.abs(turns) > 0)
    starts = np.bincount(column[order][1:][back], minlength=column.max() + 1)
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


def whitened_gram(columns: Floats, ring: Ints, noise: float, bias: float) -> Floats:
    """(K, K) Gram matrix of columns (N, K), each less a share of its means over rings (N,): see the module."""
    order = np.argsort(ring, kind="stable")
    starts = np.flatnonzero(np.diff(ring[order], prepend=-1))
    counts = np.diff(starts, append=len(ring))
    share = 1.0 - noise / np.sqrt(noise**2 + counts * bias**2)
    sums = np.add.reduceat(columns[order], starts, axis=0)
    return np.asarray(columns.T @ columns - sums.T @ (((2 - share) * share / counts)[:, None] * sums))


def _schur(G: Floats, b: int) -> Floats:
    """Gram matrix of the columns from b on, after those before have been taken out."""
    return np.asarray(G[b:, b:] - G[b:, :b] @ np.linalg.lstsq(G[:b, :b], G[:b, b:], rcond=1e-12)[0])


def _medians(values: Floats, column: Ints, counts: Ints) -> Floats:
    """(R,) median of the values of each ring."""
    ordered = values[np.lexsort((values, column))]
    starts = np.cumsum(counts) - counts
    return np.asarray(0.5 * (ordered[starts + (counts - 1) // 2] + ordered[starts + counts // 2]))
