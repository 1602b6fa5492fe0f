"""Bad inputs, and what the command line says of them: one line that names the file, the value and what was expected.

Each row is a command, the files it needs (in the current folder), and what its message must contain, in that order.
"""

# ruff: noqa: E501 - a row is a line

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from optshape_graph.cli.main import COMMANDS, main

Files = dict[str, str | bytes]

PCD = "VERSION 0.7\nFIELDS x y z ring\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
POINTS = "5 0 0 0\n5 1 1 1\n"
PLY = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
TARGET = "schema: optshape/target/1\nvertices: [[0, 0.5, -0.5], [0, 0.5, 0.5], [0, -0.5, 0.5], [0, -0.5, -0.5]]\n"
SENSOR = "schema: optshape/sensor/1\nelevations_deg: [-2, 0, 2]\n"
CAMERA = (
    "schema: optshape/camera/1\nmodel: pinhole\nwidth: 64\nheight: 48\n"
    "K: [[50, 0, 32], [0, 50, 24], [0, 0, 1]]\nD: [0, 0, 0, 0]\n"
)
MOCAP = (
    "schema: optshape/session/1\nsensor: vlp16\ntarget: board.yaml\nscans:\n  - {file: a.pcd, mocap_frame: 0}\n"
    "mocap: {file: m.csv, units: m}\n"
)
MARKERS = "frame,marker,x,y,z\n0,corner0,5,0,0\n0,corner1,5,1,0\n"
VIEWS = (
    "schema: optshape/session/1\nsensor: vlp16\ntarget: board.yaml\ncamera: c.yaml\n"
    "views:\n  - {scan: a.pcd, image: a.png}\n"
)
SCENE = "schema: optshape/scene/1\nfloor: {height: -1}\n"
MAP = (
    '{"schema": "optshape/map/1", "targets": {"A": {"vertices": [[0, 1, -1], [0, 1, 1], [0, -2, 0]]}}, "landmarks": '
    '[{"id": "A", "target": "t", "T_world_target": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], '
    '"covariance": [[1,0,0,0,0,0],[0,1,0,0,0,0],[0,0,1,0,0,0],[0,0,0,1,0,0],[0,0,0,0,1,0],[0,0,0,0,0,1]]}], '
    '"trajectory": []}'
)
FOLDER: Files = {"folder/a.pcd": PCD + POINTS, "folder/timestamps.txt": "1\n"}
"""A recording of one cloud."""
BASE: Files = {"a.pcd": PCD + POINTS, "board.yaml": TARGET, "m.csv": MARKERS, "c.yaml": CAMERA, "a.png": b"no image"}
"""What sessions name."""


def npz(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=True, **arrays)
    return stream.getvalue()


def big_png() -> bytes:
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I4sIIBBBBBI", 13, b"IHDR", 60000, 60000, 8, 0, 0, 0, 0, 0)
        + struct.pack(">I4sI", 0, b"IEND", 0)
    )


ESTIMATE = "estimate {} --target paper"
WITH = "estimate a.pcd --target {}"
OF = "estimate a.pcd --target paper --sensor s.yaml"
MAPPED = "map folder --targets paper --sensor vlp16 "


def cloud(name: str, content: str | bytes, *parts: str) -> tuple[str, Files, tuple[str, ...]]:
    return ESTIMATE.format(name), {name: content}, (name, *parts)


def target(content: str, *parts: str) -> tuple[str, Files, tuple[str, ...]]:
    return WITH.format("t.yaml"), {"a.pcd": PCD + POINTS, "t.yaml": content}, ("t.yaml", *parts)


def sensor(content: str, *parts: str) -> tuple[str, Files, tuple[str, ...]]:
    return OF, {"a.pcd": PCD + POINTS, "s.yaml": content}, ("s.yaml", *parts)


def mocap(change: tuple[str, str], *parts: str, **files: str | bytes) -> tuple[str, Files, tuple[str, ...]]:
    named = {name.replace("_", "."): content for name, content in files.items()}
    return "calibrate mocap s.yaml", BASE | {"s.yaml": MOCAP.replace(*change)} | named, parts


