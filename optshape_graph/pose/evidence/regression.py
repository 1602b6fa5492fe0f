"""Regressions of several scans side by side, their rows whitened for what the returns of a ring share.

With a bias of its own in each ring, rows are whitened by taking a share of the ring's mean off each (the random-effects
transform of panel regression; Fuller and Battese, J. Econometrics 2, 1974).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph.gaussian import f_tail
from optshape_graph.groups import Layout


@dataclass(frozen=True, eq=False, repr=False)
class Regression(Value):
    """Columns and residuals of B scans after the base columns have been taken out of both.

    Attributes:
        gram: (B, K + 1, K + 1) of the whitened columns and residuals.
        plain: (B, K, K) mean squares and products of the columns themselves.
        freedom: (B,) number of residuals less that of base columns.
    """

    gram: Floats
    plain: Floats
    freedom: Floats

    def together(self) -> tuple[Floats, Floats, Floats]:
        """F test of all columns: probability (B,), coefficients (B, K), rms (B,) of what they explain, metres."""
        A, b, k = self.gram[:, :-1, :-1], self.gram[:, :-1, -1:], self.plain.shape[1]
        x = least_squares(A, b, 1e-9)
        gain = (b * x).sum(axis=(1, 2))
        left = np.maximum(self.gram[:, -1, -1] - gain, 1e-30)
        p = f_tails(gain / k / left * (self.freedom - k), np.full(len(x), k), self.freedom - k)
        size = (x * (self.plain @ x)).sum(axis=(1, 2))
        return p, x[..., 0], np.sqrt(np.maximum(size, 0.0))


@dataclass(frozen=True, eq=False, repr=False)
class Whitening(Value):
    """Products of columns (N, ...) over the returns of scans, each column less a share of its mean over each ring.

    Attributes:
        layout: of the returns.
        weight: (R, 1) number by which the product of two sums over a ring counts less.
    """

    layout: Layout
    weight: Floats

    @classmethod
    def of(cls, layout: Layout, among: Bools, noise: Floats, bias: Floats) -> Whitening:
        """Take the share by which a ring's bias stands out of the noise of its returns.

        Args:
            layout: of the returns.
            among: (N,) the returns that count; columns are zero elsewhere.
            noise: (B,) standard deviation of one return, metres.
            bias: (B,) standard deviation of a ring's bias, metres.
        """
        count = layout.rings.sum(among)
        noise, bias = layout.rings_of_scan.each(noise), layout.rings_of_scan.each(bias)
        share = 1.0 - noise / np.sqrt(noise**2 + count * bias**2)
        return cls(layout, ((2 - share) * share / np.maximum(count, 1))[:, None])

    def products(self, a: Floats, b: Floats) -> tuple[Floats, Floats]:
        """Return the products (B, J, K) of columns (N, J) and (N, K), whitened and as they are."""
        plain, rings = self.layout.scans.products(a, b), self.layout.rings
        return plain - self.layout.rings_of_scan.products(self.weight * rings.sum(a), rings.sum(b)), plain

    def squares(self, columns: Floats) -> tuple[Floats, Floats]:
        """Return the squares (B, K) of columns (N, K), whitened and as they are."""
        plain = self.layout.scans.sum(columns**2)
        return plain - self.layout.rings_of_scan.sum(self.weight * self.layout.rings.sum(columns) ** 2), plain


def least_squares(A: Floats, b: Floats, smallest: float) -> Floats:
    """(B, K, M) shortest solutions of A x = b, eigenvalues of A below a share of its largest left out."""
    values, vectors = np.linalg.eigh(A)
    kept = values > smallest * values[:, -1:]
    scale = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    return np.asarray(vectors @ (scale[..., None] * (np.swapaxes(vectors, 1, 2) @ b)))


def schur(G: Floats, b: int) -> Floats:
    """(B, K - b, K - b) Gram matrices of the columns from b on, after those before have been taken out."""
    return np.asarray(G[:, b:, b:] - G[:, b:, :b] @ least_squares(G[:, :b, :b], G[:, :b, b:], 1e-12))


def one_by_one(products: Floats, squares: Floats) -> tuple[Floats, Floats, Floats]:
    """Take base columns out of residuals and out of further columns, each of these by itself.

    Args:
        products: (B, J, K) of J - 1 base columns and the residuals, metres, with these J and with the further columns.
        squares: (B, K - J) of the further columns, numbers.

    Returns:
        The square of the residuals (B,), their products with the further columns, and the squares of these (B, K - J).
    """
    base, residuals, j = products[:, :-1], products[:, -1], products.shape[1] - 1
    x = least_squares(base[:, :, :j], base[:, :, j:], 1e-12)
    left = residuals[:, j:] - (residuals[:, None, :j] @ x)[:, 0]
    return left[:, 0], left[:, 1:], squares - (base[:, :, j + 1 :] * x[:, :, 1:]).sum(axis=1)


def f_tails(ratio: Floats, k: Floats, freedom: Floats) -> Floats:
    """Return what `f_tail` says (B,), a probability, of ratios (B,) and two degrees of freedom (B,), numbers."""
    return np.array([f_tail(*one) for one in zip(ratio.tolist(), k.tolist(), freedom.tolist(), strict=True)])
