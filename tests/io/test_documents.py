"""YAML and JSON: what comes out, and what is refused with which message."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.documents import Node, read_document, read_json, read_yaml, write_json, write_yaml
from tests.io.refusal import read_or_refused

plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


def yaml_file(folder: Path, text: str) -> Path:
    path = folder / "a.yaml"
    path.write_text(text)
    return path


@given(plain)
def test_json_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, value: Any) -> None:
    path = tmp_path_factory.mktemp("json") / "a.json"
    write_json(path, value)
    assert read_json(path).value == value
    assert json.loads(path.read_text()) == value


@given(
    st.dictionaries(st.text(), st.text() | st.floats(allow_nan=False, allow_infinity=False) | st.integers(), max_size=5)
)
def test_yaml_round_trip_is_exact(tmp_path_factory: pytest.TempPathFactory, value: dict[str, Any]) -> None:
    path = tmp_path_factory.mktemp("yaml") / "a.yaml"
    write_yaml(path, value)
    found = read_yaml(path).value
    assert found == value
    assert [type(item) for item in found.values()] == [type(item) for item in value.values()]


def test_json_of_arrays(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_json(path, {"T": np.eye(2), "n": np.int64(3), "x": np.float32(0.5), "empty": [], "none": None, "t": (1, 2)})
    assert path.read_text() == (
        '{\n  "T": [\n    [1.0, 0.0],\n    [0.0, 1.0]\n  ],\n  "n": 3,\n  "x": 0.5,\n  "empty": [],\n  "none": null,\n'
        '  "t": [1, 2]\n}\n'
    )


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"a": [1.0, float("nan")]}, "a: nan has no JSON form"),
        ({"a": np.array([[np.inf]])}, r"a\[0\]: inf has no JSON form"),
        ({"a": {1: 2}}, "JSON keys are text"),
        ({"a": object()}, "a: object has no JSON form"),
    ],
)
def test_json_that_cannot_be_written(tmp_path: Path, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_json(tmp_path / "a.json", value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("-1.5E+2", -150.0),
        (".5", 0.5),
        ("3.", 3.0),
        ("007", 7),
        ("0x1F", 31),
        ("0o17", 15),
        ("+4", 4),
        ("no", "no"),
        ("on", "on"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("1_000", "1_000"),
        ("1.2.3", "1.2.3"),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("null", None),
        ("'1'", "1"),
        ('"true"', "true"),
        ("|\n  1\n", "1\n"),
        (".inf", np.inf),
        ("-.inf", -np.inf),
        ("[a, {b: 1}]", ["a", {"b": 1}]),
        ("<<: 1", {"<<": 1}),
    ],
)
def test_yaml_scalars_are_those_of_the_core_schema(tmp_path: Path, text: str, value: Any) -> None:
    key = "v: " if "<<" not in text else ""
    found = read_yaml(yaml_file(tmp_path, f"{key}{text}")).value
    assert (found["v"] if key else found) == value
    assert type(found["v"] if key else found) is type(value)


def test_a_trailing_empty_document_is_fine(tmp_path: Path) -> None:
    assert read_yaml(yaml_file(tmp_path, "a: 1\n---\n")).value == {"a": 1}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"a\.yaml: the file is empty"),
        ("# only a comment\n", "the file is empty"),
        ("a: 1\nb: 2\na: 3\n", r"a\.yaml:3: the key 'a' is given twice, first on line 1"),
        ("a: 1\n---\nb: 2\n", "expected one YAML document, found several"),
        ("a: &x 1\nb: *x\n", r"a\.yaml:1: anchors and aliases are not read \('x'\)"),
        ("a: !!python/object/apply:os.system ['touch pwned']\n", r"a\.yaml:1: tags are not read"),
        ("a: !!binary aGk=\n", "tags are not read"),
        ("a: !local 1\n", "tags are not read"),
        ("? [1, 2]\n: 3\n", r"a\.yaml:1: expected a text as key"),
        ("a: [1, 2\nb: 3\n", r"a\.yaml:\d: not YAML"),
        ("a: 'open\n", r"a\.yaml:\d: not YAML"),
        ("a:\n\t- 1\n", r"a\.yaml:2: not YAML"),
        ("a: \x01\n", "not YAML"),
        ("[" * 100_000, r"a\.yaml:1: nested more than 50 levels deep"),
        ("{a: " * 100_000, "nested more than 50 levels deep"),
        ("a: " + "9" * 5000, "an integer of 5000 digits"),
    ],
)
def test_yaml_that_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_yaml(yaml_file(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"a\.json:1: not JSON"),
        ('{"a": 1,\n "b": }', r"a\.json:2: not JSON \(Expecting value, column 7\)"),
        ('{"a": 1, "a": 2}', "the key 'a' is given twice"),
        ('{"a": NaN}', "NaN is not a JSON number"),
        ('{"a": -Infinity}', "-Infinity is not a JSON number"),
        ("[" * 100_000, "nested too deeply|not JSON"),
        ("9" * 5000, "not usable JSON"),
    ],
)
def test_json_that_is_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_json(path)


@given(st.text() | st.binary().map(lambda data: data.decode("latin-1")))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    folder = tmp_path_factory.mktemp("any")
    for name, read in (("a.yaml", read_yaml), ("a.json", read_json)):
        (folder / name).write_bytes(text.encode("utf-8", "surrogatepass"))
        with read_or_refused(folder / name):
            read(folder / name)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n", "expected a mapping with 'schema: optshape/target/1', found a list of 1"),
        ("name: x\n", "the key 'schema' is missing; a target file says 'schema: optshape/target/1'"),
        (
            "name: x\nschema: optshape/sensor/1\n",
            r"a\.yaml:2: schema: expected 'optshape/target/1', found 'optshape/sens",
        ),
        (
            "schema: optshape/target/2\n",
            "'optshape/target/2' is a newer form of target file; .* reads 'optshape/target/1'",
        ),
        ("schema: 1\n", "expected 'optshape/target/1', found 1"),
    ],
)
def test_schema(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_document(yaml_file(tmp_path, text), "target")


NODE = """\
name: x
size: 3
list:
  - 1.5
  - b: [1, two]
