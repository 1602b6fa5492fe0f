"""A study whether a better score means a better pose: shapes are scored, bounded, and estimated in simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from optshape_graph._arrays import Bools, Floats, Value
from optshape_graph._version import __version__
from optshape_graph.design.bound import covariance_bound
from optshape_graph.design.family import Family
from optshape_graph.design.judgement import DEGREE, worst_cell
from optshape_graph.design.limits import Limits
from optshape_graph.design.problem import Problem, orientations, random_parameters
from optshape_graph.design.rings import UniformRings
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.harness import Progress, Row, run_tasks
from optshape_graph.pose import estimate_poses
from optshape_graph.runs.workers import Pool
from optshape_graph.se3 import rotation, rotation_vector, transform
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import NoiseModel, simulate_target
from optshape_graph.target import Target

TILT = np.radians(30.0)
"""Largest incidence of the simulated targets."""


@dataclass(frozen=True, eq=False, repr=False)
class ShapeTrials(Value):
    """One shape over all placements.

    Attributes:
        target: the shape.
        score: its worst score at unit area, every degree.
        bound_r: (N,) Cramer-Rao bound of the rotation at each placement, rad; infinite if not determined.
        e_r: (N,) rotation errors, modulo the shape's symmetries, rad; pi without an estimate.
        e_in_plane: (N,) their parts about the target's normal, rad.
        usable: (N,) whether the status of the estimate is "ok".
    """

    target: Target
    score: float
    bound_r: Floats
    e_r: Floats
    e_in_plane: Floats
    usable: Bools


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rank correlation over shapes.

    Attributes:
        rho: the correlation.
        p_value: probability of a correlation as large in magnitude by chance.
    """

    rho: float
    p_value: float


