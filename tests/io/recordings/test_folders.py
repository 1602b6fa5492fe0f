import numpy as np
import pytest

from optshape_graph import InputError, Scan
from optshape_graph.io.clouds import write_scan
from optshape_graph.io.recordings import Recording
from optshape_graph.io.trajectories import Trajectory, write_tum

T0 = 1317042272.349


def clouds(folder, n=4):
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(n):
        write_scan(folder / f"{k:04d}.pcd", Scan(np.random.default_rng(k).uniform(1, 5, (10, 3))))


def stamps(stream):
    return [scan.stamp for scan in stream]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("timestamps.txt", lambda k: f"{T0 + k / 10:.6f}"),
        ("times.txt", lambda k: repr(T0 + k / 10)),
        ("timestamps.txt", lambda k: f"2011-09-26 13:04:32.{349 + 100 * k:03d}000000"),  # KITTI raw
        ("timestamps.csv", lambda k: f"{round((T0 + k / 10) * 1e9)},{k:04d}.pcd"),  # EuRoC, nanoseconds
        ("timestamps.csv", lambda k: f"{k:04d}.pcd,{round((T0 + k / 10) * 1e6)}"),  # microseconds
        ("times.csv", lambda k: f"{round((T0 + k / 10) * 1e3)}, {k:04d}.pcd"),  # milliseconds
        ("timestamps.txt", lambda k: f"{T0 + k / 10:.6f} {k:04d}.pcd"),  # TUM
    ],
)
def test_forms_of_timestamps(tmp_path, name, line):
    clouds(tmp_path)
    (tmp_path / name).write_text("#stamp file\n\n" + "".join(f"{line(k)}\n" for k in range(4)))
    found = list(Recording(tmp_path).scans())
    assert np.abs(np.array([scan.stamp for scan in found]) - T0 - np.arange(4) / 10).max() < 1e-6
    for k, scan in enumerate(found):
        sent = np.random.default_rng(k).uniform(1, 5, (10, 3)).astype(np.float32)
        assert np.array_equal(scan.value.points, sent.astype(float))


@pytest.mark.parametrize(
    "names",
    [
        [f"scan_{k}" for k in (1, 2, 9, 10, 11, 100)],
        [f"a{k}_b" for k in (1, 2, 10, 20)],
        ["8", "9", "10", "100"],
        ["1317.25", "1317.5", "1318.0"],
        ["part1_9", "part1_10", "part2_1"],
    ],
)
def test_names_are_sorted_as_numbers_are(tmp_path, names):
    for k, name in enumerate(names):
        write_scan(tmp_path / f"{name}.pcd", Scan(np.full((5, 3), k + 1.0)))
    (tmp_path / "timestamps.txt").write_text("".join(f"{k}\n" for k in range(len(names))))
    found = list(Recording(tmp_path).scans())
    assert [scan.value.points[0, 0] for scan in found] == [k + 1.0 for k in range(len(names))]


def test_another_number_of_stamps_than_of_files_is_an_error(tmp_path):
    clouds(tmp_path, 4)
    for count in (3, 5):
        (tmp_path / "timestamps.txt").write_text("".join(f"{k}\n" for k in range(count)))
        with pytest.raises(InputError, match=f"{count} stamps for 4 files .*; expected one for each file"):
            list(Recording(tmp_path).scans())


def test_a_header_line_is_not_a_stamp(tmp_path):
    clouds(tmp_path)
    (tmp_path / "timestamps.csv").write_text("stamp,file\n" + "".join(f"{k},{k:04d}.pcd\n" for k in range(4)))
    assert stamps(Recording(tmp_path).scans()) == [0, 1, 2, 3]


def test_folders_are_topics_and_trajectories_are_poses(tmp_path):
    for name in ("front", "rear"):
        clouds(tmp_path / name / "data", 3)
        (tmp_path / name / "timestamps.txt").write_text("1\n2\n3\n")
    (tmp_path / "left").mkdir()
    (tmp_path / "left" / "times.txt").write_text("1.0\n")
    (tmp_path / "left" / "a.png").write_bytes(b"\x89PNG")
    poses = np.tile(np.eye(4), (2, 1, 1))
    write_tum(tmp_path / "odometry.tum", Trajectory(poses, np.array([1.0, 2.0])))
    recording = Recording(tmp_path)
    assert [(topic.name, topic.kind, topic.count) for topic in recording.topics] == [
        ("front", "scan", 3), ("left", "image", 1), ("rear", "scan", 3), ("odometry.tum", "pose", 2),
    ]  # fmt: skip
    with pytest.raises(InputError, match="several topics of point clouds, name one: front"):
        recording.scans()
    assert stamps(recording.scans("rear")) == [1, 2, 3]
    assert stamps(recording.poses()) == [1, 2]
    assert [image.value.suffix for image in recording.images()] == [".png"]


