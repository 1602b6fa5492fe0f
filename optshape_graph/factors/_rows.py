"""Stacked linear rows: the checks and the compression that every measurement shares, and the noise of every factor."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError

if TYPE_CHECKING:
    import gtsam


def checked(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return `values` as floats, or raise an InputError; -1 in `shape` stands for any length."""
    array = np.asarray(values, dtype=float)
    found = array.shape
    if found != shape and (
        len(found) != len(shape) or any(s not in (-1, a) for a, s in zip(found, shape, strict=True))
    ):
        expected = " x ".join("N" if s == -1 else str(s) for s in shape)
        raise InputError(f"{name}: expected {expected}, found shape {found}")
    # A sum of squares is finite if all numbers are, unless it overflows.
    if not math.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():
        raise InputError(f"{name}: {int((~np.isfinite(array)).sum())} of {array.size} values are not finite")
    return array


def checked_keys(*keys: int) -> None:
    """Raise an InputError unless keys are those of different variables, as GTSAM takes them."""
    for key in keys:
        if not isinstance(key, int | np.integer) or not 0 <= key < 1 << 64:
            raise InputError(
                f"key: expected a number, as gtsam.symbol_shorthand makes it; found {type(key).__name__} {key!r:.40}"
            )
    if len(set(keys)) < len(keys):
        raise InputError(f"keys {', '.join(map(str, keys))}: expected a different one for each variable")


def triangular(stack: Floats) -> Floats:
    """Return the (..., n, n) upper triangular factors of rows (..., m, n): the same quadratic form, whatever m is.

    A tall stack is reduced in blocks that stay in cache (tall-skinny QR; Demmel et al., SIAM J. Sci. Comput. 2012),
    which is faster than one factorisation and keeps a threaded BLAS from being started for thin panels.
    """
    n = stack.shape[-1]
    block = 8 * n
    while stack.ndim == 2 and len(stack) > 2 * block:
        whole = len(stack) // block * block
        blocks = factored(stack[:whole].reshape(-1, block, n))
        stack = np.vstack([blocks.reshape(-1, n), stack[whole:]])
    R = factored(stack) if stack.size else stack
    missing = n - R.shape[-2]
    return np.concatenate([R, np.zeros((*R.shape[:-2], missing, n))], axis=-2) if missing else R


LARGE = 3e6
"""Rows times columns squared of a stack from which on it pays to look for parts that share no columns."""

COMMON = 4
"""A column that so many times as many rows have as the median column is no part's own."""


def triangular_by_parts(stack: Floats, k: int) -> Floats:
    """Return rows (n, n) of the same form as a stack whose first k columns are mostly zeros; `triangular` from k on.

    Columns that no row has together are of different parts, such as the errors of different rings; those that most
    rows have, such as errors that all rings share, are of none. Each part is reduced by itself, and what is left of all
    parts together. So the work grows with the rows, not with the square of k times the rows (block-angular least
    squares; Golub and Plemmons, Linear Algebra Appl. 1980).

    Args:
        stack: (m, n) rows.
        k: number of columns that may be split: the last n - k rows are zero there.
    """
    m, n = stack.shape
    return _by_parts(stack, k) if k and m * n**2 > LARGE else triangular(stack)


