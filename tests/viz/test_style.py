"""Style: files are whole, magnifications round, and nobody else's settings are touched."""

import sys

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from optshape_graph import InputError, MissingExtraError
from optshape_graph.names import file_name
from optshape_graph.viz.style import ellipse, magnification, new_figure, plain, save_figure, short


def test_an_absent_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'optshape-graph\[plot\]'"):
        new_figure()


def test_settings_of_matplotlib_stay(tmp_path):
    import matplotlib

    before = dict(matplotlib.rcParams)
    figure = new_figure()
    plain(figure.subplots(), equal=True)
    save_figure(figure, tmp_path / "a.png")
    assert dict(matplotlib.rcParams) == before
    assert "matplotlib.pyplot" not in sys.modules or not matplotlib.pyplot.get_fignums()


def test_a_figure_is_a_whole_png_in_a_new_folder(tmp_path):
    path = save_figure(new_figure(8.0, 4.0), tmp_path / "new" / "a.png")
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert data[-8:-4] == b"IEND"
    assert int.from_bytes(data[16:20], "big") == 1200
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_the_ending_is_the_format(tmp_path):
    assert save_figure(new_figure(), tmp_path / "a.pdf").read_bytes()[:5] == b"%PDF-"
    assert b"<svg" in save_figure(new_figure(), tmp_path / "a.SVG").read_bytes()
    with pytest.raises(InputError, match=r"a\.doc: expected the name of a picture to end in \.png, \.pdf, \.svg"):
        save_figure(new_figure(), tmp_path / "a.doc")


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises((InputError, OSError), match="file"):
        save_figure(new_figure(), tmp_path / "file" / "a.png")


@pytest.mark.parametrize(
    ("size", "extent", "factor"),
    [(0.1, 1.0, 1.0), (0.003, 1.0, 20.0), (1e-4, 1.0, 1000.0), (2.0, 1.0, 1.0), (0.0, 1.0, 1.0)],
)
def test_magnification_makes_the_largest_visible_and_no_more(size, extent, factor):
    assert magnification([size, 0.5 * size], extent) == factor
    assert factor == 1.0 or factor * size <= 0.1 * extent


def test_an_ellipse_has_the_covariance_s_axes():
    loop = ellipse(np.diag([0.04, 0.01]), 3.0)
    assert np.abs(loop[:, 0]).max() == pytest.approx(0.6, rel=1e-2)
    assert np.abs(loop[:, 1]).max() == pytest.approx(0.3, rel=1e-2)


@pytest.mark.parametrize(
    ("text", "name"),
    [("4m_angled_fit", "4m_angled_fit"), ("../../etc/passwd", "_.._etc_passwd"), ("paper@1", "paper@1"), ("..", "_"),
     ("Tafel Ü", "Tafel_Ü"), ("a\0b", "a_b"), ("x" * 300, "x" * 100)],
)  # fmt: skip
def test_names_of_files_stay_in_their_folder(text, name):
    assert file_name(text) == name


def test_names_of_scans_are_short():
    assert short("/a/b/scan.pcd") == "scan.pcd"
    assert short("simulated") == "simulated"
    assert short("/a/" + "x" * 200) == "x" * 24 + "…" + "x" * 23


def test_dollars_in_names_are_no_mathematics(tmp_path):
    figure = new_figure()
    figure.suptitle(short(r"a$\frac$b"))
    save_figure(figure, tmp_path / "a.png")


def test_no_colour_twice():
    from optshape_graph.viz.style import colour

    assert len({colour(k) for k in range(60)}) == 60
