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


def test_choose_writes_the_target_its_drawing_and_the_numbers(tmp_path):
    out, numbers = tmp_path / "board.yaml", tmp_path / "choice.json"
    result = run("choose", "--sensor", "vlp32c", "--range", 6, "--rotation", 4, "--translation", 0.05, "-o", out,
                 "--json", numbers)  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "does it up to" in result.output
    assert "hang it with its origin" in result.output
    assert (tmp_path / "board.pdf").stat().st_size > 1000
    document = json.loads(numbers.read_text())
    assert load_target(out).area == pytest.approx(document["chosen"]["area_m2"])
    assert document["chosen"]["does_it"]


def test_measured_puts_sides_back(tmp_path):
    out = tmp_path / "built.yaml"
    result = run("measured", "paper", "--length", "0-1=940", "--length", "0-2=1627", "--check-bar", 99.5, "-o", out)
    assert result.exit_code == 0, result.output
    polygon = load_target(out).polygon
    assert np.linalg.norm(polygon[0] - polygon[1]) == pytest.approx(0.940, abs=5e-4)
    assert "expected I-J=MM, as 0-1=941.5; found '0:1'" in run("measured", "paper", "--length", "0:1", "-o", out).output
    assert "nothing was measured" in run("measured", "paper", "-o", out).output


def test_export_with_marks_and_holes_lists_the_parts(tmp_path):
    out = tmp_path / "board.svg"
    result = run("export", "paper@0.1", "--format", "svg", "--paper", "a3", "--orientation", "landscape",
                 "--markers", 15, "--holes", 6, 40, "-o", out)  # fmt: skip
    assert result.exit_code == 0, result.output
    assert (tmp_path / "board-plan.svg").exists()
    assert "4 holes of 6 mm, each 40 mm in from its corner" in result.output


def test_score_explains_its_columns():
    text = run("score", "--help").output
    assert "e_t             bound on the distance" in text


def test_optimise_poses_writes_a_target(tmp_path):
    out = tmp_path / "mine.yaml"
    result = run("optimise-poses", "--sensor", "vlp32c", "--range", 8, "--placements", 8, "--starts", 1, "-o", out)
    assert result.exit_code == 0, result.output
    assert len(load_target(out)) == 3
    assert "geometric mean" in result.output
