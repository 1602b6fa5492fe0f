"""Packets written by hand as the manuals have them: what the decoders make of them, captured and in bags."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.errors import MissingExtraError
from optshape_graph.io import load_sensor
from optshape_graph.io.recordings import Recording, packets
from optshape_graph.io.recordings.packets import PACKET_BYTES, is_capture
from tests.io.recordings.writing import maker, write_bag
from tests.io.refusal import read_or_refused
from tests.shared import SHARED, needs_shared

RANGE = 10.0
FIRING_S = 55.296e-6
VLP16_ORDER = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
"""Ring of each laser in the order of firing (user manual 63-9243, table 9-1)."""


def velodyne(revolutions: float) -> list[tuple[float, bytes]]:
    """Data packets of a VLP-16 at 10 revolutions a second: twelve blocks of two firings; everything 10 m away."""
    packets = []
    azimuth, seconds = 0.0, 0.0
    while azimuth < 360 * revolutions:
        start, blocks = seconds, b""
        for _ in range(12):
            blocks += struct.pack("<HH", 0xEEFF, round(azimuth % 360 * 100) % 36000)
            for _ in range(2):
                blocks += b"".join(struct.pack("<HB", round(RANGE / 0.002), 10 + laser) for laser in range(16))
                azimuth, seconds = azimuth + 0.2, seconds + FIRING_S
        packets.append((1000.0 + start, blocks + struct.pack("<IBB", round(start * 1e6), 0x37, 0x22)))
    assert all(len(data) == PACKET_BYTES for _, data in packets)
    return packets


def pcap(packets: list[tuple[float, bytes]]) -> bytes:
    """A capture of UDP packets (Ethernet, IPv4)."""
    content = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for stamp, data in packets:
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(data), 0) + data
        ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes(4), bytes(4)) + udp
        frame = bytes(12) + b"\x08\0" + ip
        content += struct.pack("<IIII", int(stamp), int(stamp % 1 * 1e6), len(frame), len(frame)) + frame
    return content


def looks_right(points: np.ndarray, ring: np.ndarray) -> None:
    sensor = load_sensor("vlp16")
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    # The decoder puts the beams where they start: 42 mm from the axis, 11 mm above or below the centre.
    np.testing.assert_allclose(elevation, sensor.elevations[ring], rtol=0, atol=np.radians(0.1))
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RANGE, rtol=0, atol=0.05)


def test_a_capture(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    (tmp_path / "a.pcap").write_bytes(pcap(velodyne(3)))
    recording = Recording(tmp_path / "a.pcap")
    assert [(topic.kind, topic.type) for topic in recording.topics] == [("scan", "Velodyne packets")]
    scans = list(recording.scans(None, load_sensor("vlp16")))
    assert len(scans) == 3
    for scan in scans:
        assert scan.value.ring is not None
        assert scan.value.time is not None
        looks_right(scan.value.points, scan.value.ring)
        assert np.bincount(scan.value.ring).min() > 1700
        # A revolution takes 0.1 s, and the times of its returns run with their azimuth, clockwise.
        assert np.ptp(scan.value.time) == pytest.approx(0.1, abs=0.002)
    middle = scans[1].value
    azimuth = np.unwrap(-np.arctan2(middle.points[:, 1], middle.points[:, 0]))
    turned = np.polyfit(azimuth[200:-200], middle.time[200:-200], 1)[0]
    assert turned == pytest.approx(FIRING_S / np.radians(0.2), rel=0.02)
    assert np.diff([scan.stamp for scan in scans]) == pytest.approx(0.0995, abs=0.002)  # whole packets


@pytest.mark.parametrize("storage", ["ros1", "mcap"])
def test_packets_in_a_bag(tmp_path: Path, storage: str) -> None:
    pytest.importorskip("velodyne_decoder")
    make = maker(storage)
    packet, header = make["velodyne_msgs/msg/VelodynePacket"], make.header
    sent = []
    packets = velodyne(2)
    for k in range(2):
        chosen = packets[k * 75 : (k + 1) * 75]
        made = [packet(header(stamp).stamp, np.frombuffer(data, np.uint8)) for stamp, data in chosen]
        sent.append(("/velodyne_packets", make["velodyne_msgs/msg/VelodyneScan"](header(chosen[-1][0]), made)))
    recording = Recording(write_bag(tmp_path, storage, sent))
    stream = recording.scans(None, load_sensor("vlp16"))
    scans = list(stream)
    assert not stream.skipped
    assert len(scans) == 2
    for scan in scans:
        assert scan.value.ring is not None
        looks_right(scan.value.points, scan.value.ring)
        assert len(scan.value) == 75 * 12 * 32
        assert scan.value.time is not None
        assert np.ptp(scan.value.time) == pytest.approx(75 * 24 * FIRING_S, rel=0.01)


def test_captures_that_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    other = tmp_path / "other.pcap"
    other.write_bytes(pcap([(1.0, bytes(1248))] * 3))
    with pytest.raises(InputError, match=r"other\.pcap: packets \(3 of 1248 bytes\) of no LiDAR that is read here"):
        assert Recording(other).topics
    empty = tmp_path / "empty.pcap"
    empty.write_bytes(pcap([]))
    with pytest.raises(InputError, match=r"packets \(none\)"):
        assert Recording(empty).topics
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(pcap(velodyne(1))[:5000])
    scans = Recording(cut).scans()
    with read_or_refused(cut):
        list(scans)
    assert is_capture(cut)
    assert not is_capture(tmp_path)


def ouster(metadata: str, revolutions: int) -> list[bytes]:
    """Packets that the maker's library makes of frames in which everything is 5 m away."""
    core = pytest.importorskip("ouster.sdk.core")
    info = core.SensorInfo(metadata)
    width = info.format.columns_per_frame
    packets = []
    for k in range(revolutions):
        frame = core.LidarFrame(info)
        frame.field("RANGE")[:] = 5000
        frame.timestamp[:] = 1_000_000_000_000 + k * 100_000_000 + np.arange(width) * (100_000_000 // width)
        frame.status[:] = 1
        frame.measurement_id[:] = np.arange(width)
        frame.frame_id = 7 + k
        packets += [bytes(p.buf) for p in core.frame_to_packets(frame, core.PacketFormat(info), 0, 0)]
    return packets


@needs_shared
@pytest.mark.parametrize("where", ["pcap", "topic", "beside"])
def test_ouster(tmp_path: Path, where: str) -> None:
    metadata = (SHARED / "cases" / "files" / "15_ouster_metadata.json").read_text()
    sent = ouster(metadata, 2)
    if where != "topic":
        (tmp_path / "os1.json").write_text(metadata)
    if where == "pcap":
        path = tmp_path / "os1.pcap"
        path.write_bytes(pcap([(1000.0 + 0.001 * k, data) for k, data in enumerate(sent)]))
    else:
        make = maker("mcap")
        message = make["ouster_sensor_msgs/msg/PacketMsg"]
        items = [("/ouster/lidar_packets", message(np.frombuffer(data, np.uint8))) for data in sent]
        if where == "topic":
            items.insert(0, ("/ouster/metadata", make["std_msgs/msg/String"](metadata)))
        path = write_bag(tmp_path, "mcap", [*items, ("/ouster/imu_packets", message(np.zeros(48, np.uint8)))])
    (tmp_path / "unit.json").write_text(metadata)
    sensor = load_sensor(tmp_path / "unit.json")
    scans = list(Recording(path).scans(None, sensor))
    assert [scan.stamp for scan in scans] == pytest.approx([1000.0, 1000.1], abs=1e-6)
    for scan in scans:
        assert scan.value.ring is not None
        assert scan.value.time is not None
        assert len(np.unique(scan.value.ring)) == 128
        np.testing.assert_allclose(np.linalg.norm(scan.value.points, axis=1), 5.0, rtol=0, atol=0.05)


def test_without_ouster_sdk_the_message_says_how_to_install_it_beside_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ouster.sdk.core", None)
    with pytest.raises(MissingExtraError, match="pip install --no-deps ouster-sdk laspy") as caught:
        packets._ouster_sdk()
    assert "pip cannot install the extras 'ros' and 'ouster' together" in str(caught.value)
