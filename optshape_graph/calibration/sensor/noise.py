"""How a sensor samples: noise of ranges, azimuth between firings, and when within a cycle each ring fires."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.sensor.graph import Joint
from optshape_graph.calibration.sensor.seen import Seen
from optshape_graph.edges import azimuth_spacing, relative_azimuth

NEAR = 6.0
"""Distance, metres, up to which boards show smooth errors along rings: there these are largest, and rings long."""

LONGEST_GAP = 3
"""Firings between two returns of a ring at most, that their distance in azimuth is counted in."""

FEWEST_TIMES = 20
"""Returns of a ring at least, whose times say when it fires."""

JITTER = 0.1e-6
"""Standard deviation of a firing time over rings, seconds, below which rings fire at once."""


@dataclass(frozen=True, eq=False, repr=False)
class Sampling(Value):
    """What the scans say of how the sensor samples.

    Attributes:
        range_noise: standard deviation of one range, metres.
        range_noise_sd: of that, metres.
        azimuth_step: rad.
        azimuth_step_sd: of that, rad.
        firing_times: (R,) seconds after the first of a cycle, NaN for rings that were hardly seen; None: the clouds
            have no times of points, or rings fire at once.
        firing_sd: (R,) of them, seconds; None likewise.
        firing_period: seconds in which the sensor turns by an azimuth step; None likewise.
        smooth_noise: noise that would bend rings along themselves as much as they are bent on near boards, metres;
            None: no board was near.
    """

    range_noise: float
    range_noise_sd: float
    azimuth_step: float
    azimuth_step_sd: float
    firing_times: Floats | None = None
    firing_sd: Floats | None = None
    firing_period: float | None = None
    smooth_noise: float | None = None

    def noise_over(self, given: float) -> float:
        """Return the noise of a range that a file is to state, metres: what poses take for independent.

        It is what returns within rings show, but less than was given only as far as smooth errors along rings allow.

        Args:
            given: what the file stated, metres.
        """
        least = given if self.smooth_noise is None else min(given, self.smooth_noise)
        return max(self.range_noise, least)


def sampling(seen: Sequence[Seen], n_rings: int) -> Sampling:
    """Return what boards in revolutions say of how the sensor samples.

    Args:
        seen: boards in revolutions.
        n_rings: of the sensor.
    """
    noise = np.array([one.noise for one in seen])
    steps = np.array([step for one in seen if (step := _step(one)) is not None])
    root = np.sqrt(len(noise))
    near = [one.smooth for one in seen if np.isfinite(one.smooth) and one.distance < NEAR]
    found = Sampling(
        float(np.median(noise)), float(1.25 * noise.std() / root),
        float(np.median(steps)), float(1.25 * steps.std() / np.sqrt(len(steps))),
        smooth_noise=float(np.sqrt(np.mean(np.square(near)))) if near else None,
    )  # fmt: skip
    times = _firing_times(seen, n_rings, found.azimuth_step)
    if times is None:
        return found
    return replace(found, firing_times=times[0], firing_sd=times[1], firing_period=times[2])


def drift_of(joint: Joint) -> float:
    """Return the standard deviation of what each placement has of its own in each ring's range bias, metres.

    It is what rings are off boards by, calibrated, beyond what the noise of their returns explains. Of as many numbers
    as there are rings on boards, each ring's bias takes one, and each placement three for its plane.
    """
    beta = dict(zip(joint.errors, joint.beta.tolist(), strict=True))
    by_placement: dict[int, list[Seen]] = {}
    for one in joint.seen:
        by_placement.setdefault(one.placement, []).append(one)
    square, count, rings_seen = 0.0, 0, set[int]()
    for p, seen in by_placement.items():
        total: dict[int, list[float]] = {}
        for one in seen:
            rings, residual = one.ring_residuals(joint.T_target_lidar[p], beta)
            returns = np.bincount(one.ring)[rings]
            for ring, off, n in zip(rings.tolist(), residual.tolist(), returns.tolist(), strict=True):
                total.setdefault(ring, []).append(off**2 - one.noise**2 / n)
        square += sum(float(np.mean(values)) for values in total.values())
        count += len(total)
        rings_seen |= set(total)
    freedom = count - len(rings_seen) - 3 * len(by_placement)
    return float(np.sqrt(max(square, 0.0) / freedom)) if freedom > 0 else 0.0


def _step(one: Seen) -> float | None:
    """Azimuth between firings of a ring, by all pairs of its neighbours."""
    assert one.scan.ring is not None
    azimuth, _ = relative_azimuth(one.scan.points)
    about = azimuth_spacing(azimuth, one.scan.ring)
    if about is None:
        return None
    order = np.lexsort((azimuth, one.scan.ring))
    gaps = np.diff(azimuth[order])[np.diff(one.scan.ring[order]) == 0]
    count = np.rint(gaps / about)
    near = (count >= 1) & (count <= LONGEST_GAP)
    return float(gaps[near].sum() / count[near].sum())


def _firing_times(seen: Sequence[Seen], n_rings: int, step: float) -> tuple[Floats, Floats, float] | None:
    """Firing times (R,), their standard deviations (R,), and the period, seconds; None: nothing is to be seen of them.

    In a revolution a return's time is a common one, less its azimuth over the rate of turning, plus its ring's own.
    """
    late: list[list[float]] = [[] for _ in range(n_rings)]
    rates = []
    for one in seen:
        scan = one.scan
        if scan.time is None or scan.ring is None or np.ptp(scan.time) <= 0:
            continue
        azimuth, _ = relative_azimuth(scan.points)
        means = np.bincount(scan.ring, minlength=n_rings).clip(1)
        a = azimuth - (np.bincount(scan.ring, azimuth, n_rings) / means)[scan.ring]
        t = scan.time - (np.bincount(scan.ring, scan.time, n_rings) / means)[scan.ring]
        if (a @ a) <= 0 or (a @ t) == 0:
            continue
        slope = float(a @ t / (a @ a))
        rest = scan.time - slope * azimuth
        rest = rest - np.median(rest)
        rates.append(abs(slope))
        for ring in np.unique(scan.ring):
            late[ring] += rest[scan.ring == ring].tolist()
    known = np.array([len(values) >= FEWEST_TIMES for values in late])
    if not rates or known.sum() < 2:
        return None
    times = np.array([np.median(values) if enough else np.nan for values, enough in zip(late, known, strict=True)])
    times = times - np.nanmin(times)
    period = float(np.median(rates)) * step
    if np.nanstd(times) < JITTER or np.nanmax(times) >= period:
        return None
    sd = np.array(
        [
            1.25 * np.std(values) / np.sqrt(len(values)) if enough else np.nan
            for values, enough in zip(late, known, strict=True)
        ]
    )
    return times, sd, period
