"""Every reader of the package as a function of bytes, and inputs to start from.

An input is one byte that chooses the form, then the file's content. `read` writes the content to a file of that form
and reads it: what comes back, or this package's error, are the only outcomes allowed.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph.errors import OptshapeError
from optshape_graph.io import (
    load_camera,
    load_sensor,
    load_session,
    load_target,
    read_markers,
    read_scan,
    save_camera,
    save_sensor,
    save_target,
    write_scan,
)
from optshape_graph.io.clouds.lzf import lzf_decompress
from optshape_graph.io.documents import read_json, write_json
from optshape_graph.io.mocap import read_mocap
from optshape_graph.io.recordings import Recording
from optshape_graph.io.trajectories import read_g2o, read_kitti, read_trajectory, read_tum

VLP16 = load_sensor("vlp16")
PAPER = load_target("paper")


@dataclass(frozen=True)
class Form:
    """One form of file that a reader takes.

    Attributes:
        name: of the file, its ending included.
        read: what reads it.
        seeds: contents to start from.
    """

    name: str
    read: Callable[[Path], object]
    seeds: Callable[[Path], Sequence[bytes]]


@dataclass(frozen=True)
class Reader:
    """A reader of one or several forms, in a folder that has what its files may name."""

    forms: tuple[Form, ...]
    furnish: Callable[[Path], object] = lambda folder: None

    def read(self, data: bytes, folder: Path) -> None:
        """Read an input; whatever is not this package's error goes on to the caller."""
        if not data:
            return
        form = self.forms[data[0] % len(self.forms)]
        path = folder / form.name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_bytes(data[1:])
        with suppress(OptshapeError):
            form.read(path)

    def seeds(self, folder: Path) -> list[bytes]:
        """Inputs of every form to start from."""
        return [bytes([number]) + seed for number, form in enumerate(self.forms) for seed in form.seeds(folder)]


# Clouds


@cache
def scan() -> Any:
    from optshape_graph.scan import Scan

    azimuth, elevation = np.meshgrid(np.radians([-1.0, 0.0, 1.0]), VLP16.elevations[6:10])
    points = 5.0 * np.column_stack([
        (np.cos(elevation) * np.cos(azimuth)).ravel(), (np.cos(elevation) * np.sin(azimuth)).ravel(),
        np.sin(elevation).ravel(),
    ])  # fmt: skip
    ring = np.repeat(np.arange(6, 10), 3)
    return Scan(points, ring, np.linspace(0, 255, 12), np.linspace(0, 0.1, 12))


def table() -> Any:
    made = scan()
    kinds = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
    rows = np.empty(len(made), kinds)
    for k, axis in enumerate("xyz"):
        rows[axis] = made.points[:, k]
    rows["intensity"], rows["ring"], rows["time"] = made.intensity, made.ring, made.time
    return rows


def pcds(_: Path) -> list[bytes]:
    from tests.io.clouds.test_pcd import pcd

    return [pcd(table(), encoding) for encoding in ("ascii", "binary", "binary_compressed")]


