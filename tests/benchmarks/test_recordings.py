"""Reading a bag of full-size scans: against the time it took to record, and against rosbags alone."""

import resource
import time

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from optshape_graph.io import load_sensor
from optshape_graph.io.recordings import Recording
from tests.io.recordings.writing import LAYOUTS, maker, write_bag

SCANS = 120
"""12 s of a LiDAR at 10 Hz."""


def full_scan(seed: int) -> np.ndarray:
    """One revolution of a VLP-32C: 32 rings of 1800 returns, as the Velodyne driver sends them."""
    sensor = load_sensor("vlp32c")
    rng = np.random.default_rng(seed)
    azimuth, ring = (a.ravel() for a in np.meshgrid(np.linspace(-np.pi, np.pi, 1800), np.arange(32), indexing="ij"))
    made = np.zeros(len(ring), LAYOUTS["velodyne"])
    distance = rng.uniform(2, 60, len(ring))
    elevation = sensor.elevations[ring]
    made["x"] = distance * np.cos(elevation) * np.cos(azimuth)
    made["y"] = distance * np.cos(elevation) * np.sin(azimuth)
    made["z"] = distance * np.sin(elevation)
    made["ring"], made["time"] = ring, np.linspace(0, 0.1, len(ring))
    return made


@pytest.mark.benchmark
@pytest.mark.parametrize("storage", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("known", [False, True])
def test_bag_throughput(tmp_path, storage, known):
    make, cloud = maker(storage), full_scan(0)
    path = write_bag(tmp_path, storage, (("/points", make.cloud(1.7e9 + k * 0.1, cloud)) for k in range(SCANS)))
    recording, sensor = Recording(path), load_sensor("vlp32c") if known else None

    start, size = time.perf_counter(), 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            size += len(reader.deserialize(data, connection.msgtype).data)
    raw = time.perf_counter() - start

    start = time.perf_counter()
    assert sum(len(scan.value) for scan in recording.scans(sensor=sensor)) == SCANS * len(cloud)
    decoded = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"\n{storage}, sensor {'known' if known else 'unknown'}: {SCANS} scans of {len(cloud)} returns, "
        f"{size / 1e6:.0f} MB: {decoded / SCANS * 1e3:.1f} ms a scan, {SCANS / 10 / decoded:.1f} x real time, "
        f"{decoded / raw:.1f} x rosbags alone; peak memory {peak:.0f} MB"
    )
