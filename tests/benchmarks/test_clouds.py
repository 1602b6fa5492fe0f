"""Reading a cloud of a million points: against NumPy's own reading and conversion, and against another library."""

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from optshape_graph import read_scan
from optshape_graph.io.clouds.pcd import write_pcd

N = 1_000_000
RINGS = 128


@pytest.fixture(scope="module")
def cloud(tmp_path_factory) -> Path:
    """A binary PCD file of returns in the order in which a spinning LiDAR of 128 rings makes them."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("clouds") / "million.pcd"
    azimuth, ring, distance = np.linspace(-np.pi, np.pi, N), np.arange(N) % RINGS, rng.uniform(1, 50, N)
    elevation = np.radians(0.35 * ring - 22)
    columns = {
        "x": distance * np.cos(elevation) * np.cos(azimuth),
        "y": distance * np.cos(elevation) * np.sin(azimuth),
        "z": distance * np.sin(elevation),
        "intensity": rng.integers(0, 256, N),
        "time": np.linspace(0, 0.1, N),
    }
    write_pcd(path, {name: values.astype("<f4") for name, values in columns.items()} | {"ring": ring.astype("<u2")})
    return path


def cpu_time(run: Callable[[], object]) -> float:
    """The median of five, after one that is not counted."""
    times = []
    for _ in range(6):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times[1:]))


@pytest.mark.benchmark
def test_binary_against_numpy(cloud):
    header = cloud.read_bytes().index(b"DATA binary\n") + 12
    dtype = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity", "time")] + [("ring", "<u2")])

    def numpy_alone():
        table = np.fromfile(cloud, dtype, offset=header)
        points = np.column_stack([table["x"], table["y"], table["z"]]).astype(np.float64)
        return (
            points,
            table["intensity"].astype(np.float64),
            table["time"].astype(np.float64),
            table["ring"].astype(int),
        )

    ratio = cpu_time(lambda: read_scan(cloud)) / cpu_time(numpy_alone)
    tracemalloc.start()
    read_scan(cloud)
    peak = tracemalloc.get_traced_memory()[1] / cloud.stat().st_size
    tracemalloc.stop()
    print(f"\n1 M points of binary PCD: {ratio:.2f} x NumPy's reading and conversion; peak {peak:.2f} x the file")
    assert ratio <= 2.5
    assert peak <= 3


@pytest.mark.benchmark
def test_compressed_against_pypcd4(cloud, tmp_path):
    packed = tmp_path / "packed.pcd"
    PointCloud.from_path(cloud).save(packed, encoding=Encoding.BINARY_COMPRESSED)

    def pypcd4_alone():
        return PointCloud.from_path(packed).numpy().astype(np.float64)

    ratio = cpu_time(lambda: read_scan(packed)) / cpu_time(pypcd4_alone)
    print(f"\n1 M points of compressed PCD: {ratio:.2f} x pypcd4")
    assert ratio <= 3
