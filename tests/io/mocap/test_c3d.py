"""C3D files."""

import numpy as np
import pytest

from optshape_graph.io.mocap import read_mocap
from tests.io.mocap.exports import NAMES, F, c3d, same, truth


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("m", 1.0)])
def test_c3d(tmp_path, unit, scale):
    pytest.importorskip("ezc3d")
    c3d(tmp_path / "a.c3d", unit, scale)
    same(read_mocap(tmp_path / "a.c3d"), 100.0, tolerance=3e-7)  # float32


@pytest.mark.parametrize("first", [0, 100])
def test_c3d_with_a_model_s_outputs(tmp_path, first):
    ezc3d = pytest.importorskip("ezc3d")
    content = ezc3d.c3d()
    point = content["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [100.0], ["mm"]
    point["LABELS"]["value"] = [*NAMES, "RKneeAngles", "corner1", "GroundForce"]  # an angle has a marker's label
    content.add_parameter("POINT", "ANGLES", ["RKneeAngles", "corner1"])
    content.add_parameter("POINT", "FORCES", ["GroundForce"])
    points = np.ones((4, 7, F))
    points[:3, :4] = truth().transpose(2, 1, 0) * 1e3
    points[:3, 4:] = 77.0  # degrees, newtons
    content["data"]["points"] = points
    content["header"]["points"]["first_frame"] = first
    content.write(str(tmp_path / "a.c3d"))
    recording = read_mocap(tmp_path / "a.c3d")
    assert recording.markers == NAMES
    assert np.nanmax(np.abs(recording.positions - truth())) < 3e-7  # float32
    assert recording.times == pytest.approx((first + np.arange(F)) / 100)
