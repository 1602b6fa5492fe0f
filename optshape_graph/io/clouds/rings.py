"""Rings in the package's order: from the lowest elevation up; rows of the sensor's table, if the sensor is known.

Drivers number beams from the bottom, from the top or in firing order, from 0 or 1. The elevation decides, since it is
better known than anything else of a return: noise is along the ray.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Floats, Ints
from optshape_graph.errors import AnotherSensorError, InputError
from optshape_graph.groups import Groups
from optshape_graph.scan import elevations_of
from optshape_graph.sensor import SensorModel

_LOG = logging.getLogger(__name__)

COUNTED_TOLERANCE = np.radians(0.5)
"""How far a beam may be from the elevation in the data sheet, if its number tells which beam it is, rad."""

ELEVATION_TOLERANCE = np.radians(0.3)
"""How far a beam may be from that elevation, if only the elevation tells which beam it is, rad."""

BEAM_ORIGIN_TOLERANCE_M = 0.04
"""How far above or below the origin a beam may start, metres: 36 mm in Ouster's sensor frame."""

LEVEL = np.radians(0.6)
"""Largest scatter of a beam's elevations that counts as noise, rad. Real beams have next to none; simulations have been
published with 0.5 deg."""

_MEDIAN_EFFICIENCY = 1.2533
"""Standard error of a median relative to that of a mean: sqrt(pi / 2), of normal noise."""

SWEEP_BACK = np.radians(3.0)
"""Where the next beam's sweep begins, the azimuth jumps back by more than this, rad."""

SWEEP_JITTER = np.radians(0.2)
"""Sweeps of different beams begin at azimuths that differ by less than this, rad."""

MOST_SWEEPS = 256
"""Beams that a sensor has at most."""

ENOUGH_RETURNS = 1 << 14
"""So many returns tell the elevations of all beams; in a larger cloud as many are sampled."""

GOLDEN_RATIO = 0.5 * (1.0 + np.sqrt(5.0))

LARGEST_STRAY_SHARE = 0.1
"""A table still fits if no larger share of the returns lies between its rows."""


def rings_of_ids(points: Floats, ids: Ints, sensor: SensorModel | None, name: str) -> Ints | None:
    """Turn the beam numbers of a driver into rings.

    With a sensor, ring r is row r of its table. Without one, numbers that rise with the elevation (to within its noise)
    are kept, numbers that fall are counted from the highest that occurs, and others are ranked by elevation.

    Args:
        points: (N, 3) metres, LiDAR frame.
        ids: (N,) beam numbers.
        sensor: the sensor that made them, if known.
        name: the source, for messages.

    Returns:
        (N,) rings; or None if the numbers are not of rings: the elevations of one number vary as much as those of the
        cloud (Livox numbers its laser lines, which do not scan rings).

    Raises:
        InputError: the sensor's table does not fit the elevations.
    """
    counts = np.bincount(ids)
    present = np.flatnonzero(counts)
    beam = np.asarray(np.cumsum(counts > 0) - 1)
    sample = _sample(ids)
    inverse = beam[ids[sample]]
    counts = np.bincount(inverse)
    some = points[sample]
    elevation = elevations_of(some)
    if not _are_level(elevation, inverse):
        if sensor is not None:
            raise _misfit(name, sensor, "the returns of one beam are at many elevations")
        _LOG.warning("%s: beam numbers do not follow the elevation; read as a cloud without rings", name)
        return None
    medians = _medians(elevation, inverse, len(present))
    noise = 3 * _MEDIAN_EFFICIENCY * float(np.std(elevation - medians[inverse])) / np.sqrt(counts)
    if sensor is not None:
        ranges = _medians(np.linalg.norm(some, axis=1), inverse, len(present))
        return _rows_of_table(present, medians, noise, ranges, sensor, name)[beam[ids]]
    rise, noise_of_rise = np.diff(medians), np.hypot(noise[1:], noise[:-1])
    if (rise > -noise_of_rise).all():
        return ids
    if (rise < noise_of_rise).all():
        return np.asarray(present[-1] - ids)
    return np.argsort(np.argsort(medians))[beam[ids]]


