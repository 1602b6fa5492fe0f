"""Small files as users and other programs write them: each is read as the table says, or refused in one plain line."""

# ruff: noqa: E501 - a row is a line

from __future__ import annotations

import io
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import load_camera, load_sensor, read_scan
from optshape_graph.io.clouds.npz import read_npy
from optshape_graph.io.mocap import UNLABELLED, read_mocap
from optshape_graph.io.trajectories import read_trajectory
from tests.io import test_cameras as cameras
from tests.io.mocap.exports import motive_csv, vicon_csv

VLP16 = load_sensor("vlp16")
RING = np.repeat(np.arange(4), 3)
AZIMUTH = np.tile(np.radians([-20.0, 0.0, 20.0]), 4)
ELEVATION = VLP16.elevations[RING]
XYZ = 5 * np.column_stack([np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)])
TIME = 0.1 * np.degrees(AZIMUTH + np.radians(20)) / 360
"""Of a sensor that turns at 10 Hz."""
INTENSITY = np.arange(12.0) * 10


@dataclass(frozen=True)
class Reads:
    """What comes out of a file; what is None isn't looked at, and "none" must not be there."""

    ring: Any = None
    time: Any = None
    intensity: Any = None
    said: str = ""
    tolerance: float = 1e-4
    sensor: bool = False
    columns: str = ""
    check: Callable[[Any], object] | None = None


@dataclass(frozen=True)
class Refused:
    """What a message must say, in this order, after the file's name."""

    parts: tuple[str, ...]
    sensor: bool = False
    columns: str = ""


def no(*parts: str, **how: Any) -> Refused:
    return Refused(parts, **how)


# Clouds as text


def text(header: str, *columns: Any, delimiter: str = ",", form: str = "{:.6f}") -> bytes:
    rows = zip(*columns, strict=True)
    lines = [delimiter.join(form.format(x) if isinstance(x, float) else str(x) for x in row) for row in rows]
    return "\n".join([*([header] if header else []), *lines, ""]).encode()


X, Y, Z = (list(map(float, XYZ[:, k])) for k in range(3))
RINGS, TIMES, INTENSITIES = RING.tolist(), [float(t) for t in TIME], INTENSITY.tolist()
NS = [round(t * 1e9) for t in TIMES]

Row = tuple[str, bytes, Reads | Refused]
CLOUDS: dict[str, Row] = {}

for name in ("ring", "Ring", "RING", "ring_id", "channel", "laser_id", "laserid", "laser", "layer", "line", "beam_id",
             "row", "scalar_ring", "Scalar_Ring", "beam", "ring_index", "channel_id"):  # fmt: skip
    CLOUDS[f"rings called {name}"] = ("a.csv", text(f"x,y,z,{name}", X, Y, Z, RINGS), Reads(ring=RING))
for name, factor in (
    ("time", 1), ("timestamp", 1), ("time_stamp", 1), ("t", 1), ("time_offset", 1), ("gps_time", 1), ("t_us", 1e6),
    ("time_ns", 1e9), ("time (us)", 1e6), ("TIMESTAMP (ns)", 1e9), ("time [ms]", 1e3), ("offset_time", 1e9),
    ("timestamp_usec", 1e6), ("scalar_Time", 1), ("dt", 1), ("time_ms", 1e3),
):  # fmt: skip
    CLOUDS[f"times called {name}"] = (
        "a.csv",
        text(f"x,y,z,ring,{name}", X, Y, Z, RINGS, [t * factor for t in TIMES]),
        Reads(ring=RING, time=TIME),
    )
CLOUDS["microseconds of a crop that do not say so"] = (
    "a.csv",
    text("x,y,z,t", X, Y, Z, [t * 1e6 for t in TIMES]),
    Reads(time=TIME),
)
CLOUDS["nanoseconds of a crop that do not say so"] = (
    "a.csv",
    text("x,y,z,t", X, Y, Z, [t * 1e9 for t in TIMES]),
    Reads(time=TIME),
)
CLOUDS["nanoseconds since 1970"] = (
    "a.csv",
    text("x,y,z,timestamp", X, Y, Z, [1_700_000_000_000_000_000 + n for n in NS]),
    Reads(time=TIME, tolerance=1e-4),
)
CLOUDS["seconds since 1970"] = ("a.csv", text("x,y,z,timestamp", X, Y, Z, [1.7e9 + t for t in TIMES]), Reads(time=TIME))
for names, factor in (
    ("X,Y,Z", 1), ("x [m],y [m],z [m]", 1), ("X (mm),Y (mm),Z (mm)", 1000), ("x_mm,y_mm,z_mm", 1000), ("x_m,y_m,z_m", 1),
    ("Points:0,Points:1,Points:2", 1), ("Points_m_XYZ:0,Points_m_XYZ:1,Points_m_XYZ:2", 1), ("pos_x,pos_y,pos_z", 1),
    ("position_x,position_y,position_z", 1), ("x (cm),y (cm),z (cm)", 100), ('"x","y","z"', 1), ("//X,Y,Z", 1), ("# x,y,z", 1),
    ("point.x,point.y,point.z", 1), ("x (ft),y (ft),z (ft)", 1 / 0.3048),
):  # fmt: skip
    CLOUDS[f"coordinates called {names}"] = (
        "a.csv",
        text(f"{names},ring", *([c * factor for c in axis] for axis in (X, Y, Z)), RINGS),
        Reads(ring=RING),
    )