@dataclass(frozen=True)
class ShapeStudy:
    """Shapes and the errors of their poses.

    Attributes:
        shapes: the trials of each shape.
        placements: (N, 4, 4) T_lidar_target, the same for every shape.
    """

    shapes: tuple[ShapeTrials, ...]
    placements: Floats

    def medians(self, name: str) -> Floats:
        """(S,) median over placements of "bound_r", "e_r" or "e_in_plane" of each shape, rad."""
        return np.array([np.median(getattr(shape, name)) for shape in self.shapes])

    @property
    def scores(self) -> Floats:
        """(S,) score of each shape."""
        return np.array([shape.score for shape in self.shapes])

    def correlation(self, name: str, error: str = "e_r") -> RankCorrelation:
        """Return the rank correlation over shapes of "score", or of the median "bound_r", with the median error.

        It is negative for a useful score, since a higher score means a smaller error; positive for a useful bound.
        """
        predictor = self.scores if name == "score" else self.medians(name)
        result = spearmanr(predictor, self.medians(error))
        return RankCorrelation(float(result.statistic), float(result.pvalue))

    def summary(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        correlations = [
            {"of": name, "with": error, **asdict(self.correlation(name, error))}
            for name in ("score", "bound_r")
            for error in ("e_r", "e_in_plane")
        ]
        shapes = [
            {
                "name": shape.target.name,
                "vertices": shape.target.vertices,
                "score": shape.score,
                "bound_r_deg": _degrees(np.median(shape.bound_r)),
                "e_r_deg": _degrees(np.median(shape.e_r)),
                "e_r_p90_deg": _degrees(np.quantile(shape.e_r, 0.9)),
                "e_in_plane_deg": _degrees(np.median(shape.e_in_plane)),
                "ok_share": float(shape.usable.mean()),
            }
            for shape in self.shapes
        ]
        return {"placements": len(self.placements), "correlations": correlations, "shapes": shapes}


def random_shapes(count: int, seed: int, area: float = 1.0) -> list[Target]:
    """Draw triangles, quadrilaterals and pentagons of the family in turn, with no very short edge."""
    rng = np.random.default_rng(seed)
    limits = Limits(shortest_edge=0.3, aspect=4.0, asymmetry=None)
    shapes: list[Target] = []
    while len(shapes) < count:
        problem = Problem(Family(3 + len(shapes) % 3))
        polygon = problem.family.polygons(random_parameters(problem, rng))[0]
        if limits.slacks(polygon[None]).min() >= 0:
            shapes.append(Target.from_polygon(polygon * np.sqrt(area), f"random-{len(shapes)}"))
    return shapes


def random_placements(distances: Sequence[float], per_distance: int, seed: int) -> Floats:
    """Return T_lidar_target (N, 4, 4): even rolls, random tilts of up to TILT, heights near the sensor's."""
    rng = np.random.default_rng(seed)
    placements = []
    for distance in distances:
        for turn in range(per_distance):
            roll = 2 * np.pi * (turn + rng.uniform()) / per_distance
            axis, tilt = rng.uniform(0, 2 * np.pi), TILT * np.sqrt(rng.uniform())
            R = rotation(tilt * np.array([0.0, np.cos(axis), np.sin(axis)])) @ rotation([roll, 0.0, 0.0])
            placements.append(transform(R, [distance, rng.uniform(-0.5, 0.5), rng.uniform(-0.3, 0.3)]))
    return np.array(placements)


def study_shapes(
    targets: Sequence[Target],
    sensor: SensorModel,
    placements: Floats,
    seed: int,
    folder: str | Path,
    *,
    pool: Pool | None = None,
    progress: Progress | None = None,
) -> ShapeStudy:
    """Simulate every shape at every placement, with the sensor's own noise, and estimate its pose.

    Args:
        targets: the shapes.
        sensor: the sensor, whose azimuth step must be known.
        placements: (N, 4, 4) T_lidar_target.
        seed: of the noise; the result depends on it and not on the number of workers.
        folder: for finished shapes, where a killed study goes on.
        pool: the workers; None: this process.
        progress: called when a shape is finished, and once before the first.

    Raises:
        InputError: the folder holds another study.
        MissingExtraError: Dask is asked for, and absent.
    """
    describe = {
        "kind": "shape study",
        "version": __version__,
        "sensor": asdict(sensor),
        "placements": placements,
        "seed": seed,
        "shapes": [[target.name, target.vertices.tolist()] for target in targets],
    }
    describe = {key: _plain(value) for key, value in describe.items()}
    trials = partial(_trials, sensor, placements, seed)
    rows = run_tasks(trials, list(enumerate(targets)), folder, describe, pool=pool, progress=progress)
    by_shape = [[row for row in rows if row["shape"] == index] for index in range(len(targets))]
    shapes = [_collected(target, own) for target, own in zip(targets, by_shape, strict=True)]
    return ShapeStudy(tuple(shapes), placements)


def _trials(sensor: SensorModel, placements: Floats, seed: int, item: tuple[int, Target]) -> list[Row]:
    """Return one row for each placement; None stands for an infinite bound and for a missing estimate."""
    index, target = item
    noise, rows = NoiseModel.of(sensor), []
    scans = [
        simulate_target(target, sensor, T, noise=noise, rng=np.random.default_rng([seed, index, number]))
        for number, T in enumerate(placements)
    ]
    for number, (T, estimate) in enumerate(zip(placements, estimate_poses(scans, target), strict=True)):
        bound = float(np.sqrt(np.trace(covariance_bound(target, sensor, T)[:3, :3])))
        if isinstance(estimate, EstimationError):
            error, status = None, "failed"
        else:
            nearest = target.nearest_equivalent(estimate.T_lidar_target, T)
            error = rotation_vector(T[:3, :3].T @ nearest[:3, :3]).tolist()
            status = estimate.status
        rows.append(
            {
                "shape": index,
                "placement": number,
                "bound_r": bound if np.isfinite(bound) else None,
                "error": error,
                "status": status,
            }
        )
    return rows


def _collected(target: Target, rows: list[Row]) -> ShapeTrials:
    errors = [row["error"] for row in rows]
    return ShapeTrials(
        target,
        worst_cell(target, orientations(UniformRings(), DEGREE)).score,
        np.array([np.inf if row["bound_r"] is None else row["bound_r"] for row in rows]),
        np.array([np.pi if error is None else np.linalg.norm(error) for error in errors]),
        np.array([np.pi if error is None else abs(error[0]) for error in errors]),
        np.array([row["status"] == "ok" for row in rows]),
    )


def _degrees(angle: float | np.floating[Any]) -> float | None:
    return float(np.degrees(angle)) if np.isfinite(angle) else None


def _plain(value: Any) -> Any:
    """Return the value as JSON can hold it."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return None if isinstance(value, float) and not np.isfinite(value) else value
