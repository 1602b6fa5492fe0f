"""Evaluation of estimates: metrics, Monte Carlo sweeps, tables beside the paper's, consistency, verdicts.

Names are imported when they are first used: every command prints a verdict, and few evaluate.
"""

from typing import TYPE_CHECKING

from optshape_graph._lazy import lazy

if TYPE_CHECKING:
    from optshape_graph.evaluation.covariances import consistency
    from optshape_graph.evaluation.harness import run_tasks
    from optshape_graph.evaluation.metrics import NormalisedError, PoseError, normalised_error, pose_error
    from optshape_graph.evaluation.mocap import evaluate_mocap, find_sessions
    from optshape_graph.evaluation.simulation import SimulationSweep, run_simulation
    from optshape_graph.evaluation.tables import Table, beside_published, by_group, summarise, write_csv, write_parquet

_HOME = {
    "covariances": "consistency",
    "harness": "run_tasks",
    "metrics": "NormalisedError PoseError normalised_error pose_error",
    "mocap": "evaluate_mocap find_sessions",
    "simulation": "SimulationSweep run_simulation",
    "tables": "Table beside_published by_group summarise write_csv write_parquet",
}

__all__ = [
    "NormalisedError",
    "PoseError",
    "SimulationSweep",
    "Table",
    "beside_published",
    "by_group",
    "consistency",
    "evaluate_mocap",
    "find_sessions",
    "normalised_error",
    "pose_error",
    "run_simulation",
    "run_tasks",
    "summarise",
    "write_csv",
    "write_parquet",
]

__getattr__, __dir__ = lazy(__name__, _HOME)
