"""Consistency of covariances: normalised errors against chi-square, and coverage by axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2, norm

from optshape_graph.evaluation.harness import Row
from optshape_graph.evaluation.simulation import AXES


def consistency(rows: Sequence[Row], level: float = 0.95) -> Row:
    """Compare the errors of estimates with their covariances.

    Args:
        rows: from `run_simulation`, of one cell and method; only estimates that are ok count: an ambiguous one may be
            another mode.
        level: probability of the regions whose coverage is counted.

    Returns:
        `scans`; `nees_per_dof`, the mean normalised error squared over its 6 degrees of freedom, which is 1 if the
        covariance is right, and `nees_low` and `nees_high`, between which it is in 95 of 100 such experiments;
        `coverage`, the share of the errors inside their 6-dimensional region; `coverage_<axis>` for each axis; and of
        each vertex its `vertex<k>_nees_per_dof` and `vertex<k>_coverage`, of 3 degrees of freedom.
    """
    judged = [row for row in rows if row["status"] == "ok" and row["nees"] is not None]
    n = len(judged)
    if n == 0:
        return {"scans": 0}
    nees = np.array([row["nees"] for row in judged])
    half_width = norm.ppf(0.5 + level / 2)
    result: Row = {
        "scans": n,
        "nees_per_dof": float(nees.mean() / 6),
        "nees_low": float(chi2.ppf(0.025, 6 * n) / (6 * n)),
        "nees_high": float(chi2.ppf(0.975, 6 * n) / (6 * n)),
        "coverage": float((nees <= chi2.ppf(level, 6)).mean()),
    }
    for axis in AXES:
        inside = [abs(row[f"error_{axis}"]) <= half_width * row[f"sigma_{axis}"] for row in judged]
        result[f"coverage_{axis}"] = float(np.mean(inside))
    for column in (name for name in judged[0] if name.startswith("vertex")):
        squares = np.array([row[column] for row in judged])
        result[f"{column}_per_dof"] = float(squares.mean() / 3)
        result[column.replace("nees", "coverage")] = float((squares <= chi2.ppf(level, 3)).mean())
    return result
