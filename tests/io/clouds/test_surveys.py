"""LAS, LAZ and E57 against what laspy and pye57 wrote."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import read_scan

XYZ = np.array([[5.0, 0.1, -0.0873], [5.0, 0.2, 0.0873], [5.0, -0.1, 0.262], [4.0, 0.5, 0.1]])
RING = np.array([7, 8, 9, 8])


def las(path: Path, points: np.ndarray, point_format: int = 6) -> None:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=point_format, version="1.4")
    header.scales = [1e-4] * 3
    header.offsets = np.floor(points.min(axis=0))
    header.add_extra_dim(laspy.ExtraBytesParams(name="ring", type=np.uint16))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.intensity = 100 * RING
    cloud.gps_time = 1e-3 * np.arange(len(points))
    cloud["ring"] = RING
    cloud.write(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", [1, 6])
def test_las(tmp_path: Path, suffix: str, point_format: int) -> None:
    if suffix == ".laz":
        pytest.importorskip("lazrs")
    las(tmp_path / f"a{suffix}", XYZ, point_format)
    scan = read_scan(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(scan.points, XYZ, rtol=0, atol=5.1e-5)  # half of its step
    np.testing.assert_array_equal(scan.ring, RING)
    np.testing.assert_array_equal(scan.intensity, 100 * RING)
    np.testing.assert_allclose(scan.time, 1e-3 * np.arange(4), rtol=0, atol=1e-9)


def test_las_of_a_map_is_refused(tmp_path: Path) -> None:
    las(tmp_path / "a.las", XYZ + np.array([455_000, 5_411_000, 110]))
    with pytest.raises(
        InputError, match=r"a\.las: .*coordinates of a map \(UTM, \.\.\.\); expected metres from the LiDAR"
    ):
        read_scan(tmp_path / "a.las")


def e57(path: Path, points: np.ndarray) -> None:
    pye57 = pytest.importorskip("pye57")
    with pye57.E57(str(path), mode="w") as made:
        made.write_scan_raw({
            "cartesianX": points[:, 0], "cartesianY": points[:, 1], "cartesianZ": points[:, 2],
            "intensity": np.linspace(0, 1, len(points)), "rowIndex": RING.astype(np.uint16),
        })  # fmt: skip


def test_e57(tmp_path: Path) -> None:
    e57(tmp_path / "a.e57", XYZ)
    scan = read_scan(tmp_path / "a.e57")
    np.testing.assert_allclose(scan.points, XYZ, rtol=0, atol=1e-6)
    np.testing.assert_allclose(scan.intensity, np.linspace(0, 1, 4), rtol=0, atol=1e-6)


@pytest.mark.parametrize("suffix", [".las", ".laz", ".e57"])
def test_damage_costs_an_error(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pye57" if suffix == ".e57" else "laspy")
    begin = b"ASTM-E57" if suffix == ".e57" else b"LASF"
    (tmp_path / f"a{suffix}").write_bytes(begin + bytes(400))
    with pytest.raises(InputError, match=rf"a\{suffix}: not a readable {'e57' if suffix == '.e57' else 'las'} file"):
        read_scan(tmp_path / f"a{suffix}")


def test_a_header_that_promises_much_costs_an_error(tmp_path: Path) -> None:
    las(tmp_path / "a.las", XYZ)
    content = bytearray((tmp_path / "a.las").read_bytes())
    content[247:255] = (2_000_000_000).to_bytes(8, "little")  # points, of LAS 1.4
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.las: not a readable las file"):
        read_scan(tmp_path / "a.las")


@pytest.mark.parametrize("place", [100, 243])
def test_records_that_do_not_fit_are_not_looked_for(tmp_path: Path, place: int) -> None:
    las(tmp_path / "a.las", XYZ)
    content = bytearray((tmp_path / "a.las").read_bytes())
    content[place : place + 4] = b"\xff" * 4
    (tmp_path / "a.las").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.las: not a readable las file: .*its header counts 4294967295 records"):
        read_scan(tmp_path / "a.las")
