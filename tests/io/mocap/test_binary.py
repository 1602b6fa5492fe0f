"""Damaged binary files."""

import contextlib

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import c3d, mat


@pytest.mark.parametrize("form", ["c3d", "mat"])
def test_damaged_binaries_cost_an_error_not_the_process(tmp_path, form):
    if form == "c3d":
        pytest.importorskip("ezc3d")
        c3d(tmp_path / "good.c3d")
    else:
        mat(tmp_path / "good.mat")
    good = (tmp_path / f"good.{form}").read_bytes()
    rng = np.random.default_rng(11)
    for k in range(2):
        damaged = bytearray(good)
        for _ in range(30):
            damaged[rng.integers(2, 600)] = rng.integers(256)
        (tmp_path / f"{k}.{form}").write_bytes(damaged[: rng.integers(600, len(good))] if k % 2 else damaged)
        with contextlib.suppress(InputError):
            read_mocap(tmp_path / f"{k}.{form}")
    (tmp_path / f"text.{form}").write_text("not one")
    with pytest.raises(InputError, match=f"not a readable {form} file"):
        read_mocap(tmp_path / f"text.{form}")


def test_a_reader_that_crashes_is_said(tmp_path, monkeypatch):
    from optshape_graph.io import _isolated

    (tmp_path / "a.c3d").write_bytes(b"x")
    monkeypatch.setattr(_isolated.sys, "executable", "/bin/false")
    with pytest.raises(InputError, match=r"its reader crashed \(status 1\)"):
        read_mocap(tmp_path / "a.c3d")
