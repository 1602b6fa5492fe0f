"""CSV clouds: names of columns, separators, and lines that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io.clouds.text import read_csv


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z,ring\n1,2,3,4\n5,6,7,8\n",
        "ring;label;X;Y;Z\r\n4;tree;1;2;3\r\n8;a b;5;6;7\r\n",
        '"X","Y","Z","ring"\n1,2,3,4\n\n5,6,7,8',
        "//X Y Z ring\n1 2 3 4\n5 6 7 8\n",
        "# x\ty\tz\tring\n1\t2\t3\t4\n5\t6\t7\t8\n",
        "x, y, z, ring\n1, 2, 3, 4.0\n5e0, 6., 7, 8\n",
    ],
)
def test_forms_of_the_same_cloud(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, newline="")
    found = {name.lower(): values for name, values in read_csv(tmp_path / "a.csv").values.items()}
    assert {name: values.tolist() for name, values in found.items()} == {
        "x": [1, 5], "y": [2, 6], "z": [3, 7], "ring": [4, 8],
    }  # fmt: skip


def test_a_header_alone_is_an_empty_cloud(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n")
    assert all(len(values) == 0 for values in read_csv(tmp_path / "a.csv").values.values())


def test_missing_values_are_nan(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x,y,z\n1,nan,3\n")
    assert np.isnan(read_csv(tmp_path / "a.csv").values["y"][0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a first line that names the columns, as x,y,z,ring; found ''"),
        ("1,2,3\n4,5,6\n", "expected a first line that names the columns, .*; found '1,2,3'"),
        ("x,y,z,x\n1,2,3,4\n", "a column is named twice: x, x"),
        ("x,y,z\n1,2,3\n1,2,three\n", "csv:3: could not convert string 'three' to float64 in column 3"),
        ("x,y,z\n1,2\n", "csv:2: "),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        read_csv(path)
    assert str(raised.value).startswith(str(path))
