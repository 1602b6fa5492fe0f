"""Sensors with evenly spaced rings, and at other spin rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.sensor import SensorModel


def uniform_sensor(n_rings: int, lowest: float, highest: float, azimuth_step: float, name: str = "") -> SensorModel:
    """Return a sensor with evenly spaced rings.

    Args:
        n_rings: number of rings, at least 2.
        lowest: elevation of the lowest ring, rad.
        highest: elevation of the highest ring, rad.
        azimuth_step: rad.
        name: what results call it; by default "uniform-<n_rings>".

    Raises:
        InputError: fewer than two rings, or elevations that do not increase (see `SensorModel`).
    """
    if n_rings < 2:
        raise InputError(f"{n_rings} rings cannot be spaced; expected at least 2")
    return SensorModel(np.linspace(lowest, highest, n_rings), name or f"uniform-{n_rings}", azimuth_step)


def spinning_at(sensor: SensorModel, rate: float, rated: float = 10.0) -> SensorModel:
    """Return the sensor at another spin rate. It fires as often as before, so the azimuth step grows with the rate.

    Args:
        sensor: with the azimuth step that it has at `rated`.
        rate: revolutions per second.
        rated: revolutions per second for which the sensor's step holds; 10 for the built-in sensors.

    Raises:
        InputError: a rate that is not positive, or a sensor without azimuth step.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"spin rate {rate} is not a number above 0 Hz")
    if sensor.azimuth_step is None:
        raise InputError(f"sensor '{sensor.name}' has no azimuth step; simulation needs one (azimuth_step_deg)")
    return replace(sensor, azimuth_step=sensor.azimuth_step * rate / rated)
