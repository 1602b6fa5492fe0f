"""The command on recordings whose every stamp is known."""

import json

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from optshape_graph.cli.extract import command
from optshape_graph.io import load_session, read_markers, read_scan
from tests.io.recordings.writing import maker, points, write_bag

T0 = 1.7e9
SENSOR = """schema: optshape/sensor/1
name: four
elevations_deg: [-6.0, -2.0, 2.0, 6.0]
"""
K = np.array([[500.0, 0, 32], [0, 501.0, 24], [0, 0, 1]])
CORNERS = np.array([[3, 0.5, 1], [3, 0, 1.5], [3, -0.5, 1], [3, 0, 0.5]])
BODY = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.1, 0.1, 0.25]])
CAMERA_LATE = 0.3
MOCAP_ZERO = T0 - 1.25
"""What the mocap's zero is on the LiDAR's clock."""


def run(*arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments])


@pytest.fixture
def sensor(tmp_path):
    (tmp_path / "four.yaml").write_text(SENSOR)
    return tmp_path / "four.yaml"


def rotations(t):
    """A sensor turned about by hand, from t = -2 s to 32 s."""
    knots = np.arange(-2, 33, 0.7)
    spline = CubicSpline(knots, np.random.default_rng(4).normal(0, 0.6, (len(knots), 3)))
    return Rotation.from_rotvec(spline(t))


def recording(folder, storage="mcap", n=20, rate=10.0):
    make = maker(storage)
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
    items = []
    for k in range(n):
        stamp = T0 + k / rate
        items.append(("/points", make.cloud(stamp, points("velodyne", stamp=stamp, seed=k))))
        if k % 2 == 0:  # the camera is at half the rate, 12 ms late, and its clock is behind
            items.append(("/cam/image_raw", make.image(stamp + 0.012 - CAMERA_LATE, picture, "bgr8")))
        items.append(("/cam/camera_info", make.camera_info(stamp, K, np.zeros(5), "plumb_bob")))
    return write_bag(folder, storage, items)


def tsv(path, seconds, body=True):
    """Markers of a still target and a turning sensor, 100 Hz, in mm; corner3 is not seen from 1.0 to 1.5 s of T0."""
    t = np.arange(0, seconds, 0.01)
    since = t + MOCAP_ZERO - T0
    targets = np.tile(CORNERS, (len(t), 1, 1)) + np.outer(since, [0.1, 0, 0])[:, None]  # it drifts: times show
    targets[(since > 1.0) & (since < 1.5), 3] = 0
    bodies = np.einsum("fij,mj->fmi", rotations(since.clip(-2, 32)).as_matrix(), BODY) + np.array([5, 5, 1])
    names = [f"corner{k}" for k in range(4)] + [f"body{k}" for k in range(4)] * body
    positions = np.concatenate([targets, bodies], axis=1)[:, : len(names)] * 1e3
    lines = [f"NO_OF_FRAMES\t{len(t)}", "FREQUENCY\t100", "DATA_INCLUDED\t3D", "MARKER_NAMES\t" + "\t".join(names)]
    lines += ["\t".join(f"{x:.3f}" for x in frame.ravel()) for frame in positions]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("storage", ["ros1", "mcap", "sqlite3"])
