"""Scans of scenes: geometry of each surface, occlusion, motion, partial illumination."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from optshape_graph import InputError, SensorModel, Target
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.scan import moved
from optshape_graph.simulation import (
    AngleErrors,
    Box,
    ConstantTwist,
    Floor,
    Mesh,
    NoiseModel,
    Patch,
    Scene,
    Trajectory,
    pose_from_rpy,
    random_rings,
    room,
    simulate,
    simulate_target,
    spinning_at,
    uniform_sensor,
    without_rings,
)

TARGET, SENSOR = load_target("paper"), load_sensor("vlp32c")
COARSE = uniform_sensor(24, np.radians(-40), np.radians(40), np.radians(1.0))


def in_target_frame(points, T_lidar_target):
    return (points - T_lidar_target[:3, 3]) @ T_lidar_target[:3, :3]


poses = st.tuples(
    st.floats(2.0, 20.0), st.floats(-180.0, 180.0), st.floats(-0.3, 0.3), *[st.floats(-40.0, 40.0)] * 3
).map(lambda v: pose_from_rpy([0, 0, 0], np.radians([0, 0, v[1]])) @ pose_from_rpy([v[0], 0, v[2]], np.radians(v[3:])))


@settings(max_examples=40, deadline=None)
@given(pose=poses)
def test_target_returns_are_exactly_the_rays_inside_the_polygon(pose):
    scan = simulate_target(TARGET, SENSOR, pose)
    local = in_target_frame(scan.points, pose)
    assert np.abs(local[:, 0]).max(initial=0) < 1e-12  # in the plane, to rounding at 20 m
    assert TARGET.outside_distance(local[:, 1:]).max(initial=-1) < 1e-12
    # every ray of the sensor, by brute force: the same number meets the polygon
    k = np.arange(1800)[:, None] * SENSOR.azimuth_step
    d = np.stack(np.broadcast_arrays(*[
        np.cos(SENSOR.elevations) * np.cos(k), np.cos(SENSOR.elevations) * np.sin(k), np.sin(SENSOR.elevations)
    ]), -1).reshape(-1, 3) @ pose[:3, :3]  # fmt: skip
    o = -pose[:3, 3] @ pose[:3, :3]
    s = -o[0] / d[:, 0]
    outside = TARGET.outside_distance((o + s[:, None] * d)[:, 1:])
    assert ((outside < -1e-9) & (s > 0)).sum() <= len(scan) <= ((outside < 1e-9) & (s > 0)).sum()


@settings(max_examples=20, deadline=None)
@given(pose=poses, placement=poses)
def test_scans_do_not_depend_on_the_world_frame(pose, placement):
    moved = simulate(Scene((Patch(TARGET, placement @ pose),)), SENSOR, placement)
    still = simulate_target(TARGET, SENSOR, pose)
    assert abs(len(moved.scan) - len(still)) <= 1  # a ray on an edge may fall either way
    if len(moved.scan) == len(still):
        np.testing.assert_allclose(moved.scan.points, still.points, atol=1e-9)
    np.testing.assert_allclose(moved.T_lidar_targets[0], pose, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(pose=poses, placement=poses)
def test_leaving_out_columns_without_a_target_changes_nothing(pose, placement):
    """A sensor that does not move, said as a motion, fires all its columns."""
    sensor = replace(SENSOR, azimuth_offsets=np.radians(np.linspace(-4, 4, SENSOR.n_rings)))
    scene = Scene((Patch(TARGET, placement @ pose),))
    noise = NoiseModel(hit_fraction=0.1)
    all_columns = simulate(scene, sensor, ConstantTwist(placement, np.zeros(6)), noise=noise).scan
    few = simulate(scene, sensor, placement, noise=noise).scan
    assert abs(len(all_columns) - len(few)) <= 1  # a ray on an edge may fall either way
    if len(all_columns) == len(few):
        np.testing.assert_allclose(few.points, all_columns.points, atol=1e-9)


def test_a_target_between_two_columns_returns_nothing():
    tiny = load_target("paper@1e-6")
    noise = NoiseModel.of(SENSOR)
    pose = pose_from_rpy([0.0, 0.0, 0.0], [0.0, 0.0, 0.5 * SENSOR.azimuth_step]) @ pose_from_rpy([20.0, 0.0, 0.05])
    assert len(simulate_target(tiny, SENSOR, pose)) == 0
    assert len(simulate_target(tiny, SENSOR, pose, noise=replace(noise, random_phase=False))) == 0
    assert len(simulate(Scene(), SENSOR, noise=noise).scan) == 0


def test_a_wide_beam_returns_from_outside_the_edge_by_the_stated_angle():
    divergence = np.radians(0.4)
    sensor = SensorModel(np.radians([-1.0, 0.0, 1.0]), azimuth_step=np.radians(0.01), beam_divergence=divergence)
    square = Target.from_polygon([[1, -1], [1, 1], [-1, 1], [-1, -1]])
    pose = pose_from_rpy([10.0, 0.0, 0.0])
    for fraction in (0.1, 0.5, 0.9):
        noise = NoiseModel(hit_fraction=fraction)
        points = simulate_target(square, sensor, pose, noise=noise).points
        widest = np.arctan2(points[:, 1], points[:, 0]).max()
        expected = np.arctan(0.1) + noise.edge_shift * divergence / 2
        assert widest == pytest.approx(expected, abs=1.1 * sensor.azimuth_step)
        assert np.abs(points[:, 0] - 10.0).max() < 1e-12  # all in the target's plane


def box_mesh(box):
    corners = np.array(list(itertools.product([-0.5, 0.5], repeat=3))) * box.size
    T = box.T_world_box
    return Mesh(corners @ T[:3, :3].T + T[:3, 3], ConvexHull(corners).simplices, box.reflectivity)


def test_box_equals_its_mesh_from_outside_and_inside():
    pytest.importorskip("open3d", exc_type=ImportError)
    for box in (
        Box([0.7, 0.5, 1.8], pose_from_rpy([4, 3, -0.6], [0.2, 0.3, 0.5])),
        Box([20, 16, 6], pose_from_rpy([3, 1, 1.5])),
    ):
        analytic, traced = (simulate(Scene((), (surface,)), COARSE) for surface in (box, box_mesh(box)))
        assert len(analytic.scan) == len(traced.scan) > 30
        np.testing.assert_allclose(analytic.scan.points, traced.scan.points, atol=1e-4)  # Open3D: single precision
        np.testing.assert_allclose(analytic.scan.intensity, traced.scan.intensity, atol=1e-4)


def test_target_equals_its_mesh_also_in_motion():
    pytest.importorskip("open3d", exc_type=ImportError)
    pose = pose_from_rpy([5.0, 1.0, 0.2], np.radians([5, 10, 20]))
    mesh = Mesh(TARGET.vertices @ pose[:3, :3].T + pose[:3, 3], [[0, 1, 2], [0, 2, 3]])
    motion = ConstantTwist(np.eye(4), [0.1, -0.2, 0.8, 2.0, 0.5, 0.0])
    for placement in (np.eye(4), motion):
        analytic = simulate(Scene((Patch(TARGET, pose),)), SENSOR, placement).scan
        traced = simulate(Scene((), (mesh,)), SENSOR, placement).scan
        assert abs(len(analytic) - len(traced)) <= 2  # edge rays, in single precision
        assert len(analytic) > 500
        gaps = np.abs(analytic.points[:, None] - traced.points[None]).sum(-1).min(1)
        assert np.quantile(gaps, 0.99) < 1e-4


def test_a_ray_along_a_face_of_a_box_is_decided_without_nan():
    sensor = SensorModel(np.array([0.0]), azimuth_step=np.pi / 2)
    box = Box([1.0, 1.0, 1.0], pose_from_rpy([3.0, 0.0, 0.0]))
    scan = simulate(Scene((), (box,)), sensor).scan
    np.testing.assert_allclose(scan.points, [[2.5, 0, 0]], atol=1e-12)
    assert len(simulate(Scene((), (Box([1.0, 1.0, 1.0], pose_from_rpy([3.0, 0.0, 2.0])),)), sensor).scan) == 0


def test_floor_is_hit_below_the_horizon_only():
    result = simulate(Scene((), (Floor(-1.5),)), COARSE)
    below = (COARSE.elevations < 0).sum()
    assert len(result.scan) == below * 360
    np.testing.assert_allclose(result.scan.points[:, 2], -1.5, atol=1e-12)


def test_the_nearest_surface_returns():
    pose = pose_from_rpy([6.0, 0.0, 0.0])
    wall = Box([0.1, 10.0, 10.0], pose_from_rpy([9.0, 0.0, 0.0]))
    occluder = Box([0.1, 0.5, 5.0], pose_from_rpy([4.0, 0.3, 0.0]))
    alone = simulate_target(TARGET, SENSOR, pose)
    result = simulate(Scene((Patch(TARGET, pose),), (wall, occluder)), SENSOR)
    seen = result.target_returns(0)
    assert 0.3 * len(alone) < len(seen) < 0.8 * len(alone)
    shadow = np.abs(seen.points[:, 1] / seen.points[:, 0] - 0.3 / 3.95) < 0.2 / 3.95
    assert not shadow.any()
    beside = result.scan.select(result.surface == 1)
    assert len(beside) > 0
    assert beside.points[:, 0].min() == pytest.approx(8.95, abs=1e-9)


def test_several_targets_are_told_apart():
    patches = tuple(Patch(TARGET, pose_from_rpy([6.0, y, 0.0])) for y in (-3.0, 0.0, 3.0))
    result = simulate(Scene(patches), SENSOR)
    for k, patch in enumerate(patches):
        np.testing.assert_allclose(result.T_lidar_targets[k], patch.T_world_patch, atol=1e-12)
        assert np.abs(result.target_returns(k).points[:, 1] - 3.0 * (k - 1)).max() < 1.1


def test_range_limits_apply():
    sensor = SensorModel(SENSOR.elevations, azimuth_step=SENSOR.azimuth_step, min_range=2.0, max_range=10.0)
    scan = simulate(Scene((), (Floor(-1.0), Box([100.0, 100.0, 50.0], np.eye(4)))), sensor).scan
    ranges = np.linalg.norm(scan.points, axis=1)
    assert len(scan) > 100
    assert ranges.min() >= 2.0
    assert ranges.max() <= 10.0


def test_moving_sensor_deskews_onto_the_target():
    """Each point, mapped by the pose at its own time, lies on the target's plane."""
    motion = ConstantTwist(pose_from_rpy([0.5, 0.2, 0.0], [0.0, 0.0, 0.1]), [0.2, 0.1, 1.0, 5.0, 1.0, 0.3])
    pose = pose_from_rpy([6.0, 1.0, 0.2], np.radians([5, 10, 20]))
    result = simulate(Scene((Patch(TARGET, pose),)), SENSOR, motion)
    R, t = motion.at(result.scan.time)
    world = np.einsum("nij,nj->ni", R, result.scan.points) + t
    local = in_target_frame(world, pose)
    assert len(local) > 500
    assert np.abs(local[:, 0]).max() < 1e-9
    assert TARGET.outside_distance(local[:, 1:]).max() < 1e-9
    as_if_still = in_target_frame(result.scan.points, result.T_lidar_targets[0])
    assert np.abs(as_if_still[:, 0]).max() > 1e-3
    assert np.ptp(result.scan.time) < 0.1


