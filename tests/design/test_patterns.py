"""Patterns are found by OpenCV in the drawing, where the target file says, to a tenth of a millimetre."""

import io
from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.calibration.images.chessboard import chessboard_points, find_chessboard
from optshape_graph.calibration.images.tags import find_tags, tag_points
from optshape_graph.design.drawing import Workshop, draw, lidar_face
from optshape_graph.design.formats import export, figure_of
from optshape_graph.design.parts import parts_list
from optshape_graph.design.polylines import Layer
from optshape_graph.design.sheets import lay_out
from optshape_graph.io.targets import load_target
from optshape_graph.target import Chessboard, Tags

cv2 = pytest.importorskip("cv2")

DPI = 200
TENTH_MM = 0.1

BOARD = replace(load_target("paper@0.1"), chessboard=Chessboard((5, 7), 0.025, (-0.006, 0.003)))
TAGS = {
    name: replace(load_target("paper@0.1"), tags=Tags(name, 0.06, {3: (0.03, 0.016), 7: (-0.09, -0.05)}, turn))
    for name, turn in (("4X4_50", 0.0), ("APRILTAG_36h11", 0.3), ("ARUCO_ORIGINAL", np.pi))
}


def charuco():
    """Tags in the white squares of a 5 x 5 chessboard of 34 mm squares, numbered from the top left as it is seen."""
    square, board = 0.034, Chessboard((4, 4), 0.034, (0.006, 0.0))
    centres = {}
    for row in range(5):
        for column in range(5):
            if (row + column) % 2:
                y, z = board.offset[0] - (column - 2) * square, board.offset[1] - (row - 2) * square
                centres[len(centres)] = (y, z)
    return replace(load_target("paper@0.1"), chessboard=board, tags=Tags("4X4_50", 0.025, centres))


def photographed(target):
    """The drawing as an orthographic picture, and the function from its pixels to (y, z) in metres."""
    drawing = draw(target)
    (sheet,) = lay_out(drawing, None)
    figure, buffer = figure_of(drawing, sheet), io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white")
    image = cv2.imdecode(np.frombuffer(buffer.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)
    mm = 25.4 / DPI

    def to_yz(pixels):
        x = sheet.origin[0] + (pixels[:, 0] + 0.5) * mm
        y = sheet.origin[1] + (image.shape[0] - pixels[:, 1] - 0.5) * mm
        return np.column_stack([-x, y]) / 1000

    return image, to_yz


def test_a_chessboard_reads_back():
    image, to_yz = photographed(BOARD)
    found = find_chessboard(image, BOARD.chessboard)
    expected = chessboard_points(BOARD.chessboard)[:, 1:]
    places = to_yz(found.pixels)
    apart = np.linalg.norm(places[:, None] - expected, axis=2).min(axis=1)  # its half turn is the same board
    assert 1000 * apart.max() < TENTH_MM


@pytest.mark.parametrize("target", TAGS.values(), ids=TAGS)
def test_tags_read_back(target):
    image, to_yz = photographed(target)
    found = find_tags(image, target.tags)
    expected = np.vstack([tag_points(target.tags, number) for number in (3, 7)])[:, 1:]
    # OpenCV's refined corner of a square is the last black pixel: half a pixel inside.
    assert 1000 * np.abs(to_yz(found.pixels) - expected).max() < 25.4 / DPI


def test_tags_are_drawn_where_they_are_to_the_tenth_of_a_millimetre():
    for target in TAGS.values():
        areas = [line.points for line in draw(target).polylines if line.name == "tag-3"]
        corners = target.tags.corners(3) * [-1000, 1000]
        points = np.concatenate(areas)
        for corner in corners:
            assert np.linalg.norm(points - corner, axis=1).min() < 1e-9


def test_a_charuco_board_reads_back():
    target = charuco()
    image, to_yz = photographed(target)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((5, 5), target.chessboard.square, target.tags.size, dictionary)
    corners, _, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert len(markers) == 12
    assert len(corners) == 16
    expected = chessboard_points(target.chessboard)[:, 1:]
    apart = np.linalg.norm(to_yz(corners.reshape(-1, 2))[:, None] - expected, axis=2).min(axis=1)
    assert 1000 * apart.max() < TENTH_MM


def test_dxf_has_the_black_areas(tmp_path):
    import ezdxf

    (path,) = export(draw(BOARD), tmp_path / "board.dxf")
    document = ezdxf.readfile(path)
    assert not document.audit().has_errors
    hatches = document.modelspace().query('HATCH[layer=="PRINT"]')
    assert len(hatches) == 24  # of 6 x 8 squares, the black half
    first = np.array(hatches[0].paths[0].vertices)[:, :2]
    assert np.ptp(first, axis=0) == pytest.approx([25.0, 25.0], abs=1e-6)


def test_nothing_is_drawn_over_a_pattern():
    drawing = draw(BOARD)
    assert not [line for line in drawing.polylines if line.name.startswith(("diagonal", "centre"))]
    inside = [text for text in drawing.texts if BOARD.contains(np.array([text.position]) * [-1e-3, 1e-3])[0]]
    assert inside == []
    assert any(text.text.startswith("diagonals 0-2") for text in drawing.texts)


def test_a_pattern_off_the_target_is_refused():
    with pytest.raises(InputError, match=r"chessboard reaches \d+ mm beyond the outline"):
        draw(replace(BOARD, chessboard=Chessboard((9, 9), 0.04)))
    with pytest.raises(InputError, match="no tag 50; it has 0 to 49"):
        draw(replace(BOARD, tags=Tags("4X4_50", 0.1, {50: (0.0, 0.0)})))


def test_markers_and_holes_are_on_the_bisectors():
    target = load_target("paper")
    drawing = draw(target, Workshop(marker_inset=20.0, hole_diameter=8.0, hole_inset=40.0))
    lines = {line.name: line for line in drawing.polylines}
    for k, corner in enumerate(lidar_face(target)):
        at = lines[f"marker-{k}-level"].points.mean(axis=0)
        assert np.linalg.norm(at - corner) == pytest.approx(20.0)
        hole = lines[f"hole-{k}"]
        assert hole.layer == Layer.CUT
        assert np.linalg.norm(hole.points.mean(axis=0) - corner) == pytest.approx(40.0)
        assert np.linalg.norm(hole.points - hole.points.mean(axis=0), axis=1) == pytest.approx(4.0)
    with pytest.raises(InputError, match="hole at vertex 0 is"):
        draw(target, Workshop(hole_diameter=100.0, hole_inset=10.0))
    with pytest.raises(InputError, match="marker_inset: expected millimetres, at least 0; found -1"):
        Workshop(marker_inset=-1.0)


def test_parts_name_what_is_drawn():
    parts = "\n".join(parts_list(BOARD, Workshop(marker_inset=15, hole_diameter=6), lay_out(draw(BOARD), "A4")))
    for word in (
        "1 plate",
        "edges 0-1",
        "diagonals 0-2",
        "4 markers",
        "4 holes of 6 mm",
        "6 x 8 squares of 25.0",
        "sheets",
    ):
        assert word in parts
    assert "APRILTAG_36h11 3, 7, black square 60.0" in "\n".join(parts_list(TAGS["APRILTAG_36h11"]))
