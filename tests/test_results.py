"""Results print in a line, show themselves in notebooks, become tables, and come back from their files equal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import (
    Detections,
    InputError,
    Map,
    PoseEstimate,
    detect_targets,
    estimate_pose,
    load_sensor,
    load_target,
    read_scan,
)
from optshape_graph._arrays import LONGEST_REPR
from optshape_graph.evaluation import SimulationSweep, Table, run_simulation
from optshape_graph.io import demo_folder
from optshape_graph.io.results import Result
from optshape_graph.mapping import Landmark
from tests.detection.scenes import pose, scan_of
from tests.io.schema_support import complaint


@pytest.fixture(scope="module")
def estimate() -> PoseEstimate:
    return estimate_pose(read_scan(demo_folder() / "4m.pcd", load_sensor("vlp32c")), load_target("built"))


@pytest.fixture(scope="module")
def detections() -> Detections:
    placed = [(load_target("square@1"), pose(6, 0, 0, 30, 10, 5))]
    return detect_targets(scan_of(load_sensor("vlp32c"), placed).scan, load_target("square@1"))


@pytest.fixture(scope="module")
def mapped(estimate: PoseEstimate) -> Map:
    return Map((Landmark("<b>board</b>", estimate.target, estimate.T_lidar_target, estimate.covariance, 3),))


@pytest.fixture
def results(estimate: PoseEstimate, detections: Detections, mapped: Map) -> list[Result]:
    return [estimate, detections, mapped]


def test_what_is_printed_is_a_line(results: list[Result], estimate: PoseEstimate) -> None:
    for result in results:
        assert len(repr(result)) <= LONGEST_REPR
        assert "\n" not in repr(result)
    assert repr(estimate).startswith("PoseEstimate('built' ok: (")
    failed = replace(estimate, status="failed", reason="why\n" * 200)
    assert len(repr(failed)) <= LONGEST_REPR


def test_what_is_saved_comes_back_equal(results: list[Result], tmp_path: Path) -> None:
    pytest.importorskip("jsonschema")
    for result in results:
        path = tmp_path / f"{type(result).__name__}.json"
        result.save(path)
        assert complaint(path) is None
        assert type(result).load(path) == result


def test_a_loaded_estimate_makes_the_same_factor(estimate: PoseEstimate, tmp_path: Path) -> None:
    from optshape_graph.factors import SummaryFactor

    estimate.save(tmp_path / "a.json")
    loaded = PoseEstimate.load(tmp_path / "a.json")
    assert SummaryFactor(loaded, 0, 1).equals(SummaryFactor(estimate, 0, 1), 0.0)


def test_a_viewer_shows_what_was_saved(estimate: PoseEstimate, tmp_path: Path) -> None:
    from optshape_graph.viz.documents import spatial

    estimate.save(tmp_path / "a.json")
    assert {item.name for item in spatial(tmp_path / "a.json").items} >= {"target/best", "target/edge points"}


def test_other_files_are_refused(estimate: PoseEstimate, detections: Detections, tmp_path: Path) -> None:
    detections.save(tmp_path / "a.json")
    with pytest.raises(InputError, match=r"a\.json: schema: expected 'optshape/estimate/1'"):
        PoseEstimate.load(tmp_path / "a.json")
    from optshape_graph.io.documents import write_json

    write_json(tmp_path / "b.json", {"schema": "optshape/estimate/1", "scans": [estimate.to_dict()]})
    with pytest.raises(InputError, match=r"b.json: expected one scan with its 'record', as `PoseEstimate.save`"):
        PoseEstimate.load(tmp_path / "b.json")


def test_notebooks_show_tables_and_pictures(results: list[Result]) -> None:
    pytest.importorskip("matplotlib")
    for result in results:
        shown = result._repr_html_()
        assert "<table>" in shown
        assert '<img src="data:image/png;base64,' in shown
        assert "<b>board" not in shown


def test_tables_become_data_frames(results: list[Result], detections: Detections) -> None:
    pandas = pytest.importorskip("pandas")
    for result in results:
        frame = result.to_dataframe()
        assert isinstance(frame, pandas.DataFrame)
        assert len(frame) == len(result.rows()) == 1
    assert detections.to_dataframe()["target"][0] == "square@1"
    np.testing.assert_allclose(detections.to_dataframe()["x_m"][0], 6.0, atol=0.05)  # where it was put


def test_sweeps_are_tables(tmp_path: Path) -> None:
    for library in ("pyarrow", "matplotlib"):
        pytest.importorskip(library)
    sweep = SimulationSweep(
        load_target("paper"), methods=("global",), distances=(4.0, 6.0), noise=("0",), draws=1,
        orientations=(("front", (0.0, 0.0, 0.0)),),
    )  # fmt: skip
    rows = run_simulation(sweep, tmp_path / "tasks")
    assert len(repr(rows)) <= LONGEST_REPR
    assert repr(rows).startswith("Table(2 rows: method, ")
    rows.save(tmp_path / "a.parquet")
    assert Table.load(tmp_path / "a.parquet") == rows
    assert '<img src="data:image/png' in rows._repr_html_()
    assert sweep == replace(sweep)
    assert len(repr(sweep)) <= LONGEST_REPR
