"""Every form is read back: as YAML, as XML, as a shell's words, and compared with where the sensors are."""

import shlex
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.exports import EXPORTS, OPTICAL_OF_LINK, Mounted, kalibr_camchain, write_exports
from optshape_graph.errors import InputError
from optshape_graph.io import load_camera
from optshape_graph.se3 import exp, transform
from tests.calibration.camera.support import FISHEYE, PINHOLE

NAMES = ("top", "rear", "le'ft; $(reboot)", '<right> & "co"')
PLACES = [np.eye(4), *(exp(x) for x in np.random.default_rng(0).normal(size=(3, 6)))]


@pytest.fixture
def folder(tmp_path):
    lenses = (None, None, PINHOLE, FISHEYE)
    sensors = [Mounted(name, T, lens) for name, T, lens in zip(NAMES, PLACES, lenses, strict=True)]
    assert [path.name for path in write_exports(tmp_path / "out", sensors)] == list(EXPORTS)
    return tmp_path / "out"


def test_camchain(folder):
    chain = yaml.safe_load((folder / "camchain.yaml").read_text())
    assert list(chain) == ["cam0", "cam1"]
    assert np.allclose(np.linalg.inv(chain["cam0"]["T_cam_lidar"]), PLACES[2])
    assert np.allclose(chain["cam1"]["T_cn_cnm1"], np.linalg.inv(PLACES[3]) @ PLACES[2])
    assert np.allclose(load_camera(f"{folder / 'camchain.yaml'}:cam1").K, FISHEYE.K)


def test_urdf(folder):
    robot = ElementTree.parse(folder / "rig.urdf").getroot()
    assert [link.get("name") for link in robot.iter("link")] == list(NAMES)
    for joint, name, T in zip(robot.iter("joint"), NAMES[1:], PLACES[1:], strict=True):
        assert joint.get("type") == "fixed"
        assert joint.find("parent").get("link") == "top"
        assert joint.find("child").get("link") == name
        xyz, rpy = (np.array(joint.find("origin").get(key).split(), float) for key in ("xyz", "rpy"))
        assert np.allclose(transform(Rotation.from_euler("xyz", rpy).as_matrix(), xyz), T, atol=1e-7)


@pytest.mark.parametrize("ros", ["ros1", "ros2"])
def test_static_transforms(folder, ros):
    first, *lines, last = (folder / f"static_transforms.{ros}.sh").read_text().splitlines()
    assert (first, last) == ("#!/bin/sh", "wait")
    for line, name, T in zip(lines, NAMES[1:], PLACES[1:], strict=True):
        words = shlex.split(line.removesuffix(" &"))
        if ros == "ros1":
            assert words[:3] == ["rosrun", "tf2_ros", "static_transform_publisher"]
            numbers, frames = np.array(words[3:10], float), words[10:]
        else:
            assert words[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
            given = dict(zip(words[4::2], words[5::2], strict=True))
            numbers = np.array([given[f"--{key}"] for key in ("x", "y", "z", "qx", "qy", "qz", "qw")], float)
            frames = [given["--frame-id"], given["--child-frame-id"]]
        assert frames == ["top", name]
        assert np.allclose(transform(Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]), T, atol=1e-7)


def test_autoware(folder):
    kit = yaml.safe_load((folder / "sensor_kit_calibration.yaml").read_text())["sensor_kit_base_link"]
    assert list(kit) == ["top_base_link", "rear_base_link", f"{NAMES[2]}/camera_link", f"{NAMES[3]}/camera_link"]
    for (link, place), T in zip(kit.items(), PLACES, strict=True):
        R = Rotation.from_euler("xyz", [place[key] for key in ("roll", "pitch", "yaw")]).as_matrix()
        found = transform(R, [place[key] for key in "xyz"])
        # Autoware's camera_link has x forward; the optical frame is turned from it.
        assert np.allclose(found, T @ OPTICAL_OF_LINK if "camera" in link else T, atol=1e-9)


def test_without_cameras_there_is_no_camchain(tmp_path):
    sensors = [Mounted("a", np.eye(4)), Mounted("b", PLACES[1])]
    assert "camchain.yaml" not in [path.name for path in write_exports(tmp_path, sensors)]
    with pytest.raises(InputError, match="a camchain is of cameras"):
        kalibr_camchain(sensors)
