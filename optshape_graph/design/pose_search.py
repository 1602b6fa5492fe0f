"""The search for the shape whose pose is known best: it minimises the bound on both errors, not the paper's score.

Every candidate is placed as users may place it: with any roll, tilts up to a largest one, heights between two rings, at
several distances of several sensors, some of whose rings are lost. For each sensor and distance (a cell), the median
and the 95th percentile of e_r and of e_t are divided by those of a reference shape of the same area. The cost is the
mean of the logarithms of these ratios, and a penalty on the worst ratio.

Limits keep a shape buildable, and unlike any turned copy of itself, so that a stray return cannot turn the estimate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.design.bound import bound_of, pose_information
from optshape_graph.design.family import Family
from optshape_graph.design.limits import Limits
from optshape_graph.design.multistart import upright
from optshape_graph.design.polygons import centred
from optshape_graph.design.problem import Problem, parameters_of, random_parameters, unknowns_of
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.se3 import rotation, transform
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

PRIOR = np.repeat([np.radians(30.0), 0.5], 3)
"""Prior standard deviations of a pose, rad and m, without which a bound could be infinite."""

WORST = 2.0
"""Weight of the logarithm of the worst ratio above `WORST_RATIO`, relative to the mean of all."""

WORST_RATIO = 0.98
"""A worst ratio up to this has no penalty."""

PENALTY = 20.0
"""Cost per unit of the relative slack by which a limit is violated."""

QUANTILES = (0.5, 0.95)
"""Quantiles of the errors over placements."""


@dataclass(frozen=True, eq=False, repr=False)
class Placements(Value):
    """Sensors, distances and attitudes over which a shape is judged.

    Attributes:
        sensors: the sensors, whose azimuth steps must be known.
        distances: of the target, metres.
        per_cell: placements of each sensor at each distance.
        largest_tilt: of the target away from facing the sensor, rad.
        lost_rings: share of the rings that every second placement loses.
        seed: of the attitudes and lost rings, which are the same for every shape.

    Raises:
        InputError: no sensor, no distance, or fewer than 4 placements in a cell.
    """

    sensors: tuple[SensorModel, ...]
    distances: tuple[float, ...] = (10.0, 20.0, 30.0)
    per_cell: int = 32
    largest_tilt: float = np.radians(50.0)
    lost_rings: float = 0.2
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.sensors or not self.distances or self.per_cell < 4:
            raise InputError("expected a sensor, a distance and at least 4 placements in each cell")

    @cached_property
    def cells(self) -> tuple[tuple[tuple[SensorModel, Floats], ...], ...]:
        """For each sensor and distance: pairs of a sensor, whole and with rings lost, and (N, 4, 4) poses."""
        rng = np.random.default_rng(self.seed)
        cells = []
        for sensor in self.sensors:
            for distance in self.distances:
                poses = attitudes(sensor, distance, self.per_cell, self.largest_tilt, rng)
                kept = rng.uniform(size=sensor.n_rings) >= self.lost_rings
                lossy = replace(sensor, elevations=sensor.elevations[kept], azimuth_offsets=None)
                cells.append(((sensor, poses[::2]), (lossy, poses[1::2])))
        return tuple(cells)

    def errors(self, target: Target) -> Floats:
        """(C, 2, 2) quantiles of the bounds on e_r (rad) and e_t (m): cells x (e_r, e_t) x `QUANTILES`."""
        found = []
        for cell in self.cells:
            bounds = np.concatenate([expected_covariance(target, sensor, poses) for sensor, poses in cell])
            variances = np.diagonal(bounds, axis1=1, axis2=2)
            rms = np.sqrt([variances[:, :3].sum(axis=1), variances[:, 3:].sum(axis=1)])
            found.append(np.quantile(rms, QUANTILES, axis=1).T)
        return np.array(found)


def attitudes(
    sensor: SensorModel, distance: float, count: int, largest_tilt: float, rng: np.random.Generator
) -> Floats:
    """Return T_lidar_target (count, 4, 4): even rolls, tilts about any axis in the plane, heights between two rings."""
    rolls = 2 * np.pi * (np.arange(count) + rng.uniform(size=count)) / count
    axes, tilts = rng.uniform(0, 2 * np.pi, count), largest_tilt * np.sqrt(rng.uniform(size=count))
    order = rng.permutation(count)
    tilted = rotation(tilts[:, None] * np.column_stack([np.zeros(count), np.cos(axes), np.sin(axes)]))
    turned = rotation(np.outer(rolls[order], [1.0, 0.0, 0.0]))
    gap = horizon_gap(sensor)
    heights = distance * np.tan(gap[0] + (gap[1] - gap[0]) * rng.uniform(size=count))
    sideways = rng.uniform(-0.5, 0.5, count)
    return transform(tilted @ turned, np.column_stack([np.full(count, distance), sideways, heights]))


def horizon_gap(sensor: SensorModel) -> Floats:
    """Return the elevations (2,), rad, of the two rings nearest to the horizon, one on each side if possible."""
    above = int(np.searchsorted(sensor.elevations, 0.0).clip(1, max(sensor.n_rings - 1, 1)))
    return np.asarray(sensor.elevations[[above - 1, min(above, sensor.n_rings - 1)]])


def expected_covariance(target: Target, sensor: SensorModel, T_lidar_target: Floats) -> Floats:
    """Return bounds (N, 6, 6) that also use between which rings the target's top and bottom lie; never infinite.

    The ends of rings alone leave a target with a level edge undetermined. But the next ring misses the target, so the
    edge lies in the gap between the two: a uniform distribution, here taken for Gaussian.
    """
    T = np.asarray(T_lidar_target)
    information = pose_information(target, sensor, T) + np.diag(PRIOR**-2)
    corners = np.einsum("bij,nj->bni", T[:, :3, :3], target.vertices) + T[:, None, :3, 3]
    elevations = np.arctan2(corners[..., 2], np.hypot(corners[..., 0], corners[..., 1]))
    up = T[:, 2, :3].copy()
    up[:, 0] = 0.0
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    for extreme in (elevations.argmin(axis=1), elevations.argmax(axis=1)):
        at = target.vertices[extreme]
        reach = np.linalg.norm(corners[np.arange(len(T)), extreme], axis=1)
        gap = _gap_at(sensor, elevations[np.arange(len(T)), extreme]) * reach
        row = np.hstack([np.cross(at, up), up]) / (gap / np.sqrt(12.0))[:, None]
        information += row[:, :, None] * row[:, None]
    return bound_of(information, target.circumradius)


def _gap_at(sensor: SensorModel, elevations: Floats) -> Floats:
    """Return the angles (N,), rad, between the rings below and above elevations, at most 18 degrees."""
    edges = np.concatenate([[-np.pi / 2], sensor.elevations, [np.pi / 2]])
    above: Ints = np.searchsorted(edges, elevations).clip(1, len(edges) - 1)
    return np.asarray(np.minimum(edges[above] - edges[above - 1], np.pi / 10))


@dataclass(frozen=True, eq=False, repr=False)
class PoseProblem(Value):
    """The problem: find the shape of a family whose pose is known best.

    Attributes:
        placements: where a shape is judged.
        reference: the shape whose errors count as 1, scaled to the area of the limits.
        family: the candidates.
        limits: of the workshop.
    """

    placements: Placements
    reference: Target
    family: Family = field(default_factory=Family)
    limits: Limits = field(default_factory=Limits)

    @cached_property
    def reference_errors(self) -> Floats:
        """(C, 2, 2) errors of the reference: see `Placements.errors`."""
        return self.placements.errors(self.reference.scaled_to_area(self.limits.area))

    def ratios(self, target: Target) -> Floats:
        """(C, 2, 2) ratios of a target's errors to those of the reference, both with the area of the limits."""
        return self.placements.errors(target.scaled_to_area(self.limits.area)) / self.reference_errors

    def cost(self, target: Target) -> float:
        """Return the cost, which the search minimises; below 0, the target is better than the reference."""
        logs = np.log(self.ratios(target))
        return float(logs.mean() + WORST * max(logs.max() - np.log(WORST_RATIO), 0.0))

    def penalised(self, unknowns: Floats) -> float:
        """Return the cost of a candidate's unknowns (5,), plus PENALTY times its violation of the limits."""
        parameters = parameters_of(unknowns[None])
        depth = float(self.family.depths(parameters).min())
        if depth < 0.05 or abs(unknowns[2]) > 2.0:
            return 1e3 * (1.0 + max(-depth, 0.0))
        polygon = centred(self.family.polygons(parameters)[0])
        lacking = float(np.minimum(self.limits.slacks(polygon[None]), 0.0).sum())
        if lacking < -1.0:
            return -PENALTY * lacking
        return self.cost(Target.from_polygon(polygon * np.sqrt(self.limits.area))) - PENALTY * lacking