def camera(change: tuple[str, str], *parts: str, **files: str | bytes) -> tuple[str, Files, tuple[str, ...]]:
    named = {name.replace("_", "."): content for name, content in files.items()}
    return "calibrate camera s.yaml", BASE | {"s.yaml": VIEWS.replace(*change)} | named, parts


def scene(content: str, *parts: str) -> tuple[str, Files, tuple[str, ...]]:
    return "simulate --scene s.yaml -o out.pcd", {"s.yaml": content}, ("s.yaml", *parts)


ROWS: dict[str, tuple[str, Files, tuple[str, ...]]] = {
    # clouds
    "no such cloud": (ESTIMATE.format("b.pcd"), {}, ("b.pcd: no such file",)),
    "a folder as cloud": (ESTIMATE.format("."), {}, (".: no clouds in the folder (.pcd, .ply, .npz, ",)),
    "unknown ending": cloud("a.xls", "1 2 3", ": expected a cloud ending in .pcd, .ply, .npz, .npy, .csv, ", "found '.xls'"),
    "empty PCD": cloud("a.pcd", "", "its header has no line 'DATA ...'"),
    "text as PCD": cloud("a.pcd", "hello there\n", "expected one of the keywords VERSION", "found 'hello'"),
    "PCD cut off": cloud("a.pcd", PCD.replace("ascii", "binary") + "abc", "promises 2 points of 16 bytes, 32 in all", "3 bytes"),
    "PCD of a million million points": cloud(
        "a.pcd", PCD.replace("2\n", "1000000000000\n", 3).replace("ascii", "binary"), "promises 1000000000000 points",
    ),
    "PCD of two sizes": cloud("a.pcd", PCD.replace("POINTS 2", "POINTS 3"), "says 3 points, but 2 x 1"),
    "PCD of an unknown type": cloud("a.pcd", PCD.replace("F F F U", "F F F Q"), "field 'ring' has type Q, size 4; expected F 4|8"),
    "PCD of an unknown encoding": cloud("a.pcd", PCD.replace("ascii", "zip"), "DATA is 'zip', expected ascii, binary or binary_compressed"),
    "PCD with a word": cloud("a.pcd", PCD + "5 0 0 0\n5 far 1 1\n", ":11: could not convert string 'far' to float32 in column 2"),
    "PCD with a point missing": cloud("a.pcd", PCD + "5 0 0 0\n", "promises 2 points, 1 lines of points"),
    "PCD without coordinates": cloud("a.pcd", PCD.replace("x y z", "a b c") + POINTS, "expected columns x, y, z", "found: a, b, c, ring"),
    "PCD without a return": cloud("a.pcd", PCD + "0 0 0 0\nnan 1 1 1\n", "no returns (2 points, all at the origin, not finite"),
    "PCD in millimetres": cloud("a.pcd", PCD + "5000 0 0 0\n5000 1 1 1\n", "beyond 5000 m; expected metres from the LiDAR (millimetres, or coordinates of a map?)"),
    "rings that are no integers": cloud("a.csv", "x,y,z,ring\n5,0,0,0.5\n5,0,1,1\n", "expected ring numbers as integers from 0, found 0.5"),
    "compressed PCD that is damaged": cloud(
        "a.pcd", PCD.replace("ascii", "binary_compressed").encode() + struct.pack("<II", 2, 32) + b"\xff\xff",
        "damaged compressed data",
    ),
    "text as PLY": cloud("a.ply", "hello\n", "its first line is not 'ply'"),
    "PLY without vertices": cloud("a.ply", "ply\nformat ascii 1.0\nend_header\n", "declares no vertices"),
    "PLY with lists": cloud("a.ply", PLY.replace("float z", "list uchar int z"), "the vertices have a list"),
    "PLY of a million million vertices": cloud(
        "a.ply", PLY.replace("vertex 1", "vertex 1000000000000").replace("ascii", "binary_little_endian"),
        "promises 1000000000000 vertices of 12 bytes",
    ),
    "text as NPZ": cloud("a.npz", "hello", "not a usable NPZ file"),
    "NPZ of objects": cloud("a.npz", npz(xyz=np.array([{}], dtype=object)), "'xyz.npy' holds Python objects; expected numbers"),
    "NPZ of another shape": cloud("a.npz", npz(xyz=np.ones((4, 2))), "'xyz' is float64 of shape (4, 2), expected N x 3"),
    "CSV without names": cloud("a.csv", "1,2,3\n", "expected a first line that names the columns, as x,y,z,ring; found '1,2,3'"),
    "CSV with a column twice": cloud("a.csv", "x,y,z,x\n1,2,3,4\n", "a column is named twice: x, x"),
    "CSV with a word": cloud("a.csv", "x,y,z\n1,2,tall\n", ":2: could not convert string 'tall' to float64 in column 3"),
    "a sensor of other rings": (
        "detect a.csv --target paper --sensor vlp16", {"a.csv": "x,y,z,ring\n5,0,3,0\n5,1,3,0\n5,0,4,1\n5,1,4,1\n"},
        ("a.csv: the elevations do not fit the table of vlp16", "nearest row of the table"),
    ),
    # targets
    "no such target": (WITH.format("sqare"), {"a.pcd": PCD + POINTS}, ("sqare: no such file, and the built-in targets are: built, ",)),
    "area that is none": (WITH.format("paper@big"), {"a.pcd": PCD + POINTS}, ("paper@big: expected NAME@AREA with the area in m2, found 'big'",)),
    "target without schema": target("vertices: []\n", "the key 'schema' is missing; a target file says 'schema: optshape/target/1'"),
    "target of another kind": target(SENSOR, ":1: schema: expected 'optshape/target/1', found 'optshape/sensor/1'"),
    "target of a newer form": target(TARGET.replace("target/1", "target/2"), "'optshape/target/2' is a newer form", "reads 'optshape/target/1'"),
    "target with a misspelt key": target(TARGET.replace("vertices", "vertexes"), ":2: vertexes: unknown key 'vertexes' (did you mean 'vertices'?)"),
    "target with a key twice": target(TARGET + "schema: x\n", ":3: the key 'schema' is given twice, first on line 1"),
    "target with a word": target(TARGET.replace("-0.5]]", "low]]"), ":2: vertices[3][2]: expected a finite number, found 'low'"),
    "target with NaN": target(TARGET.replace("-0.5]]", ".nan]]"), "vertices[3][2]: expected a finite number, found nan"),
    "target of two vertices": target("schema: optshape/target/1\nvertices: [[0, 1, 0], [0, -1, 0]]\n", "expected a list of 3 to 1000 elements, found 2"),
    "target of two thousand vertices": target("schema: optshape/target/1\nvertices: [" + "[0, 1, 0], " * 2000 + "]\n", "expected a list of 3 to 1000 elements, found 2000"),
    "target out of its plane": target(TARGET.replace("[0, 0.5, -0.5]", "[0.3, 0.5, -0.5]"), "plane x = 0"),
    "target the wrong way round": target(
        "schema: optshape/target/1\nvertices: [[0, 0, 1], [0, 1, -0.5], [0, -1, -0.5]]\n", "counter-clockwise",
    ),
    "target in millimetres": target(TARGET.replace("0.5", "500"), "millimetres"),
    "YAML that is none": target("schema: [optshape\n", "not YAML"),
    "YAML with a tag": target("schema: !!python/object/apply:os.system ['true']\n", ":1: tags are not read", "expected plain values"),
    "YAML with aliases": target("a: &a [1]\nb: *a\n", ":1: anchors and aliases are not read ('a')"),
    "YAML nested deeply": target("a: " + "[" * 2000, "nested more than 50 levels deep"),
    "chessboard of half a corner": target(
        TARGET + "chessboard: {inner_corners: [7, 4.5], square: 0.1}\n", "inner_corners[1]: expected an integer of at least 2, found 4.5",
    ),
    "tags without centres": target(TARGET + "tags: {dictionary: 4X4_50, size: 0.1, centres: {}}\n", "centres: expected 1 or more entries, found 0"),
    "a key with a line break and an escape": target(TARGET + '"a\\nb\\e[2Jc": 1\n', "unknown key 'a\\nb\\x1b[2Jc'"),
    "a word of a million letters": (MAPPED + "--odometry o.tum", FOLDER | {"o.tum": "w" * 1_000_000 + " 0 0 0 0 0 0 1"}, ("o.tum:1: could not convert string to float: 'www", "www...")),
    "a word of blanks": ("estimate a.csv --target paper", {"a.csv": "x,y,z\n1,2,w" + " ," * 3 + " " * 200_000 + "w"}, ("a.csv:2: ",)),
    # sensors
    "no such sensor": ("estimate a.pcd --target paper --sensor vlp61", {"a.pcd": PCD}, ("vlp61: no such file, and the built-in sensors are: ",)),
    "elevations from the top": sensor(SENSOR.replace("-2, 0, 2", "2, 0, -2"), "from the lowest ring up; number 1 (0 deg) does not exceed number 0 (2 deg)"),
    "elevation above the zenith": sensor(SENSOR.replace("0, 2", "0, 95"), "elevations_deg[2]: expected a finite number above -90 and below 90, found 95"),
    "negative noise": sensor(SENSOR + "range_noise_m: -0.1\n", "range_noise_m: expected a finite number of at least 0, found -0.1"),
    "noise in quotes": sensor(SENSOR + "range_noise_m: '0.1'\n", ":3: range_noise_m: expected a finite number of at least 0, found '0.1'"),
    "sensor with a misspelt key": sensor(SENSOR + "range_noise: 0.1\n", ":3: range_noise: unknown key 'range_noise' (did you mean 'range_noise_m'?)"),
    # sessions with motion capture
    "no such session": ("calibrate mocap x.yaml", {}, ("x.yaml: no such file",)),
    "session without a target": mocap(("target: board.yaml\n", ""), "s.yaml:1: expected 'target' or 'targets', found only: schema, sensor"),
    "session with two kinds of sensors": mocap(("sensor: vlp16", "sensor: vlp16\nlidars: {a: vlp16}"), "s.yaml:2: sensor: expected 'sensor' or 'lidars', found both"),
    "session without its scan": mocap(("a.pcd", "z.pcd"), "s.yaml:5: scans[0].file: no such file: z.pcd"),
    "session without scans": mocap(("\n  - {file: a.pcd, mocap_frame: 0}", " []"), "s.yaml:4: scans: expected a list of 1 or more elements, found 0"),
    "session that leads out": mocap(("a.pcd", "../../../etc/hostname"), "s.yaml:5: scans[0].file: ", "leads out of its folder and the one above", "--allow-outside"),
    "session with a frame that is not there": mocap(("mocap_frame: 0", "mocap_frame: 7"), "s.yaml:5: scans[0].mocap_frame: no marker frame 7; the file has 1 frames, 0 to 0"),
    "session without motion capture": mocap(("mocap: {file: m.csv, units: m}\n", ""), "s.yaml:5: scans[0].mocap_frame: a marker frame, but the session has no motion capture"),
    "unit that is none": mocap(("units: m", "units: inch"), "s.yaml:6: mocap.units: expected one of: m, cm, mm, found 'inch'"),
    "markers with other columns": mocap(("", ""), "m.csv: expected a first line with the columns frame,marker,x,y,z, found 'a,b'", m_csv="a,b\n1,2\n"),
    "marker with a word": mocap(("", ""), "m.csv:2: expected a coordinate, found 'left'", m_csv="frame,marker,x,y,z\n0,corner0,left,0,0\n"),
    "marker twice": mocap(("", ""), "m.csv:4: marker 'corner1' is given twice in frame 0", m_csv=MARKERS + "0,corner1,5,1,0\n"),
    "marker seen in part": mocap(("", ""), "m.csv:4: marker 'corner2' has some coordinates only; expected all three or none", m_csv=MARKERS + "0,corner2,5,1,\n"),
    "markers in millimetres": mocap(("", ""), "m.csv: the markers of frame 0 span 1000 m, read in 'm'; expected 0.01 to 50 m (is the unit right?)", m_csv=MARKERS.replace("5,1,0", "5,1000,0")),
    "markers that are not UTF-8": mocap(("", ""), "m.csv: expected UTF-8 text, found byte 0xff at position 0", m_csv=b"\xff\xfe"),
    # cameras
    "camera of an unknown model": camera(("", ""), "c.yaml:2: model: expected one of: pinhole, equidistant, found 'fisheye'", c_yaml=CAMERA.replace("pinhole", "fisheye")),
    "camera with three coefficients": camera(("", ""), "c.yaml: camera 'c': 3 distortion coefficients, expected 0 or 4 or 5 or 8", c_yaml=CAMERA.replace("0, 0, 0, 0]", "0, 0, 0]")),
    "camera that looks past its image": camera(("", ""), "c.yaml: camera 'c': the principal point (320, 24) is outside the image of 64 x 48", c_yaml=CAMERA.replace("0, 32", "0, 320")),
    "a camera's keys of no form": camera(("", ""), "c.yaml:1: expected intrinsics with 'schema: optshape/camera/1'", "found the keys: f", c_yaml="f: 500\n"),
    "an image but no camera": camera(("camera: c.yaml\n", ""), "s.yaml:5: views[0].image: an image, but the session names no camera"),
    "an image that is none": camera(("", ""), "a.png: not an image that OpenCV can read (8 bytes); expected PNG, JPEG", board_yaml=TARGET + "chessboard: {inner_corners: [7, 5], square: 0.1}\n"),
    "an image of too many pixels": camera(("", ""), "a.png: 60000 x 60000 pixels; expected at most 268435456", a_png=big_png(), board_yaml=TARGET + "chessboard: {inner_corners: [7, 5], square: 0.1}\n"),
    # recordings
    "no such recording": ("extract x.bag --list", {}, ("x.bag: no such file or folder",)),
    "a recording that is none": ("extract x.txt --list", {"x.txt": "x"}, ("x.txt: expected a .bag, .mcap, .db3 or .pcap file",)),
    "text as bag": ("extract x.bag --list", {"x.bag": "hello"}, ("x.bag: not a readable bag", "rosbag reindex")),
    "text as mcap": ("extract x.mcap --list", {"x.mcap": "hello"}, ("x.mcap: not a readable bag",)),
    "text as db3": ("extract x.db3 --list", {"x.db3": "hello"}, ("x.db3: not a readable bag",)),
    "a folder without timestamps": (MAPPED, {"folder/a.pcd": PCD + POINTS}, ("folder: no topic of point clouds; it has none",)),
    "stamps of other clouds": (MAPPED, {"folder/a.pcd": PCD + POINTS, "folder/timestamps.txt": "1\n2\n"}, ("timestamps.txt: 2 stamps for 1 files",)),
    "a stamp that is none": (MAPPED, {"folder/a.pcd": PCD + POINTS, "folder/b.pcd": PCD, "folder/timestamps.txt": "1\nnoon\n"}, ("timestamps.txt:2: expected a stamp, found 'noon'",)),
    "motion capture of no vendor": (
        "extract folder -o out --sensor vlp16 --target paper --mocap m.csv",
        {"folder/a.pcd": PCD + POINTS, "folder/timestamps.txt": "1\n", "m.csv": "a,b\n"}, ("m.csv: neither Motive's CSV", "nor Vicon's"),
    ),
    "motion capture that is damaged": (
        "extract folder -o out --sensor vlp16 --target paper --mocap m.c3d",
        {"folder/a.pcd": PCD + POINTS, "folder/timestamps.txt": "1\n", "m.c3d": "no"}, ("m.c3d: not a readable c3d file",),
    ),
    # maps and trajectories
    "odometry with a word": (MAPPED + "--odometry o.tum", FOLDER | {"o.tum": "0 0 0 0 0 0 0 one\n"}, ("o.tum:1: could not convert string to float: 'one'",)),
    "odometry that is no rotation": (MAPPED + "--odometry o.tum", FOLDER | {"o.tum": "0 0 0 0 0 0 0 2\n"}, ("o.tum:1: quaternion [0.0, 0.0, 0.0, 2.0] has norm 2; expected 1",)),
    "odometry that goes back": (MAPPED + "--odometry o.tum", FOLDER | {"o.tum": "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"}, ("o.tum:2: stamp 0.000000000 does not exceed 1.000000000",)),
    "map that is no JSON": (MAPPED + "--known k.json", {"k.json": "{", "folder/timestamps.txt": "1\n", "folder/a.pcd": PCD + POINTS}, ("k.json:1: not JSON",)),
    "map with a pose that is none": (
        MAPPED + "--known k.json", {"k.json": MAP.replace("[[1, 0, 0, 0]", "[[2, 0, 0, 0]"), "folder/timestamps.txt": "1\n", "folder/a.pcd": PCD + POINTS},
        ("k.json: landmarks[0]: landmark 'A': not a rigid transform",),
    ),
    "map with a covariance that is none": (
        MAPPED + "--known k.json", {"k.json": MAP.replace("[[1,0", "[[-1,0"), "folder/timestamps.txt": "1\n", "folder/a.pcd": PCD + POINTS},
        ("k.json: landmarks[0]: landmark 'A': its covariance is not symmetric and positive",),
    ),
    "map with infinity": (MAPPED + "--known k.json", {"k.json": '{"schema": Infinity}', "folder/timestamps.txt": "1\n", "folder/a.pcd": PCD + POINTS}, ("k.json: Infinity is not a JSON number; expected finite numbers",)),
    # scenes
    "scene with an unknown thing": scene(SCENE + "trees: []\n", ":3: trees: unknown key 'trees' (did you mean 'targets'?); expected one of: schema, targets, floor"),
    "wall of no size": scene(SCENE + "walls: [{size: [0, 1], position: [1, 0, 0]}]\n", "walls[0].size[0]: expected a finite number above 0, found 0"),
    "reflectivity above one": scene(SCENE.replace("-1}", "-1, reflectivity: 2}"), "floor.reflectivity: expected a finite number from 0 to 1, found 2"),
    "mesh that is not there": scene(SCENE + "meshes: [{file: chair.ply}]\n", "meshes[0].file: no such file: chair.ply"),
    "cloud to a name of another form": ("simulate --range 5 -o out.ply", {}, ("expected a name ending in .pcd, found 'out.ply'",)),
    # results to be shown
    "a result that is of no kind": ("view r.json", {"r.json": '{"schema": "optshape/poem/1"}'}, ("r.json: schema: 'optshape/poem/1' cannot be shown in space; expected one of: ",)),
    "a result of a newer form": ("view r.json", {"r.json": '{"schema": "optshape/estimate/2", "scans": []}'}, ("r.json: schema: 'optshape/estimate/2' cannot be shown in space",)),
    "a result without its scans": ("view r.json", {"r.json": '{"schema": "optshape/estimate/1"}'}, ("r.json: the key 'scans' is missing; found only: schema",)),
    "a report of no result": ("report r.json", {"r.json": '{"schema": "optshape/poem/1"}'}, ("r.json: schema: expected the result of camera-calibration, ", "found 'optshape/poem/1'")),
    "a report of a hollow result": ("report r.json", {"r.json": '{"schema": "optshape/estimate/1"}'}, ("r.json: the key 'scans' is missing",)),
    "a report of a list": ("report r.json", {"r.json": "[1]"}, ("r.json: expected a mapping, found a list",)),
    # maps that become one
    "a merge with no map": ("merge a.json b.json --json c.json", {"a.json": MAP, "b.json": '{"schema": "optshape/poem/1"}'}, ("b.json",)),
    "a merge of maps with nothing in common": ("merge a.json b.json --json c.json", {"a.json": MAP, "b.json": MAP.replace('"A"', '"B"')}, ("landmark",)),
    # information
    "information on no file": ("info nosuch.pcd", {}, ("nosuch.pcd: no such file or folder",)),
    "information on a binary file": ("info a.dat", {"a.dat": b"\0\1\2"}, ("a.dat: a binary file of no form that is read here; it begins with 00 01 02",)),
    # shapes
    "shape that is not there": ("design score nosuch", {}, ("nosuch: no such file, and the built-in targets are: ",)),
    "negative area": ("design optimise --area -1", {}, ("--area", "expected a number of at least 1e-06", "found '-1'")),
    "starts of another search": (
        "design optimise --starts 1 -o o.yaml",
        {"o.starts/start-00000.json": '{"schema": "optshape/design-start/1", "seed": 9, "problem": {}, "start": {"index": 0, "initial": [0,0,0,0,0], "parameters": [0,0,0,0,0], "score": 1, "slack": 1, "iterations": 1}}'},
        ("start-00000.json: belongs to a search for another problem or with another seed",),
    ),
    # evaluations
    "no sessions in a folder": ("evaluate mocap folder", {"folder/x": ""}, ("folder: expected session.yaml with 'mocap', in it or in a folder of it; found none",)),
    "reference without poses": (
        "evaluate mocap folder --reference r.json", {f"folder/{name}": content for name, content in BASE.items()}
        | {"folder/session.yaml": MOCAP, "r.json": '{"s/a.pcd": {}}'}, ("r.json: s/a.pcd: the key 'T_lidar_target_paper' is missing",),
    ),
    "tasks of another sweep": (
        "evaluate simulation --distance 4 --seeds 1 -o out", {"out/tasks/sweep.json": '{"digest": "x"}'},
        ("sweep.json: the folder holds another sweep (digest x, this one ",),
    ),
    "no workers": ("evaluate simulation --workers 0 -o out", {}, ("--workers", "0")),
    # results that cannot be written
    "results to no folder": ("design score square -o no/such/out.json", {}, ("nothing can be written to no/such (No such file or directory)",)),
    "results over a folder": ("doctor --json folder", {"folder/x": ""}, ("folder", "is a directory")),
    "a file where the demo's folder goes": ("demo -o file", {"file": ""}, ("file",)),
}  # fmt: skip


def said(line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Exit status of a command line, and what it wrote to standard error."""
    monkeypatch.setattr(sys, "argv", ["optshape", *line.split()])
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main()
    status = ended.value.code
    assert isinstance(status, int)
    return status, capsys.readouterr().err


@pytest.mark.parametrize("name", ROWS)
def test_bad_input_is_said_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    line, files, parts = ROWS[name]
    folder = tmp_path / "campaign" / "one"  # two levels: the parent of a session's folder counts as its own
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    for file, content in files.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    status, error = said(line, capsys, monkeypatch)
    assert status == 2, error
    assert "Traceback" not in error
    last = error.splitlines()[-1]
    if not last.startswith("Error: "):  # of click, with the usage before it
        assert last.startswith("optshape: error: "), error
        assert len(error.splitlines()) == 1, error
    at = 0
    for part in parts:
        assert part in last[at:], last
        at = last.index(part, at) + len(part)
    assert not list(tmp_path.rglob("*.tmp"))


def test_the_table_covers_every_command() -> None:
    assert len(ROWS) >= 60
    assert {line.split()[0] for line, _, _ in ROWS.values()} >= set(COMMANDS) - {"completion"}
