"""Scene files."""

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.simulation import ConstantTwist, load_scene

SCENE = """schema: optshape/scene/1
targets:
  - {target: paper, position: [8, 0, 0.2], rpy_deg: [5, 10, 10], reflectivity: 0.9}
  - {target: square@0.5, position: [6, 3, 0]}
floor: {height: -1.5}
walls:
  - {size: [10, 3], position: [12, 0, 0]}
boxes:
  - {size: [0.05, 0.05, 1.6], position: [8.1, 0, -0.7]}
lidar: {position: [0.1, 0, 0], rpy_deg: [0, 0, 2], velocity: [1, 0, 0], angular_velocity_deg: [0, 0, 20]}
"""


def write(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    return path


def test_a_scene_is_read(tmp_path):
    scene, placement = load_scene(write(tmp_path, SCENE))
    assert [patch.shape.name for patch in scene.targets] == ["paper", "square@0.5"]
    assert scene.targets[1].shape.area == pytest.approx(0.5)
    assert len(scene.background) == 3
    assert isinstance(placement, ConstantTwist)
    np.testing.assert_allclose(placement.twist, [0, 0, np.radians(20), 1, 0, 0])
    np.testing.assert_allclose(placement.T_world_lidar[:3, 3], [0.1, 0, 0])


def test_without_lidar_it_stands_at_the_origin(tmp_path):
    _, placement = load_scene(write(tmp_path, "schema: optshape/scene/1\nfloor: {height: -1}\n"))
    np.testing.assert_array_equal(placement, np.eye(4))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("floor: {height: -1.5}", "floor: {hight: -1.5}", r"scene.yaml:5.*hight"),
        ("size: [10, 3]", "size: [10, 0]", r"scene.yaml:7.*number above 0"),
        ("reflectivity: 0.9", "reflectivity: 1.9", r"scene.yaml:3.*from 0 to 1"),
        ("target: paper", "target: papr", r"papr"),
        ("position: [6, 3, 0]", "position: [6, 3]", r"scene.yaml:4.*3 elements"),
    ],
)
def test_mistakes_are_named_with_their_line(tmp_path, old, new, message):
    assert old in SCENE
    with pytest.raises(InputError, match=message):
        load_scene(write(tmp_path, SCENE.replace(old, new, 1)))


def test_an_absent_mesh_is_named(tmp_path):
    text = "schema: optshape/scene/1\nmeshes:\n  - {file: chair.ply}\n"
    with pytest.raises(InputError, match=r"chair\.ply"):
        load_scene(write(tmp_path, text))