def test_missing_and_unreadable_clouds_are_skipped(tmp_path):
    clouds(tmp_path)
    (tmp_path / "0001.pcd").write_text("not a cloud")
    (tmp_path / "0002.pcd").unlink()
    (tmp_path / "timestamps.txt").write_text("".join(f"{k} {k:04d}.pcd\n" for k in range(4)))
    stream = Recording(tmp_path).scans()
    assert stamps(stream) == [0, 3]
    assert stream.skipped == {"unreadable file": 1, "file missing": 1}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("1\n2\n3\n", "3 stamps for 4 files"),
        ("1 0000.pcd\n2\n", "timestamps.txt:2: expected a stamp and a file name"),
        ("1 0000.pcd x\n", "timestamps.txt:1"),
        ("noon 0000.pcd1\n", "expected a stamp, found"),
        ("1\n2\n3\nfour4\n", "timestamps.txt:4: expected a stamp, found 'four4'"),
    ],
)
def test_bad_timestamps_are_named(tmp_path, text, complaint):
    clouds(tmp_path)
    (tmp_path / "timestamps.txt").write_text(text)
    with pytest.raises(InputError, match=complaint):
        list(Recording(tmp_path).scans())


@pytest.mark.parametrize("how", ["relative", "absolute", "link"])
def test_nothing_outside_the_folder_is_read(tmp_path, how):
    outside = tmp_path / "outside"
    clouds(outside, 1)
    inside = tmp_path / "inside"
    clouds(inside, 1)
    name = {"relative": "../outside/0000.pcd", "absolute": str(outside / "0000.pcd"), "link": "link.pcd"}[how]
    if how == "link":
        (inside / "link.pcd").symlink_to(outside / "0000.pcd")
    (inside / "timestamps.txt").write_text(f"1 {name}\n")
    with pytest.raises(InputError, match="leads out of the recording's folder"):
        list(Recording(inside).scans())


def test_a_folder_without_timestamps_has_no_topics(tmp_path):
    clouds(tmp_path)
    with pytest.raises(InputError, match="no topic of point clouds; it has none"):
        Recording(tmp_path).scans()


def test_kitti_s_odometry_keeps_its_stamps_above(tmp_path):
    folder = tmp_path / "00"
    (folder / "velodyne").mkdir(parents=True)
    for k in range(3):
        points = np.array([[5, 0.1 * k, 0.2, 0.5], [6, 0.3, 0.1, 0.2]], "<f4")
        (folder / "velodyne" / f"{k:06d}.bin").write_bytes(points.tobytes())
    (folder / "times.txt").write_text("0.0\n1.036e-01\n2.07e-01\n")
    recording = Recording(folder)
    assert [(topic.name, topic.kind, topic.count) for topic in recording.topics] == [("velodyne", "scan", 3)]
    scans = list(recording.scans())
    assert [scan.stamp for scan in scans] == [0.0, 0.1036, 0.207]
    assert scans[2].value.points[0, 1] == pytest.approx(0.2, abs=1e-7)


def test_a_video_is_a_topic_of_images(tmp_path):
    cv2 = pytest.importorskip("cv2")
    (tmp_path / "front").mkdir()
    writer = cv2.VideoWriter(str(tmp_path / "front" / "a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for k in range(4):
        writer.write(np.full((48, 64, 3), 50 * k, np.uint8))
    writer.release()
    (tmp_path / "front" / "timestamps.txt").write_text("1\n1.1\n1.2\n1.3\n")
    recording = Recording(tmp_path)
    assert [(topic.name, topic.kind, topic.count) for topic in recording.topics] == [("front", "image", 4)]
    images = list(recording.images())
    assert [image.stamp for image in images] == [1, 1.1, 1.2, 1.3]
    for k, image in enumerate(images):
        assert image.value.pixels().mean() == pytest.approx(50 * k, abs=3)  # of a compressed film
    (tmp_path / "front" / "timestamps.txt").write_text("1\n1.1\n")
    with pytest.raises(InputError, match="2 stamps for the 3 frames"):
        list(Recording(tmp_path).images())
    (tmp_path / "front" / "a.avi").write_text("#EXTM3U\nhttp://elsewhere/a.ts\n")
    with pytest.raises(InputError, match="not a video; expected MP4, AVI or MKV"):
        list(Recording(tmp_path).images())