nothing:
flag: yes
on: true
huge: 1e999
rows: [[1, 2], [3]]
"""


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (
            lambda n: n.at("list").at(1).fields(["b", "c"]),
            r"a\.yaml:5: list\[1\]: the key 'c' is missing; found only: b",
        ),
        (
            lambda n: n.at("list").at(1).at("b").at(1).number(),
            r"a\.yaml:5: list\[1\]\.b\[1\]: expected a finite number, f",
        ),
        (lambda n: n.at("name").entries(), "name: expected a mapping, found 'x'"),
        (lambda n: n.at("size").items(), r"a\.yaml:2: size: expected a list, found 3"),
        (lambda n: n.at("size").text(), r"expected a text \(put it in quotes\), found 3"),
        (lambda n: n.at("nothing").text(), r"nothing: expected a text, found nothing \(null\)"),
        (lambda n: n.at("on").number(), "expected a finite number, found True"),
        (lambda n: n.at("on").integer(), "expected an integer, found True"),
        (lambda n: n.at("huge").number(), "expected a finite number, found inf"),
        (lambda n: n.at("list").at(0).integer(), r"list\[0\]: expected an integer, found 1\.5"),
        (lambda n: n.at("rows").numbers(2, 2), r"rows\[1\]: expected a list of 2 elements, found 1"),
        (lambda n: n.at("rows").numbers(3, -1), "rows: expected a list of 3 elements, found 2"),
        (lambda n: Node("n" * 300, n.path).file(), "no such file"),
        (lambda n: n.at("name").file(), r"a\.yaml:1: name: no such file: .*/x"),
    ],
)
def test_nodes_say_where_and_what(tmp_path: Path, use: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        use(read_yaml(yaml_file(tmp_path, NODE)))


def test_nodes_of_json_say_the_key(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^a\.json: views\[0\]\.stamp: expected a finite number, found 'x'$"):
        Node({"views": [{"stamp": "x"}]}, Path("a.json")).at("views").at(0).at("stamp").number()
    huge = Node(10**400, Path("a.json"))
    with pytest.raises(InputError, match="expected a finite number"):
        huge.number()


def test_numbers_are_read_only_arrays(tmp_path: Path) -> None:
    rows = read_yaml(yaml_file(tmp_path, "a: [[1, 2], [3, 4.5]]")).at("a").numbers(-1, 2)
    np.testing.assert_array_equal(rows, [[1, 2], [3, 4.5]])
    assert not rows.flags.writeable
