"""Records: dataclasses as plain data and back, restored by their declared types only."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.errors import InputError
from optshape_graph.io.records import from_record, to_record


class Pair(NamedTuple):
    stamp: float
    place: Path


@dataclass(frozen=True, eq=False, repr=False)
class Inner(Value):
    values: Floats


@dataclass(frozen=True, eq=False, repr=False)
class Other(Value):
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class Outer(Value):
    number: float
    kind: Literal["a", "b"]
    counts: Ints
    flags: Bools
    either: Inner | Other | None
    many: tuple[Inner, ...]
    two: tuple[int, str]
    named: Mapping[str, float]
    keyed: Mapping[tuple[str, str], slice]
    some: frozenset[str]
    pair: Pair


def outer(**changed: Any) -> Outer:
    fields: dict[str, Any] = {
        "number": 0.1, "kind": "a", "counts": np.array([1, 2]), "flags": np.array([True]), "either": Other("x"),
        "many": (Inner(np.zeros((0, 3))), Inner(np.array([[np.nan, np.inf], [-0.0, 1e-300]]))), "two": (1, "z"),
        "named": {"a": 1.5}, "keyed": {("a", "b"): slice(2, 5)}, "some": frozenset({"q", "p"}),
        "pair": Pair(float("-inf"), Path("a/b")),
    }  # fmt: skip
    return Outer(**(fields | changed))


def again(value: Outer) -> Outer:
    found = from_record(Outer, json.loads(json.dumps(to_record(value), allow_nan=False)), "file")
    assert isinstance(found, Outer)
    return found


def test_everything_comes_back() -> None:
    assert again(outer()) == outer()
    for either in (None, Inner(np.ones(3)), Other("")):
        assert again(outer(either=either)) == outer(either=either)
    assert again(outer()).counts.dtype == np.int64


@given(st.floats(), st.lists(st.floats(), max_size=5))
def test_numbers_come_back_bit_for_bit(number: float, values: list[float]) -> None:
    value = outer(number=number, either=Inner(np.array(values)))
    found = again(value)
    assert np.array([found.number]).tobytes() == np.array([number]).tobytes() or number != number
    assert isinstance(found.either, Inner)
    np.testing.assert_array_equal(found.either.values, np.array(values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"is": "Other"}, "expected the record of a Outer"),
        ({"number": "a"}, "number: expected float, found 'a'"),
        ({"number": True}, "number: expected float"),
        ({"kind": "c"}, "kind: expected"),
        ({"either": {"is": "Pair", "stamp": 1.0, "place": "x"}}, "either: not of a type that can stand here"),
        ({"either": {"is": "os.system", "text": "x"}}, "either: not of a type"),
        ({"many": 3}, "many: expected a list"),
        ({"two": [1]}, "two: expected a list of 2"),
        ({"counts": [[1], [1, 2]]}, "counts: expected an array"),
        ({"counts": ["a"]}, "counts: expected an array"),
        ({"flags": [1]}, "flags: expected an array"),
        ({"counts": {"shape": [10**12]}}, "counts: expected an array"),
        ({"more": 1}, "another version of optshape_graph .more."),
    ],
)
def test_other_data_are_refused(change: dict[str, Any], message: str) -> None:
    record = to_record(outer()) | change
    with pytest.raises(InputError, match=f"file.*{message}"):
        from_record(Outer, record, "file")


def test_what_is_no_data_is_not_saved() -> None:
    with pytest.raises(InputError, match="a object cannot be saved"):
        to_record(object())
