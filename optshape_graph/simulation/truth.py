"""Files of simulated scans, with their truth beside them."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from optshape_graph.errors import EstimationError
from optshape_graph.io import write_scan
from optshape_graph.io.documents import write_json
from optshape_graph.se3 import apply
from optshape_graph.simulation.noise import NoiseModel
from optshape_graph.simulation.scene import SimulatedScan


def write_simulation(
    path: str | Path, result: SimulatedScan, noise: NoiseModel, seed: int, rings_left_out: ArrayLike = ()
) -> Path:
    """Write a cloud as PCD, and its truth as JSON under the same name.

    The truth (`optshape/simulation/1`) has one entry of `targets` for each target: its `T_lidar_target` at the scan's
    stamp, its `vertices` in the LiDAR frame and its number of returns. If there is a single target, its pose and
    vertices are also at the top.

    Args:
        path: ends in .pcd.
        result: the scan and its truth.
        noise: the noise asked for.
        seed: of the noise.
        rings_left_out: (K,) numbers of the rings whose returns were left out.

    Returns:
        The path of the truth.

    Raises:
        EstimationError: nothing was hit.
        InputError: the path cannot be written.
    """
    path = Path(path)
    if len(result.scan) == 0:
        raise EstimationError(f"{path}: no ray of sensor '{_sensor_name(result)}' returned; nothing was written")
    targets = [
        {
            "target": patch.shape.name,
            "T_lidar_target": T,
            "vertices": apply(T, patch.shape.vertices),
            "returns": int((result.surface == k).sum()),
        }
        for k, (patch, T) in enumerate(zip(result.scene.targets, result.T_lidar_targets, strict=True))
    ]
    document: dict[str, Any] = {
        "schema": "optshape/simulation/1",
        "scan": path.name,
        "sensor": _sensor_name(result),
        "seed": seed,
        "noise": {**asdict(replace(noise, rings=None)), "rings": noise.rings.name if noise.rings else None},
        "rings_left_out": np.asarray(rings_left_out, dtype=int),
        "T_world_lidar": result.T_world_lidar,
    }
    if len(targets) == 1:
        document |= {key: targets[0][key] for key in ("target", "T_lidar_target", "vertices")}
    write_scan(path, result.scan)
    write_json(path.with_suffix(".json"), document | {"targets": targets})
    return path.with_suffix(".json")


def _sensor_name(result: SimulatedScan) -> str:
    return result.scan.sensor.name if result.scan.sensor else "unknown"