def plys(_: Path) -> list[bytes]:
    kinds = {"f4": "float", "u2": "ushort"}
    rows = table()
    properties = "".join(f"property {kinds[rows.dtype[n].str[1:]]} {n}\n" for n in rows.dtype.names)
    head = (
        f"element vertex {len(rows)}\n{properties}element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    text = "\n".join(" ".join(str(x) for x in row) for row in rows)
    big = rows.astype(rows.dtype.newbyteorder(">"))
    bodies = {"ascii": text.encode(), "binary_little_endian": rows.tobytes(), "binary_big_endian": big.tobytes()}
    return [f"ply\nformat {form} 1.0\n{head}".encode() + body for form, body in bodies.items()]


def csvs(_: Path) -> list[bytes]:
    rows = [",".join(str(x) for x in row) for row in table()]
    text = "\n".join(["x,y,z,intensity,ring,time", *rows]) + "\n"
    return [text.replace(",", delimiter).encode() for delimiter in ",;\t "]


def other_texts(_: Path) -> list[bytes]:
    """Tables as other programs write them, and one without names."""
    rows = [",".join(str(x) for x in row) for row in table()]
    heads = ("x (mm),y (mm),z (mm),i,RING,TIMESTAMP (ns)", "Points:0,Points:1,Points:2,i,laser_id,adjustedtime",
             "//X,Y,Z,a,scalar_ring,t_us", "# made\nx,y,z,a,layer,time_stamp")  # fmt: skip
    body = "\n".join(rows) + "\n"
    return [f"{head}\n{body}".encode() for head in heads] + [
        body.encode(),
        body.replace(",", ";").replace(".", ",").encode(),
    ]


def read_named(path: Path) -> object:
    return read_scan(path, VLP16, ["x", "y", "z", "_", "ring", "t"])


def surveys(form: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        from tests.io.clouds import test_surveys

        path = folder / f"seed.{form}"
        (test_surveys.e57 if form == "e57" else test_surveys.las)(path, test_surveys.XYZ)
        return [path.read_bytes()]

    return seeds


def floats(_: Path) -> list[bytes]:
    values = np.column_stack([scan().points, scan().intensity, scan().ring]).astype("<f4")
    return [values[:, :4].tobytes(), values.tobytes(), np.column_stack([values, values[:, 0]]).astype("<f4").tobytes()]


def npys(_: Path) -> list[bytes]:
    content = []
    wide = np.column_stack([scan().points, scan().intensity, scan().ring, scan().time])
    for array in (scan().points, table(), wide[:, :4], wide):
        stream = io.BytesIO()
        np.save(stream, array)
        content.append(stream.getvalue())
    return content


def npz_archives(_: Path) -> list[bytes]:
    archives = []
    for save in (np.savez, np.savez_compressed):
        stream = io.BytesIO()
        save(stream, points=scan().points, ring=scan().ring, time=scan().time)
        archives.append(stream.getvalue())
    return archives


def arrays(_: Path) -> list[bytes]:
    """Arrays without their archive, whose checksums would turn every damage away before it is read."""
    content = []
    for array in (scan().points, scan().points.astype("f4").T, scan().points.astype(">f8")):
        stream = io.BytesIO()
        np.lib.format.write_array(stream, array)
        content.append(stream.getvalue())
    return content


def read_in_archive(path: Path) -> None:
    archive = path.with_suffix(".npz")
    with zipfile.ZipFile(archive, "w") as stream:
        stream.writestr("points.npy", path.read_bytes())
    read_scan(archive)


def read_lzf(path: Path) -> None:
    data = path.read_bytes()
    size = int.from_bytes(data[:4], "little")
    made = lzf_decompress(data[4:], size)
    assert len(made) == size


def lzfs(_: Path) -> list[bytes]:
    from tests.io.clouds.test_lzf import compress

    plain = [b"", b"abcabcabcabcabcabc" * 9, table().tobytes(), bytes(3000)]
    return [struct.pack("<I", len(data)) + compress(data) for data in plain]


def clouds(suffix: str, seeds: Callable[[Path], Sequence[bytes]]) -> tuple[Form, ...]:
    return (
        Form(f"cloud{suffix}", read_scan, seeds),
        Form(f"of-sensor{suffix}", lambda path: read_scan(path, VLP16), seeds),
    )


# Documents

K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])

TAGS = """schema: optshape/target/1
vertices: [[0, 0.5, 0.5], [0, -0.5, 0.5], [0, -0.5, -0.5], [0, 0.5, -0.5]]
tags: {dictionary: DICT_4X4_50, size: 0.2, centres: {"7": [0.1, 0.2]}, turn_deg: 90}
"""


def written(save: Callable[..., None], thing: object, suffix: str = ".yaml") -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        path = folder / f"seed{suffix}"
        save(path, thing)
        return [path.read_bytes()]

    return seeds


