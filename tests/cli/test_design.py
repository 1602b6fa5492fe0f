import json

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import InputError
from optshape_graph.cli.design import command
from optshape_graph.io.targets import load_target


def run(*arguments):
    return CliRunner().invoke(command, [str(argument) for argument in arguments], catch_exceptions=False)


def test_score_compares_shapes(tmp_path):
    out = tmp_path / "scores.json"
    result = run("score", "square", "paper@0.5", "--sensor", "vlp16", "--distance", "6", "-o", out)
    assert result.exit_code == 0
    assert "0.00400" in result.output
    square, paper = json.loads(out.read_text())["shapes"]
    assert square["asymmetry"] < 1e-9
    assert square["e_t_m"][1] is None
    assert paper["name"] == "paper@0.5"
    assert paper["area_m2"] == pytest.approx(0.5)
    assert paper["score_every_degree"] == pytest.approx(0.0122, rel=5e-3)


def test_score_plots(tmp_path):
    assert run("score", "triangle", "--plot", tmp_path / "plots" / "shapes.png").exit_code == 0
    assert (tmp_path / "plots" / "shapes.png").stat().st_size > 1000


def test_export_writes_the_drawing_and_the_target(tmp_path):
    out = tmp_path / "board.dxf"
    result = run("export", "paper@0.3", "--format", "dxf", "-o", out)
    assert result.exit_code == 0
    assert out.exists()
    np.testing.assert_array_equal(load_target(tmp_path / "board.yaml").vertices, load_target("paper@0.3").vertices)


def test_export_over_sheets(tmp_path):
    result = run("export", "paper@0.3", "--format", "svg", "--paper", "a4", "-o", tmp_path / "board.svg")
    assert result.exit_code == 0
    assert len(list(tmp_path.glob("board-*.svg"))) > 1


def test_export_format_and_name_agree(tmp_path):
    result = run("export", "paper", "--format", "svg", "-o", tmp_path / "board.dxf")
    assert result.exit_code == 2
    assert "--format svg writes a .svg file" in result.output


def test_optimise_is_repeatable_and_resumes(tmp_path):
    options = ["--starts", 1, "--seed", 3, "--rings", 1, 3, "--area", 0.5, "--sides", 3]
    first = run("optimise", *options, "-o", tmp_path / "a.yaml")
    assert first.exit_code == 0
    target = load_target(tmp_path / "a.yaml")
    assert (target.name, len(target)) == ("a", 3)
    assert target.area == pytest.approx(0.5)
    stamp = (tmp_path / "a.starts" / "start-00000.json").stat().st_mtime_ns
    (tmp_path / "a.yaml").unlink()
    assert run("optimise", *options, "-o", tmp_path / "a.yaml").exit_code == 0
    assert (tmp_path / "a.starts" / "start-00000.json").stat().st_mtime_ns == stamp
    np.testing.assert_array_equal(load_target(tmp_path / "a.yaml").vertices, target.vertices)


def test_errors_are_the_packages(tmp_path):
    with pytest.raises(InputError, match="nosuchshape"):
        run("score", "nosuchshape")
    result = run("optimise", "--area", -1, "-o", tmp_path / "a.yaml")
    assert result.exit_code == 2
    assert "'--area': expected a number of at least 1e-06 and of at most 1000, found '-1'" in result.output


def test_optimise_draws_what_it_found(tmp_path):
    plots = tmp_path / "plots"
    result = run("optimise", "--sides", 3, "--starts", 1, "--rings", 2, 2, "--shortest-edge", 0.2, "--asymmetry", 0,
                 "--plots", plots, "-o", tmp_path / "mine.yaml")  # fmt: skip
    assert result.exit_code == 0
    assert {path.stem for path in plots.glob("*.png")} == {"shape", "cells", "sensitivity", "search", "convexity"}
    assert len(load_target(tmp_path / "mine.yaml")) == 3


def test_study_writes_numbers_and_a_plot_and_goes_on(tmp_path):
    arguments = ["study", "--shapes", 1, "--distances", "6", "--placements", 2, "-o", tmp_path / "study"]
    result = run(*arguments)
    assert result.exit_code == 0
    assert "rank correlation of the score with the median e_r" in result.output
    document = json.loads((tmp_path / "study" / "study.json").read_text())
    assert document["schema"] == "optshape/design-study/1"
    assert (tmp_path / "study" / "study.png").stat().st_size > 1000
    assert run(*arguments).output == result.output


def test_study_of_distances_that_are_none(tmp_path):
    result = run("study", "--distances", "near,far", "-o", tmp_path / "study")
    assert result.exit_code == 2
    assert "expected numbers with commas between, found 'near,far'" in result.output
