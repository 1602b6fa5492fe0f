"""Units of motion-capture files: lengths as the vendors spell them, and frames at a rate."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError

METRES = {
    "m": 1.0, "meters": 1.0, "metres": 1.0, "cm": 1e-2, "centimeters": 1e-2, "centimetres": 1e-2,
    "mm": 1e-3, "millimeters": 1e-3, "millimetres": 1e-3, "in": 0.0254, "inches": 0.0254, "ft": 0.3048, "feet": 0.3048,
}  # fmt: skip
"""Metres per unit of length, by the unit's name in lower case."""


def metres_per(unit: str, path: Path) -> float:
    """Return the metres in a unit of length.

    Raises:
        InputError: a unit that is not known; the message names the file.
    """
    if unit.strip().lower() not in METRES:
        raise InputError(f"{path}: unit of length '{unit}'; expected one of {', '.join(METRES)}")
    return METRES[unit.strip().lower()]


def times_of(frames: Floats, rate: float, path: Path) -> Floats:
    """Return the times (F,), in seconds, of frames whose numbers (F,) count from 0.

    Raises:
        InputError: a rate that is not a positive number; the message names the file.
    """
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"{path}: rate {rate} Hz is not a positive number")
    return frames / rate
