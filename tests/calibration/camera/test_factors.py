import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, K, L, P, S, W

from optshape_graph.calibration.camera.factors import CompiledCamera, coupling_factor
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.projection import project
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.se3 import inverse
from tests.calibration.camera.support import (
    BOARD,
    FISHEYE,
    PINHOLE,
    T_CAMERA_LIDAR,
    Sensor,
    chessboard_points,
    placement,
    seen_by_lidar,
)

RATIONAL = CameraIntrinsics("cam", "pinhole", 1600, 1200, PINHOLE.K, np.array([-0.21, 0.07, 3e-4, -2e-4, 0.01]))


def perturbed(values: gtsam.Values, key: int, x: np.ndarray) -> gtsam.Values:
    moved = gtsam.Values(values)
    delta = gtsam.VectorValues()
    delta.insert(key, x)
    return moved.retract(delta)


def check_jacobians(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> None:
    linear = factor.linearize(values)
    A, _ = linear.jacobian()
    sizes = [len(values.zeroVectors().at(key)) for key in list(factor.keys())]
    start = 0
    for key, size in zip(list(factor.keys()), sizes, strict=True):
        numeric = np.zeros((len(A), size))
        for k in range(size):
            step = 1e-6 * np.eye(size)[k]
            plus, minus = (factor.whitenedError(perturbed(values, key, s)) for s in (step, -step))
            numeric[:, k] = (plus - minus) / 2e-6
        scale = max(np.abs(numeric).max(), 1.0)
        assert np.allclose(A[:, start : start + size], numeric, atol=2e-6 * scale)
        start += size


@pytest.fixture(scope="module")
def view():
    rng = np.random.default_rng(0)
    T = placement(rng)
    return T, seen_by_lidar(Sensor.drawn("lidar", rng), T, BOARD, rng)


@pytest.mark.parametrize("k_sensor", [None, S(1)], ids=["base", "other"])
@pytest.mark.parametrize("k_bias", [None, B(0)], ids=["known", "bias"])
def test_coupling_derivatives(view, k_sensor, k_bias):
    T, scan = view
    rng = np.random.default_rng(1)
    values = gtsam.Values()
    values.insert(W(0), gtsam.Pose3(inverse(T)))
    values.insert(S(1), gtsam.Pose3.Expmap(rng.normal(0, 0.3, 6)))
    values.insert(B(0), 0.02)
    right = values.atPose3(S(1)) if k_sensor else gtsam.Pose3()
    values.insert(L(0), values.atPose3(W(0)).compose(right).compose(gtsam.Pose3.Expmap(rng.normal(0, 0.02, 6))))
    factor = coupling_factor((W(0), k_sensor, L(0), k_bias), scan, np.repeat([0.01, 0.005], 3), inverse(T))
    if isinstance(factor, gtsam.BetweenFactorPose3):
        assert k_sensor is None
        assert k_bias is None
    else:
        check_jacobians(factor, values)


def test_coupling_vanishes_where_ranges_are_too_long_by_the_bias(view):
    T, scan = view
    values = gtsam.Values()
    values.insert(W(0), gtsam.Pose3(inverse(T)))
    values.insert(B(0), 0.02)
    seen = np.array(T)
    seen[:3, 3] += 0.02 * scan.ray
    values.insert(L(0), gtsam.Pose3(inverse(seen)))
    factor = coupling_factor((W(0), None, L(0), B(0)), scan, np.full(6, 0.01), inverse(T))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE, RATIONAL], ids=["equidistant", "radtan", "k3"])
def test_projection_factors_are_opencvs_model(camera):
    T = T_CAMERA_LIDAR @ placement(np.random.default_rng(2))
    points = chessboard_points(BOARD.chessboard)
    pixels = project(camera, points @ T[:3, :3].T + T[:3, 3]) + np.array([1.0, -0.5])
    image = ImagePoints.of_pattern(points, pixels, 0.2)
    values = gtsam.Values()
    values.insert(W(0), gtsam.Pose3(inverse(T)))
    values.insert(S(1), gtsam.Pose3())
    for k, point in enumerate(points):
        values.insert(P(k), point)
    compiled = CompiledCamera.of(camera)
    factors = compiled.factors(image, W(0), S(1), [P(k) for k in range(len(points))], None)
    # Freed of distortion, a pixel's error is what it was to first order only.
    tolerance = 0.02 if compiled.ideal else 1e-9
    for factor in factors:
        assert factor.error(values) == pytest.approx(0.5 * 1.25 / 0.04, rel=tolerance)
    check_jacobians(factors[0], values)


@pytest.mark.parametrize("camera", [FISHEYE, PINHOLE], ids=lambda c: c.model)
def test_refined_intrinsics_derivatives(camera):
    T = T_CAMERA_LIDAR @ placement(np.random.default_rng(3))
    points = chessboard_points(BOARD.chessboard)[:1]
    image = ImagePoints.of_pattern(points, project(camera, points @ T[:3, :3].T + T[:3, 3]), 0.2)
    compiled = CompiledCamera.of(camera)
    values = gtsam.Values()
    values.insert(W(0), gtsam.Pose3(inverse(T)))
    values.insert(S(1), gtsam.Pose3())
    values.insert(P(0), points[0])
    values.insert(K(1), compiled.calibration)
    (factor,) = compiled.factors(image, W(0), S(1), [P(0)], K(1))
    assert factor.error(values) == pytest.approx(0.0, abs=1e-9)
    check_jacobians(factor, values)
    same = compiled.refined(compiled.vector)
    assert np.allclose(same.K, camera.K)
    assert np.allclose(same.D, camera.D)


def test_longer_distortion_models_are_not_refined():
    with pytest.raises(InputError, match="5 distortion terms"):
        CompiledCamera.of(RATIONAL).check_refinable()
