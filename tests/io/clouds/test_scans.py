"""Scans out of clouds of every format, and what makes no scan."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from optshape_graph import InputError, Scan
from optshape_graph.io import Columns, load_sensor, make_scan, read_scan, write_scan
from optshape_graph.io.clouds.pcd import write_pcd
from tests.io.clouds.test_pcd import pcd
from tests.shared import SHARED, needs_shared

VLP16 = load_sensor("vlp16")
XYZ = np.array([[5.0, 0.1, -0.0873], [5.0, 0.2, 0.0873], [5.0, -0.1, 0.2620]])
"""At -1, 1 and 3 degrees of elevation."""


def columns(**values: Any) -> Columns:
    return Columns({"xyz": XYZ, **{name: np.asarray(column) for name, column in values.items()}}, name="cloud")


# Files


def test_the_same_cloud_from_every_format(tmp_path: Path) -> None:
    ring, time = np.array([7, 8, 9], "u2"), np.array([0.001, 0.002, 0.003], "f4")
    table = np.array(
        [(*p, 10.0 * r, r, t) for p, r, t in zip(XYZ, ring, time, strict=True)],
        dtype=[("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")],
    )
    for encoding in ("ascii", "binary", "binary_compressed"):
        (tmp_path / f"{encoding}.PCD").write_bytes(pcd(table, encoding))
    np.savez(tmp_path / "a.npz", xyz=XYZ, ring=ring, intensity=10.0 * ring, time=time)
    np.savez(tmp_path / "b.npz", x=XYZ[:, 0], y=XYZ[:, 1], z=XYZ[:, 2], RING=ring, Intensity=10.0 * ring, t=time)
    rows = [",".join(str(x) for x in row) for row in table]
    (tmp_path / "a.csv").write_text("\n".join(["x,y,z,intensity,ring,time", *rows]))
    kinds = [("double", "x"), ("double", "y"), ("double", "z"), ("float", "intensity"), ("ushort", "ring")]
    properties = "".join(f"property {kind} {name}\n" for kind, name in [*kinds, ("float", "time")])
    header = f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}"
    (tmp_path / "a.ply").write_text(header + "end_header\n" + "\n".join(row.replace(",", " ") for row in rows))
    paths = sorted(tmp_path.iterdir())
    assert len(paths) == 7
    for path in paths:
        scan = read_scan(path)
        np.testing.assert_array_equal(scan.points, XYZ)
        np.testing.assert_array_equal(scan.ring, ring)
        np.testing.assert_array_equal(scan.intensity, 10.0 * ring)
        np.testing.assert_allclose(scan.time, time, rtol=0, atol=1e-9)
        assert scan.name == str(path)


@given(
    npst.arrays("f8", st.tuples(st.integers(1, 20), st.just(3)), elements=st.floats(-250, 250)).filter(
        lambda points: bool((np.abs(points) > 1e-30).all())
    ),
    st.booleans(),
)
def test_written_is_read_back(tmp_path_factory: pytest.TempPathFactory, points: Any, extras: bool) -> None:
    path = tmp_path_factory.mktemp("scan") / "a.pcd"
    n = len(points)
    scan = Scan(points, None, np.arange(n) if extras else None, np.linspace(-0.05, 0.05, n) if extras else None)
    write_scan(path, scan)
    found = read_scan(path)
    np.testing.assert_allclose(found.points, points, rtol=6e-8)  # 32-bit floats: half of 2^-23
    if extras:
        np.testing.assert_array_equal(found.intensity, scan.intensity)
        np.testing.assert_allclose(found.time, scan.time, rtol=6e-8)
    else:
        assert found.intensity is None
        assert found.time is None


def test_the_columns_that_were_given_stay() -> None:
    given = columns(ring=[7, 8, 9], time=[0.0, 0.1, 0.2])
    names = list(given.values)
    make_scan(given, VLP16)
    assert list(given.values) == names


def test_rings_are_written_and_read_back(tmp_path: Path) -> None:
    scan = make_scan(columns(ring=[7, 8, 9]), VLP16)
    write_scan(tmp_path / "a.pcd", scan)
    np.testing.assert_array_equal(read_scan(tmp_path / "a.pcd", VLP16).ring, [7, 8, 9])
    np.testing.assert_array_equal(read_scan(tmp_path / "a.pcd").ring, [7, 8, 9])


def test_rings_that_are_not_written(tmp_path: Path) -> None:
    for ring in (-1, 1 << 16):
        with pytest.raises(InputError, match=f"expected ring numbers as integers from 0, found {ring}"):
            write_scan(tmp_path / "a.pcd", Scan(XYZ, np.full(3, ring)))


def test_names_of_files(tmp_path: Path) -> None:
    (tmp_path / "a.xls").write_text("x,y,z")
    with pytest.raises(InputError, match=r"expected a cloud ending in \.pcd, \.ply, \.npz, .*, found '\.xls'"):
        read_scan(tmp_path / "a.xls")
    with pytest.raises(InputError, match=r"a\.pcd: no such file"):
        read_scan(tmp_path / "a.pcd")
    with pytest.raises(InputError, match=r"expected a name ending in \.pcd"):
        write_scan(tmp_path / "a.ply", Scan(XYZ))


# Points


def test_points_that_are_no_returns_go_with_all_their_fields() -> None:
    bad = [[np.nan, 0, 0], [0, 0, 0], [np.inf, 1, 1], [3.4e38, 3.4e38, 3.4e38], [0, 0, np.nan]]
    xyz = np.vstack([XYZ[:1], bad[:3], XYZ[1:2], bad[3:], XYZ[2:]])
    n = len(xyz)
    scan = make_scan(
        Columns({"xyz": xyz, "ring": np.arange(n), "intensity": np.arange(n), "t": np.arange(n, dtype="u4") * 1000})
    )
    np.testing.assert_array_equal(scan.points, XYZ)
    for values, factor in ((scan.ring, 1), (scan.intensity, 1), (scan.time, 1e-6)):
        np.testing.assert_allclose(values, np.array([0, 4, 7]) * factor)


def test_signalling_nans_are_nans() -> None:
    xyz = XYZ.astype("f4")
    xyz[1].view("u4")[:] = 0x7FA00000
    scan = make_scan(Columns({"xyz": xyz, "intensity": xyz[:, 0].copy(), "t": xyz[:, 0].copy()}))
    np.testing.assert_array_equal(scan.points, XYZ[[0, 2]].astype("f4"))


@pytest.mark.parametrize("dtype", ["i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8", ">u2"])
@pytest.mark.parametrize("name", ["ring", "channel", "line", "laser_id", "row", "Ring", "CHANNEL"])
def test_names_and_types_of_rings(name: str, dtype: str) -> None:
    np.testing.assert_array_equal(make_scan(columns(**{name: np.array([7, 8, 9], dtype)}), VLP16).ring, [7, 8, 9])


def test_rings_of_an_organised_cloud() -> None:
    azimuth, ring = np.meshgrid(np.linspace(-0.2, 0.2, 5), np.arange(15, -1, -1))
    elevation = VLP16.elevations[ring]
    xyz = 8 * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    xyz[3, 2] = 0  # no return, whose place counts all the same
    there = (xyz != 0).any(axis=-1)
    by_rows = make_scan(Columns({"xyz": xyz.reshape(-1, 3)}, height=16), VLP16)
    np.testing.assert_array_equal(by_rows.ring, ring[there])
    by_columns = make_scan(Columns({"xyz": xyz.swapaxes(0, 1).reshape(-1, 3)}, height=5), VLP16)
    np.testing.assert_array_equal(by_columns.ring, ring.T[there.T])
    assert make_scan(Columns({"xyz": xyz.reshape(-1, 3)}, height=16)).ring is None
    shuffled = np.random.default_rng(1).permutation(80)
    by_elevation = make_scan(Columns({"xyz": xyz.reshape(-1, 3)[shuffled]}, height=16), VLP16)
    np.testing.assert_array_equal(by_elevation.ring, ring.ravel()[shuffled][there.ravel()[shuffled]])


def test_rings_from_elevations_or_none() -> None:
    np.testing.assert_array_equal(make_scan(columns(), VLP16).ring, [7, 8, 9])
    assert make_scan(columns()).ring is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"cloud: expected columns x, y, z, or one of .*; found: none"),
        ({"x": np.ones(3), "y": np.ones(3)}, "expected columns x, y, z, or one .*; found: x, y"),
        ({"x": np.ones(3), "y": np.ones(3), "z": np.ones(2)}, "expected x, y, z as numbers, as many of each"),
        ({"x": np.ones(3), "y": np.ones(3), "z": np.array(["a", "b", "c"])}, "expected x, y, z as numbers"),
        ({"xyz": np.ones((3, 4))}, r"'xyz' is float64 of shape \(3, 4\), expected N x 3 numbers"),
        ({"points": np.ones((3, 3), complex)}, "'points' is complex128 of shape"),
        ({"xyz": np.ones((0, 3))}, r"no returns \(0 points"),
        ({"xyz": np.zeros((4, 3))}, r"no returns \(4 points, all at the origin, not finite, or out of reach\)"),
        ({"xyz": np.full((4, 3), np.nan)}, r"no returns \(4 points"),
        (
            {"xyz": XYZ * 1000},
            r"half of the returns are beyond 500\d m; expected metres from the LiDAR \(millimetres, or",
        ),
        ({"xyz": XYZ, "ring": np.arange(4)}, r"expected 'ring' as 3 numbers, found int64 of shape \(4,\)"),
        ({"xyz": XYZ, "ring": np.array(["a", "b", "c"])}, "expected 'ring' as 3 numbers, found <U1"),
        ({"xyz": XYZ, "ring": [1.5, 2, 3]}, r"expected ring numbers as integers from 0, found 1\.5"),
        ({"xyz": XYZ, "ring": [1, np.nan, 3]}, "expected ring numbers as integers from 0, found nan"),
        ({"xyz": XYZ, "ring": [1, -1, 3]}, "expected ring numbers as integers from 0, found -1"),
        ({"xyz": XYZ, "ring": np.array([1, 2, 2**63], "u8")}, "expected ring numbers as integers from 0, found 9223"),
        ({"xyz": XYZ, "intensity": np.arange(2)}, "expected 'intensity' as 3 numbers"),
        ({"xyz": XYZ, "time": np.array(["a", "b", "c"])}, "expected 'time' as 3 numbers"),
    ],
)
def test_columns_that_make_no_scan(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_scan(Columns({name: np.asarray(column) for name, column in values.items()}))


# Time

EPOCH = 1_700_000_000


@pytest.mark.parametrize(
    ("time", "stamp", "expected"),
    [
        (np.array([-0.05, 0.0, 0.05], "f4"), None, [-0.05, 0, 0.05]),  # Velodyne: seconds around the stamp
        (np.array([0, 50_000_000, 99_999_999], "u4"), None, [0, 0.05, 0.099999999]),  # Ouster, Livox: ns
        (np.array([1_000_000, 2_000_000, 3_000_000], "u4"), 5.0, [0.001, 0.002, 0.003]),  # the same, of a few degrees
        (EPOCH + np.array([0.0, 0.05, 0.1]), None, [0, 0.05, 0.1]),  # Hesai, RoboSense: seconds since 1970
        (EPOCH + np.array([0.0, 0.05, 0.1]), EPOCH + 0.1, [-0.1, -0.05, 0]),
        (EPOCH * 10**9 + np.array([0, 5 * 10**7, 10**8]), None, [0, 0.05, 0.1]),  # ns since 1970
        (EPOCH * 10**9 + np.array([0, 5e7, 1e8]), EPOCH, [0, 0.05, 0.1]),  # Livox: the same as floats
        ((EPOCH * 10**6 + np.array([0, 50_000, 100_000])).astype("u8"), EPOCH, [0, 0.05, 0.1]),  # us
        (EPOCH * 10**3 + np.array([0.0, 50.0, 100.0]), EPOCH, [0, 0.05, 0.1]),  # ms
        (3.6e9 - np.array([1e5, 5e4, 0.0]), None, [0, 0.05, 0.1]),  # VeloView: us since the hour
        (np.array([0.0, 50.0, 100.0]), None, [0, 0.05, 0.1]),  # ms, as floats
        (np.array([0.0, 5e4, 1e5]), None, [0, 0.05, 0.1]),  # us, as floats
        (np.array([0.0, 5e7, 1e8]), None, [0, 0.05, 0.1]),  # ns, as floats
        (np.array([1000.0, 1000.05, 1000.1]), None, [0, 0.05, 0.1]),  # seconds since the sensor was switched on
    ],
)
@pytest.mark.parametrize("name", ["t", "time", "timestamp", "time_offset", "offset_time"])
def test_times(name: str, time: Any, stamp: float | None, expected: list[float]) -> None:
    scan = make_scan(columns(**{name: time}), stamp=stamp)
    # A 64-bit float holds 1.7e9 s to 0.24 us, and 1.7e18 ns to 256 ns; 0.1 s in 32 bits are good to 4 ns.
    np.testing.assert_allclose(scan.time, expected, rtol=0, atol=1e-6)


def test_integers_since_1970_keep_their_nanoseconds() -> None:
    scan = make_scan(columns(t=EPOCH * 10**9 + np.array([1, 2, 4])))
    np.testing.assert_allclose(scan.time, [0, 1e-9, 3e-9], rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_times_that_are_none(caplog: pytest.LogCaptureFixture, bad: float) -> None:
    with caplog.at_level(logging.WARNING):
        assert make_scan(columns(time=[0.0, bad, 0.1])).time is None
    assert "cloud: times of points that are not times; read without them" in caplog.text


# Real recordings


@needs_shared
def test_real_recordings() -> None:
    vlp32c = load_sensor("vlp32c")
    paths = sorted((SHARED / "data" / "mocap").rglob("*.pcd"))
    assert len(paths) == 10
    for path in paths:
        scan = read_scan(path, vlp32c)
        elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
        assert scan.ring is not None
        # Coordinates are rounded to 1e-6 m: 1.6e-5 deg at 2 m.
        np.testing.assert_allclose(elevation, vlp32c.elevations[scan.ring], rtol=0, atol=np.radians(3e-5))
        np.testing.assert_array_equal(read_scan(path).ring, scan.ring)
        with pytest.raises(InputError, match="do not fit the table of vlp16"):
            read_scan(path, VLP16)


@needs_shared
def test_real_full_scans() -> None:
    for pose in (1, 20):
        path = SHARED / "data" / "camera" / "scans" / f"pose{pose:02d}_full.pcd"
        scan = read_scan(path, VLP16)
        assert len(scan) > 20_000
        assert scan.intensity is not None
        assert scan.ring is not None
        np.testing.assert_array_equal(np.unique(scan.ring), np.arange(16))
        with pytest.raises(InputError, match="do not fit the table of vlp32c"):
            read_scan(path, load_sensor("vlp32c"))


@needs_shared
def test_reference_clouds_are_numbered_by_elevation() -> None:
    sensor = load_sensor(SHARED / "reference" / "reference_simulator.sensor.yaml")
    with np.load(SHARED / "reference" / "sim_noisefree_clouds.npz", allow_pickle=False) as arrays:
        names = [name.removesuffix("_pts") for name in arrays.files if name.endswith("_pts")]
        clouds = {name: (arrays[f"{name}_pts"], arrays[f"{name}_ring"]) for name in names}
    assert len(clouds) == 40
    for name, (points, ids) in clouds.items():
        scan = make_scan(Columns({"pts": points, "ring": ids}, name=name), sensor)
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        assert scan.ring is not None
        # The table is given to 1e-3 deg.
        np.testing.assert_allclose(elevation, sensor.elevations[scan.ring], rtol=0, atol=np.radians(6e-4))
        by_elevation = make_scan(Columns({"pts": points}, name=name), sensor)
        np.testing.assert_array_equal(by_elevation.ring, scan.ring)


def test_big_endian_and_odd_layouts(tmp_path: Path) -> None:
    scan = make_scan(Columns({"xyz": XYZ.reshape(1, 3, 3).astype(">f4"), "ring": np.array([[7, 8, 9]], ">i4")}), VLP16)
    np.testing.assert_array_equal(scan.ring, [7, 8, 9])
    write_pcd(tmp_path / "a.pcd", {"x": XYZ[:, 0].astype(">f4"), "y": XYZ[:, 1], "z": XYZ[:, 2]})
    np.testing.assert_allclose(read_scan(tmp_path / "a.pcd").points, XYZ, rtol=6e-8)
