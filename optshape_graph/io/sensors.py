"""Sensor files: `schema: optshape/sensor/1`, and the makers' own tables of a unit's beams."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.builtin import builtin_names, find
from optshape_graph.io.documents import Node, read_document, write_yaml
from optshape_graph.io.maker_tables import MakerTable, read_maker_table
from optshape_graph.sensor import SensorModel

_METRES = {
    "range_noise_m": "range_noise",
    "ring_bias_m": "ring_bias",
    "common_range_bias_m_sd": "common_range_sd",
    "brightness_bias_m": "brightness_bias",
    "beam_aperture_m": "beam_aperture",
    "beam_crossing_m": "beam_crossing",
    "range_resolution_m": "range_resolution",
    "min_range_m": "min_range",
    "max_range_m": "max_range",
}
"""Keys of lengths, and the attributes of `SensorModel` that they set."""

_DEGREES = {
    "azimuth_step_deg": "azimuth_step",
    "beam_divergence_deg": "beam_divergence",
    "elevation_error_deg": "elevation_error",
    "azimuth_error_deg": "azimuth_error",
    "common_elevation_deg_sd": "common_elevation_sd",
    "common_azimuth_deg_sd": "common_azimuth_sd",
    "blooming_deg": "blooming",
}
"""Keys of angles, likewise."""

_DEGREES_BY_RING = {
    "azimuth_offsets_deg": "azimuth_offsets",
    "azimuth_offsets_deg_sd": "azimuth_sd",
    "elevations_deg_sd": "elevation_sd",
    "reported_elevations_deg": "reported_elevations",
    "reported_azimuth_offsets_deg": "reported_azimuth_offsets",
}
"""Keys of lists of angles, likewise."""

_BY_RING = {"range_bias_m": "range_bias", "range_bias_m_sd": "range_bias_sd"}
"""Keys of other lists, likewise."""

_FIRING = {"firing_times_us": "firing_phases", "firing_times_us_sd": "firing_sd"}
"""Keys of lists of times, which the attributes have as shares of the cycle of firings."""

_SHARES = {
    "edge_offset": "edge_offset",
    "edge_offset_sd": "edge_offset_sd",
    "odd_ends": "odd_ends",
    "elevation_trend_sd": "elevation_trend_sd",
    "azimuth_trend_sd": "azimuth_trend_sd",
}
"""Keys of numbers without a unit, likewise."""

_TREND = "range_bias_trend_m_per_deg_sd"
"""Key of `range_trend_sd`, which the attribute has by radians."""

ALIKE = np.radians(1.5)
"""Up to this much the beams of a unit differ from its model's data sheet, rad."""

ASSUMED = {
    "range_noise": 0.01,
    "ring_bias": 0.01,
    "brightness_bias": 0.005,
    "blooming": np.radians(0.04),
    "beam_divergence": np.radians(0.17),
    "beam_aperture": 0.01,
}
"""What is assumed of a sensor of which nothing but its beams is known, metres and rad."""


def load_sensor(name_or_path: str | Path, folder: Path | None = None) -> SensorModel:
    """Return a built-in sensor or the sensor of a file; degrees in the file, radians in the model.

    Files are of this package's own form, or a maker's: Ouster's metadata JSON, a Velodyne calibration YAML (of the ROS
    driver), Hesai's or RoboSense's angle correction CSV. A maker's file has the beams; noise and beam shape are those
    of the built-in sensor that has nearly the same table, or what is assumed of an unknown one.

    Args:
        name_or_path: a built-in name ("vlp32c") or a file.
        folder: where a relative path starts; by default the current folder.

    Raises:
        InputError: neither name nor file; a file with a missing, unknown or wrong key; or values that no sensor has
            (see `SensorModel`).
    """
    path = find("sensor", str(name_or_path), folder)
    table = read_maker_table(path)
    if table is not None:
        return _of_maker(path, table)
    return _own(read_document(path, "sensor"))


