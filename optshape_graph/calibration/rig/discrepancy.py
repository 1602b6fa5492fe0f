"""What a LiDAR's scans are off by beyond their noise model: recordings show more than sensor files say.

Each scan is compared with where the placement's other sightings put the target by the rig of all other placements. A
rotation and a translation of the target, each the same about all axes, of standard deviations that make the differences
likeliest, stand for what the noise model leaves out; the scans are loosened by them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import minimize

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.consistency import CHANCE
from optshape_graph.calibration.camera.graph import Discrepancy
from optshape_graph.calibration.rig.graph import RigGraph
from optshape_graph.calibration.rig.judgement import scatter_of, widening
from optshape_graph.calibration.rig.left_out import predictions
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.solve import solve_graph
from optshape_graph.graph import SharedErrors
from optshape_graph.se3 import adjoint

SETTLING = 5
"""Solutions after which it is taken as it is."""

FEWEST = 5
"""Scans of a LiDAR from which it can be told."""

SMALLEST, LARGEST = (1e-5, 1e-5), (np.radians(5.0), 0.1)
"""Of what is looked for: rotation, rad, and translation, metres."""


def settled(graph: RigGraph, used: Collection[int], values: gtsam.Values | None = None) -> RigSolution:
    """Solve over some sightings; where they scatter more than chance explains, scans are loosened by what they are off.

    Args:
        graph: of all sightings.
        used: numbers of those that take part.
        values: where to start; None: where the graph's start is.

    Raises:
        EstimationError: the minimum is not found.
    """
    solved = solve_graph(graph, used, values)
    if widening(*scatter_of(solved)) == 1.0:
        return solved
    for _ in range(SETTLING):
        found = estimate(solved)
        if _alike(found, solved.graph.discrepancy):
            break
        solved = solve_graph(replace(graph, discrepancy=found), used, solved.solution.values)
    return solved


def estimate(solved: RigSolution) -> dict[str, Discrepancy]:
    """Return by LiDAR what its scans are off by; those have no entry that chance explains, or that took few scans."""
    models: Any = solved.solution.models
    term, state = models[0].term, models[0].state
    graph = replace(solved.graph, discrepancy={})
    plain = SharedErrors(
        term.chains, tuple(graph.measurements[n] for n in solved.scans), term.sensor, term.keys, term.errors
    ).at(state)
    by_state = term.chains.derivatives(plain.R, state)
    H = term.chains.at(state)
    predicted = predictions(solved)
    columns = solved.solution.system.columns
    found: dict[str, list[tuple[Floats, Floats, Floats]]] = {}
    for k, number in enumerate(solved.scans):
        if number not in predicted:
            continue
        step, spread = predicted[number]
        rows = np.zeros((6, len(step)))
        key = term.keys[int(term.sensor[k])]
        own = plain.E[k][:, : len(term.errors[int(term.sensor[k])])]
        for one, block in zip([*term.chains.keys[k], key], [*by_state[k], own], strict=True):
            rows[:, columns[one]] += block
        residual, whole = plain.d[k] + rows @ step, np.eye(6) + rows @ spread @ rows.T
        # Exp(x) H = H Exp(Ad(H^-1) x)
        effect = plain.R[k] @ adjoint(np.linalg.inv(H[k]))
        sensor = solved.graph.start.sightings[number].sensor
        found.setdefault(sensor, []).append((residual, whole, effect))
    estimates = {name: _likeliest(scans) for name, scans in found.items() if len(scans) >= FEWEST}
    return {name: value for name, value in estimates.items() if value is not None}


def _likeliest(scans: list[tuple[Floats, Floats, Floats]]) -> Discrepancy | None:
    r, W, G = (np.array(one) for one in zip(*scans, strict=True))

    def cost(log_sigmas: Floats) -> float:
        D = np.diag(np.repeat(np.exp(2 * log_sigmas), 3))
        total = W + G @ D @ np.swapaxes(G, 1, 2)
        fit = np.einsum("vi,vi->", r, np.linalg.solve(total, r[..., None])[..., 0])
        return float(fit + np.linalg.slogdet(total)[1].sum())

    smallest, largest = np.log(SMALLEST), np.log(LARGEST)
    start = np.log([np.radians(0.1), 0.001])
    best = minimize(cost, start, method="L-BFGS-B", bounds=list(zip(smallest, largest, strict=True)))
    if cost(smallest) - best.fun < CHANCE:
        return None
    rotation, translation = np.exp(best.x)
    return Discrepancy(float(rotation), float(translation))


def _alike(a: Mapping[str, Discrepancy], b: Mapping[str, Discrepancy]) -> bool:
    return a.keys() == b.keys() and all(
        abs(np.log(a[name].rotation / b[name].rotation)) < 0.05
        and abs(np.log(a[name].translation / b[name].translation)) < 0.05
        for name in a
    )
