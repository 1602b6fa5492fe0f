"""Tables: files that read back, summaries, the paper's rows beside ours, consistency."""

import csv

import numpy as np
import pytest

from optshape_graph.evaluation import beside_published, consistency, summarise, write_csv, write_parquet
from optshape_graph.evaluation.published import TABLE_1, TABLE_2
from optshape_graph.evaluation.simulation import AXES
from tests.shared import SHARED, needs_shared


def row(**changes):
    base = {
        "method": "global", "noise": "1", "orientation": "face", "range_m": 2.0, "distance_m": 2.0, "n_points": 2530,
        "e_q_m": 0.014, "status": "ok", "rmse_m": 0.1, "e_t_m": 0.2, "e_r_deg": 1.0, "bound_rmse_m": 0.01,
        "bound_e_t_m": 0.02, "bound_e_r_deg": 0.5, "nees": 6.0,
    }  # fmt: skip
    return base | changes


ROWS = [
    row(rmse_m=0.1 / 3), row(rmse_m=0.3, e_r_deg=40.0, status="ambiguous"),
    row(status="failed", rmse_m=None, e_t_m=None, e_r_deg=None, nees=None),
]  # fmt: skip


def test_csv_and_parquet_read_back_exactly(tmp_path):
    write_csv(tmp_path / "a.csv", ROWS)
    with (tmp_path / "a.csv").open() as stream:
        read = list(csv.DictReader(stream))
    assert [float(r["rmse_m"]) if r["rmse_m"] else None for r in read] == [r["rmse_m"] for r in ROWS]
    parquet = pytest.importorskip("pyarrow.parquet")
    write_parquet(tmp_path / "a.parquet", ROWS)
    assert parquet.read_table(tmp_path / "a.parquet").to_pylist() == ROWS


def test_summary_counts_and_measures():
    (summary,) = summarise(ROWS, ["method", "noise"])
    assert (summary["scans"], summary["ok"], summary["ambiguous"], summary["failed"]) == (3, 1, 1, 1)
    assert summary["rmse_m_mean"] == pytest.approx((0.1 / 3 + 0.3) / 2)
    assert summary["e_r_deg_max"] == 40.0
    assert summary["worst_ok_e_r_deg"] == 1.0
    assert summary["rmse_m_bound"] == 0.01


def test_the_papers_rows_stand_beside_ours():
    cells = summarise([row(), row(method="paper", rmse_m=0.5)], ["method", "orientation", "range_m"])
    beside = beside_published(cells)
    assert len(beside) == len(TABLE_1)
    assert beside[0]["published_rmse_m"] == 0.01
    assert beside[0]["global_rmse_m"] == 0.1
    assert beside[0]["paper_rmse_m"] == 0.5
    assert "global_rmse_m" not in beside[1]


@needs_shared
@pytest.mark.parametrize(("table", "file"), [(TABLE_1, "table1_simulation"), (TABLE_2, "table2_experiment")])
def test_tables_are_as_printed(table, file):
    with (SHARED / "reference" / f"{file}.csv").open() as stream:
        printed = list(csv.DictReader(stream))
    assert len(printed) == len(table)
    for ours, theirs in zip(table, printed, strict=True):
        assert ours.orientation == theirs["condition"].removesuffix("_on")
        for name in ours._fields[1:]:
            assert getattr(ours, name) == float(theirs[name])


def test_consistency_of_errors_drawn_from_their_covariance():
    rng = np.random.default_rng(1)
    sigma = np.array([1e-2, 2e-2, 3e-2, 1e-3, 2e-3, 3e-3])
    rows = []
    for xi in rng.normal(size=(2000, 6)) * sigma:
        rows.append(
            row(nees=float(((xi / sigma) ** 2).sum()), vertex0_nees=float(((xi / sigma)[3:] ** 2).sum()))
            | {f"error_{axis}": x for axis, x in zip(AXES, xi, strict=True)}
            | {f"sigma_{axis}": s for axis, s in zip(AXES, sigma, strict=True)}
        )
    result = consistency(rows)
    assert result["scans"] == 2000
    assert result["nees_low"] < 1 < result["nees_high"]
    assert result["nees_per_dof"] == pytest.approx(1, abs=4 / np.sqrt(3 * 2000))  # chi-square mean, 4 sigma
    assert result["vertex0_nees_per_dof"] == pytest.approx(1, abs=4 * np.sqrt(2 / (3 * 2000)))
    for name in ("coverage", "vertex0_coverage", *(f"coverage_{axis}" for axis in AXES)):
        assert result[name] == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / 2000))
    assert consistency([]) == {"scans": 0}
