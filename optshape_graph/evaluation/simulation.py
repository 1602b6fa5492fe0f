"""The paper's simulation sweep, for any number of draws, target, sensor, noise and method."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph._version import __version__
from optshape_graph.design.bound import covariance_bound
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.evaluation.harness import Progress, Row, run_tasks
from optshape_graph.evaluation.metrics import normalised_error, pose_error, quantisation_error, vertex_jacobian
from optshape_graph.evaluation.tables import Table
from optshape_graph.pose import estimate_poses
from optshape_graph.runs.workers import Pool
from optshape_graph.scan import Scan
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import NoiseModel, pose_from_rpy, random_rings, simulate_target, without_rings
from optshape_graph.simulation.reference import DISTANCES, ORIENTATIONS, reference_pose, reference_sensor
from optshape_graph.target import Target

SCANS_PER_TASK = 8
"""Scans of a task, whose results are one file."""

AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Names of the directions of the target's tangent space in columns, rotation first, as in GTSAM."""

Removal = Literal["random", "lowest", "highest"]


class Estimate(Protocol):
    """The attributes of an estimate that the sweep uses; `PoseEstimate` has them."""

    @property
    def T_lidar_target(self) -> Floats:
        """(4, 4) estimated pose."""

    @property
    def covariance(self) -> Floats:
        """(6, 6) of its right perturbation, rotation first."""

    @property
    def status(self) -> str:
        """`ok`, `doubtful`, `ambiguous` or `failed`."""


Estimator = Callable[[Scan, Target, str], Estimate]


@dataclass(frozen=True, eq=False, repr=False)
class SimulationSweep(Value):
    """The simulations of a sweep, and the methods of estimation.

    Attributes:
        target: the target.
        sensor: the sensor; None: the paper's simulator with its quirks, and its way of placing the target.
        methods: of `estimate_pose`; all see the same clouds.
        distances: metres.
        orientations: names to (roll, pitch, yaw), rad, R = Rx Ry Rz.
        noise: levels 0 to 4, or "sensor" for that of the sensor's own model.
        range_only: whether the angular part of the levels is left out.
        draws: scans per cell.
        jitter: whether the true pose moves within an azimuth step and a gap between rings, to sample quantisation.
        removed_share: share of the rings on the target that are left out.
        removal: which rings: drawn, or from one side.
        seed: from which the seeds of all scans are spawned.

    Raises:
        InputError: no draw, a share outside [0, 1), an unknown noise level, or a distance that is not above 0.
    """

    target: Target
    sensor: SensorModel | None = None
    methods: tuple[str, ...] = ("global", "paper")
    distances: tuple[float, ...] = DISTANCES
    orientations: tuple[tuple[str, tuple[float, float, float]], ...] = tuple(ORIENTATIONS.items())
    noise: tuple[str, ...] = ("0", "1", "3")
    range_only: bool = False
    draws: int = 20
    jitter: bool = True
    removed_share: float = 0.0
    removal: Removal = "random"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.draws < 1:
            raise InputError(f"expected at least one draw, found {self.draws}")
        if not 0 <= self.removed_share < 1:
            raise InputError(f"share of rings to remove: {self.removed_share} is not within [0, 1)")
        for level in self.noise:
            if level != "sensor" and level not in "01234":
                raise InputError(f"noise level '{level}' is not one of 0, 1, 2, 3, 4, sensor")
        for distance in self.distances:
            if not (np.isfinite(distance) and distance > 0):
                raise InputError(f"distance {distance} m is not a number above 0")

    @property
    def model(self) -> SensorModel:
        """The sensor, or the paper's if none is given."""
        return reference_sensor() if self.sensor is None else self.sensor

    def describe(self) -> dict[str, Any]:
        """Return all settings that decide the results, as plain data."""
        sensor = self.model
        return {
            "version": __version__,
            "target": {"name": self.target.name, "vertices": self.target.vertices.tolist()},
            "sensor": {
                "name": sensor.name,
                "elevations": sensor.elevations.tolist(),
                "azimuth_step": sensor.azimuth_step,
                "azimuth_offsets": None if sensor.azimuth_offsets is None else sensor.azimuth_offsets.tolist(),
                "range_noise": sensor.range_noise,
                "ring_bias": sensor.ring_bias,
                "beam_divergence": sensor.beam_divergence,
                "range_resolution": sensor.range_resolution,
                "range_limits": [sensor.min_range, sensor.max_range if np.isfinite(sensor.max_range) else None],
                "placement": "diagonals" if self.sensor is None else "vertex mean",
            },
            "methods": list(self.methods),
            "distances": list(self.distances),
            "orientations": {name: list(angles) for name, angles in self.orientations},
            "noise": list(self.noise),
            "range_only": self.range_only,
            "draws": self.draws,
            "jitter": self.jitter,
            "removed_share": self.removed_share,
            "removal": self.removal,
            "seed": self.seed,
        }


