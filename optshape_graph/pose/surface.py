"""What the returns' distances from the plane say of noise, of rings' biases, and of a target that is not flat.

A return's distance from the plane is e = a + b y + c z + (bias of its ring) + noise, plus the shape of a surface that is
no plane. Ring biases look like a shape across the rings, so rows are whitened by partial demeaning of each ring (the
random-effects transform of panel regression; Fuller and Battese, J. Econometrics 1974): with biases left free a fold
would hide in them. Noise and biases are taken from the scan itself, so that a sensor file that is off doesn't look like
a shape, and the tests are F tests.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betainc

from optshape_graph._arrays import Floats, Ints

SEEN = 1e-3
"""Probability of the F test below which a surface counts as seen, and its size widens the pose: clean scans that pay
for a surface which isn't there are one in a thousand for each test."""

FEWEST_RINGS = 9
"""Rings from which on the scan tells the size of their biases: with fewer, the sensor file's stands."""

_HINGES = [(angle, at) for angle in np.radians(np.arange(0.0, 180.0, 22.5)) for at in (-0.6, -0.2, 0.2, 0.6)]


@dataclass(frozen=True)
class Surface:
    """How the returns scatter about their plane.

    Attributes:
        noise: standard deviation of a return within its ring, metres off the plane.
        bias: standard deviation over rings of their biases, metres off the plane; that of the sensor file where rings
            are too few to tell.
        shape: "bend" (second order in the plane) or "fold" (a hinge), whichever explains more.
        size: root mean square of the distances that it explains, metres; 0 where the test sees none.
        probability: of so large a shape by chance.
    """

    noise: float
    bias: float
    shape: str
    size: float
    probability: float


@dataclass(frozen=True, eq=False)
class PlaneResiduals:
    """Distances of returns from their plane, and the columns that any plane explains, whitened by rings.

    Attributes:
        e: (N,) metres, positive behind.
        yz: (N, 2) place in the plane, in radii of the target.
        column: (N,) index of each return's ring, 0 to R - 1.
        noise: standard deviation within rings, metres.
        bias: standard deviation over rings, metres.
    """

    e: Floats
    yz: Floats
    column: Ints
    noise: float
    bias: float

    def whitened(self, columns: Floats) -> Floats:
        """Return columns (N, K) less a share of their means over each ring."""
        counts = np.bincount(self.column)
        share = 1.0 - self.noise / np.sqrt(self.noise**2 + counts * self.bias**2)
        means = np.zeros((len(counts), columns.shape[1]))
        for k in range(columns.shape[1]):
            means[:, k] = np.bincount(self.column, columns[:, k]) / counts
        return np.asarray(columns - (share[:, None] * means)[self.column])

    @property
    def plane(self) -> Floats:
        """(N, 3) what a plane explains: 1, y, z."""
        return np.column_stack([np.ones(len(self.e)), self.yz])

    def test(self, base: Floats, more: Floats) -> tuple[float, Floats]:
        """F test of further columns.

        Args:
            base: (N, B) columns that are there anyway.
            more: (N, K) columns in question.

        Returns:
            The probability of so good a fit by chance, and the distances (N,), metres, that the further columns
            explain beyond the base.
        """
        Q, R = np.linalg.qr(self.whitened(np.column_stack([base, more, self.e])))
        return self._tested(R, base, more)

    def _tested(self, R: Floats, base: Floats, more: Floats) -> tuple[float, Floats]:
        n, b, k = len(self.e), base.shape[1], more.shape[1]
        explained, left = float((R[b : b + k, -1] ** 2).sum()), float(R[b + k, -1] ** 2)
        p = f_tail(explained / max(left, 1e-30) * (n - b - k) / k, k, n - b - k)
        coefficients = np.linalg.lstsq(R[b : b + k, b : b + k], R[b : b + k, -1], rcond=1e-9)[0]
        shape = more @ coefficients
        return p, shape - base @ np.linalg.lstsq(base, shape, rcond=None)[0]


