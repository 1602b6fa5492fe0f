"""Sensor files: `schema: optshape/sensor/1`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.builtin import find
from optshape_graph.io.documents import read_document, write_yaml
from optshape_graph.sensor import SensorModel

_METRES = {
    "range_noise_m": "range_noise",
    "ring_bias_m": "ring_bias",
    "beam_aperture_m": "beam_aperture",
    "beam_crossing_m": "beam_crossing",
    "range_resolution_m": "range_resolution",
    "min_range_m": "min_range",
    "max_range_m": "max_range",
}
"""Keys of lengths, and the attributes of `SensorModel` that they set."""


def load_sensor(name_or_path: str | Path, folder: Path | None = None) -> SensorModel:
    """Return a built-in sensor or the sensor of a file; degrees in the file, radians in the model.

    Args:
        name_or_path: a built-in name ("vlp32c") or a file.
        folder: where a relative path starts; by default the current folder.

    Raises:
        InputError: neither name nor file; a file with a missing, unknown or wrong key; or values that no sensor has
            (see `SensorModel`).
    """
    path = find("sensor", str(name_or_path), folder)
    root = read_document(path, "sensor")
    fields = root.entries()
    parameters: dict[str, Any] = {
        attribute: fields[key].number() for key, attribute in _METRES.items() if key in fields
    }
    for key in ("azimuth_step_deg", "beam_divergence_deg"):
        if key in fields:
            parameters[key.removesuffix("_deg")] = float(np.radians(fields[key].number()))
    if "azimuth_offsets_deg" in fields:
        parameters["azimuth_offsets"] = np.radians(fields["azimuth_offsets_deg"].numbers(-1))
    name = fields["name"].text() if "name" in fields else path.stem
    elevations = np.radians(fields["elevations_deg"].numbers(-1))
    try:
        return SensorModel(elevations, name, **parameters)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


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
    if sensor.azimuth_step is not None:
        document["azimuth_step_deg"] = float(np.degrees(sensor.azimuth_step))
    if sensor.azimuth_offsets is not None:
        document["azimuth_offsets_deg"] = np.degrees(sensor.azimuth_offsets).tolist()
    document["beam_divergence_deg"] = float(np.degrees(sensor.beam_divergence))
    for key, attribute in _METRES.items():
        value = float(getattr(sensor, attribute))
        if np.isfinite(value):  # without a largest range, the key is left out
            document[key] = value
    write_yaml(path, document)
