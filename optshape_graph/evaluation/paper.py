"""The tables of Huang, Clark and Grizzle, "Optimal Target Shape for LiDAR Pose Estimation", beside ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optshape_graph.evaluation.harness import Progress, Row
from optshape_graph.evaluation.published import TABLE_1, TABLE_2, PublishedRow
from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation
from optshape_graph.evaluation.tables import ERRORS, beside_published, summarise
from optshape_graph.target import Target

NOT_REPRODUCED = {
    "1": "photographs of the target and a scan of it: see figure 8 for the fit, `design export` for the target",
    "2": "a sketch of the optimisation: `design optimise --plot` draws the search itself",
    "11 and 12": "photographs of the experiment",
}
"""Figures of the paper that are not reproduced, by number, with the reason."""


def table_1(
    target: Target, folder: str | Path, draws: int, seed: int = 0, progress: Progress | None = None
) -> list[Row]:
    """Run the simulations of Table I, and put the medians of `draws` scans beside the printed numbers.

    Args:
        target: the paper's.
        folder: where finished tasks are kept.
        draws: scans of each row.
        seed: of everything random.
        progress: called as tasks finish.
    """
    distances = tuple(sorted({round(row.distance_m / 2) * 2.0 for row in TABLE_1}))
    sweep = SimulationSweep(target, distances=distances, noise=("1",), draws=draws, seed=seed)
    rows = run_simulation(sweep, folder, progress=progress)
    return beside_published(summarise(rows, ("method", "noise", "orientation", "range_m")))


def figure_10(
    target: Target, folder: str | Path, draws: int, seed: int = 0, progress: Progress | None = None
) -> list[Row]:
    """Run the simulations of the paper's charts, 2 to 40 m at two levels of noise, and return a row for each cell.

    Args:
        target: the paper's.
        folder: where finished tasks are kept.
        draws: scans of each cell.
        seed: of everything random.
        progress: called as tasks finish.
    """
    sweep = SimulationSweep(target, methods=("global",), noise=("1", "3"), draws=draws, seed=seed)
    rows = run_simulation(sweep, folder, progress=progress)
    return summarise(rows, ("method", "noise", "orientation", "range_m"))


def columns_of(
    table: Sequence[PublishedRow], ours: Sequence[Mapping[str, Any]], methods: Sequence[str]
) -> list[list[str]]:
    """Return the cells of a table in the paper's columns: the printed numbers, then each method's, with percentages.

    Args:
        table: `TABLE_1` or `TABLE_2`.
        ours: a row for each of its rows, or an empty one; columns METHOD_rmse_m, METHOD_e_t_m and METHOD_e_r_deg.
        methods: their names.
    """
    cells = []
    for printed, row in zip(table, ours, strict=True):
        own = f"{row['n_points']:.0f}" if row.get("n_points") else "-"
        line = [printed.orientation, f"{printed.distance_m:.2f}", f"{printed.n_points} / {own}", f"{printed.e_q_m:.3f}"]
        line.append(f"{printed.rmse_m:.3f} ({printed.rmse_pct:.2f} %) {printed.e_t_m:.3f} {printed.e_r_deg:.2f}")
        for method in methods:
            values = [row.get(f"{method}_{name}") for name in ERRORS]
            given = [float(value) for value in values if value is not None]
            if len(given) < len(ERRORS):
                line.append("-")
                continue
            rmse, e_t, e_r = given
            line.append(f"{rmse:.3f} ({100 * rmse / printed.distance_m:.2f} %) {e_t:.3f} {e_r:.2f}")
        cells.append(line)
    return cells


def table_2(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return, for each row of Table II, our row of the same attitude at the nearest distance, or an empty row.

    Args:
        rows: from `evaluate_mocap`.
    """
    found: list[Mapping[str, Any]] = []
    for printed in TABLE_2:
        near = [row for row in rows if abs(row["distance_m"] - printed.distance_m) < 0.15]
        mine = next((row for row in near if _attitude(row) == printed.orientation), None)
        errors = {} if mine is None else {f"ours_{name}": mine[name] for name in ERRORS}
        found.append({"n_points": None if mine is None else mine["n_points"], **errors})
    return found


def _attitude(row: Mapping[str, Any]) -> str:
    return "extreme" if "angled" in str(row["scan"]) or "extreme" in str(row["scan"]) else "face"