def targets(folder: Path) -> list[bytes]:
    from tests.calibration.camera.support import BOARD

    return [*written(save_target, PAPER)(folder), *written(save_target, BOARD)(folder), TAGS.encode()]


def camera() -> Any:
    from optshape_graph.camera import CameraIntrinsics

    return CameraIntrinsics("front", "pinhole", 64, 48, K, np.zeros(5))


SESSIONS = (
    """schema: optshape/session/1
name: short
sensor: vlp16
target: paper
camera: camera.yaml
scans:
  - {file: scan.pcd, mocap_frame: 0, image: image.png, stamp: 1.5}
  - {file: scan.pcd, target_points: scan.pcd, mocap_frame: 1}
mocap: {file: markers.csv, units: m}
""",
    """schema: optshape/session/1
lidars: {front: {sensor: vlp16}, rear: vlp32c}
cameras: {left: camera.yaml}
targets: {A: square@0.5, B: paper}
views:
  - {lidar: front, scan: scan.pcd, camera: left, image: image.png, corners: corners.csv, targets: [A, B]}
mocap: {file: markers.csv, units: mm, markers: {corner0: [A, 0], corner1: [B, 1]}}
""",
)

SCENE = """schema: optshape/scene/1
targets:
  - {target: paper, position: [8, 0, 0.2], rpy_deg: [5, 10, 10], reflectivity: 0.9}
floor: {height: -1.5}
walls:
  - {size: [10, 3], position: [12, 0, 0]}
boxes:
  - {size: [0.05, 0.05, 1.6], position: [8.1, 0, -0.7]}
lidar: {position: [0, 0, 0], rpy_deg: [0, 0, 0], velocity: [1, 0, 0], angular_velocity_deg: [0, 0, 20]}
"""

MARKERS = "frame,marker,x,y,z\n0,corner0,1,2,3\n0,corner1,1,2.5,3\n1,corner0,,,\n1,corner1,nan,nan,nan\n"


def furnish(folder: Path) -> None:
    """Put there what sessions name."""
    import cv2

    write_scan(folder / "scan.pcd", scan())
    save_camera(folder / "camera.yaml", camera())
    (folder / "markers.csv").write_text(MARKERS)
    (folder / "corners.csv").write_text("vertex,u,v\n0,10,20\n")
    (folder / "image.png").write_bytes(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())


def load_scene(path: Path) -> object:
    from optshape_graph.simulation import load_scene

    return load_scene(path)


def load_map(path: Path) -> object:
    from optshape_graph.mapping import load_map

    return load_map(path)


def maps(folder: Path) -> list[bytes]:
    from optshape_graph.io.trajectories import Trajectory
    from optshape_graph.mapping import Landmark, Map, save_map

    landmark = Landmark("A", PAPER, np.eye(4), 1e-4 * np.eye(6), 3)
    path = Trajectory(np.tile(np.eye(4), (2, 1, 1)), np.array([0.0, 1.0]), "drive")
    return written(save_map, Map((landmark,), 1e-4 * np.eye(6), {"drive": path}), ".json")(folder)


def read_start(path: Path) -> object:
    from optshape_graph.design.family import Family
    from optshape_graph.design.limits import Limits
    from optshape_graph.design.multistart import _read
    from optshape_graph.design.problem import Problem
    from optshape_graph.design.rings import UniformRings

    return _read(path, Problem(Family(4), UniformRings(5, 4), Limits()), 0)


def starts(folder: Path) -> list[bytes]:
    from optshape_graph.design.family import Family
    from optshape_graph.design.limits import Limits
    from optshape_graph.design.multistart import _document
    from optshape_graph.design.problem import Problem, Start
    from optshape_graph.design.rings import UniformRings

    start = Start(index=0, initial=(0.1,) * 5, parameters=(0.2,) * 5, score=0.5, slack=0.1, iterations=3)
    document = _document(start, Problem(Family(4), UniformRings(5, 4), Limits()), 0)
    return written(write_json, document, ".json")(folder)