def test_scans_images_and_markers_of_the_same_moments(tmp_path, sensor, storage):
    pytest.importorskip("cv2")
    bag, markers, out = recording(tmp_path, storage), tsv(tmp_path / "a.tsv", 10, body=False), tmp_path / "out"
    result = run(bag, "-o", out, "--sensor", sensor, "--target", "paper", "--mocap", markers,
                 "--clock-offset", f"mocap={MOCAP_ZERO}", "--clock-offset", f"camera={CAMERA_LATE}")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "10 views of 20 scans" in result.output
    assert "10 dropped: no image within 0.05 s" in result.output
    session = load_session(out / "session.yaml")
    assert len(session.views) == 10
    for view, k in zip(session.views, range(0, 20, 2), strict=True):
        assert view.stamp == pytest.approx(T0 + k / 10, abs=2.4e-7)
        scan = read_scan(view.scan, session.lidars[view.lidar])
        assert np.array_equal(scan.points[:, 0], points("velodyne", seed=k)["x"].astype(float))
        assert np.array_equal(scan.ring, np.arange(40) % 4)
        assert view.image.is_file()
        expected = CORNERS + np.array([0.1 * k / 10, 0, 0])
        found = session.mocap.markers.frames[view.mocap_frame]
        for number in range(4):
            gap = number == 3 and 10 < k < 15
            assert np.isnan(found[f"corner{number}"]).all() == gap
            if not gap:  # 1 mm/cs between frames, printed to 1 um
                assert np.abs(found[f"corner{number}"] - expected[number]).max() < 2e-6
    (camera,) = session.cameras.values()
    assert np.array_equal(camera.K, K)
    report = json.loads((out / "extract.json").read_text())
    assert report["views"] == 10
    assert report["clock_offsets_s"] == {"camera": CAMERA_LATE, "mocap": MOCAP_ZERO}
    assert np.allclose(report["image_lags_s"], 0.012, atol=1e-6)


def test_the_offset_of_motion_capture_is_estimated_from_the_sensors_turning(tmp_path, sensor):
    make = maker("mcap")
    T, items = np.eye(4), []
    for k in range(300):
        stamp = T0 + k / 10
        T[:3, :3] = rotations(k / 10).as_matrix()
        items.append(("/odom", make.odometry(stamp, T)))
        if k % 10 == 0:
            items.append(("/points", make.cloud(stamp, points("velodyne", stamp=stamp))))
    bag = write_bag(tmp_path, "mcap", items)
    body = [option for k in range(4) for option in ("--body", f"body{k}")]
    result = run(bag, "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper", "--mocap",
                 tsv(tmp_path / "a.tsv", 35), "--estimate-clock-offset", *body)  # fmt: skip
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out/extract.json").read_text())
    assert report["clock_offsets_s"]["mocap"] == pytest.approx(MOCAP_ZERO, abs=3e-3)
    assert report["views"] == 30
    assert read_markers(tmp_path / "out/markers.csv").names == tuple(f"corner{k}" for k in range(4))


def test_an_offset_that_is_not_observable_is_said(tmp_path, sensor):
    make = maker("mcap")
    items = [("/points", make.cloud(T0, points("velodyne")))]
    items += [("/odom", make.odometry(T0 + k / 10, np.eye(4))) for k in range(100)]
    bag = write_bag(tmp_path, "mcap", items)
    result = run(bag, "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper", "--mocap",
                 tsv(tmp_path / "a.tsv", 10), "--estimate-clock-offset", *["--body", "body0", "--body", "body1"],
                 *["--body", "body2"])  # fmt: skip
    assert result.exit_code != 0
    assert "hardly turned" in str(result.exception)
    assert not (tmp_path / "out").exists()


def test_times_that_do_not_overlap_are_an_error_that_shows_both(tmp_path, sensor):
    result = run(recording(tmp_path), "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper", "--no-images",
                 "--mocap", tsv(tmp_path / "a.tsv", 3))  # fmt: skip
    assert "20 x fewer than 3 markers" in str(result.exception)
    assert "scans from 1700000000.000" in str(result.exception)
    assert "is a clock offset needed?" in str(result.exception)


def test_start_end_every(tmp_path, sensor):
    result = run(recording(tmp_path), "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper", "--no-images",
                 "--start", 0.3, "--end", 1.2, "--every", 0.25)  # fmt: skip
    assert result.exit_code == 0, result.output
    stamps = [view.stamp - T0 for view in load_session(tmp_path / "out/session.yaml").views]
    assert np.allclose(stamps, [0.3, 0.6, 0.9, 1.2], atol=1e-6)
    assert "6 left out by --every" in result.output


