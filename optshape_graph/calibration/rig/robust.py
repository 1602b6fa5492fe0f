"""A rig solved over the sightings that agree; the others are left out, and it is said why."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.rig.discrepancy import settled
from optshape_graph.calibration.rig.graph import RigGraph
from optshape_graph.calibration.rig.judgement import scatter_of
from optshape_graph.calibration.rig.result import DISAGREES
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.errors import EstimationError
from optshape_graph.se3 import difference, inverse

LIMIT = 35.0
"""Chi-square of a sighting, six degrees of freedom, beyond which it contradicts the others."""

LIKELY = 0.5
"""Share of the limit within which a sighting that was left out agrees after all."""

SLACK = np.diag([np.radians(1.0) ** 2] * 3 + [0.01**2] * 3)
"""Covariance that stands for what a sighting's own leaves out, its rings' errors among it."""


def solve_robustly(graph: RigGraph) -> tuple[RigSolution, dict[int, str]]:
    """Solve, leave out the worst sighting or take in those that turn out to agree, until nothing changes.

    Returns:
        The solution, and why sightings take no part, by number.

    Raises:
        EstimationError: too few sightings agree.
    """
    sightings = graph.start.sightings
    used = _shared(graph, set(range(len(sightings))) - graph.start.strangers)
    why = dict.fromkeys(graph.start.strangers, "")
    values, tried = None, False
    for _ in range(2 * len(sightings) + 2):
        _check_sensors(graph, used)
        solved = settled(graph, used, values)
        values = solved.solution.values
        scatter = max(1.0, scatter_of(solved)[0])
        worst = max(solved.chi2, key=lambda number: solved.chi2[number])
        if solved.chi2[worst] > LIMIT * scatter:
            why[worst] = ""
            used = _shared(graph, used - {worst})
            continue
        agreeing = set() if tried else {n for n in why if _distance(solved, n) < LIKELY * LIMIT * scatter}
        if not agreeing:
            break
        why = {n: reason for n, reason in why.items() if n not in agreeing}
        used, tried = used | agreeing, True
    return solved, {number: _disagreement(solved, number) for number in why}


def _shared(graph: RigGraph, used: set[int]) -> set[int]:
    """Leave out sightings that have nothing to be compared with."""
    if graph.moments:
        return used
    sensors: dict[str, set[str]] = {}
    for number in used:
        sighting = graph.start.sightings[number]
        sensors.setdefault(sighting.placement, set()).add(sighting.sensor)
    return {number for number in used if len(sensors[graph.start.sightings[number].placement]) > 1}


def _check_sensors(graph: RigGraph, used: set[int]) -> None:
    seeing = {graph.start.sightings[number].sensor for number in used}
    if missing := [name for name in graph.start.T_base_sensor if name not in seeing]:
        raise EstimationError(f"no view of {', '.join(missing)} agrees with those of the other sensors")


def _predicted(solved: RigSolution, number: int) -> Floats | None:
    """Where a sensor should see a target (4, 4); None where no other sensor tells."""
    sighting, graph = solved.graph.start.sightings[number], solved.graph
    values = solved.solution.values
    keys = [graph.placements[sighting.placement]]
    if sighting.moment in graph.moments:
        keys.append(graph.moments[sighting.moment])
    if not all(values.exists(key) for key in keys):
        return None
    T_base_target = solved.solution.pose(keys[0])
    if len(keys) > 1:
        T_base_target = inverse(solved.solution.pose(keys[1])) @ T_base_target
    return inverse(solved.T_base_sensor(sighting.sensor)) @ T_base_target


def _distance(solved: RigSolution, number: int) -> float:
    """Squared distance of a sighting from where it should be, in standard deviations; infinite: nowhere."""
    predicted, sighting = _predicted(solved, number), solved.graph.start.sightings[number]
    if predicted is None:
        return np.inf
    x = difference(sighting.pose, predicted)
    return float(x @ np.linalg.solve(sighting.candidates[sighting.reading].covariance + SLACK, x))


def _disagreement(solved: RigSolution, number: int) -> str:
    predicted, sighting = _predicted(solved, number), solved.graph.start.sightings[number]
    if predicted is None:
        return f"{DISAGREES}the only other sensor that saw the placement"
    x = difference(predicted, sighting.pose)
    moved = f": did '{sighting.target.name}' move?" if "@" not in sighting.placement else ""
    return (
        f"{DISAGREES}the others by {np.linalg.norm(x[3:]):.3f} m and {np.degrees(np.linalg.norm(x[:3])):.1f} deg{moved}"
    )
