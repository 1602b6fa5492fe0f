"""Noisy azimuths, put back on the grid on which a spinning LiDAR fires.

The n returns of a ring come from consecutive firings, a known step apart. Their number fixes the chord's width to
within a step, whatever the noise; their mean fixes where the firings are, to sigma / sqrt(n). So the boundary is
within a step beyond the first and the last *firing*, as for exact azimuths, and both ends share one Gaussian shift.
(The extremes of the noisy azimuths themselves lie beyond the boundary, and scatter as the noise does.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import EdgePoints, extreme_width, relative_azimuth
from optshape_graph.scan import Scan

GAP_EVIDENCE = 7.0
"""Gain in log likelihood from which on a firing within a ring is taken to have returned nothing: one in 1,000 does."""

IRREGULAR = 4.0
"""Standard deviations by which azimuths may scatter more about the grid than elevations do, before there is none."""


def place_on_firings(edges: EdgePoints, scan: Scan, azimuth_noise: float) -> EdgePoints:
    """Move the ends of rings to the first and last firing that returned.

    Where the returns are not on a regular grid (several revolutions merged, firings that jitter), the ends stay at the
    extremes, and the boundary where extremes of noisy azimuths say it is.

    Args:
        edges: both ends of each ring, at the extremes.
        scan: the returns they were found in.
        azimuth_noise: standard deviation of one azimuth, rad; 0: nothing to do.
    """
    if azimuth_noise == 0.0:
        return edges
    assert scan.ring is not None
    azimuth, _ = relative_azimuth(scan.points)
    order = np.lexsort((-azimuth, scan.ring))
    counts = np.unique(scan.ring, return_counts=True)[1]
    row = np.repeat(np.arange(len(counts)), counts)
    rank = np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)
    steps = np.full((len(counts), counts.max()), np.nan)
    steps[row, rank] = azimuth[order] / edges.azimuth_step
    jitter = azimuth_noise / edges.azimuth_step
    slots = _slots(steps, jitter)
    left = np.nanmean(steps + slots, axis=1)
    off = steps + slots - left[:, None]
    freedom = max(len(scan) - len(counts), 1)
    ratio = np.nansum(off**2) / (freedom * jitter**2)  # of two variances, each of about as many returns
    merged = len(scan) / np.sum(1.0 + np.nanmax(steps, axis=1) - np.nanmin(steps, axis=1))
    if merged > 1.5 or np.log(ratio) > IRREGULAR * 2 / np.sqrt(freedom):
        revolutions = edges.revolutions[::2] if merged > 1.5 else np.ones(len(counts))
        return _extremes(edges, revolutions, counts, jitter)
    right = left - np.nanmax(slots, axis=1)
    at = np.column_stack([left, right]).ravel() * edges.azimuth_step
    moved = np.exp(1j * (at - edges.azimuth)) * (edges.points[:, 0] + 1j * edges.points[:, 1])
    return replace(
        edges,
        points=np.column_stack([moved.real, moved.imag, edges.points[:, 2]]),
        azimuth=at,
        revolutions=np.ones(len(edges), dtype=np.int64),
        lower=np.zeros(len(edges)),
        upper=np.full(len(edges), edges.azimuth_step),
        shift=np.repeat(azimuth_noise / np.sqrt(counts), 2),
    )


def _slots(steps: Floats, jitter: float) -> Floats:
    """Firing (R, N) of each return, 0 for the leftmost, from azimuths in steps, from the left, padded with NaN.

    Consecutive, unless the azimuths are likelier by GAP_EVIDENCE with a firing left out between two of them.
    """
    slots = np.where(np.isnan(steps), np.nan, np.arange(steps.shape[1], dtype=float))
    counts = (~np.isnan(steps)).sum(axis=1)
    rows = np.arange(len(steps))
    for _ in range(steps.shape[1]):
        off = np.nan_to_num(steps + slots - np.nanmean(steps + slots, axis=1, keepdims=True))
        # Moving the returns from j on by one changes the sum of squares by 2 (sum of off from j on) + k (1 - k / n).
        after = np.cumsum(off[:, ::-1], axis=1)[:, ::-1]
        k = np.maximum(counts[:, None] - np.arange(steps.shape[1]), 0)
        gain = -(2 * after + k * (1 - k / counts[:, None])) / (2 * jitter**2)
        gain[:, 0] = -np.inf
        gap = gain.argmax(axis=1)
        found = gain[rows, gap] > GAP_EVIDENCE
        if not found.any():
            break
        slots += found[:, None] & (np.arange(steps.shape[1]) >= gap[:, None])
    return slots


def _extremes(edges: EdgePoints, revolutions: Floats | Ints, returns: Ints, jitter: float) -> EdgePoints:
    """Set the boundary where the outermost of several noisy azimuths says it is: before it, and scattering."""
    reach = np.minimum(returns, int(np.ceil(6 * jitter)) + 2)
    pairs = list(zip(reach.tolist(), np.asarray(revolutions, dtype=int).tolist(), strict=True))
    moments = {pair: _overshoot(jitter, *pair) for pair in set(pairs)}
    mean, variance = np.array([moments[pair] for pair in pairs]).T
    width = np.minimum(extreme_width(np.asarray(revolutions, dtype=float)), np.sqrt(12 * variance))
    scatter = np.sqrt(np.maximum(variance - width**2 / 12, 0.0))
    step = edges.azimuth_step
    return replace(
        edges,
        lower=np.repeat(-mean - width / 2, 2) * step,
        upper=np.repeat(-mean + width / 2, 2) * step,
        scatter=np.repeat(scatter, 2) * step,
    )


def _overshoot(jitter: float, returns: int, revolutions: int) -> tuple[float, float]:
    """Mean and variance of how far the outermost of some returns lies beyond the boundary, in azimuth steps.

    The outermost of -(k + U) + jitter Z_k, k = 0 ... returns - 1, U uniform on a step and common to a revolution, Z_k
    normal.
    """
    phase = (np.arange(16) + 0.5) / 16
    x = np.linspace(-1.0 - 5 * jitter, 5 * jitter, 400)
    k = np.arange(returns)
    inside = ndtr((x[:, None, None] + k + phase[:, None]) / jitter).prod(axis=-1).mean(axis=-1) ** revolutions
    density = np.diff(inside)
    middle = 0.5 * (x[1:] + x[:-1])
    mean = float(density @ middle / density.sum())
    return mean, float(density @ (middle - mean) ** 2 / density.sum())