def rings_of_elevations(points: Floats, sensor: SensorModel, name: str) -> Ints:
    """Recover rings from the elevations of (N, 3) points, metres, LiDAR frame.

    Raises:
        InputError: the sensor's table does not fit the elevations.
    """
    elevation = elevations_of(points)
    ring = sensor.nearest_ring(elevation)
    misfit = np.abs(elevation - sensor.elevations[ring])
    excess = misfit - _free_tolerance(ring, np.linalg.norm(points, axis=1), sensor)
    if np.mean(excess > 0) > LARGEST_STRAY_SHARE:
        k = int(np.argmax(excess))
        raise _misfit(
            name,
            sensor,
            f"{np.mean(excess > 0):.0%} of the returns lie between its rows, one at "
            f"{np.degrees(elevation[k]):.3f} deg, the nearest row at {np.degrees(sensor.elevations[ring[k]]):.3f} deg",
        )
    return ring


def rings_by_firing(points: Floats, sensor: SensorModel | None, name: str) -> Ints | None:
    """Recover rings from the order of returns, if the file keeps each beam's sweep together, as KITTI's do.

    A beam's sweep ends where the azimuth jumps back, or has gone round; the next sweep is of the next beam. The azimuth
    at which a round begins is not known: of three candidates, the one with the fewest level sweeps is taken.

    Args:
        points: (N, 3) metres, LiDAR frame, in the order of the file.
        sensor: the sensor that made them, if known.
        name: the source, for messages.

    Returns:
        (N,) rings; or None if the order shows none, or others than the sensor has.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    step = np.angle(np.exp(1j * np.diff(azimuth)))
    direction = float(np.sign(np.median(step[step != 0]))) if step.any() else 0.0
    if direction == 0:
        return None
    elevation = elevations_of(points)
    sweeps = []
    for start in (
        0.0,
        np.pi,
        azimuth[0] - direction * SWEEP_JITTER,
    ):  # straight ahead (KITTI), behind, at the first return
        phase = np.mod(direction * (azimuth - start), 2 * np.pi)
        back = (direction * step < -SWEEP_BACK) | (np.diff(phase) < -np.pi)
        sweeps.append(np.concatenate([[0], np.cumsum(back)]))
    scatters = [_scatter(elevation, sweep) for sweep in sweeps]
    level = [sweep for sweep, s in zip(sweeps, scatters, strict=True) if s <= 2 * min(scatters) + SWEEP_JITTER**2 / 9]
    sweep = min(level, key=lambda sweep: int(sweep[-1]))
    if not 2 <= sweep[-1] + 1 <= MOST_SWEEPS or not _are_level(elevation, sweep):
        return None
    try:
        return rings_of_ids(points, sweep, sensor, name)
    except InputError as error:
        _LOG.info("%s: the order of firing shows %d beams: %s", name, sweep[-1] + 1, error)
        return None


def _sample(ids: Ints) -> slice | NDArray[np.intp]:
    """Return which returns to use: all, or in a large cloud as many evenly over it, and the first of each beam.

    The places between them follow the golden ratio, so that they don't keep in step with the order of the beams.
    """
    if len(ids) < 2 * ENOUGH_RETURNS:
        return slice(None)
    k = np.arange(ENOUGH_RETURNS)
    evenly = ((k + k * GOLDEN_RATIO % 1.0) * (len(ids) / ENOUGH_RETURNS)).astype(np.intp)
    first = np.full(int(ids.max()) + 1, -1)
    first[ids[::-1]] = np.arange(len(ids) - 1, -1, -1)  # of a number that comes again the last is kept
    return np.append(evenly, first[first >= 0])


def _medians(values: Floats, group: NDArray[np.intp], n: int) -> Floats:
    """Return the median (n,) of the values of each group."""
    order = np.argsort(group.astype(np.uint16), kind="stable")  # of 16 bits: counted, not compared
    return Groups(np.bincount(group, minlength=n)).median(values[order])


def _scatter(elevation: Floats, group: NDArray[np.intp]) -> float:
    """Return the mean square of elevations about the mean of their group, rad2."""
    means = np.bincount(group, elevation) / np.maximum(np.bincount(group), 1)
    return float(np.mean((elevation - means[group]) ** 2))


def _are_level(elevation: Floats, group: NDArray[np.intp]) -> bool:
    """Return whether beam numbers explain most of the variance of the elevation, or there is hardly any."""
    within = _scatter(elevation, group)
    return within < 0.5 * float(np.var(elevation)) or within < LEVEL**2


def _rows_of_table(
    present: Ints, medians: Floats, noise: Floats, ranges: Floats, sensor: SensorModel, name: str
) -> Ints:
    """Return the table's row of each beam number: by a driver's way of counting if one fits, else by elevation alone.

    Args:
        present: (m,) beam numbers.
        medians: (m,) elevation of each, rad.
        noise: (m,) standard error of each median, rad.
        ranges: (m,) median range of each, metres.
        sensor: whose table.
        name: the source, for messages.
    """
    n, table = sensor.n_rings, sensor.elevations
    if len(present) > n:
        raise _misfit(name, sensor, f"the cloud has {len(present)} rings, the sensor {n}")
    numberings = (present, n - 1 - present, present - 1, n - present)  # from the bottom or the top, from 0 or 1
    counted = [rows for rows in numberings if rows.min() >= 0 and rows.max() < n]
    misfits = [np.maximum(np.abs(medians - table[rows]) - noise, 0) for rows in counted]
    if misfits:
        means = [float(misfit.mean()) for misfit in misfits]
        chance = float(noise.mean()) / np.sqrt(len(noise))
        best = next(i for i, mean in enumerate(means) if mean <= min(means) + chance)  # the first of equals
        if (misfits[best] <= COUNTED_TOLERANCE + _beam_origin(ranges)).all():
            return counted[best]
    nearest = sensor.nearest_ring(medians)
    excess = np.abs(medians - table[nearest]) - _free_tolerance(nearest, ranges, sensor)
    if (excess > 0).any():
        k = int(np.argmax(excess))
        raise _misfit(
            name,
            sensor,
            f"ring {present[k]} of the cloud is at {np.degrees(medians[k]):.3f} deg, the nearest row of the table at "
            f"{np.degrees(table[nearest[k]]):.3f} deg",
        )
    if len(np.unique(nearest)) < len(nearest):
        row = int(np.argmax(np.bincount(nearest)))
        raise _misfit(
            name, sensor, f"{(nearest == row).sum()} rings of the cloud are nearest to {np.degrees(table[row]):.3f} deg"
        )
    return nearest


def _free_tolerance(rows: Ints, ranges: Floats, sensor: SensorModel) -> Floats:
    """Return how far from a row of the table an elevation may be to count as that row's, without a beam number, rad.

    Of elevations unrelated to the table, 70 % would be within 0.35 of the gap between rows.
    """
    gaps = np.concatenate([[np.inf], np.diff(sensor.elevations), [np.inf]])
    gap = np.minimum(gaps[rows], gaps[rows + 1])
    return np.asarray(np.minimum(ELEVATION_TOLERANCE + _beam_origin(ranges), 0.35 * gap))


def _beam_origin(ranges: Floats) -> Floats:
    return np.arctan2(BEAM_ORIGIN_TOLERANCE_M, ranges)


def _misfit(name: str, sensor: SensorModel, found: str) -> AnotherSensorError:
    return AnotherSensorError(
        f"{name}: the elevations do not fit the table of {sensor.name}: {found} (another sensor? points that are not "
        "in the LiDAR's frame? a unit with a table of its own: give the maker's file of it as --sensor, or a file with "
        "'schema: optshape/sensor/1' and 'elevations_deg: [lowest, ..., highest]')",
        name,
        found,
    )