def read_reference(path: Path) -> object:
    from optshape_graph.evaluation.mocap import load_reference

    return load_reference(path)


def read_sweep(path: Path) -> None:
    from optshape_graph.evaluation.harness import _claim, _read

    with suppress(OptshapeError):
        _read(path, 0)
    path.rename(path.with_name("sweep.json"))
    _claim(path.parent, {"what": "a sweep"})


def json_of(document: object) -> Callable[[Path], list[bytes]]:
    return written(write_json, document, ".json")


def scene_json(_: Path) -> list[bytes]:
    box = b'{"size": [1, 1, 1], "position": [5, 0, 0]}'
    return [b'{"schema": "optshape/scene/1", "floor": {"height": -1}, "boxes": [' + box + b"]}"]


def read_result(path: Path) -> object:
    from optshape_graph.viz.documents import spatial

    return spatial(path)


def results(folder: Path) -> list[bytes]:
    """One result of each kind, with the keys that are looked at."""
    T, C, points = np.eye(4), 1e-4 * np.eye(6), np.array([5.0, 0, 0]) + PAPER.vertices
    found = {"target": "paper", "T_lidar_target": T, "covariance": C, "vertices": points, "status": "ok", "reason": ""}
    of_edges = {"labels": [0, 1, 2, 3], "edge_points": points, "ambiguity": {"margin": 9.0, "T_lidar_target": T}}
    rejected = {"reason": "too small", "centre": [1, 2, 3]}
    own = {"name": "front", "model": "pinhole", "width": 64, "height": 48, "K": K, "D": []}
    pair = {"camera": "front", "lidar": "top", "T_lidar_camera": T, "covariance_T_lidar_camera": C}
    documents: dict[str, dict[str, object]] = {
        "estimate": {"scans": [{"scan": "a", **found, **of_edges}, {"scan": "b", "T_lidar_target": None, "reason": 1}]},
        "detect": {"scans": [{"scan": "a", "targets": [{**found, "return_indices": [0, 2]}], "rejected": [rejected]}]},
        "mocap": {"T_lidar_mocap": T, "covariance": C, "marker_layout": points,
                  "scans": [{"scan": "a", "T_lidar_target": T}]},
        "camera": {**pair, "cameras": [own], "extrinsics": [{**pair, "next_placement": {"T_lidar_target": T}}],
                   "lidars": [{"lidar": "rear", "T_base_lidar": T}]},
        "simulation": {"scan": "a.pcd", "targets": [{"target": "paper", "vertices": points}]},
    }  # fmt: skip
    made = []
    for kind, document in documents.items():
        write_json(folder / "seed.json", {"schema": f"optshape/{kind}/1", **document})
        made.append((folder / "seed.json").read_bytes())
    return [*made, *maps(folder)]


def makers(_: Path) -> list[bytes]:
    from tests.io import test_oddities as odd

    return [text.encode() for _, text, _ in odd.SENSORS.values()]


def camera_files(_: Path) -> list[bytes]:
    from tests.io import test_cameras as texts

    forms = (texts.OWN, texts.ROS_FILE, texts.ROS_MESSAGE, texts.ROS2_MESSAGE, texts.KALIBR, texts.OPENCV, texts.EUROC,
             texts.NUMBERS, texts.CAMODOCAL, texts.ORB, texts.ROS_INI, texts.OPENCV_XML)  # fmt: skip
    return [text.encode() for text in forms]


# Trajectories, markers, motion capture, pixels


def tums(_: Path) -> list[bytes]:
    return [b"# stamp tx ty tz qx qy qz qw\n0 1 2 3 0 0 0 1\n1.5 1 2 3 0.5 0.5 0.5 0.5\n"]


def trajectories(_: Path) -> list[bytes]:
    from tests.io import test_oddities as odd

    return [text.encode() for _, text, _, _ in odd.TRAJECTORIES.values()]


