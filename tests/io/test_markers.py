"""Marker files: frames, gaps, units, and lines that are wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import read_markers
from tests.shared import SHARED, needs_shared

GOOD = "frame,marker,x,y,z\n3,a,1,2,3\n3,b,1.5,2,3\n1,b,1,1,1\n"


def test_frames_and_names(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(GOOD)
    markers = read_markers(path)
    assert markers.names == ("a", "b")
    assert list(markers.frames) == [3, 1]
    np.testing.assert_array_equal(markers.frames[3]["b"], [1.5, 2, 3])
    assert np.isnan(markers.frames[1]["a"]).all()
    assert not markers.frames[3]["b"].flags.writeable


@pytest.mark.parametrize(("units", "metres"), [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)])
def test_units(tmp_path: Path, units: str, metres: float) -> None:
    path = tmp_path / "a.csv"
    path.write_text("frame,marker,x,y,z\n0,a,0,0,0\n0,b,40,0,0\n")
    np.testing.assert_allclose(read_markers(path, units).frames[0]["b"], [40 * metres, 0, 0])


def test_forms_of_the_same_markers(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("marker, z, y, x, frame\r\n\r\na,3,2,1,0\r\n'b',,,,0\r\nc,NaN,nan,nan,0\r\n", newline="")
    frame = read_markers(path).frames[0]
    np.testing.assert_array_equal(frame["a"], [1, 2, 3])
    assert np.isnan(frame["'b'"]).all()
    assert np.isnan(frame["c"]).all()


@needs_shared
def test_real_markers() -> None:
    markers = read_markers(SHARED / "data" / "mocap" / "session1" / "markers.csv", "m")
    assert markers.names == ("corner0", "corner1", "corner2", "corner3")
    assert sorted(markers.frames) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("text", "units", "message"),
    [
        (GOOD, "inch", r"bad\.csv: units 'inch', expected one of: m, cm, mm"),
        ("", "m", r"bad\.csv: expected a first line with the columns frame,marker,x,y,z, found ''$"),
        ("0,a,1,2,3\n", "m", r"with the columns frame,marker,x,y,z, found '0,a,1,2,3'"),
        ("frame,marker,x,y\n0,a,1,2\n", "m", "expected a first line with the columns"),
        ("frame,marker,x,y,z\n", "m", "no markers after the first line"),
        ("frame,marker,x,y,z\n0,a,1,2\n", "m", r"bad\.csv:2: expected 5 values, found 4"),
        ("frame,marker,x,y,z\n0.5,a,1,2,3\n", "m", r"bad\.csv:2: expected a frame number, found '0\.5'"),
        ("frame,marker,x,y,z\n0,,1,2,3\n", "m", r"bad\.csv: no markers after the first line"),
        ("frame,marker,x,y,z\n0,a,1,two,3\n", "m", r"bad\.csv:2: expected a coordinate, found 'two'"),
        ("frame,marker,x,y,z\n0,a,1,inf,3\n", "m", r"bad\.csv:2: expected a finite coordinate, found 'inf'"),
        ("frame,marker,x,y,z\n0,a,1,,3\n", "m", r"bad\.csv:2: marker 'a' has some coordinates only"),
        ("frame,marker,x,y,z\n0,a,1,2,3\n\n0,a,1,2,3\n", "m", r"bad\.csv:4: marker 'a' is given twice in frame 0"),
        (
            "frame,marker,x,y,z\n0,a,0,0,0\n0,b,700,0,0\n",
            "m",
            "markers of frame 0 span 700 m, read in 'm'; expected 0.01 to 50 m",
        ),
        ("frame,marker,x,y,z\n0,a,0,0,0\n0,b,0.7,0,0\n", "mm", "span 0.0007 m, read in 'mm'"),
        ("frame,marker,x,y,z\n0,a,1,2,3\n0,b,1,2,3\n", "m", "span 0 m"),
        ('frame,marker,x,y,z\n0,"a' + "b" * 200_000 + '",1,2,3\n', "m", "not CSV"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, text: str, units: str, message: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as raised:
        read_markers(path, units)
    assert str(raised.value).startswith(str(path))


def test_unnamed_markers_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    path.write_text("frame,marker,x,y,z\n0,a,0,0,0\n0,,9,9,9\n0,,8,8,8\n0,b,1,0,0\n")
    assert read_markers(path).names == ("a", "b")


def test_exports_are_read_with_their_own_unit(tmp_path: Path) -> None:
    path = tmp_path / "m.tsv"
    path.write_text(
        "NO_OF_FRAMES\t2\nNO_OF_CAMERAS\t8\nNO_OF_MARKERS\t2\nFREQUENCY\t100\nDATA_INCLUDED\t3D\n"
        "MARKER_NAMES\tcorner0\tcorner1\n0\t0\t0\t1000\t0\t0\n10\t0\t0\t1010\t0\t0\n"
    )
    markers = read_markers(path, "m")
    np.testing.assert_allclose(markers.frames[1]["corner1"], [1.01, 0, 0])
    assert np.isnan(markers.frames[0]["corner0"]).all()  # three zeros are a gap there