@dataclass(frozen=True, eq=False, repr=False)
class SweepTask(Value):
    """Some draws of one cell.

    Attributes:
        sweep: the sweep.
        noise: level.
        orientation: name and angles.
        distance: metres.
        cell: number of the cell.
        draws: numbers of the draws.
        estimator: how to estimate; None: by `estimate_poses`.
    """

    sweep: SimulationSweep
    noise: str
    orientation: tuple[str, tuple[float, float, float]]
    distance: float
    cell: int
    draws: range
    estimator: Estimator | None


def run_simulation(
    sweep: SimulationSweep,
    folder: str | Path,
    *,
    pool: Pool | None = None,
    progress: Progress | None = None,
    estimator: Estimator | None = None,
) -> Table:
    """Run a sweep; return one row for each scan and method, in an order that depends on the sweep only.

    Args:
        sweep: the sweep.
        folder: for finished tasks, where a killed sweep goes on.
        pool: the workers; None: this process.
        progress: called as tasks finish.
        estimator: in place of `estimate_poses`, of one scan; importable by name.

    Raises:
        InputError: the folder holds another sweep (see `run_tasks`).
        MissingExtraError: Dask is asked for, and absent.
    """
    cells = list(product(sweep.noise, sweep.orientations, sweep.distances))
    tasks = [
        SweepTask(sweep, noise, orientation, distance, cell, draws, estimator)
        for cell, (noise, orientation, distance) in enumerate(cells)
        for draws in _blocks(sweep.draws)
    ]
    return Table(run_tasks(run_task, tasks, folder, sweep.describe(), pool=pool, progress=progress))


def run_task(task: SweepTask) -> list[Row]:
    """Simulate and estimate the draws of a task: one row per draw and method."""
    drawn = [_draw(task, draw) for draw in task.draws]
    scans = [scan for scan, _, _ in drawn]
    estimates = [_estimated(task, scans, method) for method in task.sweep.methods]
    return [
        {"method": method, **common, **_judge(one[k], task.sweep.target, T_true)}
        for k, (_, T_true, common) in enumerate(drawn)
        for method, one in zip(task.sweep.methods, estimates, strict=True)
    ]


def _estimated(task: SweepTask, scans: Sequence[Scan], method: str) -> Sequence[Estimate | EstimationError]:
    """Estimate the scans of a task by a method."""
    target, estimator = task.sweep.target, task.estimator
    if estimator is None:
        return estimate_poses(scans, target, method)  # type: ignore[arg-type]  # a Method
    estimates: list[Estimate | EstimationError] = []
    for scan in scans:
        try:
            estimates.append(estimator(scan, target, method))
        except EstimationError as error:
            estimates.append(error)
    return estimates


def _blocks(draws: int) -> list[range]:
    return [range(start, min(start + SCANS_PER_TASK, draws)) for start in range(0, draws, SCANS_PER_TASK)]


def _draw(task: SweepTask, draw: int) -> tuple[Scan, Floats, Row]:
    """Simulate a draw: the scan, the true pose (4, 4), and the columns that all methods share."""
    sweep, target = task.sweep, task.sweep.target
    rng = np.random.default_rng(np.random.SeedSequence(sweep.seed, spawn_key=(task.cell, draw)))
    noise, sensor = _noise_and_sensor(sweep, task.noise)
    T_true = true_pose(sweep, task.orientation[1], task.distance, rng)
    scan = simulate_target(target, sensor, T_true, noise=noise, rng=rng, name=f"cell {task.cell}, draw {draw}")
    if sweep.removed_share:
        scan = without_rings(scan, _removed(scan, sweep, rng))
    bound = covariance_bound(target, sensor, T_true, noise.azimuth_noise)
    assert scan.ring is not None
    assert sensor.azimuth_step is not None
    distance = float(np.linalg.norm(T_true[:3, 3]))
    common: Row = {
        "noise": task.noise,
        "orientation": task.orientation[0],
        "range_m": task.distance,
        "draw": draw,
        "distance_m": distance,
        "n_points": len(scan),
        "n_rings": len(np.unique(scan.ring)),
        "e_q_m": quantisation_error(sensor.azimuth_step, distance),
        "bound_rmse_m": _finite(_vertex_rms(target, bound)),
        "bound_e_t_m": _finite(np.sqrt(np.trace(bound[3:, 3:]))),
        "bound_e_r_deg": _finite(np.degrees(np.sqrt(np.trace(bound[:3, :3])))),
    }
    return scan, T_true, common