def test_constant_twist_is_the_exponential_of_gtsam():
    import gtsam

    motion = ConstantTwist(pose_from_rpy([1, 2, 3], [0.3, -0.2, 0.9]), np.array([0.3, -0.2, 1.1, 2.0, -1.0, 0.4]))
    times = np.array([-0.05, 0.0, 0.7])
    R, t = motion.at(times)
    for k, time in enumerate(times):
        expected = gtsam.Pose3(motion.T_world_lidar).compose(gtsam.Pose3.Expmap(time * motion.twist)).matrix()
        np.testing.assert_allclose(np.column_stack([R[k], t[k]]), expected[:3], atol=1e-12)


def test_a_trajectory_through_a_constant_twist_is_nearly_it():
    twist = ConstantTwist(np.eye(4), [0.0, 0.0, 0.5, 1.0, 0.0, 0.0])
    knots = np.linspace(-0.1, 0.1, 21)
    R, t = twist.at(knots)
    poses = np.tile(np.eye(4), (21, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = R, t
    trajectory = Trajectory(knots, poses)
    times = np.linspace(-0.1, 0.1, 77)
    for a, b in zip(trajectory.at(times), twist.at(times), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)  # chord against arc: (v w dt^2) / 8 = 6e-6
    with pytest.raises(InputError, match=r"covers -0\.1 to 0\.1 s"):
        trajectory.at(np.array([0.2]))


def test_hidden_angles_turn_rays_and_not_what_is_reported():
    """Put right by what is hidden, the returns are on the target's plane again, to rounding."""
    rng = np.random.default_rng(1)
    errors = AngleErrors(rng.normal(0, 1e-3, SENSOR.n_rings), rng.normal(0, 1e-3, SENSOR.n_rings))
    T = pose_from_rpy([6.0, 0.0, 0.0], [0.0, 0.4, 0.4])
    scan = simulate_target(load_target("paper"), SENSOR, T, angle_errors=errors)
    local = (scan.points - T[:3, 3]) @ T[:3, :3]
    right = moved(scan.points, scan.ring, np.zeros(SENSOR.n_rings), errors.elevation, errors.azimuth)
    assert np.abs(local[:, 0]).max() > 1e-3
    assert np.abs(((right - T[:3, 3]) @ T[:3, :3])[:, 0]).max() < 1e-9
    known = replace(
        SENSOR, elevations=SENSOR.elevations + errors.elevation, reported_elevations=SENSOR.elevations,
        azimuth_offsets=errors.azimuth, reported_azimuth_offsets=np.zeros(SENSOR.n_rings),
    )  # fmt: skip
    same = simulate_target(load_target("paper"), known, T)
    np.testing.assert_allclose(same.points, scan.points, atol=1e-9)


def test_azimuth_offsets_turn_rings():
    offsets = np.radians(np.linspace(-4, 4, SENSOR.n_rings))
    turned = SensorModel(SENSOR.elevations, azimuth_step=SENSOR.azimuth_step, azimuth_offsets=offsets)
    scan = simulate_target(TARGET, turned, pose_from_rpy([5.0, 0.0, 0.0]))
    steps = (np.arctan2(scan.points[:, 1], scan.points[:, 0]) - offsets[scan.ring]) / turned.azimuth_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_rings_can_be_left_out_by_name_and_by_share():
    scan = simulate_target(TARGET, SENSOR, pose_from_rpy([6.0, 0.0, 0.0]))
    rings = np.unique(scan.ring)
    assert set(np.unique(without_rings(scan, rings[:3]).ring)) == set(rings[3:])
    drawn = random_rings(scan, 1 / 3, rng=4)
    assert len(drawn) == len(set(drawn)) == round(len(rings) / 3)
    assert set(drawn) <= set(rings)
    np.testing.assert_array_equal(drawn, random_rings(scan, 1 / 3, rng=4))
    with pytest.raises(InputError, match="share"):
        random_rings(scan, 1.5)


def test_spin_rate_sets_the_step_and_a_sensor_without_one_is_refused():
    assert spinning_at(SENSOR, 20.0).azimuth_step == pytest.approx(2 * SENSOR.azimuth_step)
    blind = SENSOR.with_azimuth_step(None)
    with pytest.raises(InputError, match="azimuth step"):
        spinning_at(blind, 10.0)
    with pytest.raises(InputError, match="azimuth step"):
        simulate_target(TARGET, blind, pose_from_rpy([6.0, 0.0, 0.0]))


def test_a_mesh_file_is_read_and_a_wrong_one_refused(tmp_path):
    o3d = pytest.importorskip("open3d", exc_type=ImportError)
    box = o3d.geometry.TriangleMesh.create_box(1000.0, 1000.0, 1000.0)
    box.compute_vertex_normals()
    path = tmp_path / "box.ply"
    o3d.io.write_triangle_mesh(str(path), box)
    mesh = Mesh.read(path, pose_from_rpy([3.0, -0.5, -0.5]), scale=1e-3)
    scan = simulate(Scene((), (mesh,)), COARSE).scan
    assert scan.points[:, 0].min() == pytest.approx(3.0, abs=1e-5)
    (tmp_path / "empty.ply").write_text("not a mesh")
    for name in ("empty.ply", "absent.ply"):
        with pytest.raises(InputError, match=name):
            Mesh.read(tmp_path / name, np.eye(4))
    with pytest.raises(InputError, match="names vertex 7"):
        Mesh(np.eye(3), [[0, 1, 7]])


def test_in_a_room_every_ray_returns_and_targets_hide_the_wall_and_their_stands():
    poses = [pose_from_rpy([6.0, y, 0.0], [0.0, 0.0, yaw]) for y, yaw in ((-3.0, -0.4), (3.0, 0.4))]
    scene = room([(TARGET, pose) for pose in poses])
    result = simulate(scene, SENSOR)
    assert len(result.scan) == SENSOR.n_rings * 1800
    for k, pose in enumerate(poses):
        assert len(result.target_returns(k)) == len(simulate_target(TARGET, SENSOR, pose))
    stands = result.scan.select(result.surface >= 3)
    assert len(stands) > 10
    assert stands.points[:, 2].max() < 0.0
    with pytest.raises(InputError, match="not in the room"):
        room([(TARGET, pose_from_rpy([60.0, 0.0, 0.0]))])
