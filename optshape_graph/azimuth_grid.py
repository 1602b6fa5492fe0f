"""Correct noisy angles: move elevations to the cone of their ring, and azimuths to the grid of firings.

Elevations should not vary within a ring, so their scatter measures the angular noise, and can be removed. Azimuths are
assumed to have the same noise. A spinning LiDAR's firings are a known step apart, and the n returns of a ring come from
consecutive firings. The number n fixes the chord's width to within a step, whatever the noise; the mean azimuth fixes
where the firings are, to sigma / sqrt(n). So the boundary lies within a step beyond the first and the last *firing*, as
for exact azimuths, and both ends share one Gaussian shift. (The extremes of the noisy azimuths themselves lie beyond
the boundary, and scatter as much as the noise.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.edges import EdgePoints, extreme_width
from optshape_graph.gaussian import f_tail, ndtr
from optshape_graph.ring_returns import RingReturns

NEGLIGIBLE = 1e-4
"""Scatter of elevations within a ring, rad, below which angles count as exact, as those of real sensors do."""

GAP_EVIDENCE = 7.0
"""A firing within a ring counts as lost if that gains as much in log likelihood: one firing in 1,000 is lost."""

IRREGULAR = 4.0
"""Azimuths count as off any grid if they scatter more than elevations do by this many standard deviations."""


def level_rings(returns: RingReturns) -> tuple[RingReturns, Floats]:
    """Move every return to the cone of its ring, and measure how far the returns were off it.

    A ring's elevation is the sensor's, if the returns agree with it, else their mean. Azimuths are assumed to have the
    same noise; there it cannot be removed.

    Args:
        returns: of B scans of one target each.

    Returns:
        The returns, those of scans with exact angles unchanged; and the standard deviation (B,) of an angle, rad.
    """
    rings, rings_of_scan, scans = returns.rings, returns.rings_of_scan, returns.scans
    mean = rings.mean(returns.elevation)
    square = rings_of_scan.sum(rings.sum((returns.elevation - rings.each(mean)) ** 2))
    freedom = scans.counts - rings_of_scan.counts
    noise = np.sqrt(np.where(freedom > 0, square, 0.0) / np.maximum(freedom, 1))
    noise = np.where(noise < NEGLIGIBLE, 0.0, noise)
    if not noise.any():
        return returns, noise
    level, known = _known(returns, mean, rings_of_scan.each(noise) / np.sqrt(rings.counts))
    # A known elevation takes no degree of freedom: far away, where rings have few returns, that doubles what is left.
    square = rings_of_scan.sum(rings.sum((returns.elevation - rings.each(level)) ** 2))
    noisy = noise > 0
    noise[noisy] = np.sqrt(square / np.maximum(scans.counts - rings_of_scan.sum(~known), 1))[noisy]
    x, y, _ = returns.points.T
    along, up = np.linalg.norm(returns.points, axis=1), rings.each(level)
    inwards = along * np.cos(up) / np.maximum(np.hypot(x, y), 1e-12)
    points = np.column_stack([inwards * x, inwards * y, along * np.sin(up)])
    return returns.moved(np.where(scans.each(noisy)[:, None], points, returns.points)), noise


def _known(returns: RingReturns, mean: Floats, error: Floats) -> tuple[Floats, Bools]:
    """Return each ring's elevation, and whether it is the table's: where the mean is within 5 standard errors of it."""
    table = np.concatenate(
        [
            np.full(rings.stop - rings.start, np.inf) if sensor is None else sensor.elevations[returns.ring[rings]]
            for sensor, rings in zip(returns.sensors, returns.rings_of_scan.slices, strict=True)
        ]
    )
    known = np.abs(mean - table) < 5 * error
    return np.where(known, table, mean), known


def place_on_firings(edges: EdgePoints, returns: RingReturns, azimuth_noise: float) -> EdgePoints:
    """Move the ends of rings to the first and last firing that returned.

    If the returns are not on a regular grid (several revolutions merged, firings that jitter), the ends stay at the
    extremes, and the boundary is where extremes of noisy azimuths put it.

    Args:
        edges: both ends of each ring, at the extremes.
        returns: of the one scan that they were found in.
        azimuth_noise: standard deviation of one azimuth, rad; 0: nothing to do.
    """
    if azimuth_noise == 0.0:
        return edges
    rings, counts, n = returns.rings, returns.rings.counts, len(returns.points)
    steps = np.full((len(counts), counts.max()), np.nan)
    steps[rings.of_row, np.arange(n) - rings.each(rings.first)] = returns.azimuth / edges.azimuth_step
    jitter = azimuth_noise / edges.azimuth_step
    slots = _slots(steps, jitter)
    left = np.nanmean(steps + slots, axis=1)
    off = steps + slots - left[:, None]
    freedom = max(n - len(counts), 1)
    ratio = np.nansum(off**2) / (freedom * jitter**2)  # of two variances, each of about as many returns
    merged = n / np.sum(1.0 + np.nanmax(steps, axis=1) - np.nanmin(steps, axis=1))
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
    """Return the firing (R, N) of each return, 0 for the leftmost.

    Firings are consecutive, unless the azimuths are likelier by GAP_EVIDENCE with a firing lost between two of them.

    Args:
        steps: (R, N) azimuths in steps, from the left, padded with NaN.
        jitter: standard deviation of an azimuth, in steps.
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
    """Set the boundary by the outermost of several noisy azimuths: it lies inside that azimuth, with a scatter."""
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
    """Return mean and variance of how far the outermost of some returns lies beyond the boundary, in azimuth steps.

    That is the largest of -(k + U) + jitter Z_k, k = 0 ... returns - 1, with Z_k normal, and U uniform on a step and
    common to a revolution.
    """
    phase = (np.arange(16) + 0.5) / 16
    x = np.linspace(-1.0 - 5 * jitter, 5 * jitter, 400)
    k = np.arange(returns)
    inside = ndtr((x[:, None, None] + k + phase[:, None]) / jitter).prod(axis=-1).mean(axis=-1) ** revolutions
    density = np.diff(inside)
    middle = 0.5 * (x[1:] + x[:-1])
    mean = float(density @ middle / density.sum())
    return mean, float(density @ (middle - mean) ** 2 / density.sum())


