"""Target files: built-in, scaled, saved and read back, and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import Chessboard, InputError, Target
from optshape_graph.io import load_target, save_target
from optshape_graph.io.builtin import builtin_names
from tests.shared import SHARED, needs_shared

SQUARE = """\
schema: optshape/target/1
name: mine
vertices:
  - [0, 0.5, -0.5]
  - [0, 0.5, 0.5]
  - [0, -0.5, 0.5]
  - [0, -0.5, -0.5]
"""
BOARD = SQUARE + "chessboard:\n  inner_corners: [7, 5]\n  square: 0.1\n"


@st.composite
def targets(draw: st.DrawFn) -> Target:
    """Polygons inscribed in an ellipse."""
    n = draw(st.integers(3, 9))
    gaps = np.array(draw(st.lists(st.floats(0.3, 1.0), min_size=n, max_size=n)))
    angles = 2 * np.pi * np.cumsum(gaps) / gaps.sum()
    size = draw(st.floats(0.05, 5.0))
    polygon = np.column_stack([size * np.cos(angles), 0.7 * size * np.sin(angles)])
    target = Target.from_polygon(polygon, draw(st.text(min_size=1, max_size=8)))
    if draw(st.booleans()):
        corners = (draw(st.integers(2, 12)), draw(st.integers(2, 12)))
        offset = (draw(st.floats(-1, 1)), draw(st.floats(-1, 1)))
        return Target(target.vertices, target.name, Chessboard(corners, draw(st.floats(1e-3, 1)), offset))
    return target


@given(targets())
def test_saved_is_loaded(tmp_path_factory: pytest.TempPathFactory, target: Target) -> None:
    path = tmp_path_factory.mktemp("target") / "a.yaml"
    save_target(path, target)
    found = load_target(path)
    np.testing.assert_array_equal(found.vertices, target.vertices)
    assert (found.name, found.chessboard) == (target.name, target.chessboard)


@pytest.mark.parametrize("name", builtin_names("target"))
def test_built_in_targets(name: str) -> None:
    target = load_target(name)
    assert target.name == name
    scaled = load_target(f"{name}@0.25")
    assert scaled.name == f"{name}@0.25"
    np.testing.assert_allclose(scaled.area, 0.25, rtol=1e-12)
    np.testing.assert_allclose(scaled.vertices / scaled.circumradius, target.vertices / target.circumradius, atol=1e-12)


def test_a_built_in_name_wins_over_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("square").write_text(SQUARE)
    assert load_target("square").name == "square"
    assert load_target("./square").name == "mine"
    assert load_target(Path("square"), tmp_path).name == "square"


def test_name_and_offset_may_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "board.yaml").write_text(BOARD.replace("name: mine\n", ""))
    target = load_target("board.yaml", tmp_path)
    assert target.name == "board"
    assert target.chessboard == Chessboard((7, 5), 0.1)


def test_json_is_read_too(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(
        '{"schema": "optshape/target/1", "vertices": [[0, -1, -1], [0, 1, -1], [0, 0, 2]], "name": "tri"}'
    )
    assert len(load_target(tmp_path / "a.json")) == 3


@needs_shared
def test_real_targets() -> None:
    built = load_target(SHARED / "data" / "mocap" / "target.yaml")
    np.testing.assert_array_equal(built.vertices, load_target("built").vertices)
    board = load_target(SHARED / "data" / "camera" / "board.yaml")
    assert board.chessboard == Chessboard((7, 5), 0.095, (0.002, 0.0))
    np.testing.assert_allclose(board.edge_lengths, [0.85, 0.61, 0.85, 0.61])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            SQUARE.replace("vertices", "vertexes"),
            r"bad\.yaml:3: vertexes: unknown key 'vertexes' \(did you mean 'vertices'\?\)",
        ),
        ("schema: optshape/target/1\n", "the key 'vertices' is missing; found only: schema"),
        (
            SQUARE.replace("target/1", "sensor/1"),
            r"bad\.yaml:1: schema: expected 'optshape/target/1', found 'optshape/sensor/1'",
        ),
        (SQUARE.replace("target/1", "target/9"), "'optshape/target/9' is a newer form of target file"),
        (SQUARE.replace("mine", "12"), r"bad\.yaml:2: name: expected a text \(put it in quotes\), found 12"),
        (
            SQUARE.replace("[0, 0.5, 0.5]", "[0.5, 0.5]"),
            r"bad\.yaml:5: vertices\[1\]: expected a list of 3 elements, found 2",
        ),
        (
            SQUARE.replace("[0, 0.5, 0.5]", "[0, 0.5, half]"),
            r"bad\.yaml:5: vertices\[1\]\[2\]: expected a finite number, found",
        ),
        (SQUARE.replace("[0, 0.5, 0.5]", "[0, 0.5, .nan]"), "expected a finite number, found nan"),
        (SQUARE.replace("[0, 0.5, 0.5]", "[0, 0.5, null]"), r"expected a finite number, found nothing \(null\)"),
        ("schema: optshape/target/1\nvertices: []\n", "expected a list of 3 to 1000 elements, found 0"),
        ("schema: optshape/target/1\nvertices: 3\n", r"bad\.yaml:2: vertices: expected a list, found 3"),
        (SQUARE.replace("0.5", "500"), r"bad\.yaml:3: vertices: target 'mine': it is 1000 m wide; .* millimetres\?"),
        (
            SQUARE.replace("  - [0, 0.5, 0.5]\n  - [0, -0.5, 0.5]\n", ""),
            "expected a list of 3 to 1000 elements, found 2",
        ),
        (SQUARE + "  - [0, 0.5, -0.5]\n", "vertex mean|coincide"),
        (SQUARE.replace("[0, 0.5, 0.5]", "[0.1, 0.5, 0.5]"), "vertices lie in the plane x = 0; found x = 0.1"),
        (
            SQUARE.replace("[0, 0.5, 0.5]", "[0, A]")
            .replace("[0, -0.5, -0.5]", "[0, 0.5, 0.5]")
            .replace("A", "-0.5, -0.5"),
            "vertices run clockwise; expected counter-clockwise seen from",
        ),
        (
            SQUARE.replace("[0, 0.5, 0.5]", "[0, -0.2, 0.0]").replace("[0, 0.5, -0.5]", "[0, 1.2, 0.0]"),
            "not strictly convex at",
        ),
        (BOARD.replace("[7, 5]", "[7]"), r"chessboard\.inner_corners: expected a list of 2 elements, found 1"),
        (BOARD.replace("[7, 5]", "[7, 1]"), r"inner_corners\[1\]: expected an integer of at least 2, found 1"),
        (
            BOARD.replace("square: 0.1", "square: 0"),
            r"bad\.yaml:10: chessboard\.square: expected a finite number above 0",
        ),
        (BOARD + "  offset: [0.1]\n", r"chessboard\.offset: expected a list of 2 elements, found 1"),
        (BOARD + "  colour: red\n", r"bad\.yaml:11: chessboard\.colour: unknown key 'colour'"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        load_target(path)
    assert str(raised.value).startswith(str(path))


@pytest.mark.parametrize("name", ["nosuch", "nosuch@1", "square@", "/nowhere/a.yaml", "", "a\0b", "n" * 300])
def test_neither_name_nor_file(name: str) -> None:
    with pytest.raises(InputError, match=r"no such file, and the built-in targets are: .*paper.*square"):
        load_target(name)


def test_a_folder_is_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a folder; expected the file of a target, or a built-in one: .*paper"):
        load_target(tmp_path)


@pytest.mark.parametrize("area", ["one", "-1", "0", "nan", "inf"])
def test_areas_that_are_none(area: str) -> None:
    with pytest.raises(InputError, match=f"paper@{area}: expected NAME@AREA with the area in m2, found '{area}'"):
        load_target(f"paper@{area}")
