import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.exports import kalibr_camchain, static_transforms
from optshape_graph.errors import InputError
from optshape_graph.io import load_camera
from optshape_graph.io.documents import write_json, write_yaml
from tests.calibration.camera.support import FISHEYE, PINHOLE, synthetic_views, transform


@pytest.fixture(scope="module")
def calibration():
    return calibrate(synthetic_views(6, np.random.default_rng(0)))


def test_json_has_the_stated_keys(calibration, tmp_path):
    write_json(tmp_path / "a.json", calibration.to_dict())
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["schema"] == "optshape/camera-calibration/1"
    assert np.allclose(document["T_camera_lidar"], calibration.transform("cam", "lidar")[0])
    assert np.shape(document["covariance"]) == (6, 6)
    assert np.allclose(np.linalg.inv(document["T_camera_lidar"]), document["T_lidar_camera"])
    assert document["range_bias_m"] == calibration.range_bias("lidar")[0]
    keys = {
        "scan",
        "image",
        "used",
        "reason",
        "centre_error_mm",
        "plane_offset_mm",
        "normal_error_deg",
        "reprojection_px",
    }
    assert keys <= set(document["views"][0])
    assert document["cross_validation"]["protocol"] == "leave-one-out"
    assert document["k_fold"]["protocol"] == "k-fold, k = 5"


def test_camchain_reads_back(calibration, tmp_path):
    chain = kalibr_camchain(calibration.mounted())
    extrinsic = chain["cam0"]["T_cam_lidar"]
    assert np.allclose(extrinsic, calibration.transform("cam", "lidar")[0])
    write_yaml(tmp_path / "camchain.yaml", chain)
    camera = load_camera(tmp_path / "camchain.yaml")
    assert np.allclose(camera.K, FISHEYE.K)
    assert np.allclose(camera.D, FISHEYE.D)


@pytest.mark.parametrize(
    ("D", "model", "coefficients"),
    [((), "none", []), ((0.0,) * 5, "none", []), ((-0.2, 0.1, 0.0, 1e-3, 0.0), "radtan", [-0.2, 0.1, 0.0, 1e-3])],
)
def test_camchain_has_kalibrs_models(calibration, D, model, coefficients):
    """Kalibr knows four terms, or none."""
    rig = replace(calibration.rig, cameras={"cam": replace(PINHOLE, D=np.array(D, float))})
    entry = kalibr_camchain(replace(calibration, rig=rig).mounted())["cam0"]
    assert entry["distortion_model"] == model
    assert entry["distortion_coeffs"] == coefficients


def test_camchain_refuses_what_kalibr_has_not(calibration):
    rig = replace(calibration.rig, cameras={"cam": replace(PINHOLE, D=np.array([-0.2, 0.1, 0, 0, 0.05]))})
    with pytest.raises(InputError, match="camera 'cam': 5 distortion terms; Kalibr's radtan model has"):
        kalibr_camchain(replace(calibration, rig=rig).mounted())


def test_json_says_what_the_targets_and_lenses_are(calibration):
    document = calibration.to_dict()
    (shape,) = document["targets"]
    assert (shape["target"], shape["lidar"], shape["agrees"]) == ("board", "lidar", True)
    assert np.shape(shape["measured_sides_m"]) == np.shape(shape["sides_m"]) == np.shape(shape["sigma_m"]) == (4,)
    assert len(shape["scans"]) == 6
    assert document["cameras"][0]["refined"] is False
    assert abs(document["edge_inset_deg"] - 0.1) < 0.5  # half a step, and half a beam either way
    assert {view["lidar"] for view in document["views"]} == {"lidar"}


def test_ros_and_urdf_lines_are_the_transform():
    T = transform(Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    lines = static_transforms("lidar", "camera", T)
    words = lines["ros1"].split()
    assert words[:3] == ["rosrun", "tf2_ros", "static_transform_publisher"]
    assert words[-2:] == ["lidar", "camera"]
    x, y, z, qx, qy, qz, qw = map(float, words[3:10])
    assert np.allclose([x, y, z], T[:3, 3])
    assert np.allclose(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), T[:3, :3])
    words = lines["ros2"].split()
    named = dict(zip(words[4::2], words[5::2], strict=True))
    assert named["--frame-id"] == "lidar"
    assert named["--child-frame-id"] == "camera"
    assert np.allclose([float(named[f"--q{k}"]) for k in "xyzw"], [qx, qy, qz, qw])
    rpy = [float(v) for v in lines["urdf"].split('rpy="')[1].rstrip('"/>').split()]
    assert np.allclose(Rotation.from_euler("xyz", rpy).as_matrix(), T[:3, :3])  # URDF: fixed axes, roll first