def kittis(_: Path) -> list[bytes]:
    return [b"1 0 0 1 0 1 0 2 0 0 1 3\n0 -1 0 1 1 0 0 2 0 0 1 3\n"]


def g2os(_: Path) -> list[bytes]:
    upper = " ".join("10" if i == j else "0" for i in range(6) for j in range(i, 6))
    return [f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nFIX 0\n"
            f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {upper}\n".encode()]  # fmt: skip


def exports(_: Path) -> list[bytes]:
    from tests.io.mocap.exports import motive_csv, vicon_csv

    return [motive_csv().encode(), vicon_csv().encode()]


def trcs(_: Path) -> list[bytes]:
    from tests.io import test_oddities as odd

    return [odd.TRC.encode(), odd.BODIES.format(kind="Rigid Body").encode()]


def captures(_: Path) -> list[bytes]:
    from tests.io.recordings.test_packets import pcap, velodyne

    return [pcap(velodyne(0.05)), pcap([(1.0, bytes(1248))])]


def describe(path: Path) -> object:
    from optshape_graph.io.describe import describe

    return describe(path)


def everything(folder: Path) -> list[bytes]:
    makers_of = (csvs, floats, npys, pcds, plys, trajectories, trcs, makers, camera_files, stamps)
    return [seed for make in makers_of for seed in make(folder)]


def tsvs(_: Path) -> list[bytes]:
    from tests.io.mocap.exports import qualisys_tsv

    return [qualisys_tsv("0.000", 2, True).encode(), qualisys_tsv("", 0, False).encode()]


def binary_of(form: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        from tests.io.mocap import exports

        path = folder / f"seed.{form}"
        getattr(exports, form)(path)
        return [path.read_bytes()]

    return seeds


def read_pixels(path: Path) -> object:
    from optshape_graph.calibration.images.pixel_table import read_pixel_table

    return read_pixel_table(path, PAPER)


def pixels(_: Path) -> list[bytes]:
    return [b"vertex,u,v\n0,10,20\n2,30.5,40\n", b"y,z,u,v,sigma\n0.1,0.2,10,20,0.25\n"]


# Recordings


def read_recording(path: Path) -> None:
    recording = Recording(path)
    for topic in recording.topics:
        read = {
            "scan": recording.scans,
            "image": recording.images,
            "pose": recording.poses,
            "camera": recording.cameras,
        }
        if topic.kind in read:
            for item in read[topic.kind](topic.name):
                if topic.kind == "image":
                    with suppress(_bad_message()):
                        item.value.pixels()


def _bad_message() -> type[Exception]:
    from optshape_graph.io.recordings.stream import BadMessage

    return BadMessage


def _messages(storage: str) -> list[tuple[str, Any]]:
    import cv2

    from tests.io.recordings.writing import maker, points

    make = maker(storage)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    livox = np.zeros(2, [("offset_time", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4"), ("reflectivity", "u1"),
                         ("tag", "u1"), ("line", "u1")])  # fmt: skip
    livox["x"] = 5.0
    return [
        ("/points", make.cloud(100.0, points("velodyne", n=8))),
        ("/points", make.cloud(100.1, points("ouster", n=8), height=4, row_padding=2)),
        ("/livox", make.livox(100.0, livox)),
        ("/image", make.image(100.0, np.zeros((2, 3, 3), np.uint8), "rgb8", padding=2)),
        ("/image/compressed", make.compressed(100.0, jpeg)),
        ("/camera_info", make.camera_info(100.0, K, np.zeros(5), "plumb_bob")),
        ("/odom", make.odometry(100.0, np.eye(4))),
        ("/pose", make.pose_stamped(100.0, np.eye(4))),
        ("/tf", make.tf(make.transform(100.0, np.eye(4), "map", "lidar"))),
    ]


def bag_of(storage: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        from tests.io.recordings.writing import write_bag

        place = folder / storage
        place.mkdir()
        few = [item for item in _messages(storage) if item[0] in ("/points", "/tf", "/camera_info")]
        return [write_bag(place, storage, few).read_bytes()]

    return seeds


def read_bag_folder(path: Path) -> None:
    """Read a folder of a ROS 2 bag whose metadata is the input."""
    read_recording(path.parent)


def metadata(folder: Path) -> list[bytes]:
    from tests.io.recordings.writing import write_bag

    place = folder / "metadata"
    place.mkdir()
    bag = write_bag(place, "mcap", _messages("mcap")[:2])
    return [(bag / "metadata.yaml").read_bytes()]


def decode(ros: int) -> Callable[[Path], None]:
    def read(path: Path) -> None:
        from optshape_graph.io.recordings import messages

        data = path.read_bytes()
        if not data:
            return
        types = sorted(
            messages.SCANS | messages.IMAGES | messages.CAMERAS | messages.POSES | messages.TRANSFORMS | {messages.PATH}
        )
        kind, data = types[data[0] % len(types)], data[1:]
        with suppress(_bad_message()):
            if kind in messages.SCANS:
                messages.decode_scan(ros, kind, data, "fuzz", VLP16 if len(data) % 2 else None)
            elif kind in messages.IMAGES:
                messages.decode_image(ros, kind, data).value.pixels()
            elif kind in messages.CAMERAS:
                messages.decode_camera(ros, kind, data)
            elif kind in messages.POSES:
                messages.decode_pose(ros, kind, data)
            elif kind == messages.PATH:
                messages.decode_path(ros, data)
            else:
                list(messages.decode_transform(ros, kind, data, "map", "lidar"))

    return read


def messages_of(storage: str) -> Callable[[Path], list[bytes]]:
    def seeds(_: Path) -> list[bytes]:
        from optshape_graph.io.recordings import messages
        from tests.io.recordings.writing import maker

        types = sorted(
            messages.SCANS | messages.IMAGES | messages.CAMERAS | messages.POSES | messages.TRANSFORMS | {messages.PATH}
        )
        make, sent = maker(storage), [message for _, message in _messages(storage)]
        return [bytes([types.index(message.__msgtype__)]) + make.serialize(message) for message in sent]

    return seeds


def images(_: Path) -> list[bytes]:
    import cv2

    picture = np.arange(12 * 16 * 3, dtype=np.uint8).reshape(12, 16, 3)
    return [cv2.imencode(suffix, picture)[1].tobytes() for suffix in (".png", ".jpg", ".bmp", ".tiff", ".ppm")]


def read_image(path: Path) -> None:
    from optshape_graph.calibration.images.reading import read_grey
    from optshape_graph.io.recordings.images import CompressedImage

    with suppress(OptshapeError):
        read_grey(path)
    with suppress(_bad_message()):
        CompressedImage(path.read_bytes(), ".png").pixels()


def stamps(_: Path) -> list[bytes]:
    return [b"100.0\n100.1\n", b"#stamp,file\n1000000000000000000,a.pcd\n1000000000100000000,b.pcd\n",
            b"2011-09-26 13:04:32.349000000\n2011-09-26 13:04:32.449000000\n", b"a.pcd 100\nb.pcd 101\n"]  # fmt: skip


def recording_folder(folder: Path) -> None:
    (folder / "recording").mkdir()
    for name in ("a.pcd", "b.pcd"):
        write_scan(folder / "recording" / name, scan())


READERS: dict[str, Reader] = {
    "pcd": Reader(clouds(".pcd", pcds)),
    "ply": Reader(clouds(".ply", plys)),
    "npz": Reader((*clouds(".npz", npz_archives), Form("array.npy", read_in_archive, arrays))),
    "csv": Reader((*clouds(".csv", csvs), *clouds(".txt", other_texts), Form("named.txt", read_named, other_texts))),
    "floats": Reader((
        *clouds(".bin", floats), Form("a.pcd.bin", read_scan, floats), Form("b.bin", read_named, floats),
    )),
    "npy": Reader((*clouds(".npy", npys), Form("named.npy", read_named, npys))),
    "survey": Reader(tuple(Form(f"a.{form}", read_scan, surveys(form)) for form in ("las", "laz", "e57"))),
    "maker": Reader(tuple(Form(f"unit{ending}", load_sensor, makers) for ending in (".json", ".yaml", ".csv"))),
    "capture": Reader((Form("a.pcap", read_recording, captures),)),
    "any": Reader(tuple(
        Form(f"a{ending}", describe, everything) for ending in (".csv", ".txt", ".yaml", ".json", "", ".bin")
    )),
    "lzf": Reader((Form("a.lzf", read_lzf, lzfs),)),
    "yaml": Reader(
        (
            Form("target.yaml", load_target, targets),
            Form("sensor.yaml", load_sensor, written(save_sensor, VLP16)),
            Form("session.yaml", load_session, lambda _: [text.encode() for text in SESSIONS]),
            Form("scene.yaml", load_scene, lambda _: [SCENE.encode()]),
        ),
        furnish,
    ),
    "json": Reader(
        (
            Form("map.json", load_map, maps),
            Form("scene.json", load_scene, scene_json),
            Form("start.json", read_start, starts),
            Form("reference.json", read_reference, json_of({"s/a.pcd": {"T_lidar_target_paper": np.eye(4)}})),
            Form("sweep/task.json", read_sweep, json_of({"task": 0, "rows": [{"a": 1.5}]})),
            Form("sweep/task.json", read_sweep, json_of({"schema": "optshape/sweep/1", "digest": "a"})),
            Form("any.json", read_json, json_of({"a": [1, 2.5, None, True, "x"]})),
        )
    ),
    "result": Reader((Form("result.json", read_result, results),)),
    "camera": Reader((
        Form("camera.yaml", load_camera, camera_files),
        Form("camera.json", load_camera, lambda _: [b'{"schema": "optshape/camera/1", "model": "pinhole", "width": 64, '
             b'"height": 48, "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]], "D": []}']),
        Form("camera.xml", load_camera, camera_files),
    )),
    "trajectory": Reader((
        Form("a.tum", read_tum, tums), Form("a.kitti", read_kitti, kittis), Form("a.g2o", read_g2o, g2os),
        Form("a.txt", read_trajectory, trajectories),
    )),
    "markers": Reader((
        Form("m.csv", read_markers, lambda _: [MARKERS.encode()]),
        Form("mm.csv", lambda path: read_markers(path, "mm"), lambda _: [MARKERS.replace("2.5", "2500").encode()]),
    )),
    "mocap": Reader((
        Form("a.csv", read_mocap, exports), Form("a.tsv", read_mocap, tsvs), Form("a.trc", read_mocap, trcs),
    )),
    "mocap-binary": Reader((
        Form("a.c3d", read_mocap, binary_of("c3d")), Form("a.mat", read_mocap, binary_of("mat")),
    )),
    "bag": Reader((
        Form("a.bag", read_recording, bag_of("ros1")),
        Form("a.mcap", read_recording, bag_of("bare")),
        Form("a.db3", read_recording, bag_of("db3")),
        Form("folder/metadata.yaml", read_bag_folder, metadata),
    )),
    "message": Reader((
        Form("a.ros1", decode(1), messages_of("ros1")), Form("a.ros2", decode(2), messages_of("mcap")),
    )),
    "image": Reader((Form("a.png", read_image, images),)),
    "pixels": Reader((Form("a.csv", read_pixels, pixels),)),
    "stamps": Reader(
        (
            Form("recording/timestamps.txt", lambda path: read_recording(path.parent), stamps),
            Form("recording/odometry.tum", lambda path: read_recording(path.parent), tums),
        ),
        recording_folder,
    ),
}  # fmt: skip