@dataclass(frozen=True)
class FoundShape:
    """The result of a search for the best pose.

    Attributes:
        target: the shape, with the area of the limits, turned upright (`upright`).
        cost: its cost (`PoseProblem.cost`).
        costs: of the ends of all starts, including penalties.
    """

    target: Target
    cost: float
    costs: tuple[float, ...]


def search_for_poses(
    problem: PoseProblem,
    starts: int,
    seed: int,
    name: str = "target",
    *,
    steps: int = 100,
    progress: Callable[[int, int], None] | None = None,
    initial: Sequence[Floats] = (),
) -> FoundShape:
    """Search from random shapes of the family (Nelder and Mead); the same seed finds the same shape.

    Args:
        problem: the problem.
        starts: number of random starts, after the `initial` ones.
        seed: of the starts.
        name: of the target that is found.
        steps: evaluations of each start.
        progress: called with the number of finished starts and that of all.
        initial: further parameters (5,) to start from.

    Raises:
        EstimationError: no start ended within the limits.
    """
    rng = np.random.default_rng(seed)
    drawn = [random_parameters(Problem(problem.family), rng) for _ in range(starts)]
    ends = []
    for number, parameters in enumerate([*initial, *drawn]):
        if progress is not None:
            progress(number, starts + len(initial))
        # Placements have all rolls: the bound depends on theta only through their draws, so theta stays.
        start = unknowns_of(parameters)

        def penalised(free: Floats, theta: Floats = start[:1]) -> float:
            return problem.penalised(np.concatenate([theta, free]))

        simplex = start[1:] + np.vstack([np.zeros(4), 0.25 * np.eye(4)])
        found = minimize(
            penalised,
            start[1:],
            method="Nelder-Mead",
            options={"maxfev": steps, "initial_simplex": simplex, "xatol": 1e-3, "fatol": 1e-4},
        )
        ends.append((float(found.fun), np.concatenate([start[:1], found.x])))
    within = [(cost, x, _polygon(problem, x)) for cost, x in ends]
    within = [entry for entry in within if problem.limits.slacks(entry[2][None]).min(initial=0.0) > -1e-3]
    if not within:
        raise EstimationError(
            f"none of {len(ends)} starts found a shape within the limits; allow more starts, or less strict limits"
        )
    cost, _, polygon = min(within, key=lambda entry: entry[0])
    target = Target.from_polygon(upright(polygon) * np.sqrt(problem.limits.area), name)
    return FoundShape(target, cost, tuple(cost for cost, _ in ends))


def _polygon(problem: PoseProblem, unknowns: Floats) -> Floats:
    return centred(problem.family.polygons(parameters_of(unknowns[None]))[0])
