"""Bags of every storage and layout, written with rosbags' writers, against the arrays they were written from."""

import contextlib
import sys
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from optshape_graph import InputError, SensorModel
from optshape_graph.io import read_scan
from optshape_graph.io.recordings import Recording
from optshape_graph.io.recordings.messages import rigid
from optshape_graph.io.recordings.stream import BadMessage
from tests.io.recordings.writing import LAYOUTS, STORAGES, layout, maker, points, write_bag
from tests.shared import SHARED, needs_shared

SENSOR = SensorModel(np.radians([-6.0, -2.0, 2.0, 6.0]))
T0 = 1.7e9
ROS = ("ros1", "mcap")
"""One storage of each serialisation, where the storage does not matter."""


def clouds(storage, name="velodyne", n=5, **options):
    make = maker(storage)
    stamps = T0 + np.arange(n) * 0.1
    return [("/points", make.cloud(s, points(name, stamp=s, seed=k), **options)) for k, s in enumerate(stamps)]


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_in_every_storage(tmp_path, storage, name):
    path = write_bag(tmp_path, storage, clouds(storage, name))
    stream = Recording(path).scans()
    scans = list(stream)
    assert len(scans) == stream.expected == 5
    assert not stream.skipped
    for k, scan in enumerate(scans):
        sent = points(name, stamp=scan.stamp, seed=k)
        assert scan.stamp == pytest.approx(T0 + k * 0.1, abs=2.4e-7)  # the header's, not the recording's
        assert np.array_equal(scan.value.points, np.column_stack([sent[axis] for axis in "xyz"]).astype(float))
        assert np.array_equal(scan.value.intensity, sent["intensity"])
        tolerance = {"velodyne": 1e-8, "ouster": 1e-9}.get(name, 1e-6)  # float32; 1 ns; float64 at 1.7e9 s
        assert np.abs(scan.value.time - np.linspace(0, 0.099, 40)).max() < tolerance
        if name == "livox":
            assert scan.value.ring is None
        else:  # from the lowest beam, also where the driver counts from the highest
            assert np.array_equal(scan.value.ring, np.arange(40) % 4)


@needs_shared
@pytest.mark.parametrize("storage", ROS)
def test_a_real_scan_is_the_same_from_a_bag_and_from_its_file(tmp_path, storage):
    from optshape_graph.io import load_sensor, read_scan

    sensor = load_sensor("vlp16")
    file = read_scan(SHARED / "data/camera/scans/pose01_full.pcd", sensor)
    sent = np.zeros(len(file), LAYOUTS["velodyne"])
    for k, axis in enumerate("xyz"):
        sent[axis] = file.points[:, k]
    sent["intensity"], sent["ring"] = file.intensity, file.ring
    (scan,) = Recording(write_bag(tmp_path, storage, [("/points", maker(storage).cloud(T0, sent))])).scans(
        sensor=sensor
    )
    assert np.array_equal(scan.value.points, file.points)  # both are 32-bit floats
    assert np.array_equal(scan.value.ring, file.ring)
    assert np.array_equal(scan.value.intensity, file.intensity)


@pytest.mark.parametrize("storage", ROS)
@pytest.mark.parametrize("package", ["livox_ros_driver", "livox_ros_driver2", "livox_interfaces"])
@pytest.mark.parametrize("n", [1, 2, 33])
def test_livox_custom_messages(tmp_path, storage, package, n):
    rng = np.random.default_rng(3)
    kind = layout({"offset_time": ("<u4", 0), "x": ("<f4", 4), "y": ("<f4", 8), "z": ("<f4", 12),
                   "reflectivity": ("u1", 16), "tag": ("u1", 17), "line": ("u1", 18)}, 19)  # fmt: skip
    sent = np.zeros(n, kind)
    for axis in "xyz":
        sent[axis] = rng.uniform(1, 20, n)
    sent["offset_time"] = np.arange(n) * 4167
    sent["reflectivity"] = rng.integers(0, 256, n)
    sent["line"] = np.arange(n) % 4
    path = write_bag(tmp_path, storage, [("/livox/lidar", maker(storage).livox(T0, sent, package))])
    (scan,) = Recording(path).scans()
    assert np.array_equal(scan.value.points, np.column_stack([sent[axis] for axis in "xyz"]).astype(float))
    assert np.array_equal(scan.value.intensity, sent["reflectivity"])
    assert np.abs(scan.value.time - sent["offset_time"] * 1e-9).max() < 1e-9
    assert scan.value.ring is None


