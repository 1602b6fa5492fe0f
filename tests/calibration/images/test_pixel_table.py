import numpy as np
import pytest

from optshape_graph.calibration.images.pixel_table import read_pixel_table
from optshape_graph.errors import InputError
from tests.calibration.camera.support import BOARD


def test_vertices_and_points(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("vertex,u,v\n0,10,20\n2,30.5,40\n")
    found = read_pixel_table(file, BOARD)
    assert np.allclose(found.points, BOARD.vertices[[0, 2]])
    assert np.allclose(found.pixels, [[10, 20], [30.5, 40]])
    assert np.allclose(found.sqrt_information[0], np.eye(2) / 0.5)
    file.write_text("y,z,u,v,sigma\n0.1,0.2,10,20,0.25\n")
    found = read_pixel_table(file, BOARD)
    assert np.allclose(found.points, [[0, 0.1, 0.2]])
    assert np.allclose(found.sqrt_information[0], np.eye(2) * 4)
    assert not found.printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vertex,u,v\n4,1,2\n", r"vertex 4; target 'board' has 0 to 3"),
        ("vertex,u\n0,1\n", r"expected vertex,u,v or y,z,u,v"),
        ("vertex,u,v\n0,one,2\n", r"a\.csv"),
        ("vertex,u,v\n0,nan,2\n", r"1 values of 'u' are not finite"),
        ("vertex,u,v,sigma\n0,1,2,0\n", r"sigma 0 px; expected positive"),
    ],
)
def test_bad_tables(tmp_path, text, message):
    file = tmp_path / "a.csv"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        read_pixel_table(file, BOARD)
