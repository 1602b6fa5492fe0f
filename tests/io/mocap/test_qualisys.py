"""Exports of Qualisys Track Manager."""

import pytest

from optshape_graph import InputError
from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import mat, qualisys_tsv, same


@pytest.mark.parametrize("gap", ["0.000", "", "NULL", "NaN"])
@pytest.mark.parametrize(("leading", "header"), [(0, False), (0, True), (2, False), (2, True), (1, True)])
def test_qualisys_tsv(tmp_path, gap, leading, header):
    (tmp_path / "a.tsv").write_bytes(qualisys_tsv(gap, leading, header).encode("cp1252"))
    same(read_mocap(tmp_path / "a.tsv"), 200.0)


def test_qualisys_6d_is_refused(tmp_path):
    (tmp_path / "a.tsv").write_text(qualisys_tsv("0", 2, True).replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D"))
    with pytest.raises(InputError, match="DATA_INCLUDED is 6D; export 3D"):
        read_mocap(tmp_path / "a.tsv")


def test_qualisys_mat(tmp_path, monkeypatch):
    mat(tmp_path / "a.mat")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numpy.py").write_text("raise SystemExit('code beside the data was run')")
    same(read_mocap(tmp_path / "a.mat"), 200.0)