@pytest.mark.parametrize("storage", ROS)
def test_big_endian_organised_and_padded_clouds(tmp_path, storage):
    make = maker(storage)
    little = points("ouster")
    big = little.astype(little.dtype.newbyteorder(">"))
    items = [
        ("/points", make.cloud(T0, big)),
        ("/points", make.cloud(T0 + 0.1, little, height=4)),
        ("/points", make.cloud(T0 + 0.2, little, height=4, row_padding=13)),
        ("/points", make.cloud(T0 + 0.3, big, height=8, row_padding=5)),
    ]
    scans = [scan.value for scan in Recording(write_bag(tmp_path, storage, items)).scans()]
    assert len(scans) == 4
    for scan in scans:
        assert np.array_equal(scan.points, np.column_stack([little[axis] for axis in "xyz"]).astype(float))
        assert np.array_equal(scan.ring, np.arange(40) % 4)
        assert np.abs(scan.time - np.linspace(0, 0.099, 40)).max() < 1e-9


def test_a_ros_2_message_in_big_endian_cdr(tmp_path):
    make = maker("mcap")
    message = make.cloud(T0, points("velodyne"))
    raw = bytes(make.store.serialize_cdr(message, message.__msgtype__, little_endian=False))
    path = write_bag(tmp_path, "mcap", [("/points", raw)], {"/points": message.__msgtype__})
    (scan,) = Recording(path).scans()
    assert len(scan.value) == 40