def f_tail(F: float, k: int, freedom: int) -> float:
    """Return the probability that an F variable of (k, freedom) degrees of freedom exceeds F."""
    return float(betainc(freedom / 2, k / 2, freedom / (freedom + k * F))) if freedom > 0 else 1.0


def second_order(yz: Floats) -> Floats:
    """(N, 3) y^2, yz, z^2 of places (N, 2)."""
    y, z = yz.T
    return np.column_stack([y * y, y * z, z * z])


def plane_residuals(e: Floats, yz: Floats, ring: Ints, noise: float, bias: float) -> PlaneResiduals:
    """Take noise and bias from the scan, never less than those of the sensor file.

    Args:
        e: (N,) distances of the returns from a plane near theirs, metres.
        yz: (N, 2) places in the plane about the target's middle, in radii of the target.
        ring: (N,) of each return.
        noise: of the sensor file, off the plane, metres.
        bias: of the sensor file, off the plane, metres.
    """
    _, column, counts = np.unique(ring, return_inverse=True, return_counts=True)
    first = PlaneResiduals(e, yz, column, noise, bias)
    terms = np.column_stack([first.plane, second_order(yz)])
    rows = first.whitened(np.column_stack([terms, e]))
    left = e - terms @ np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=1e-9)[0]
    order = np.lexsort((left, column))
    starts = np.cumsum(counts) - counts
    low, high = left[order][starts + (counts - 1) // 2], left[order][starts + counts // 2]
    medians = 0.5 * (low + high)
    freedom = max(len(e) - len(counts) - 2, 1)
    within = 1.4826 * float(np.median(np.abs(left - medians[column]))) * np.sqrt(len(e) / freedom)
    if len(counts) >= FEWEST_RINGS:
        own = float(np.mean(np.pi / 2 * within**2 / counts))  # variance of a median
        spread = float(np.var(medians) * len(counts) / (len(counts) - 4))
        bias = max(bias, float(np.sqrt(max(spread - own, 0.0))))
    return PlaneResiduals(e, yz, column, max(noise, within), bias)


def surface(residuals: PlaneResiduals) -> Surface:
    """Look for a bend and for a fold."""
    base = residuals.plane
    p, explained = residuals.test(base, second_order(residuals.yz))
    shape = "bend"
    along = np.column_stack([np.abs(residuals.yz @ [np.cos(a), np.sin(a)] - d) for a, d in _HINGES])
    hinge_p, hinge = _best_hinge(residuals, base, along)
    if hinge_p < p:
        p, explained, shape = hinge_p, hinge, "fold"
    size = float(np.sqrt(np.mean(explained**2))) if p < SEEN else 0.0
    return Surface(residuals.noise, residuals.bias, shape, size, p)


def _best_hinge(residuals: PlaneResiduals, base: Floats, hinges: Floats) -> tuple[float, Floats]:
    """Probability of the best of several hinges (N, K), each alone, and the distances (N,) that it explains."""
    rows = residuals.whitened(np.column_stack([base, hinges, residuals.e]))
    Q, _ = np.linalg.qr(rows[:, :3])
    rest = rows[:, 3:] - Q @ (Q.T @ rows[:, 3:])
    norms = np.maximum((rest[:, :-1] ** 2).sum(axis=0), 1e-12)
    slope = rest[:, :-1].T @ rest[:, -1] / norms
    gain = slope**2 * norms
    best = int(gain.argmax())
    left = float((rest[:, -1] ** 2).sum() - gain[best])
    n = len(residuals.e)
    p = f_tail(float(gain[best]) / max(left, 1e-30) * (n - 4), 1, n - 4)
    shape = hinges[:, best] * slope[best]
    return min(1.0, p * hinges.shape[1]), shape - base @ np.linalg.lstsq(base, shape, rcond=None)[0]
