"""Results of evaluations in plain form, as in their JSON files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from optshape_graph.calibration.mocap.result import LeftOut
from optshape_graph.evaluation.covariances import consistency
from optshape_graph.evaluation.harness import Row
from optshape_graph.evaluation.mocap import PROTOCOLS, mean_errors
from optshape_graph.evaluation.simulation import SimulationSweep
from optshape_graph.evaluation.tables import ERRORS, summarise

CELL = ("method", "noise", "orientation", "range_m")
"""Columns that all scans of a cell share."""

COUNTS = ("scans", "ok", "doubtful", "ambiguous", "failed")


def simulation_document(sweep: SimulationSweep, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the results of a sweep for each cell: statuses of scans, errors, and consistency of covariances.

    Args:
        sweep: the sweep.
        rows: from `run_simulation`.
    """
    kept = (*CELL, *COUNTS, *(f"{error}_{part}" for error in ERRORS for part in ("median", "p95")), "worst_ok_e_r_deg")
    cells = []
    for cell in summarise(rows, CELL):
        of_cell = [row for row in rows if all(row[name] == cell[name] for name in CELL)]
        consistent = consistency(of_cell)
        nees = {name: consistent.get(name) for name in ("nees_per_dof", "nees_low", "nees_high")}
        cells.append({**{name: cell[name] for name in kept}, **nees})
    return {
        "schema": "optshape/simulation-evaluation/1",
        "target": sweep.target.name,
        "sensor": None if sweep.sensor is None else sweep.sensor.name,
        "draws": sweep.draws,
        "seed": sweep.seed,
        "cells": cells,
    }


def mocap_document(rows: Sequence[Row], left_out: Sequence[LeftOut]) -> dict[str, Any]:
    """Return the errors of every scan against motion capture, ours and others', their means, and scans left out.

    Args:
        rows: from `evaluate_mocap`.
        left_out: from `evaluate_mocap`.
    """
    means = {f"{prefix}mean": mean_errors(rows, prefix) for prefix in PROTOCOLS}
    return {
        "schema": "optshape/mocap-evaluation/1",
        "protocol": "leave-one-out",
        "scans": list(rows),
        **means,
        "left_out": [{"scan": item.scan, "reason": item.reason} for item in left_out],
    }