for name in (
    "intensity",
    "reflectivity",
    "Reflectance",
    "remission",
    "scalar_Intensity",
    "SIGNAL (photons)",
    "REFLECTIVITY (%)",
):
    CLOUDS[f"intensity called {name}"] = (
        "a.csv",
        text(f"x,y,z,{name}", X, Y, Z, INTENSITIES),
        Reads(intensity=INTENSITY),
    )
PLAIN = text("x,y,z,ring", X, Y, Z, RINGS)
CLOUDS |= {
    "semicolons and decimal commas": ("a.csv", PLAIN.replace(b",", b";").replace(b".", b","), Reads(ring=RING)),
    "tabs": ("a.txt", PLAIN.replace(b",", b"\t"), Reads(ring=RING)),
    "blanks": ("a.xyz", PLAIN.replace(b",", b"  "), Reads(ring=RING)),
    "line ends of Windows": ("a.csv", PLAIN.replace(b"\n", b"\r\n"), Reads(ring=RING)),
    "a byte order mark": ("a.csv", b"\xef\xbb\xbf" + PLAIN, Reads(ring=RING)),
    "UTF-16 of a spreadsheet": ("a.csv", PLAIN.decode().encode("utf-16"), Reads(ring=RING)),
    "Latin-1 in a name": ("a.csv", text("x,y,z,time (\xb5s)", X, Y, Z, [t * 1e6 for t in TIMES]).decode().encode("latin-1"), Reads(time=TIME)),
    "comments before the names": ("a.csv", b"# made by a tool\n# on a Monday\n" + PLAIN, Reads(ring=RING)),
    "a title before the names": ("a.csv", b"Exported scan 7\n\n" + PLAIN, Reads(ring=RING)),
    "a comment in between": ("a.csv", PLAIN.replace(b"\n", b"\n# turn\n", 3), Reads(ring=RING)),
    "a word in one line of many": ("a.csv", PLAIN + b"lost,,,\n", Reads(ring=RING, said="1 of 13 lines are no returns and left out, the first on line 14")),
    "semicolons and blanks": ("a.csv", PLAIN.replace(b",", b" ; "), Reads(ring=RING)),
    "an empty cell is no return": ("a.csv", PLAIN + b",,,3\n", Reads(ring=RING)),
    "columns of words that nobody needs": ("a.csv", text("label,x,y,z,ring", ["a b"] * 12, X, Y, Z, RINGS), Reads(ring=RING)),
    "names given, no line of them": ("a.csv", PLAIN.split(b"\n", 1)[1], Reads(ring=RING, columns="x,y,z,ring")),
    "names given for some columns": ("a.txt", text("", X, Y, Z, INTENSITIES, RINGS), Reads(ring=RING, columns="x,y,z,_,ring")),
    "names given instead of others": ("a.csv", PLAIN.replace(b"x,y,z,ring", b"a,b,c,d"), Reads(ring=RING, columns="x,y,z,ring")),
    "text under another ending": ("a.asc", PLAIN, Reads(ring=RING)),
    "PCD under another ending": ("a.csv", b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 12\nHEIGHT 1\nDATA binary\n" + XYZ.astype("<f4").tobytes(), Reads(ring="none")),
    "no line of names": ("a.csv", PLAIN.split(b"\n", 1)[1], no("a first line that names the columns", "--columns x,y,z,_,ring")),
    "names that are none": ("a.csv", PLAIN.replace(b"x,y,z", b"a,b,c"), no("names the columns, as x,y,z,ring; found 'a,b,c,ring'", "--columns")),
    "names given without coordinates": ("a.csv", PLAIN, no("expected x, y and z among the names given", columns="a,b")),
    "more names than columns": ("a.csv", PLAIN, no("5 columns are named, found 4 values", columns="x,y,z,ring,t")),
    "half of the lines are words": ("a.csv", b"x,y,z\n1,2,3\n1,2,b\n", no(":3: could not convert string 'b'")),
    "an unknown unit": ("a.csv", PLAIN.replace(b"x,y,z", b"x (furlong),y,z"), no("column 'x (furlong)': unit 'furlong'; expected one of: m, ")),
    "millimetres that do not say so": ("a.csv", text("x,y,z", *([c * 1000 * (1 if k % 2 else -1) for k, c in enumerate(axis)] for axis in (X, Y, Z))), no("beyond 5000 m", "millimetres? a CSV may say so: 'x (mm)'")),
    "coordinates of a map": ("a.csv", text("x,y,z", [x + 455_000 for x in X], [y + 5_411_000 for y in Y], Z), no("coordinates of a map (UTM, ...); expected metres from the LiDAR")),
    "coordinates of the earth": ("a.csv", text("x,y,z", [x + 4_177_000 for x in X], [y + 858_000 for y in Y], [z + 4_727_000 for z in Z]), no("coordinates of a map (UTM, ...)")),
    "empty": ("a.csv", b"", no("names the columns", "--columns")),
    "rings that are no integers": ("a.csv", text("x,y,z,ring", X, Y, Z, [r + 0.5 for r in RINGS]), no("expected ring numbers as integers from 0, found 0.5")),
    "another sensor": ("a.csv", text("x,y,z,ring", X, Y, [z + 1.5 for z in Z], RINGS), no("do not fit the table of vlp16", "maker's file", "elevations_deg", sensor=True)),
    "a spreadsheet": ("a.xlsx", b"PK\x03\x04 no", no("not a usable NPZ file")),
    "an unknown ending": ("a.rcs", PLAIN, no("expected a cloud ending in .pcd, ", "found '.rcs'")),
}  # fmt: skip

# PCD


def pcd(
    fields: str = "x y z ring",
    size: str = "4 4 4 2",
    kind: str = "F F F U",
    body: bytes | None = None,
    **changes: str | None,
) -> bytes:
    rows = np.zeros(12, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2")])
    for k, axis in enumerate("xyz"):
        rows[axis] = XYZ[:, k]
    rows["ring"] = RING
    header = {"VERSION": "0.7", "FIELDS": fields, "SIZE": size, "TYPE": kind, "COUNT": "1 1 1 1", "WIDTH": "12", "HEIGHT": "1",
              "VIEWPOINT": "0 0 0 1 0 0 0", "POINTS": "12", "DATA": "binary"} | changes  # fmt: skip
    return "".join(f"{key} {value}\n" for key, value in header.items() if value is not None).encode() + (
        rows.tobytes() if body is None else body
    )


ASCII = b"".join(b"%.6f %.6f %.6f %d\n" % (*map(float, p), r) for p, r in zip(XYZ, RING, strict=True))
CLOUDS |= {
    "PCD": ("a.pcd", pcd(), Reads(ring=RING)),
    "PCD padded to a page": ("a.pcd", pcd().ljust(4096, b"\0"), Reads(ring=RING)),
    "PCD padded by two points": ("a.pcd", pcd() + bytes(28), Reads(ring=RING)),
    "PCD with a line end after it": ("a.pcd", pcd() + b"\n", Reads(ring=RING)),
    "PCD followed by something": ("a.pcd", pcd() + b"x" * 40, no("promises 12 points of 14 bytes, 168 in all; 208 bytes follow it")),
    "PCD with a field of count 0": ("a.pcd", pcd("x y z ring _", "4 4 4 2 1", "F F F U U", COUNT="1 1 1 1 0"), Reads(ring=RING)),
    "PCD with padding": ("a.pcd", pcd("x y z _", "4 4 4 1", "F F F U", COUNT="1 1 1 2"), Reads(ring="none")),
    "PCD with layers": ("a.pcd", pcd("x y z layer"), Reads(ring=RING)),
    "PCD without WIDTH": ("a.pcd", pcd(WIDTH=None), Reads(ring=RING)),
    "PCD without POINTS": ("a.pcd", pcd(POINTS=None), Reads(ring=RING)),
    "PCD without COUNT": ("a.pcd", pcd(COUNT=None), Reads(ring=RING)),
    "PCD without VIEWPOINT": ("a.pcd", pcd(VIEWPOINT=None), Reads(ring=RING)),
    "PCD with a viewpoint": ("a.pcd", pcd(VIEWPOINT="1 2 3 1 0 0 0"), Reads(ring=RING, said="the viewpoint 1 2 3 1 0 0 0 is not applied")),
    "PCD of version .5": ("a.pcd", pcd(VERSION=".5").replace(b"FIELDS", b"COLUMNS"), Reads(ring=RING)),
    "PCD with types in small letters": ("a.pcd", pcd(kind="f f f u"), Reads(ring=RING)),
    "PCD with a line of its own": ("a.pcd", pcd().replace(b"WIDTH", b"LIDAR of a lab\nWIDTH"), Reads(ring=RING)),
    "PCD with a field twice": ("a.pcd", pcd("x y z x"), Reads(ring="none", said="field 'x' is there twice")),
    "PCD in ascii": ("a.pcd", pcd(body=ASCII, DATA="ascii"), Reads(ring=RING)),
    "PCD in ascii, integers as floats": ("a.pcd", pcd(body=ASCII.replace(b" 3\n", b" 3.000\n"), DATA="ascii"), Reads(ring=RING)),
    "PCD with line ends of Windows": ("a.pcd", pcd(body=ASCII, DATA="ascii").replace(b"\n", b"\r\n"), Reads(ring=RING)),
    "PCD in ascii with a point lost": ("a.pcd", pcd(body=ASCII[:-30], DATA="ascii"), no("promises 12 points, 11 lines of points follow it")),
    "PCD cut off": ("a.pcd", pcd()[:-20], no("promises 12 points", "148 bytes follow it")),
    "PCD without coordinates": ("a.pcd", pcd("a b c ring"), no("expected columns x, y, z", "found: a, b, c, ring")),
    "PCD of an unknown type": ("a.pcd", pcd(kind="F F F Q"), no("field 'ring' has type Q")),
    "PCD that is text": ("a.pcd", b"hello\n", no("expected one of the keywords VERSION")),
}  # fmt: skip

# PLY, NumPy, floats


def ply(properties: str, rows: np.ndarray, form: str = "binary_little_endian", extra: str = "") -> bytes:
    lines = "".join(f"property {p}\n" for p in properties.split(","))
    head = f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {len(rows)}\n{lines}{extra}end_header\n"
    body = "\n".join(" ".join(map(str, row)) for row in rows.tolist()).encode() if form == "ascii" else rows.tobytes()
    return head.encode() + body


def rows(*kinds: tuple[str, str]) -> np.ndarray:
    table = np.zeros(12, list(kinds))
    values = {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "ring": RING, "flag": RING % 2, "time": TIME}
    for name, _ in kinds:
        table[name] = values[name.lower().removeprefix("scalar_")]
    return table


def npz(**arrays: Any) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


FLOATS = np.column_stack([XYZ, INTENSITY]).astype("<f4")
STRUCTURED = rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1"), ("time", "<f8"))
CLOUDS |= {
    "PLY": ("a.ply", ply("float x,float y,float z,uchar ring", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "u1"))), Reads(ring=RING)),
    "PLY with a truth value": ("a.ply", ply("float x,float y,float z,bool flag,uchar ring", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("flag", "u1"), ("ring", "u1"))), Reads(ring=RING)),
    "PLY of CloudCompare": ("a.ply", ply("float x,float y,float z,float scalar_ring", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<f4"))), Reads(ring=RING)),
    "PLY of large bytes first": ("a.ply", ply("double x,double y,double z", rows(("x", ">f8"), ("y", ">f8"), ("z", ">f8")), "binary_big_endian"), Reads(ring="none")),
    "PLY in ascii with faces": ("a.ply", ply("float x,float y,float z", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4")), "ascii", "element face 1\nproperty list uchar int vertex_indices\n") + b"\n3 0 1 2\n", Reads(ring="none")),
    "PLY of 64-bit integers": ("a.ply", ply("float x,float y,float z,int64 ring", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<i8"))), Reads(ring=RING)),
    "PLY under another ending": ("a.txt", ply("float x,float y,float z", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4"))), Reads(ring="none")),
    "PLY with a list": ("a.ply", ply("float x,float y,list uchar int z", STRUCTURED), no("the vertices have a list")),
    "PLY cut off": ("a.ply", ply("float x,float y,float z", rows(("x", "<f4"), ("y", "<f4"), ("z", "<f4")))[:-5], no("promises 12 vertices of 12 bytes, 144 in all; 139")),
    "NPZ of arrays": ("a.npz", npz(points=XYZ, ring=RING), Reads(ring=RING)),
    "NPZ of a structured array": ("a.npz", npz(cloud=STRUCTURED), Reads(ring=RING, time=TIME)),
    "NPZ of a structured array without a name": ("a.npz", npz(arr_0=STRUCTURED), Reads(ring=RING)),
    "NPZ of an organised structured array": ("a.npz", npz(a=STRUCTURED.reshape(4, 3)), Reads(ring=RING)),
    "NPZ of N x 4": ("a.npz", npz(arr_0=FLOATS), Reads(ring="none", said="the first three of 4 unnamed columns are taken as x, y, z")),
    "NPZ with a note of Python": ("a.npz", npz(xyz=XYZ, note=np.array([{"a": 1}], dtype=object)), Reads(said="array 'note.npy' holds Python objects; it is passed over")),
    "NPZ with a matrix beside": ("a.npz", npz(xyz=XYZ, T=np.eye(4)), Reads()),
    "NPZ with points of Python": ("a.npz", npz(xyz=np.array([{}], dtype=object)), no("'xyz.npy' holds Python objects; expected numbers")),
    "NPZ with nothing of use": ("a.npz", npz(images=np.zeros((2, 2, 2))), no("expected columns x, y, z, or one of N x 3", "found: images")),
    "NPY structured": ("a.npy", npy(STRUCTURED), Reads(ring=RING, time=TIME)),
    "NPY of N x 3": ("a.npy", npy(XYZ), Reads(ring="none")),
    "NPY of N x 4": ("a.npy", npy(FLOATS), Reads(said="the first three of 4 unnamed columns")),
    "NPY with names": ("a.npy", npy(np.column_stack([XYZ, INTENSITY, RING])), Reads(ring=RING, intensity=INTENSITY, columns="x,y,z,intensity,ring")),
    "NPY of an organised cloud": ("a.npy", npy(XYZ.reshape(4, 3, 3)), Reads(ring=RING, sensor=True)),
    "NPY of Python": ("a.npy", npy(np.array([{}], dtype=object)), no("holds Python objects")),
    "NPY cut off": ("a.npy", npy(XYZ)[:-9], no("promises 288 bytes of data, 279 are there")),
    "KITTI": ("a.bin", FLOATS.tobytes(), Reads(ring=RING, intensity=INTENSITY)),
    "nuScenes": ("a.pcd.bin", np.column_stack([FLOATS, RING]).astype("<f4").tobytes(), Reads(ring=RING, intensity=INTENSITY)),
    "nuScenes under the shorter ending": ("a.bin", np.column_stack([FLOATS, RING]).astype("<f4").tobytes(), Reads(ring=RING)),
    "floats of another layout": ("a.bin", np.column_stack([XYZ, TIME, INTENSITY, RING]).astype("<f4").tobytes(), Reads(ring=RING, time=TIME, columns="x,y,z,t,intensity,ring")),
    "floats cut off": ("a.bin", FLOATS.tobytes()[:-2], no("190 bytes; expected 32-bit floats, four of a return (KITTI) or five (nuScenes)")),
    "bytes that are no floats": ("a.bin", b"\x7f\x45\x4c\x46" * 40, no("are not 5 or 4 32-bit floats a return", "--columns")),
    "a bag is no cloud": ("a.pcd", b"#ROSBAG V2.0\n", no("a bag, of many scans; expected one cloud")),
    "packets are no cloud": ("a.pcap", b"\xd4\xc3\xb2\xa1" + bytes(20), no("captured packets (pcap), of many scans; expected one cloud")),
}  # fmt: skip


@pytest.mark.parametrize("name", CLOUDS)
def test_clouds(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, content, expected = CLOUDS[name]
    path = tmp_path / file
    path.write_bytes(content)
    sensor = VLP16 if expected.sensor else None
    columns = expected.columns.split(",") if expected.columns else None
    if isinstance(expected, Refused):
        refused(lambda: read_scan(path, sensor, columns), path, expected)
        return
    with caplog.at_level(logging.INFO):
        scan = read_scan(path, sensor, columns)
    np.testing.assert_allclose(scan.points, XYZ, rtol=0, atol=2e-6)  # as written: six digits, or 32 bits
    for found, wanted in ((scan.ring, expected.ring), (scan.time, expected.time), (scan.intensity, expected.intensity)):
        if isinstance(wanted, str):
            assert found is None
        elif wanted is not None:
            assert found is not None
            np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-6)
    assert expected.said in caplog.text


def refused(read: Callable[[], object], path: Path, expected: Refused) -> None:
    with pytest.raises(InputError) as raised:
        read()
    message = str(raised.value)
    assert str(path) in message
    assert "\n" not in message
    at = 0
    for part in expected.parts:
        assert part in message[at:], message
        at = message.index(part, at) + len(part)


BODIES = (
    "Format Version,1.23,Capture Frame Rate,120,Export Frame Rate,120,Length Units,Meters\n\n,Type,{kind},{kind},{kind},{kind},{kind},{kind},{kind}\n"
    ",Name,Board,Board,Board,Board,Board,Board,Board\n,ID,1,1,1,1,1,1,1\n,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position\n"
    "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z\n0,0.0,0,0,0,1,1,2,3\n"
)  # fmt: skip

# Trajectories

T0, T1 = "0 1 2 3 0.5 0.5 0.5 0.5", "0.1 1.5 2 3 0 0 0.6 0.8"
TUM = f"{T0}\n{T1}\n"
WXYZ = "0,1,2,3,0.5,0.5,0.5,0.5\n{t},1.5,2,3,0.8,0,0,0.6\n"
EUROC = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
LATER = "1700000000000000000,1,2,3,0.5,0.5,0.5,0.5\n1700000000100000000,1.5,2,3,0.8,0,0,0.6\n"
MANY = "".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(1, 30))

TRAJECTORIES: dict[str, tuple[str, str, int | Refused, str]] = {
    "TUM": ("a.tum", TUM, 2, ""),
    "TUM as text": ("groundtruth.txt", "# ground truth\n# timestamp tx ty tz qx qy qz qw\n" + TUM, 2, ""),
    "TUM without an ending": ("poses", TUM, 2, ""),
    "TUM with commas": ("a.csv", TUM.replace(" ", ","), 2, ""),
    "TUM with line ends of Windows": ("a.txt", TUM.replace("\n", "\r\n"), 2, ""),
    "TUM with names that are no comment": ("a.csv", "timestamp,tx,ty,tz,qx,qy,qz,qw\n" + TUM.replace(" ", ","), 2, ""),
    "w first, as the names say": ("a.csv", "time,x,y,z,qw,qx,qy,qz\n" + WXYZ.format(t=0.1), 2, ""),
    "w first, as a comment says": ("a.txt", "# t x y z qw qx qy qz\n" + WXYZ.format(t=0.1).replace(",", " "), 2, ""),
    "EuRoC": ("data.csv", EUROC + LATER, 2, ""),
    "EuRoC with velocities and biases": ("data.csv", EUROC.rstrip("\n") + ", v_RS_R_x [m s^-1], b_w_x [rad s^-1]\n" + LATER.replace("\n", ",9,9\n"), 2, ""),
    "millimetres, as the names say": ("a.csv", "time [s],x [mm],y [mm],z [mm],qx,qy,qz,qw\n0,1000,2000,3000,0.5,0.5,0.5,0.5\n0.1,1500,2000,3000,0,0,0.6,0.8\n", 2, ""),
    "columns in another order": ("a.csv", "qx,qy,qz,qw,x,y,z,stamp\n0.5,0.5,0.5,0.5,1,2,3,0\n0,0,0.6,0.8,1.5,2,3,0.1\n", 2, ""),
    "a column that nobody needs": ("a.csv", "seq,time,x,y,z,qx,qy,qz,qw,cov\n7,0,1,2,3,0.5,0.5,0.5,0.5,1\n8,0.1,1.5,2,3,0,0,0.6,0.8,1\n", 2, ""),
    "nanoseconds in TUM": ("a.txt", "1700000000000000000 1 2 3 0.5 0.5 0.5 0.5\n1700000000100000000 1.5 2 3 0 0 0.6 0.8\n", 2, ""),
    "names between commas, with blanks": ("a.csv", "Time (s),Position X (m),Position Y (m),Position Z (m),Rotation X,Rotation Y,Rotation Z,Rotation W\n" + TUM.replace(" ", ","), 2, ""),
    "rostopic echo -p": ("odom.csv", "%time,field.header.seq,field.pose.pose.position.x,field.pose.pose.position.y,field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,field.pose.pose.orientation.z,field.pose.pose.orientation.w\n1700000000000000000,1,1,2,3,0.5,0.5,0.5,0.5\n1700000000100000000,2,1.5,2,3,0,0,0.6,0.8\n", 2, ""),
    "PlotJuggler": ("odom.csv", "__time,/odom/pose/pose/position/x,/odom/pose/pose/position/y,/odom/pose/pose/position/z,/odom/pose/pose/orientation/x,/odom/pose/pose/orientation/y,/odom/pose/pose/orientation/z,/odom/pose/pose/orientation/w\n" + TUM.replace(" ", ","), 2, ""),
    "a stamp twice": ("a.txt", f"{T0}\n{T0}\n{T1}\n", 2, "1 of 3 lines are no pose and left out, the first:"),
    "a stamp that goes back": ("a.txt", MANY + "3 0 0 0 0 0 0 1\n", 29, "1 of 30 lines"),
    "a line cut off at the end": ("a.txt", MANY + "30 0 0", 29, "expected 8 numbers, found 3 words"),
    "a pose that is no number": ("a.txt", MANY + "31 nan nan nan 0 0 0 1\n", 29, "nan is not a finite number"),
    "a lost frame of zeros": ("a.txt", MANY + "31 0 0 0 0 0 0 0\n", 29, "has norm 0; expected 1"),
    "Motive's rigid body": ("take.csv", BODIES.format(kind="Rigid Body"), 1, ""),
    "KITTI": ("00.txt", "1 0 0 1 0 1 0 2 0 0 1 3\n" * 3, no("twelve numbers a line are KITTI's poses, which have no stamps"), ""),
    "nanoseconds in an order that nothing tells": ("a.csv", LATER, no(":1: stamps in nanoseconds", "whether w is the first or the last", "#timestamp, p_x"), ""),
    "roll, pitch and yaw": ("a.csv", "time,x,y,z,roll,pitch,yaw\n0,1,2,3,0,0,0\n", no("expected quaternions, x y z w"), ""),
    "nothing but words": ("a.txt", "once upon\na time\n", no(":1: could not convert string to float: 'once'"), ""),
    "half of the lines are bad": ("a.txt", f"{T0}\n1 2\n{T1}\n3 4\n", no(":2: expected 8 numbers, found 2 words"), ""),
    "quaternions that are none": ("a.txt", "0 0 0 0 1 1 1 1\n1 0 0 0 1 1 1 1\n", no(":1: quaternion [1.0, 1.0, 1.0, 1.0] has norm 2; expected 1"), ""),
    "an unknown unit of length": ("a.csv", "time,x [mi],y [mi],z [mi],qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n", no("unit of length 'mi'; expected one of m, "), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_trajectories(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, content, expected, said = TRAJECTORIES[name]
    path = tmp_path / file
    path.write_text(content, newline="")
    if isinstance(expected, Refused):
        refused(lambda: read_trajectory(path), path, expected)
        return
    found = read_trajectory(path)
    assert found.stamps is not None
    assert len(found) == expected
    assert said in caplog.text
    if expected == 2:
        np.testing.assert_allclose(found.stamps - found.stamps[0], [0, 0.1], rtol=0, atol=3e-7)  # 64 bits at 1.7e9 s
        np.testing.assert_allclose(found.poses[:, :3, 3], [[1, 2, 3], [1.5, 2, 3]], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.poses[0, :3, :3], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.poses[1, :2, :2], [[0.28, -0.96], [0.96, 0.28]], rtol=0, atol=1e-12)


# Motion capture

TRC = (
    "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    "100\t100\t2\t2\tmm\t100\t1\t2\nFrame#\tTime\tA\t\t\tB\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
    "1\t0.000\t1000\t2000\t3000\t4000\t5000\t6000\n2\t0.010\t1000\t2000\t3000\t\t\t\n"
)  # fmt: skip
MOCAP: dict[str, tuple[str, str, tuple[str, ...] | Refused, str]] = {
    "TRC": ("a.trc", TRC, ("A", "B"), ""),
    "TRC as text": ("a.txt", TRC, ("A", "B"), ""),
    "TRC with a label twice": ("a.trc", TRC.replace("\tB\t", "\tA\t"), ("A",), "several markers are called A; the first of each is read"),
    "TRC of another unit": ("a.trc", TRC.replace("\tmm\t", "\tfurlongs\t"), no("unit of length 'furlongs'"), ""),
    "TRC that is none": ("a.trc", "hello\n", no("expected the lines of a TRC file"), ""),
    "Motive with bodies and markers": ("a.csv", motive_csv(), ("corner0", "corner1", "corner2", "corner3"), ""),
    "Motive with bodies only": ("a.csv", BODIES.format(kind="Rigid Body"), no("no markers in it, but rigid bodies: Board", "--odometry"), ""),
    "Motive with nothing": ("a.csv", BODIES.format(kind="Bone"), no("no markers and no rigid bodies in it"), ""),
    "Motive with unlabeled markers": ("a.csv", motive_csv().replace("corner3", "Unlabeled 1234"), ("corner0", "corner1", "corner2"), ""),
    "Motive with a label twice": ("a.csv", motive_csv().replace("corner3", "corner0"), ("corner0", "corner1", "corner2"), "several markers are called corner0"),
    "Vicon with a label twice": ("a.csv", vicon_csv().replace("corner3", "corner0"), ("corner0", "corner1", "corner2"), "several markers are called"),
    "a spreadsheet": ("a.xlsx", "", no("motion capture is read from .c3d, .mat, "), ""),
    "a table of another program": ("a.csv", "a,b\n1,2\n", no("neither Motive's CSV", "nor Vicon's", "nor Qualisys'"), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", MOCAP)
def test_motion_capture(name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, content, expected, said = MOCAP[name]
    path = tmp_path / file
    path.write_text(content, newline="")
    if isinstance(expected, Refused):
        refused(lambda: read_mocap(path), path, expected)
        return
    found = read_mocap(path)
    assert tuple(marker.rpartition(":")[2] for marker in found.markers) == expected
    assert said in caplog.text
    assert found.passed_over.get(UNLABELLED, 0) == (name == "Motive with unlabeled markers")
    if name.startswith("TRC"):
        np.testing.assert_allclose(found.positions[0, 0], [1, 2, 3], rtol=0, atol=1e-12)
        np.testing.assert_allclose(found.times, [0, 0.01], rtol=0, atol=1e-12)


# Sensors

OUSTER = {
    "beam_intrinsics": {"beam_altitude_angles": [10, 0, -10], "beam_azimuth_angles": [3, 0, -3]},
    "lidar_data_format": {"columns_per_frame": 1024},
}
LASERS = "lasers:\n" + "".join(
    f"- {{laser_id: {k}, rot_correction: {r}, vert_correction: {v}, vert_offset_correction: 0.0}}\n"
    for k, (v, r) in enumerate([(0.1, 0.01), (-0.1, -0.02), (0.0, 0.0)])
)
SENSORS: dict[str, tuple[str, str, tuple[Any, Any, Any] | Refused]] = {
    "Ouster, nested": ("a.json", json.dumps(OUSTER), ([-10, 0, 10], [3, 0, -3], 360 / 1024)),
    "Ouster, flat": ("a.json", json.dumps({**OUSTER["beam_intrinsics"], "lidar_mode": "2048x10", "prod_sn": "1"}), ([-10, 0, 10], [3, 0, -3], 360 / 2048)),
    "Ouster without a mode": ("a.json", json.dumps({"beam_altitude_angles": [1, 0]}), ([0, 1], None, None)),
    "Ouster with angles that fit not": ("a.json", json.dumps({"beam_altitude_angles": [1, 0], "beam_azimuth_angles": [1]}), no("beam_azimuth_angles: expected 2 angles")),
    "Ouster beyond the zenith": ("a.json", json.dumps({"beam_altitude_angles": [100, 0]}), no("elevation 100 deg; expected all within 90")),
    "Velodyne": ("a.yaml", LASERS + "num_lasers: 3\ndistance_resolution: 0.002\n", (np.degrees([-0.1, 0, 0.1]), np.degrees([-0.02, 0, 0.01]), None)),
    "Velodyne without a laser": ("a.yaml", "lasers: []\n", no("lasers: expected at least one laser")),
    "Velodyne without an angle": ("a.yaml", "lasers:\n- {laser_id: 0}\n", no("lasers[0]: the key 'vert_correction' is missing")),
    "Hesai": ("a.csv", "Laser id,Elevation,Azimuth\n1,10,2\n2,0,-1\n3,-10,0.5\n", ([-10, 0, 10], [-0.5, 1, -2], None)),
    "Hesai with its mark": ("a.csv", "EEFF,1,5\nChannel,Elevation,Azimuth\n1,10,2\n2,-10,0\n", ([-10, 10], [0, -2], None)),
    "RoboSense": ("angle.csv", "10,2\n0,-1\n-10,0.5\n", ([-10, 0, 10], [-0.5, 1, -2], None)),
    "RoboSense, elevations alone": ("angle.csv", "10\n0\n-10\n", ([-10, 0, 10], None, None)),
    "a CSV of something else": ("a.csv", "a,b\nc,d\n", no("expected a maker's angles, a line of channel,elevation,azimuth (Hesai)")),
    "Velodyne's XML": ("db.xml", "<?xml version='1.0'?>", no("the calibration YAML of the ROS driver is read")),
    "this package's own": ("a.yaml", "schema: optshape/sensor/1\nelevations_deg: [-1, 0, 1]\n", ([-1, 0, 1], None, None)),
    "this package's own with a key of another": ("a.yaml", "schema: optshape/sensor/1\nelevations_deg: [-1, 0, 1]\nlasers: 3\n", no(":3: lasers: unknown key 'lasers'")),
}  # fmt: skip


@pytest.mark.parametrize("name", SENSORS)
def test_sensors(name: str, tmp_path: Path) -> None:
    file, content, expected = SENSORS[name]
    path = tmp_path / file
    path.write_text(content)
    if isinstance(expected, Refused):
        refused(lambda: load_sensor(path), path, expected)
        return
    elevations, offsets, step = expected
    sensor = load_sensor(path)
    np.testing.assert_allclose(np.degrees(sensor.elevations), elevations, rtol=0, atol=1e-9)
    if offsets is None:
        assert sensor.azimuth_offsets is None
    else:
        assert sensor.azimuth_offsets is not None
        np.testing.assert_allclose(np.degrees(sensor.azimuth_offsets), offsets, rtol=0, atol=1e-9)
    assert sensor.azimuth_step == (None if step is None else pytest.approx(np.radians(step)))


# Cameras

CAMERAS: dict[str, tuple[str, str, list[float] | Refused]] = {
    "OpenCV with its first line": ("a.yaml", cameras.OPENCV, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "OpenCV in XML": ("a.xml", cameras.OPENCV_XML, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "ROS's INI": ("ost.ini", cameras.ROS_INI, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "ROS's INI as text": ("ost.txt", cameras.ROS_INI, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "EuRoC": ("sensor.yaml", cameras.EUROC, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "EuRoC with tags": ("sensor.yaml", cameras.EUROC.replace("T_BS:", "T_BS: !!opencv-matrix"), [0.1, -0.2, 0.001, 0.002, 0.05]),
    "Kalibr with a key of OpenVINS": ("a.yaml", cameras.ONE.replace("cam0:", "cam0:\n  T_imu_cam: [[1]]\n  timeshift_cam_imu: 0.1"), [0.1, -0.2, 0.001, 0.002]),
    "Kalibr with eight terms": ("a.yaml", cameras.ONE.replace("0.001, 0.002]", "0.001, 0.002, 1, 2, 3, 4]"), [0.1, -0.2, 0.001, 0.002, 1, 2, 3, 4]),
    "ROS with zeros for twelve terms": ("a.yaml", cameras.ROS_FILE.replace("0.05]", "0.05, 0, 0, 0, 0, 0, 0, 0]"), [0.1, -0.2, 0.001, 0.002, 0.05, 0, 0, 0]),
    "ROS with a word misspelt by its own tool": ("a.yaml", cameras.ROS_FILE.replace("distortion_coefficients", "distortion_coefficents"), [0.1, -0.2, 0.001, 0.002, 0.05]),
    "numbers, each under its name": ("a.yaml", cameras.NUMBERS, [0.1, -0.2, 0.001, 0.002, 0.05]),
    "twelve terms": ("a.yaml", cameras.ROS_FILE.replace("0.05]", "0.05, 1, 2, 3, 4, 5, 6, 7]"), no("12 distortion coefficients, expected 0 or 4 or 5 or 8")),
    "omnidirectional": ("a.yaml", cameras.ONE.replace("camera_model: pinhole", "camera_model: omni"), no("camera_model: expected plumb_bob, ", "found 'omni'")),
    "without a size": ("a.yaml", cameras.NUMBERS.replace("image_width", "w"), no("intrinsics without the image's size; expected image_width")),
    "without a number": ("a.yaml", cameras.NUMBERS.replace("fy: 510\n", ""), no("the key 'fy' is missing")),
    "a projector": ("a.yaml", "projector: 3\n", no("expected intrinsics with 'schema: optshape/camera/1'", "found the keys: projector")),
    "aliases": ("a.yaml", "a: &x 1\nb: *x\n", no(":2: anchors and aliases are not read ('x')")),
}  # fmt: skip


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras(name: str, tmp_path: Path) -> None:
    file, content, expected = CAMERAS[name]
    path = tmp_path / file
    path.write_text(content)
    if isinstance(expected, Refused):
        refused(lambda: load_camera(path), path, expected)
        return
    camera = load_camera(path)
    np.testing.assert_array_equal(camera.K, [[500, 0, 320], [0, 510, 240], [0, 0, 1]])
    np.testing.assert_array_equal(camera.D, expected)


def test_there_are_enough() -> None:
    assert sum(map(len, (CLOUDS, TRAJECTORIES, MOCAP, SENSORS, CAMERAS))) >= 150


def test_names_for_an_array_that_has_fewer(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(npy(XYZ))
    with pytest.raises(InputError, match="4 columns are named, found 3"):
        read_npy(tmp_path / "a.npy", ["x", "y", "z", "ring"])
