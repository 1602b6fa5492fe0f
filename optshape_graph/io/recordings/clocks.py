"""The offset between two clocks, from one motion that both saw.

Two sensors on one rigid body have the same angular speed, whatever their frames and lever arms. The two records of it
are correlated at every lag; the lag with the highest correlation is the offset. If the body did not turn, or turned so
regularly that several lags fit, an error says that the offset is not determined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import correlate
from scipy.spatial.transform import Rotation, Slerp

from optshape_graph._arrays import Bools, Floats
from optshape_graph.errors import InputError, UnobservableError
from optshape_graph.io.mocap import MocapRecording

STEP = 0.01
"""Sampling of the angular speeds, seconds."""

SPAN = 0.2
"""Speeds are averaged over this time, seconds, so that the noise of both sensors is averaged alike."""

SHORTEST_OVERLAP = 5.0
"""Both must have seen this much motion at a lag, seconds."""

LEAST_CORRELATION = 0.8
"""Below this the two records do not show the same motion."""

LEAST_MARGIN = 0.1
"""The correlation at the best lag must exceed that of every other peak by this much."""

LEAST_SPEED = np.radians(3.0)
"""Standard deviation of the angular speed, rad/s, below which a body counts as not turning."""

RIGID_M = 0.01
"""Markers are not on one rigid body if their median distance from the body fitted to them is larger, metres."""


@dataclass(frozen=True)
class ClockOffset:
    """The offset between two clocks: what to add to the times of one to get those of the other.

    Attributes:
        seconds: the offset.
        standard_deviation: of it, seconds; from the residual speeds, taken as independent from `SPAN` to `SPAN`.
        correlation: of the two angular speeds at that offset.
        runner_up: highest correlation at another peak.
        overlap: seconds of motion compared.
    """

    seconds: float
    standard_deviation: float
    correlation: float
    runner_up: float
    overlap: float


def estimate_clock_offset(
    stamps: Floats, rotations: Rotation, other_stamps: Floats, other_rotations: Rotation
) -> ClockOffset:
    """Estimate what to add to `other_stamps` to get `stamps`.

    Drift between the clocks is not estimated; it lowers the correlation.

    Args:
        stamps: (N,) seconds, increasing.
        rotations: N rotations R_world_body.
        other_stamps: (M,) seconds of the other clock.
        other_rotations: M rotations of the same body, or of one rigidly mounted on it, in a fixed frame.

    Raises:
        UnobservableError: no common motion, or a motion that fits at several lags.
        InputError: too little data.
    """
    a, seen_a = angular_speed(stamps, rotations)
    b, seen_b = angular_speed(other_stamps, other_rotations)
    for speed, seen, which in ((a, seen_a, "first"), (b, seen_b, "second")):
        if speed[seen].std() < LEAST_SPEED:
            raise UnobservableError(
                f"clock offset: the {which} sensor hardly turned (angular speed varies by "
                f"{np.degrees(speed[seen].std()):.2f} deg/s, {np.degrees(LEAST_SPEED):g} needed); "
                "turn it about, irregularly, or give the offset",
                ("offset between the clocks",),
            )
    lags, correlation, overlap = masked_correlation(a, seen_a, b, seen_b)
    usable = overlap * STEP >= min(SHORTEST_OVERLAP, 0.5 * STEP * min(seen_a.sum(), seen_b.sum()))
    correlation = np.where(usable, correlation, -1.0)
    best = int(correlation.argmax())
    runner_up = _runner_up(correlation, best)
    if correlation[best] < LEAST_CORRELATION or correlation[best] - runner_up < LEAST_MARGIN:
        raise UnobservableError(
            f"clock offset: the angular speeds correlate by {correlation[best]:.2f} at best and by {runner_up:.2f} at "
            f"another lag; at least {LEAST_CORRELATION} and {LEAST_MARGIN} more than elsewhere are needed: "
            "the motion is not common to both, or repeats itself",
            ("offset between the clocks",),
        )
    # Index i of a and i - lag of b coincide, so adding (origin of a) - (origin of b) + lag STEP takes b's time to a's.
    lag = lags[best] + _peak(correlation, best)
    return ClockOffset(
        seconds=float(stamps[0] - other_stamps[0] + lag * STEP),
        standard_deviation=_deviation(a, seen_a, b, seen_b, int(lags[best])),
        correlation=float(correlation[best]),
        runner_up=runner_up,
        overlap=float(overlap[best] * STEP),
    )


def angular_speed(stamps: Floats, rotations: Rotation) -> tuple[Floats, Bools]:
    """Sample the angular speed of a body, rad/s, every `STEP` from `SPAN` / 2 after the first stamp on.

    Args:
        stamps: (N,) seconds, increasing.
        rotations: N of the body.

    Returns:
        (S,) speed averaged over `SPAN`, rad/s, and (S,) whether stamps were near enough.

    Raises:
        InputError: too few poses, or over too short a time, to show a motion.
    """
    if len(stamps) < 3 or stamps[-1] - stamps[0] < 2 * SPAN:
        raise InputError(f"clock offset: {len(stamps)} poses do not show a motion")
    times = stamps - stamps[0]
    centres = np.arange(SPAN / 2, times[-1] - SPAN / 2, STEP)
    starts, ends = centres - SPAN / 2, np.minimum(centres + SPAN / 2, times[-1])
    turned = Slerp(times, rotations)
    speed = (turned(starts).inv() * turned(ends)).magnitude() / SPAN
    longest = max(SPAN, 3 * float(np.median(np.diff(times))))
    gap = np.append(np.diff(times) > longest, False)
    before = np.searchsorted(times, starts, side="right") - 1
    after = np.searchsorted(times, ends)
    gaps = np.concatenate([[0], np.cumsum(gap)])
    return np.asarray(speed), np.asarray(gaps[after] == gaps[before])


def masked_correlation(a: Floats, seen_a: Bools, b: Floats, seen_b: Bools) -> tuple[Floats, Floats, Floats]:
    """Correlate two records at every lag, over what both saw at that lag.

    Padfield, Masked Object Registration in the Fourier Domain, IEEE TIP 21(5), 2012, in one dimension.

    Args:
        a: (N,) samples, any unit.
        seen_a: (N,) whether each was seen.
        b: (M,) samples, any unit.
        seen_b: (M,) whether each was seen.

    Returns:
        (L,) lags, numbers of samples: sample i of a lies over sample i - lag of b; (L,) Pearson correlation; (L,)
        number of samples seen by both.
    """
    mean = (a[seen_a].mean() + b[seen_b].mean()) / 2  # for less rounding; correlations do not change
    a, b = np.where(seen_a, a - mean, 0.0), np.where(seen_b, b - mean, 0.0)
    ma, mb = seen_a.astype(float), seen_b.astype(float)

    def over(x: Floats, y: Floats) -> Floats:
        return np.asarray(correlate(x, y, mode="full", method="fft"))

    n = np.round(over(ma, mb))
    count = np.maximum(n, 1.0)
    sum_a, sum_b = over(a, mb), over(ma, b)
    covariance = over(a, b) - sum_a * sum_b / count
    variance_a = over(a * a, mb) - sum_a**2 / count
    variance_b = over(ma, b * b) - sum_b**2 / count
    # A stretch in which either hardly moves correlates by chance.
    floor_a, floor_b = (0.1 * x[seen].var() * n for x, seen in ((a, seen_a), (b, seen_b)))
    moving = (variance_a > np.maximum(floor_a, 1e-12)) & (variance_b > np.maximum(floor_b, 1e-12))
    product = np.where(moving, variance_a * variance_b, 1.0)
    lags = np.arange(len(n), dtype=np.float64) - (len(b) - 1)
    return lags, np.asarray(np.where(moving, covariance / np.sqrt(product), -1.0), dtype=np.float64), n


def marker_rotations(mocap: MocapRecording) -> tuple[Floats, Rotation]:
    """Return the times at which three markers are seen, and the rotations of their rigid body.

    The rotations are relative to the frame in which most markers are seen (Kabsch, batched).

    Raises:
        InputError: fewer than three markers ever, in a line, or not rigid.
    """
    seen, positions = mocap.seen, np.nan_to_num(mocap.positions)
    reference = int(seen.sum(axis=1).argmax())
    common = (seen & seen[reference]).astype(float)
    usable = common.sum(axis=1) >= 3
    if usable.sum() < 3:
        raise InputError(f"{mocap.name}: fewer than three markers are seen together in most frames")
    weights = common[usable] / common[usable].sum(axis=1, keepdims=True)
    now, then = positions[usable], np.broadcast_to(positions[reference], positions[usable].shape)
    now = now - np.einsum("fm,fmi->fi", weights, now)[:, None]
    then = then - np.einsum("fm,fmi->fi", weights, then)[:, None]
    U, singular, Vt = np.linalg.svd(np.einsum("fm,fmi,fmj->fij", weights, now, then))
    if np.median(singular[:, 1] / singular[:, 0].clip(1e-12)) < 1e-3:
        raise InputError(f"{mocap.name}: the markers are in a line, about which a rotation does not show")
    D = np.ones((len(U), 3))
    D[:, 2] = np.sign(np.linalg.det(U @ Vt))
    R = np.einsum("fij,fj,fjk->fik", U, D, Vt)
    residual = np.sqrt(np.einsum("fm,fmi->f", weights, (now - np.einsum("fij,fmj->fmi", R, then)) ** 2))
    if np.median(residual) > RIGID_M:
        raise InputError(
            f"{mocap.name}: the markers move by {np.median(residual):.3f} m against each other (median); "
            "name those of one rigid body"
        )
    return mocap.times[usable], Rotation.from_matrix(R)


def _runner_up(correlation: Floats, best: int) -> float:
    """Return the highest correlation beyond the best peak, which ends where it has fallen by `LEAST_MARGIN`."""
    low = correlation < correlation[best] - LEAST_MARGIN
    left = best - int(low[best::-1].argmax()) if low[: best + 1].any() else -1
    right = best + int(low[best:].argmax()) if low[best:].any() else len(correlation)
    return float(max(correlation[: left + 1].max(initial=-1.0), correlation[right:].max(initial=-1.0)))


def _peak(values: Floats, k: int) -> float:
    """Return the offset from k, in samples, of the vertex of the parabola through k and its neighbours."""
    if not 0 < k < len(values) - 1:
        return 0.0
    left, centre, right = values[k - 1 : k + 2]
    curvature = left - 2 * centre + right
    return float(np.clip(0.5 * (left - right) / curvature, -0.5, 0.5)) if curvature < 0 else 0.0


def _deviation(a: Floats, seen_a: Bools, b: Floats, seen_b: Bools, lag: int) -> float:
    """Return the standard deviation of the offset: residual speed over the slope of the speed (Cramer-Rao bound)."""
    start, stop = max(0, lag), min(len(a), len(b) + lag)
    x, y = a[start:stop], b[start - lag : stop - lag]
    seen = seen_a[start:stop] & seen_b[start - lag : stop - lag]
    residual = (x - y)[seen].std()
    slope = np.gradient(y, STEP)[seen]
    independent = SPAN / STEP  # neighbouring samples share their span
    return float(residual * np.sqrt(independent / (slope @ slope)))
