"""Drawings are read back and compared with the target they were made of, chirality included."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from optshape_graph import InputError, Target
from optshape_graph.design.drawing import draw, lidar_face, vertices_of
from optshape_graph.design.formats import export, figure_of
from optshape_graph.design.polygons import areas
from optshape_graph.design.sheets import BORDER, lay_out
from optshape_graph.io.targets import load_target

MM_PER_POINT = 25.4 / 72
SVG = "{http://www.w3.org/2000/svg}"
WRITTEN_MM = 1e-4
"""Coordinates are written to six decimals of a point, or better."""


@pytest.fixture(scope="module")
def target():
    return load_target("paper")


def svg_outline(path):
    """(n, 2) outline of an SVG, mm from the page's lower left corner, and the page (width, height)."""
    root = ElementTree.parse(path).getroot()
    width, height = (float(root.attrib[key].removesuffix("pt")) for key in ("width", "height"))
    assert root.attrib["viewBox"].split()[2:] == [root.attrib[key].removesuffix("pt") for key in ("width", "height")]
    # A sheet far from the outline has none of it, nor has the plan, which is not 1:1.
    outline = next((group for group in root.iter(f"{SVG}g") if group.get("id") == "outline"), None)
    numbers = [] if outline is None else re.findall(r"-?[\d.]+", outline.find(f"{SVG}path").get("d", ""))
    points = np.array(numbers, dtype=float).reshape(-1, 2)
    texts = [text.text for text in root.iter(f"{SVG}text")]
    return (points * [1, -1] + [0, height]) * MM_PER_POINT, (width * MM_PER_POINT, height * MM_PER_POINT), texts


def pdf_pages(path):
    """Closed paths of each page, mm from its lower left corner, its size and its text."""
    import pypdf

    for page in pypdf.PdfReader(path).pages:
        content = page.get_contents().get_data().decode("latin1")
        paths = re.findall(r"((?:-?[\d.]+ -?[\d.]+ [ml]\s+)+)h", content)
        points = [np.array(re.findall(r"-?[\d.]+ -?[\d.]+", p)) for p in paths]
        closed = [np.array([pair.split() for pair in p], dtype=float) * MM_PER_POINT for p in points]
        yield closed, np.array(page.mediabox[2:], dtype=float) * MM_PER_POINT, page.extract_text()


def assert_shows(outline, target):
    """The outline is the target's face as the LiDAR sees it, wherever it is on the page."""
    outline = outline[:-1] if np.allclose(outline[0], outline[-1]) else outline
    found = vertices_of(outline - outline.mean(axis=0))
    expected = target.polygon - target.polygon.mean(axis=0)
    np.testing.assert_allclose(found, expected, atol=WRITTEN_MM / 1000)
    # As drawn, x right and y up, the vertices run clockwise: the mirror image of the list.
    assert areas(outline) < 0
    assert areas(outline) == pytest.approx(-1e6 * target.area, rel=1e-6)


def test_face_is_the_mirror_image(target):
    face = lidar_face(target)
    # The first vertex of the paper's shape is at its right from behind: at the left for the LiDAR.
    assert target.polygon[0, 0] > 0.9
    assert face[0, 0] < -900
    np.testing.assert_allclose(vertices_of(face), target.polygon)


def test_a_camera_at_the_lidar_sees_the_drawing(target):
    """Project the target with the pose in which a LiDAR at the origin looks along +x at it: y is to the left."""
    points = target.vertices + np.array([5.0, 0.0, 0.0])
    right, up = -points[:, 1] / points[:, 0], points[:, 2] / points[:, 0]
    np.testing.assert_allclose(np.column_stack([right, up]) * 5000, lidar_face(target))


@pytest.mark.parametrize("name", ["paper", "built", "triangle", "score-optimal5"])
def test_svg_reads_back(tmp_path, name):
    target = load_target(name)
    (path,) = export(draw(target), tmp_path / "target.svg")
    outline, _, texts = svg_outline(path)
    assert_shows(outline, target)
    assert "THIS SIDE TO THE LiDAR" in texts
    assert "UP" in texts
    for length in target.edge_lengths:
        assert f"{1000 * length:.1f}" in texts


def test_pdf_reads_back(tmp_path, target):
    (path,) = export(draw(target), tmp_path / "target.pdf")
    ((closed, size, text),) = pdf_pages(path)
    assert_shows(next(p for p in closed if len(p) == len(target) + 1), target)
    assert (size > 1000 * np.ptp(target.polygon, axis=0)).all()
    assert "THIS SIDE TO THE LiDAR" in text


@pytest.mark.parametrize("name", ["paper", "triangle"])
def test_dxf_reads_back(tmp_path, name):
    import ezdxf

    target = load_target(name)
    (path,) = export(draw(target), tmp_path / "target.dxf")
    document = ezdxf.readfile(path)
    assert document.units == 4  # millimetres
    assert not document.audit().has_errors
    (outline,) = document.modelspace().query('LWPOLYLINE[layer=="CUT"]')
    assert outline.closed
    assert_shows(np.array([point[:2] for point in outline.get_points()]), target)
    texts = [text.dxf.text for text in document.modelspace().query("TEXT")]
    assert "THIS SIDE TO THE LiDAR" in texts


