"""Sessions with known truth: scans of a target with motion-capture markers near its vertices."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.errors import EstimationError
from optshape_graph.io import save_sensor, save_target, write_scan
from optshape_graph.io.documents import write_json, write_yaml
from optshape_graph.io.files import write_atomically
from optshape_graph.se3 import apply, inverse
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation.noise import NoiseModel
from optshape_graph.simulation.placement import pose_from_rpy
from optshape_graph.simulation.scene import simulate_target
from optshape_graph.target import Target

MARKER_OFFSET = 0.015
"""Distance of a marker's centre from its vertex, metres; recordings show 1 to 2 cm."""

MARKER_NOISE = 0.3e-3
"""Standard deviation of a motion-capture coordinate, metres."""


def synthetic_session(
    folder: str | Path,
    target: Target,
    sensor: SensorModel,
    *,
    distances: Sequence[float] = (4.0, 6.0, 8.0),
    noise: NoiseModel | None = None,
    rng: np.random.Generator | int = 0,
    name: str = "synthetic",
) -> Path:
    """Write a session folder: scans of a target's returns, markers.csv, session.yaml, and truth.json.

    At each distance the target is placed twice, roughly face-on and roughly at the paper's extreme angle. Errors of
    the rings are the same in all scans. The markers are fixed to the target, each about 1.5 cm from its vertex in a
    different direction, and measured in a motion-capture frame that is unknown to the LiDAR.

    Args:
        folder: made if it is not there.
        target: the target.
        sensor: the sensor.
        distances: metres.
        noise: errors of measurements; None: those of the sensor's model.
        rng: generator or seed.
        name: the session's name.

    Returns:
        The path of session.yaml.

    Raises:
        EstimationError: at some distance no ray meets the target.
        InputError: the folder cannot be written.
    """
    folder, rng = Path(folder), np.random.default_rng(rng)
    folder.mkdir(parents=True, exist_ok=True)
    noise = NoiseModel.of(sensor) if noise is None else noise
    range_bias, angle_errors = noise.draw_range_bias(sensor.n_rings, rng), noise.draw_angle_errors(sensor.n_rings, rng)
    T_lidar_mocap = pose_from_rpy(rng.uniform(-2.0, 2.0, 3), rng.uniform(-0.5, 0.5, 3))
    T_mocap_lidar = inverse(T_lidar_mocap)
    layout = target.vertices + MARKER_OFFSET * _unit_vectors(len(target), rng)

    scans: list[dict[str, str | int]] = []
    poses: dict[str, Floats] = {}
    marker_lines = ["frame,marker,x,y,z"]
    for distance in distances:
        for angle, base in (("", np.zeros(3)), ("_angled", np.radians([20.0, 30.0, 30.0]))):
            file = f"{distance:g}m{angle}.pcd"
            T = pose_from_rpy([distance, *rng.normal(0.0, 0.1, 2)], base + rng.normal(0.0, np.radians(4.0), 3))
            scan = simulate_target(
                target, sensor, T, noise=noise, rng=rng, range_bias=range_bias, angle_errors=angle_errors, name=file
            )
            if len(scan) == 0:
                raise EstimationError(f"{folder / file}: no ray of sensor '{sensor.name}' hit target '{target.name}'")
            write_scan(folder / file, scan)
            frame = len(scans)
            T_mocap_target = T_mocap_lidar @ T
            seen = apply(T_mocap_target, layout)
            seen += rng.normal(0.0, MARKER_NOISE, seen.shape)
            marker_lines += [f"{frame},corner{k},{x:.6f},{y:.6f},{z:.6f}" for k, (x, y, z) in enumerate(seen)]
            scans.append({"file": file, "mocap_frame": frame})
            poses[file] = T
    save_target(folder / "target.yaml", target)
    save_sensor(folder / "sensor.yaml", sensor)
    write_atomically(folder / "markers.csv", "\n".join(marker_lines) + "\n")
    write_json(
        folder / "truth.json",
        {
            "schema": "optshape/session-truth/1",
            "T_lidar_mocap": T_lidar_mocap,
            "markers_in_target": layout,
            "range_bias": range_bias,
            "T_lidar_target": poses,
        },
    )
    write_yaml(
        folder / "session.yaml",
        {
            "schema": "optshape/session/1",
            "name": name,
            "sensor": "sensor.yaml",
            "target": "target.yaml",
            "scans": scans,
            "mocap": {"file": "markers.csv", "units": "m"},
        },
    )
    return folder / "session.yaml"


def _unit_vectors(n: int, rng: np.random.Generator) -> Floats:
    return np.asarray(Rotation.random(n, rng=rng).as_matrix()[:, :, 0])
