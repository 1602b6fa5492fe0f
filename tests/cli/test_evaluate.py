"""`optshape evaluate simulation`."""

import csv
import json

import pytest
from click.testing import CliRunner

from optshape_graph.cli.evaluate import command

pytest.importorskip("matplotlib")
pytest.importorskip("pyarrow")


def run(tmp_path, *arguments):
    return CliRunner().invoke(command, ["simulation", *map(str, arguments), "-o", str(tmp_path)])


def read(path):
    with path.open() as stream:
        return list(csv.DictReader(stream))


def test_a_small_sweep_writes_tables_and_charts_and_goes_on(tmp_path):
    arguments = ["--distance", 4, "--distance", 8, "--rpy", 0, 0, 0, "--noise", 0, "--seeds", 1, "--method", "global"]
    result = run(tmp_path, *arguments)
    assert result.exit_code == 0, result.output
    rows = read(tmp_path / "scans.csv")
    assert [row["range_m"] for row in rows] == ["4.0", "8.0"]
    assert all(float(row["rmse_m"]) < 0.05 for row in rows)
    assert len(read(tmp_path / "cells.csv")) == 2
    assert len(read(tmp_path / "groups.csv")) == 1
    assert len(read(tmp_path / "table1.csv")) == 13
    assert len(read(tmp_path / "consistency.csv")) == 2
    assert (tmp_path / "errors.png").stat().st_size > 10_000
    sweep = json.loads((tmp_path / "tasks" / "sweep.json").read_text())
    assert sweep["sensor"]["name"] == "reference-simulator"
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "tasks").iterdir()}
    table = (tmp_path / "scans.csv").read_bytes()
    assert run(tmp_path, *arguments).exit_code == 0
    assert (tmp_path / "scans.csv").read_bytes() == table
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "tasks").iterdir()}


def test_another_sweep_does_not_go_into_the_same_folder(tmp_path):
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "sweep.json").write_text('{"digest": "another"}')
    result = run(tmp_path, "--distance", 4, "--noise", 0, "--seeds", 1)
    assert "holds another sweep" in str(result.exception)


def test_mocap_writes_the_table_and_says_what_was_left_out(tmp_path):
    from optshape_graph.io import load_sensor, load_target
    from optshape_graph.simulation import synthetic_session

    for seed, distances in enumerate([(4.0, 6.0), (8.0,)]):
        folder = tmp_path / "recordings" / f"s{seed}"
        synthetic_session(folder, load_target("built"), load_sensor("vlp32c"), distances=distances, rng=seed)
    session = tmp_path / "recordings" / "s1" / "session.yaml"
    session.write_text(session.read_text().replace(", mocap_frame: 1", ""))
    out = tmp_path / "out" / "tables"
    result = CliRunner().invoke(
        command, ["mocap", str(tmp_path / "recordings"), "-o", str(out), "--json", str(tmp_path / "mocap.json")],
        standalone_mode=False,
    )  # fmt: skip
    assert result.exit_code == 0
    assert result.return_value == 3
    assert "left out s1/8m.pcd" in result.output
    assert "s0/6m_angled.pcd" in result.output
    assert "mean" in result.output
    assert [row["scan"] for row in read(out / "mocap.csv")] == ["4m.pcd", "4m_angled.pcd", "6m.pcd", "6m_angled.pcd"]
    assert (out / "mocap.parquet").exists()
    document = json.loads((tmp_path / "mocap.json").read_text())
    assert document["schema"] == "optshape/mocap-evaluation/1"
    assert document["protocol"] == "leave-one-out"
    assert len(document["scans"]) == 4
    assert document["mean"]["rmse_m"] < 0.05
    assert document["published_mean"] is None
    assert len(document["left_out"]) == 2


def test_paper_makes_every_figure_and_prints_its_tables(tmp_path):
    from optshape_graph.cli.evaluate_paper import command

    arguments = ["--draws", "1", "--plot-format", "svg", "-o", str(tmp_path)]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    numbers = {path.stem.split("-")[1] for path in tmp_path.glob("figure-*.svg")}
    assert numbers == {"3", "4", "5", "7", "8", "9", "10", "13", "14"}
    assert (tmp_path / "table1.csv").read_text().count("\n") == 14  # thirteen rows and the head
    assert "0.47" in result.output  # the paper's worst row
    assert "figure 11 and 12: not made" in result.output