def _judge(estimate: Estimate | EstimationError, target: Target, T_true: Floats) -> Row:
    """Columns of one estimate; None where there is none."""
    names = ["rmse_m", "rmse_pct", "e_t_m", "e_t_pct", "e_r_deg", "nees"]
    names += [f"error_{axis}" for axis in AXES] + [f"sigma_{axis}" for axis in AXES]
    names += [f"vertex{k}_nees" for k in range(len(target))]
    if isinstance(estimate, EstimationError):
        return {"status": "failed", "reason": str(estimate), **dict.fromkeys(names)}
    errors = pose_error(target, estimate.T_lidar_target, T_true)
    normalised = normalised_error(target, estimate.T_lidar_target, estimate.covariance, T_true)
    values = [errors.rmse, errors.rmse_pct, errors.e_t, errors.e_t_pct, np.degrees(errors.e_r), normalised.nees]
    values += [*normalised.xi, *normalised.sigma, *normalised.vertex_nees]
    return {
        "status": estimate.status,
        "reason": getattr(estimate, "reason", ""),
        **{name: _finite(value) for name, value in zip(names, values, strict=True)},
    }


def true_pose(
    sweep: SimulationSweep, angles: tuple[float, float, float], distance: float, rng: np.random.Generator
) -> Floats:
    """Return T_lidar_target (4, 4) of one draw.

    Jitter moves the target sideways by up to half an azimuth step, and up or down by up to half the gap between rings,
    at its distance.
    """
    sensor, target = sweep.model, sweep.target
    T = reference_pose(target, distance, angles) if sweep.sensor is None else pose_from_rpy([distance, 0, 0], angles)
    if sweep.jitter:
        assert sensor.azimuth_step is not None
        T[1, 3] += rng.uniform(-0.5, 0.5) * sensor.azimuth_step * distance
        T[2, 3] += rng.uniform(-0.5, 0.5) * _ring_gap(sensor, target.circumradius / distance) * distance
    return T


def _ring_gap(sensor: SensorModel, half_extent: float) -> float:
    """Return the median gap, rad, between the rings that a target at elevation 0 spans, which are two at least."""
    nearest = np.argsort(np.abs(sensor.elevations), kind="stable")
    spanned = np.flatnonzero(np.abs(sensor.elevations) <= half_extent)
    rings = np.union1d(nearest[:2], spanned)
    return float(np.median(np.diff(sensor.elevations[rings]))) if len(rings) > 1 else 0.0


def _noise_and_sensor(sweep: SimulationSweep, level: str) -> tuple[NoiseModel, SensorModel]:
    """Return the noise of a level, and the sensor with that noise and an ideal beam, as its user knows it."""
    sensor = sweep.model
    if level == "sensor":
        return NoiseModel.of(sensor), sensor
    noise = NoiseModel.level(int(level), sweep.range_only)
    return noise, replace(sensor, range_noise=noise.range_noise, ring_bias=0.0, beam_divergence=0.0, beam_aperture=0.0)


def _removed(scan: Scan, sweep: SimulationSweep, rng: np.random.Generator) -> Any:
    if sweep.removal == "random":
        return random_rings(scan, sweep.removed_share, rng)
    present = np.unique(scan.ring) if scan.ring is not None else np.zeros(0, dtype=int)
    count = round(sweep.removed_share * len(present))
    return present[:count] if sweep.removal == "lowest" else present[len(present) - count :]


def _vertex_rms(target: Target, covariance: Floats) -> float:
    """Return the root mean square distance of the vertices under a pose covariance, metres."""
    J = vertex_jacobian(target)
    return float(np.sqrt(np.trace(J @ covariance @ J.swapaxes(1, 2), axis1=1, axis2=2).mean()))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