def test_images_without_intrinsics_are_left_out_with_a_reason(tmp_path, sensor):
    make = maker("mcap")
    picture = np.zeros((8, 8), np.uint8)
    items = [("/points", make.cloud(T0, points("velodyne"))), ("/image", make.image(T0, picture, "mono8"))]
    result = run(write_bag(tmp_path, "mcap", items), "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper")
    assert result.exit_code == 0, result.output
    assert "images are left out" in result.stderr
    assert load_session(tmp_path / "out/session.yaml").views[0].image is None


def test_a_view_whose_image_does_not_decode_is_dropped(tmp_path, sensor):
    cv2 = pytest.importorskip("cv2")
    make = maker("mcap")
    good = bytes(cv2.imencode(".png", np.full((48, 64), 7, np.uint8))[1])
    items = []
    for k in range(3):
        stamp = T0 + k / 10
        items += [
            ("/points", make.cloud(stamp, points("velodyne", stamp=stamp))),
            ("/cam/image_raw/compressed", make.compressed(stamp, good[:20] if k == 1 else good, "png")),
            ("/cam/camera_info", make.camera_info(stamp, K, np.zeros(5), "plumb_bob")),
        ]
    out = tmp_path / "out"
    result = run(write_bag(tmp_path, "mcap", items), "-o", out, "--sensor", sensor, "--target", "paper")
    assert result.exit_code == 0, result.output
    assert "1 dropped: undecodable image" in result.output
    views = load_session(out / "session.yaml").views
    assert np.allclose([view.stamp - T0 for view in views], [0, 0.2], atol=1e-6)
    assert views[0].image.read_bytes() == good  # as the camera compressed it


def test_skipped_messages_are_reported(tmp_path, sensor):
    make = maker("mcap")
    clouds = [make.cloud(T0 + k / 10, points("velodyne")) for k in range(5)]
    clouds[2].data = clouds[2].data[:-5]
    bag = write_bag(tmp_path, "mcap", [("/points", cloud) for cloud in clouds])
    result = run(bag, "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper@0.5", "--target", "square")
    assert result.exit_code == 0, result.output
    assert "1 messages of" in result.output
    assert "skipped: truncated" in result.output
    report = json.loads((tmp_path / "out/extract.json").read_text())
    assert report["skipped"] == {f"{bag} /points": {"truncated": 1}}
    assert report["unused_fields"] == {}
    session = load_session(tmp_path / "out/session.yaml")
    assert len(session.views) == 4
    assert len(session.targets) == 2


def test_a_sensor_that_did_not_make_the_scans_is_said(tmp_path):
    result = run(recording(tmp_path), "-o", tmp_path / "out", "--sensor", "vlp16", "--target", "paper", "--no-images")
    assert "no usable scan; 20 x not a scan" in str(result.exception)
    assert "do not fit the table" in str(result.exception)


def test_topics_are_listed(tmp_path):
    result = run(recording(tmp_path), "--list")
    assert result.exit_code == 0
    assert "scan          20 /points (sensor_msgs/msg/PointCloud2)" in result.output


def test_an_existing_session_is_not_overwritten(tmp_path, sensor):
    arguments = (recording(tmp_path), "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper", "--no-images")
    assert run(*arguments).exit_code == 0
    assert "there is a session already" in str(run(*arguments).exception)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "are needed to write a session"),
        (("--clock-offset", "gps=1"), "the source is one of camera, mocap"),
        (("--clock-offset", "mocap"), "expected SOURCE=SECONDS"),
        (("--estimate-clock-offset",), "needs --mocap"),
        (("--topic", "/points", "--topic", "/points"), "several --topic of one kind"),
    ],
)
def test_bad_usage(tmp_path, sensor, arguments, complaint):
    if arguments:
        arguments = (*arguments, "-o", tmp_path / "out", "--sensor", sensor, "--target", "paper")
    result = run(recording(tmp_path), *arguments)
    assert result.exit_code == 2
    assert complaint in result.output
