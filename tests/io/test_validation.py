"""The checks of documents: of one mind with the library jsonschema, and said with their place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.documents import read_document
from optshape_graph.io.nodes import Node
from optshape_graph.io.schemas import load_schema
from optshape_graph.io.validation import KEYWORDS, check
from tests.fuzz import readers
from tests.io.schema_support import validator
from tests.io.test_schemas import FORMS, damaged, places

pytest.importorskip("jsonschema")

ANNOTATIONS = {"$schema", "$id", "$ref", "$defs", "title", "description", "then", "else"}


@pytest.mark.parametrize("kind", FORMS)
def test_every_keyword_of_the_forms_that_are_read_is_checked(kind: str) -> None:
    def walk(schema: Any) -> None:
        assert isinstance(schema, dict)
        assert schema.keys() <= KEYWORDS.keys() | ANNOTATIONS
        for key, value in schema.items():
            if key in ("properties", "$defs"):
                for inner in value.values():
                    walk(inner)
            elif isinstance(value, dict) and key not in ("const", "dependentRequired"):
                walk(value)
            elif key in ("allOf", "anyOf", "oneOf", "prefixItems"):
                for inner in value:
                    walk(inner)

    walk(load_schema(kind))


def fits(document: Any, schema: dict[str, Any]) -> bool:
    try:
        check(Node(document, Path("a.json")), schema)
    except InputError:
        return False
    return True


@pytest.mark.parametrize("kind", FORMS)
def test_of_one_mind_with_jsonschema(tmp_path_factory: pytest.TempPathFactory, kind: str) -> None:
    folder = tmp_path_factory.mktemp("forms")
    readers.furnish(folder)
    good = []
    for seed in FORMS[kind][1](folder):
        (folder / "good.yaml").write_bytes(seed)
        good.append(read_document(folder / "good.yaml", kind).value)
    names = sorted({str(place[-1]) for document in good for place in places(document)})
    schema, library = load_schema(kind), validator(kind)

    @given(st.sampled_from(good).flatmap(lambda document: damaged(document, names)))
    @settings(max_examples=500, suppress_health_check=list(HealthCheck))
    def agree(document: Any) -> None:
        whole = [value for value in walk(document) if isinstance(value, float) and value == int(value)]
        if fits(document, schema) != library.is_valid(document):
            assert whole, "only 2.0 for an integer is a matter of taste"
            assert not fits(document, schema)

    def walk(value: Any) -> list[Any]:
        inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
        return [value, *(deeper for item in inner for deeper in walk(item))]

    agree()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertexes": []}, r"a\.json: vertexes: unknown key 'vertexes' \(did you mean 'vertices'\?\); expected one of"),
        ({"vertices": None}, r"a\.json: vertices: expected a list, found nothing \(null\)"),
        ({"vertices": [[0, 1, "x"]] * 3}, r"vertices\[0\]\[2\]: expected a finite number, found 'x'"),
        ({"name": 3}, r"name: expected a text \(put it in quotes\), found 3"),
        ({"name": ""}, r"name: expected a text, found ''"),
        ({"chessboard": {"square": 1}}, "chessboard: the key 'inner_corners' is missing; found only: square"),
        ({"chessboard": {"square": -1, "inner_corners": [2, 2]}}, "square: expected a finite number above 0, found -1"),
        ({"tags": {"dictionary": "a", "size": 1, "centres": {}}}, "centres: expected 1 or more entries, found 0"),
        (
            {"tags": {"dictionary": "a", "size": 1, "centres": {"x": [0, 0]}}},
            r"centres\.x: as key expected the number of a tag",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    triangle = [[0, 0.5, -0.3], [0, 0, 0.6], [0, -0.5, -0.3]]
    document = {"schema": "optshape/target/1", "vertices": triangle, **change}
    (tmp_path / "a.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        read_document(tmp_path / "a.json", "target")