def _own(root: Node) -> SensorModel:
    fields, path = root.entries(), root.path
    parameters: dict[str, Any] = {
        attribute: fields[key].number() for key, attribute in (_METRES | _SHARES).items() if key in fields
    }
    if _TREND in fields:
        parameters["range_trend_sd"] = float(np.degrees(fields[_TREND].number()))
    for key, attribute in _DEGREES.items():
        if key in fields:
            parameters[attribute] = float(np.radians(fields[key].number()))
    for key, attribute in _DEGREES_BY_RING.items():
        if key in fields:
            parameters[attribute] = np.radians(fields[key].numbers(-1))
    for key, attribute in _BY_RING.items():
        if key in fields:
            parameters[attribute] = fields[key].numbers(-1)
    for key, attribute in _FIRING.items():
        if key in fields:
            if "firing_period_us" not in fields:
                fields[key].fail("firing times need 'firing_period_us' beside them")
            period = fields["firing_period_us"].number()
            parameters |= {attribute: fields[key].numbers(-1) / period, "firing_period": 1e-6 * period}
    name = fields["name"].text() if "name" in fields else path.stem
    elevations = np.radians(fields["elevations_deg"].numbers(-1))
    try:
        return SensorModel(elevations, name, **parameters)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _of_maker(path: Path, table: MakerTable) -> SensorModel:
    """A maker's table with what a sensor like it has besides."""
    alike = nearest_builtin(table.elevations)
    try:
        if alike is None:
            return SensorModel(table.elevations, path.stem, table.azimuth_step, azimuth_offsets=table.azimuth_offsets,
                               **ASSUMED)  # fmt: skip
        step = alike.azimuth_step if table.azimuth_step is None else table.azimuth_step
        return replace(
            alike, elevations=table.elevations, name=path.stem, azimuth_step=step, azimuth_offsets=table.azimuth_offsets
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


@cache
def builtin_sensors() -> tuple[SensorModel, ...]:
    """Return all built-in sensors, in the order of their names."""
    return tuple(load_sensor(name) for name in builtin_names("sensor"))


def nearest_builtin(elevations: Floats) -> SensorModel | None:
    """Return the built-in sensor whose table is nearest to elevations (R,), rad; None: none has such a table."""
    sensors = builtin_sensors()
    alike = [(float(np.abs(sensor.elevations - elevations).max()), k) for k, sensor in enumerate(sensors)
             if sensor.n_rings == len(elevations)]  # fmt: skip
    if not alike or min(alike)[0] > ALIKE:
        return None
    return sensors[min(alike)[1]]


def save_sensor(path: str | Path, sensor: SensorModel) -> None:
    """Write a sensor file, which `load_sensor` reads back to rounding (radians become degrees and back).

    Raises:
        InputError: the file cannot be written.
    """
    document: dict[str, Any] = {
        "schema": "optshape/sensor/1",
        "name": sensor.name,
        "elevations_deg": np.degrees(sensor.elevations).tolist(),
    }
    for key, attribute in (_DEGREES | _DEGREES_BY_RING).items():
        if (angles := getattr(sensor, attribute)) is not None:
            document[key] = np.degrees(angles).tolist()
    for key, attribute in _BY_RING.items():
        if (values := getattr(sensor, attribute)) is not None:
            document[key] = values.tolist()
    for key, attribute in _FIRING.items():
        if (phases := getattr(sensor, attribute)) is not None:
            document["firing_period_us"] = 1e6 * sensor.firing_period
            document[key] = (1e6 * sensor.firing_period * phases).tolist()
    for key, attribute in (_METRES | _SHARES).items():
        value = float(getattr(sensor, attribute))
        if np.isfinite(value):  # without a largest range, the key is left out
            document[key] = value
    document[_TREND] = float(np.radians(sensor.range_trend_sd))
    write_yaml(path, document)