def _by_parts(stack: Floats, k: int) -> Floats:
    n = stack.shape[1]
    part_of_row, part_of_column = _parts(stack[:, :k])
    common = np.concatenate([np.flatnonzero(part_of_column < 0), np.arange(k, n)])
    common = common[stack[:, common].any(axis=0) | (common == n - 1)]
    own = np.argsort(part_of_column, kind="stable")[np.count_nonzero(part_of_column < 0) :]
    rows = np.argsort(part_of_row, kind="stable")[np.count_nonzero(part_of_row < 0) :]
    width = np.bincount(part_of_column[own])
    height = np.bincount(part_of_row[rows], minlength=len(width))
    first_column, first_row = np.cumsum(width) - width, np.cumsum(height) - height
    whole, left = np.zeros((n, n)), [stack[part_of_row < 0][:, common]]
    for w in np.unique(width[height > 0]).tolist():  # parts of as many columns at once
        parts = np.flatnonzero((width == w) & (height > 0))
        columns = own[first_column[parts, None] + np.arange(w)]
        places = np.concatenate([columns, np.broadcast_to(common, (len(parts), len(common)))], axis=1)
        rank = np.arange(max(height[parts].max(), w))
        there = rank < height[parts, None]
        row = rows[np.where(there, first_row[parts, None] + rank, 0)]
        R = factored(np.where(there[..., None], stack[row[..., None], places[:, None]], 0.0))
        whole[columns[..., None], places[:, None]] = R[:, :w]
        left.append(R[:, w:, w:].reshape(-1, len(common)))
    whole[np.ix_(common, common)] = triangular(np.vstack(left))
    return whole


def _parts(columns: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The part of each row (m,) and of each column (k,), counted from 0; -1: of none.

    Rows are of none where columns (m, k) are all zero, columns where most rows have them.
    """
    m, k = columns.shape
    row, column = np.divmod(np.flatnonzero(columns != 0), k)
    count = np.bincount(column, minlength=k)
    some = np.sort(count[count > 0])
    own = count <= COMMON * some[len(some) // 2] if len(some) else count > 0
    row, column = row[own[column]], column[own[column]]
    label = np.arange(k)
    while True:  # the smallest label goes from column to row to column
        of_row, spread = np.full(m, k), label.copy()
        np.minimum.at(of_row, row, label[column])
        np.minimum.at(spread, column, of_row[row])
        if (spread == label).all():
            break
        label = spread
    part = np.cumsum(np.bincount(label[own], minlength=k + 1) > 0) - 1  # of each label that is in use
    return np.where(of_row < k, part[of_row], -1), np.where(own, part[label], -1)


def root(covariance: ArrayLike) -> Floats:
    """Return a square root S (n, n) of a covariance S S^T (n, n) matrix, which may be singular."""
    values, vectors = np.linalg.eigh(np.asarray(covariance, float))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def marginalised(columns: Floats, stack: Floats) -> Floats:
    """Return rows (n, n) over what stacked rows (m, n) are linear in, errors with their own columns marginalised.

    Args:
        columns: (m, k) whitened, in units of the errors' standard deviations.
        stack: (m, n) whitened rows.
    """
    k = columns.shape[1]
    return triangular_by_parts(np.vstack([np.eye(k, k + stack.shape[1]), np.hstack([columns, stack])]), k)[k:, k:]


def factored(stacks: Floats) -> Floats:
    """Return the factors R (..., min(m, n), n) of the QR decompositions of stacks (..., m, n)."""
    packed, _ = np.linalg.qr(stacks, mode="raw")  # transposed, with the reflections below the diagonal
    k, n = min(stacks.shape[-2:]), stacks.shape[-1]
    return np.asarray(np.swapaxes(packed, -1, -2)[..., :k, :] * _triangle(n)[:k])


@cache
def _triangle(n: int) -> Floats:
    return np.triu(np.ones((n, n)))


def outer_rows(directions: Floats, normals: Floats) -> Floats:
    """Return the rows (N, 9) of n . (R q), linear in vec R (column-major), for q and n (N, 3)."""
    return np.reshape(directions[:, :, None] * normals[:, None, :], (-1, 9))


def in_plane(vectors: Floats) -> Floats:
    """Return (N, 2) vectors (y, z) of the template's plane as (N, 3)."""
    return np.column_stack([np.zeros(len(vectors)), vectors])


def gaussian(S: Floats, loss: gtsam.noiseModel.mEstimator.Base | None = None) -> gtsam.noiseModel.Base:
    """Return the noise of square root information S, which may be singular, with a robust loss if one is given."""
    import gtsam  # measurements alone, and so the estimate of a pose, do without

    noise = gtsam.noiseModel.Gaussian.SqrtInformation(S, False)
    return noise if loss is None else gtsam.noiseModel.Robust.Create(loss, noise)