def test_diagonals_and_centre_are_where_they_belong(target):
    drawing = draw(target)
    lines = {line.name: line.points for line in drawing.polylines if line.name}
    np.testing.assert_allclose(lines["diagonal-0-2"], lidar_face(target)[[0, 2]])
    np.testing.assert_allclose(lines["centre-level"].mean(axis=0), 0.0)
    assert lines["up"][1, 1] > lines["up"][0, 1]
    bar = lines["check-bar"]
    assert np.ptp(bar[:, 0]) == 100.0
    diagonal = np.linalg.norm(target.polygon[0] - target.polygon[2])
    assert f"{1000 * diagonal:.1f}" in [text.text for text in drawing.texts]


def test_everything_is_on_the_page():
    for name in ("paper", "triangle", "pose-optimal"):
        for area in (0.05, 1.0, 4.0):
            drawing = draw(load_target(name).scaled_to_area(area))
            points = np.concatenate([line.points for line in drawing.polylines])
            points = np.concatenate([points, [text.position for text in drawing.texts]])
            assert (points >= drawing.low).all()
            assert (points <= drawing.high).all()


def test_sheets_cover_the_drawing_and_join(tmp_path):
    target = load_target("paper@0.25")
    drawing = draw(target)
    sheets = lay_out(drawing, "A3")
    windows = np.array([sheet.window for sheet in sheets])
    low, high = windows[:, :2].min(axis=0), (windows[:, :2] + windows[:, 2:]).max(axis=0)
    assert (low <= drawing.low).all()
    assert (high >= drawing.high).all()
    # They tile the whole: no overlap, no gap.
    assert np.prod(windows[:, 2:], axis=1).sum() == pytest.approx(np.prod(high - low))
    *paths, overview = export(drawing, tmp_path / "t.svg", "A3", notes=["glue"])
    assert len(paths) == len(sheets) > 1
    _, size, texts = svg_outline(overview)
    assert sorted(size) == pytest.approx([297.0, 420.0], abs=1e-3)
    assert {"glue", "1", str(len(sheets))} <= set(texts)
    seen = []
    for path, sheet in zip(paths, sheets, strict=True):
        outline, size, texts = svg_outline(path)
        assert sorted(size) == pytest.approx([297.0, 420.0], abs=1e-3)
        # What a sheet holds of the outline, moved to the sheet's place, lies on the outline of the face.
        there = vertices_of(outline + sheet.origin)
        np.testing.assert_allclose(target.outside_distance(there), 0.0, atol=1e-6)
        seen.append(there[np.min(np.abs(there[:, None] - target.polygon).max(axis=2), axis=1) < 1e-6])
        assert any("row" in text for text in texts)
    assert len(np.unique(np.concatenate(seen).round(5), axis=0)) == len(target)


def test_pdf_has_a_page_per_sheet_of_the_paper(tmp_path, target):
    drawing = draw(target)
    (path,) = export(drawing, tmp_path / "t.pdf", "A1")
    pages = list(pdf_pages(path))
    assert len(pages) == len(lay_out(drawing, "A1")) + 1  # the plan
    for _, size, _ in pages:
        assert sorted(size) == pytest.approx([594.0, 841.0], abs=1e-2)


def test_no_sheet_is_empty(target):
    """Of a target as large as 4 x 3 sheets, those inside the outline and at the corners show nothing."""
    drawing = draw(load_target("triangle"))
    sheets = lay_out(drawing, "A4")
    windows = np.array([sheet.window for sheet in sheets])
    tiles = np.prod(np.ptp(np.concatenate([windows[:, :2], windows[:, :2] + windows[:, 2:]]), axis=0) / windows[0, 2:])
    assert len(sheets) < round(tiles) - 5
    for line in drawing.polylines:
        dense = np.concatenate([np.linspace(a, b, 200) for a, b in zip(line.points, line.points[1:], strict=False)])
        shown = (dense[:, None] >= windows[:, :2] - 1e-6) & (dense[:, None] <= windows[:, :2] + windows[:, 2:] + 1e-6)
        assert shown.all(axis=2).any(axis=1).all()


@pytest.mark.parametrize("orientation", ["portrait", "landscape"])
def test_sheets_lie_as_asked(orientation):
    for sheet in lay_out(draw(load_target("paper")), "A3", orientation):
        assert sheet.size == ((297.0, 420.0) if orientation == "portrait" else (420.0, 297.0))


def test_a_small_target_needs_one_sheet():
    (sheet,) = lay_out(draw(load_target("paper@0.03")), "A3")
    assert sheet.label is None
    (large,) = lay_out(draw(load_target("paper")), None)
    assert large.window[0] == pytest.approx(large.origin[0] + BORDER)


def test_same_drawing_same_file(tmp_path, target):
    for suffix in ("svg", "pdf"):
        first, second = (export(draw(target), tmp_path / f"{i}.{suffix}")[0].read_bytes() for i in (1, 2))
        assert first == second


def test_figure_has_the_size_of_the_paper(target):
    (sheet,) = lay_out(draw(target), None)
    figure = figure_of(draw(target), sheet)
    np.testing.assert_allclose(figure.get_size_inches() * 25.4, sheet.size)


def test_a_polygon_with_many_sides_is_drawn():
    angles = 2 * np.pi * np.arange(24) / 24
    drawing = draw(Target.from_polygon(np.column_stack([np.cos(angles), np.sin(angles)])))
    assert sum(line.name.startswith("diagonal") for line in drawing.polylines) == 1


def test_unknown_formats_and_papers(tmp_path, target):
    with pytest.raises(InputError, match=r"\.svg, \.pdf, \.dxf"):
        export(draw(target), tmp_path / "t.png")
    with pytest.raises(InputError, match="paper 'B5' is not known"):
        export(draw(target), tmp_path / "t.pdf", "B5")
    assert list(tmp_path.iterdir()) == []