def at_firing_times(returns: RingReturns) -> RingReturns:
    """Turn each ring by the angle that the sensor had turned when the ring fired, unless the driver has done so.

    A driver that gives all lasers of a cycle one azimuth leaves the rings on one grid; other drivers leave them on
    grids shifted by the firing times. The grid on which the azimuths of different rings agree better is the scan's.

    Args:
        returns: of B scans; those whose sensors state no firing times or no azimuth step are returned as they are.
    """
    rings, rings_of_scan = returns.rings, returns.rings_of_scan
    late, start, steps = np.zeros(len(rings)), np.zeros(len(rings)), np.ones(len(rings_of_scan))
    for scan, (sensor, mine) in enumerate(zip(returns.sensors, rings_of_scan.slices, strict=True)):
        if sensor is None or sensor.firing_phases is None or sensor.azimuth_step is None:
            continue
        late[mine], steps[scan] = sensor.firing_phases[returns.ring[mine]], sensor.azimuth_step
        if sensor.azimuth_offsets is not None:
            start[mine] = sensor.azimuth_offsets[returns.ring[mine]]
    if not late.any():
        return returns
    x, y, z = returns.points.T
    step = rings_of_scan.each(steps)
    phase = 2 * np.pi * rings.each(1 / step) * (np.arctan2(y, x) - rings.each(start))
    grid = rings.sum(np.cos(phase)) + 1j * rings.sum(np.sin(phase))
    at_once, in_turn = (
        np.hypot(rings_of_scan.sum(sums.real), rings_of_scan.sum(sums.imag))
        for sums in (grid, grid * np.exp(2j * np.pi * late))
    )
    turned = np.where(rings_of_scan.each(at_once <= in_turn), 0.0, -late * step)
    if not turned.any():
        return returns
    c, s = rings.each(np.cos(turned)), rings.each(np.sin(turned))
    return returns.moved(np.column_stack([c * x - s * y, s * x + c * y, z]))


def tilt_of_rings(returns: RingReturns) -> list[tuple[float, float]]:
    """Return how elevations vary with azimuth within rings, of B scans.

    A ring is a cone about the sensor's own axis. In the frame of a vehicle, or after a correction for motion, its
    elevations vary.

    Returns:
        The rms, rad, of a line fitted to each ring of a scan, and the probability of as much by chance.
    """
    rings, rings_of_scan, scans = returns.rings, returns.rings_of_scan, returns.scans
    off = returns.elevation - rings.each(rings.mean(returns.elevation))
    a = returns.azimuth - rings.each(rings.mean(returns.azimuth))
    square = rings.sum(a * a)
    fitted = rings.each(rings.sum(a * off) / np.maximum(square, 1e-12)) * a
    k = rings_of_scan.sum(square > 1e-12)
    freedom = scans.counts - rings_of_scan.counts - k
    explained = scans.sum(fitted**2)
    left = scans.sum((off - fitted) ** 2) / np.maximum(freedom, 1)
    F = explained / np.maximum(k, 1) / np.maximum(left, 1e-16)
    rms = np.sqrt(explained / scans.counts)
    return [
        (size, f_tail(*of))
        for size, *of in zip(rms.tolist(), F.tolist(), np.maximum(k, 1).tolist(), freedom.tolist(), strict=True)
    ]