def test_rows_of_an_organised_cloud_are_rings_where_the_sensor_is_known(tmp_path):
    beams = np.repeat(np.radians([6.0, 2.0, -2.0, -6.0]), 10)  # from the top, as Ouster's rows
    sent = np.zeros(40, layout({"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8)}, 12))
    sent["x"], sent["z"] = 10 * np.cos(beams), 10 * np.sin(beams)
    path = write_bag(tmp_path, "mcap", [("/points", maker("mcap").cloud(T0, sent, height=4))])
    (scan,) = Recording(path).scans(sensor=SENSOR)
    assert np.array_equal(scan.value.ring, np.repeat([3, 2, 1, 0], 10))


@pytest.mark.parametrize("storage", ROS)
def test_points_without_a_return_are_left_out(tmp_path, storage):
    sent = points("ouster")
    sent["x"][3] = np.nan
    for axis in "xyz":
        sent[axis][7] = 0.0
    (scan,) = Recording(write_bag(tmp_path, storage, [("/points", maker(storage).cloud(T0, sent))])).scans()
    kept = np.delete(np.arange(40), [3, 7])
    assert np.array_equal(scan.value.points[:, 0], sent["x"][kept].astype(float))
    assert np.array_equal(scan.value.ring, kept % 4)


@pytest.mark.parametrize("clock", [946684812.5, T0 + 37.0])  # the year 2000, and atomic time: leap seconds ahead
def test_times_of_another_clock_count_from_the_first_point(tmp_path, clock):
    sent = points("hesai", stamp=clock)
    (scan,) = Recording(write_bag(tmp_path, "mcap", [("/points", maker("mcap").cloud(T0, sent))])).scans()
    assert np.abs(scan.value.time - np.linspace(0, 0.099, 40)).max() < 1e-6


@pytest.mark.parametrize("storage", STORAGES)
def test_bad_messages_are_skipped_with_a_reason_and_nothing_else_is_lost(tmp_path, storage):
    make = maker(storage)
    good = [make.cloud(T0 + k * 0.1, points("velodyne", stamp=T0 + k * 0.1, seed=k)) for k in range(40)]
    kind = good[0].__msgtype__
    nan = points("velodyne")
    nan["x"] = np.nan
    ringless = points("velodyne")[["x", "y", "z", "intensity"]]
    short = make.cloud(T0 + 0.85, points("velodyne"))
    short.data = short.data[:-1]
    outside = make.cloud(T0 + 1.25, points("velodyne"))
    outside.fields[2].offset = 30
    no_z = make.cloud(T0 + 1.45, points("velodyne"))
    no_z.fields[2].name = "zz"
    bad = {
        4: make.serialize(good[4])[:-7],
        5: b"",
        6: b"\x00\x01\x00\x00",
        8: make.cloud(T0 + 0.75, nan),
        9: short,
        10: make.cloud(T0 + 0.95, points("velodyne", n=0)),
        12: make.cloud(T0 + 1.1, points("velodyne", seed=99)),  # the stamp of the one before it
        14: make.cloud(T0 + 0.3, points("velodyne", seed=98)),
        17: outside,
        19: no_z,
        20: make.cloud(T0 + 1.85, ringless),
        25: make.cloud(T0 + 9e5, points("velodyne")),
    }
    items = []
    for k in range(40):
        if k in bad:
            items.append(("/points", bad[k]))
        items.append(("/points", good[k]))
    stream = Recording(write_bag(tmp_path, storage, items, {"/points": kind})).scans()
    scans = list(stream)
    assert len(scans) == 40
    for k, scan in enumerate(scans):
        assert np.array_equal(scan.value.points[:, 0], points("velodyne", seed=k)["x"].astype(float))
    assert stream.skipped == {
        "truncated or malformed": 3,
        "no returns": 1,
        "truncated": 1,
        "empty": 1,
        "stamp duplicated": 1,
        "stamp goes backward": 1,
        "malformed": 1,
        "no coordinates": 1,
        "ring missing": 1,
        "stamp ahead of those that follow": 1,
    }
    assert stream.skipped.total() + len(scans) == stream.expected


def poses(n):
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.random(n, rng=1).as_matrix()
    T[:, :3, 3] = np.random.default_rng(1).normal(0, 5, (n, 3))
    return T


@pytest.mark.parametrize("storage", ROS)
def test_poses_of_messages_and_transforms(tmp_path, storage):
    make, T = maker(storage), poses(6)
    items = []
    for k in range(6):
        s = T0 + k * 0.02
        still = make.transform(s, np.eye(4), "base", "camera")
        items += [
            ("/odom", make.odometry(s, T[k])),
            ("/pose", make.pose_stamped(s, T[k])),
            ("/tf", make.tf(still, make.transform(s, T[k], "/odom" if k else "odom", "base"))),
            ("/tf_static", make.tf(still)),
            ("/vicon", make.transform(s, T[k], "world", "robot")),
        ]
    recording = Recording(write_bag(tmp_path, storage, items))
    for topic in ("/odom", "/pose", "/tf:odom:base", "/vicon"):
        found = list(recording.poses(topic))
        assert len(found) == 6
        assert np.abs(np.array([pose.value for pose in found]) - T).max() < 1e-12
        assert np.abs(np.array([pose.stamp for pose in found]) - (T0 + np.arange(6) * 0.02)).max() < 2.4e-7
    with pytest.raises(InputError, match=r"several topics of poses, name one: /odom .*, /pose .*, /vicon"):
        recording.poses()


def test_transforms_are_guessed_only_where_there_are_no_pose_messages(tmp_path):
    make, T = maker("mcap"), poses(2)
    recording = Recording(write_bag(tmp_path, "mcap", [("/tf", make.tf(make.transform(T0, T[0], "odom", "base")))]))
    assert len(list(recording.poses())) == 1
    with pytest.raises(InputError, match=r"no topic '/tf:a:b' of poses; /tf:odom:base"):
        recording.poses("/tf:a:b")


@pytest.mark.parametrize("storage", ROS)
def test_poses_that_are_none_are_skipped(tmp_path, storage):
    make, T = maker(storage), poses(5)
    messages = [make.odometry(T0 + k, T[k]) for k in range(5)]
    for k in (1, 2):
        for name in "xyzw":
            setattr(messages[k].pose.pose.orientation, name, 0.0 if k == 1 else float("nan"))
    stream = Recording(write_bag(tmp_path, storage, [("/odom", m) for m in messages])).poses()
    assert [pose.stamp for pose in stream] == [T0, T0 + 3, T0 + 4]
    assert stream.skipped == {"quaternion not of unit norm": 1, "pose not finite": 1}


def test_topics_are_guessed_or_listed(tmp_path):
    make = maker("mcap")
    cloud = make.cloud(T0, points("velodyne"))
    recording = Recording(
        write_bag(tmp_path, "mcap", [("/front", cloud), ("/rear", cloud), ("/odom", make.odometry(T0, np.eye(4)))])
    )
    with pytest.raises(InputError, match=r"several topics of point clouds, name one: /front .*, /rear"):
        recording.scans()
    with pytest.raises(InputError, match=r"no topic '/top' of point clouds; /front"):
        recording.scans("/top")
    with pytest.raises(InputError, match="no topic of images; it has /front"):
        recording.images()
    assert len(list(recording.scans("/rear"))) == 1


def test_streams_of_one_recording_are_read_side_by_side(tmp_path):
    for storage in STORAGES:
        make = maker(storage)
        items = []
        for k in range(10):
            items += [
                ("/points", make.cloud(T0 + k, points("velodyne", seed=k))),
                ("/odom", make.odometry(T0 + k, np.eye(4))),
            ]
        folder = tmp_path / storage
        folder.mkdir()
        recording = Recording(write_bag(folder, storage, items))
        pairs = list(zip(recording.scans(), recording.poses(), strict=True))
        assert [scan.stamp for scan, _ in pairs] == [pose.stamp for _, pose in pairs]


@pytest.mark.parametrize("storage", ["ros1", "db3", "bare"])
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files_are_read_or_refused(tmp_path_factory, storage, data):
    folder = tmp_path_factory.mktemp("fuzz")
    path = write_bag(folder, storage, clouds(storage, n=3))
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        content = content[: data.draw(st.integers(0, len(content)))]
    for _ in range(data.draw(st.integers(1, 8))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        for scan in Recording(path).scans():
            assert np.isfinite(scan.value.points).all()


@pytest.mark.parametrize("ros", [1, 2])
@given(
    raw=st.binary(max_size=200),
    cut=st.integers(0, 400),
    flips=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 255)), max_size=6),
)
@settings(max_examples=150, deadline=None)
def test_any_bytes_as_a_message_are_decoded_or_bad(ros, raw, cut, flips):
    from optshape_graph.io.recordings import messages
    from optshape_graph.io.recordings.stream import BadMessage

    make = maker("ros1" if ros == 1 else "mcap")
    mutated = bytearray(make.serialize(make.cloud(T0, points("velodyne", n=4)))[:cut])
    for where, value in flips:
        if where < len(mutated):
            mutated[where] = value
    for blob in (raw, bytes(mutated)):
        for name in messages.SCANS:
            try:
                scan = messages.decode_scan(ros, name, blob, "fuzz", None)
            except BadMessage:
                continue
            assert np.isfinite(scan.value.points).all()


def test_a_file_that_is_no_bag_is_refused(tmp_path):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
        with pytest.raises(InputError, match="not a readable bag"):
            Recording(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        Recording(tmp_path / "b.bag")
    (tmp_path / "c.txt").write_text("")
    with pytest.raises(InputError, match=r"expected a \.bag"):
        Recording(tmp_path / "c.txt")


def test_a_link_out_of_the_folder_of_a_bag_is_refused(tmp_path):
    inside = write_bag(tmp_path, "mcap", clouds("mcap"))
    storage = inside / "recording.mcap"
    elsewhere = tmp_path / "elsewhere.mcap"
    storage.rename(elsewhere)
    storage.symlink_to(elsewhere)
    with pytest.raises(InputError, match="leads out of the bag's folder"):
        Recording(inside)


def test_definitions_in_a_bag_are_compared_and_never_compiled(tmp_path):
    from rosbags.rosbag1 import Writer

    def bag(name, definition):
        path = tmp_path / f"{name}.bag"
        with Writer(path) as writer:
            connection = writer.add_connection("/p", "sensor_msgs/msg/PointCloud2", msgdef=definition, md5sum="0" * 32)
            writer.write(connection, 1, b"")
        return path

    with pytest.raises(InputError, match="members x; the standard one has header"):
        list(Recording(bag("other", "uint8 x\n")).scans())
    modules = set(sys.modules)
    code = 'string x="\'); import antigravity  #"\n'
    with pytest.raises(InputError):
        list(Recording(bag("code", code)).scans())
    assert "antigravity" not in set(sys.modules) - modules


def test_memory_does_not_grow_with_the_bag(tmp_path):
    def peak(n):
        folder = tmp_path / str(n)
        folder.mkdir()
        make = maker("mcap")
        cloud = points("velodyne", n=4000)
        path = write_bag(folder, "mcap", (("/points", make.cloud(T0 + k * 0.1, cloud)) for k in range(n)))
        recording = Recording(path)
        tracemalloc.start()
        assert sum(1 for _ in recording.scans()) == n
        _, highest = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return highest

    peak(20)  # imports
    assert peak(160) < 1.2 * peak(40)  # the window of scans and one chunk; a bag held in memory would be four times


def test_what_is_before_a_damaged_chunk_is_read_and_the_rest_is_counted(tmp_path):
    from rosbags.rosbag1 import Writer

    make, path = maker("ros1"), tmp_path / "a.bag"
    writer = Writer(path)
    writer.set_compression(Writer.CompressionFormat.BZ2)
    with writer:
        connection = writer.add_connection("/points", "sensor_msgs/msg/PointCloud2", typestore=make.store)
        for k in range(3):
            # Noise does not compress: each cloud fills a chunk of its own (rosbags starts one every MiB).
            cloud = points("velodyne", n=50_000, seed=k)
            writer.write(connection, (k + 1) * 10**9, make.serialize(make.cloud(T0 + k, cloud)))
    content = bytearray(path.read_bytes())
    for k in range(len(content) // 2, len(content) // 2 + 200):
        content[k] ^= 0x5A
    path.write_bytes(content)
    stream = Recording(path).scans()
    assert [scan.stamp for scan in stream] == [T0]
    assert stream.skipped == {"recording damaged from there on": 2}


@pytest.mark.parametrize("storage", ["ros1", "mcap"])
def test_a_path_is_a_trajectory(tmp_path, storage):
    make = maker(storage)
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, 0, 3] = np.arange(4)
    poses = [make.pose_stamped(100.0 + k, T[k]) for k in range(4)]
    path = make["nav_msgs/msg/Path"]
    items = [("/path", path(make.header(100.0 + k), poses[: k + 1])) for k in range(4)]
    stream = Recording(write_bag(tmp_path, storage, items)).poses("/path")
    found = list(stream)
    assert not stream.skipped
    assert [pose.stamp for pose in found] == [100.0, 101.0, 102.0, 103.0]
    np.testing.assert_allclose([pose.value for pose in found], T, atol=1e-12)
    plan = [("/path", path(make.header(100.0), [make.pose_stamped(0.0, t) for t in T]))]
    (tmp_path / "plan").mkdir()
    stream = Recording(write_bag(tmp_path / "plan", storage, plan)).poses("/path")
    assert list(stream) == []
    assert stream.skipped == {"path without stamps": 1}


def test_organised_clouds_without_a_row_step(tmp_path):
    make = maker("mcap")
    message = make.cloud(100.0, points("ouster", n=8), height=4)
    message.row_step = 0
    stream = Recording(write_bag(tmp_path, "mcap", [("/points", message)])).scans()
    assert len(list(stream)) == 1
    assert not stream.skipped


def test_livox_in_every_form_is_the_same_scan(tmp_path):
    made = points("livox", n=12)
    made["tag"][:] = 0x10
    made["tag"][3] = 0x11  # marked as noise
    made["line"] = np.arange(12) % 4
    made["timestamp"] = T0 * 1e9 + 1000.0 * np.arange(12)
    custom = np.zeros(12, [("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"),
                           ("tag", "u1"), ("line", "u1")])  # fmt: skip
    for name in ("x", "y", "z", "tag", "line"):
        custom[name] = made[name]
    custom["offset_time"] = 1000 * np.arange(12)
    make = maker("mcap")
    items = [("/cloud", make.cloud(T0, made)), ("/custom", make.livox(T0, custom))]
    recording = Recording(write_bag(tmp_path, "mcap", items))
    cloud, message = (next(iter(recording.scans(name))).value for name in ("/cloud", "/custom"))
    from optshape_graph.io.clouds.pcd import write_pcd

    write_pcd(tmp_path / "a.pcd", {name: custom[name] for name in ("x", "y", "z", "tag", "line", "offset_time")})
    for scan in (cloud, message, read_scan(tmp_path / "a.pcd")):
        assert scan.ring is None
        np.testing.assert_allclose(scan.points, cloud.points, atol=1e-6)
        np.testing.assert_allclose(scan.time, 1e-6 * np.delete(np.arange(12), 3), atol=3e-7)  # float64 of 1.7e18 ns
        assert len(scan) == 11


def test_a_damaged_quaternion_is_no_rotation():
    """Its square is more than a number holds: refused, without a warning of it."""
    huge, origin = SimpleNamespace(x=1e200, y=0.0, z=0.0, w=1.0), SimpleNamespace(x=0.0, y=0.0, z=0.0)
    with pytest.raises(BadMessage, match="not of unit norm"):
        rigid(origin, huge)
