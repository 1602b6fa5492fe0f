"""Which reader a file gets, and what is said of files that are wrong."""

import contextlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import motive_csv, qualisys_tsv, vicon_csv


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.csv", "frame,marker,x,y,z\n", "neither Motive's"),
        ("a.csv", motive_csv("Furlongs"), "unit of length 'Furlongs'"),
        ("a.csv", motive_csv().replace("120.000000", "fast"), "expected a number as Export Frame Rate"),
        ("a.csv", vicon_csv("kg"), "unit of length 'kg'"),
        ("a.tsv", qualisys_tsv("0", 2, True).replace("FREQUENCY\t200", "FREQUENCY\t0"), "rate 0.0 Hz"),
        ("a.tsv", "", "the file is empty"),
        ("a.mat", "no", "not a readable mat file"),
        ("a.xlsx", "", "motion capture is read from"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=complaint) as error:
        read_mocap(tmp_path / name)
    assert name in str(error.value)


@pytest.mark.parametrize("name", ["a.csv", "v.csv", "a.tsv"])
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_exports_are_read_or_refused(tmp_path_factory, name, data):
    folder = tmp_path_factory.mktemp("fuzz")
    text = {"a.csv": motive_csv(), "v.csv": vicon_csv(), "a.tsv": qualisys_tsv("0", 2, True)}[name]
    content = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 10))):
        k = data.draw(st.integers(0, len(content) - 1))
        content[k : k + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=4))
        if not content:
            break
    (folder / name).write_bytes(content)
    with contextlib.suppress(InputError):
        read_mocap(folder / name)
