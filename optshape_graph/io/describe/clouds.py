"""Facts about clouds and scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds import make_scan, read_columns
from optshape_graph.io.clouds.columns import Columns, roles
from optshape_graph.io.clouds.files import form_of
from optshape_graph.io.describe.facts import Facts
from optshape_graph.scan import Scan

if TYPE_CHECKING:
    from optshape_graph.io.sensor_guess import Guess


def cloud_facts(path: Path, names: list[str] | None = None) -> Facts:
    """Return what a cloud's file holds: its fields and what each is used as, returns, rings, times, the sensor.

    Args:
        path: the file.
        names: of its columns, in order, if the file names none.

    Raises:
        InputError: as `read_columns`.
        MissingExtraError: the library for LAS or E57 is absent.
    """
    return {"form": f"cloud ({form_of(path)})", **_column_facts(read_columns(path, names))}


def _column_facts(columns: Columns) -> Facts:
    from optshape_graph.io.sensor_guess import guess_sensor

    known = roles(columns.values)
    taken = {role.column: (what, role.unit) for what, role in known.items()}
    fields = {
        name: " ".join(
            [_type(values), *([f"= {taken[name][0]}"] if name in taken else ["(not used)"]),
             *([f"x {taken[name][1]:g}"] if name in taken and taken[name][1] not in (None, 1.0) else [])]
        )
        for name, values in columns.values.items()
    }  # fmt: skip
    facts: Facts = {"points": int(next(iter(columns.values.values())).shape[0]) if columns.values else 0}
    if columns.height > 1:
        facts["organised"] = f"{columns.height} rows"
    facts["fields"] = fields
    try:
        scan = make_scan(columns)
    except InputError as error:
        return {**facts, "problem": str(error)}
    points = {"points": facts["points"]}
    facts |= scan_facts(scan)
    guess = guess_sensor(scan)
    facts["sensor"] = str(guess)
    facts["numbers"] = points | facts["numbers"] | guess_numbers(guess)
    return facts


def scan_facts(scan: Scan) -> Facts:
    """Return how many returns a scan has, and their ranges, elevations, rings and times."""
    distance = np.linalg.norm(scan.points, axis=1)
    elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1])))
    facts: Facts = {
        "returns": len(scan),
        "range": f"{distance.min():.2f} to {distance.max():.2f} m, median {np.median(distance):.2f}",
        "elevations": f"{elevation.min():.2f} to {elevation.max():.2f} deg",
    }
    if scan.ring is None:
        facts["rings"] = "none in the file (detect and map need them: --sensor recovers them from the elevations)"
    else:
        present = np.unique(scan.ring)
        facts["rings"] = f"{len(present)}, numbered {present[0]} to {present[-1]}"
    if scan.time is None:
        facts["times"] = "none"
    else:
        facts["times"] = f"{scan.time.min():.6f} to {scan.time.max():.6f} s, relative to the scan's stamp"
    facts["numbers"] = {
        "returns": len(scan),
        "range_m": [float(distance.min()), float(np.median(distance)), float(distance.max())],
        "elevations_deg": [float(elevation.min()), float(elevation.max())],
        "n_rings": 0 if scan.ring is None else len(np.unique(scan.ring)),
        "times_s": None if scan.time is None else [float(scan.time.min()), float(scan.time.max())],
    }
    return facts


def guess_numbers(guess: Guess) -> Facts:
    """Return the sensor that a scan is most like, and how far each known sensor is from it, for programs."""
    return {"sensor": guess.sensor.name if guess.sensor else None, "misfits_deg": guess.misfits}


def _type(values: np.ndarray[Any, Any]) -> str:
    shape = "" if values.ndim == 1 else f" x {values.shape[1:]}"
    return f"{values.dtype.name}{shape}"
