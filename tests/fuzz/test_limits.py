"""Files that promise more than they hold: refused with little memory and in little time.

They are read in a process of its own that may take 600 MB beyond what the libraries took, so that a reader that
believes a promise fails here, not on somebody's machine.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

SECONDS = 60
MEGABYTES = 600

SCRIPT = """
import json, resource, sys, time
from pathlib import Path
from tests.fuzz.readers import READERS, furnish
import cv2, rosbags.rosbag1, rosbags.rosbag2, scipy.spatial.transform, optshape_graph.mapping, optshape_graph.simulation
from optshape_graph.errors import OptshapeError
taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + int(sys.argv[1]) * 2**20,) * 2)
said = {}
for reader, form, path in json.load(sys.stdin):
    start = time.perf_counter()
    try:
        next(f for f in READERS[reader].forms if f.name == form).read(Path(path))
        what = "read"
    except OptshapeError as error:
        what = str(error)
    except BaseException as error:
        what = f"WRONG {type(error).__name__}: {error}"
    said[path] = [what, time.perf_counter() - start]
print(json.dumps(said))
"""


def npz_bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (40000000, 3), }"
        header = header.ljust(128 - 11) + b"\n"
        with archive.open("points.npy", "w") as member:
            member.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
            for _ in range(960):
                member.write(bytes(1_000_000))


def png_bomb(path: Path) -> None:
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", 30000, 30000, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(10_000_000))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def text(value: str | bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(value.encode() if isinstance(value, str) else value)


PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA {kind}\n"
MANY = 10**12
AXES = "property double x\nproperty double y\nproperty double z\n"
PLY = f"ply\nformat {{}} 1.0\nelement vertex {MANY}\n{AXES}end_header\n"

PROMISES: dict[str, tuple[str, str, Callable[[Path], object]]] = {
    "binary PCD": ("pcd", "cloud.pcd", text(PCD.format(n=MANY, kind="binary") + "x" * 100)),
    "ascii PCD": ("pcd", "cloud.pcd", text(PCD.format(n=MANY, kind="ascii") + "1 2 3\n")),
    "compressed PCD": (
        "pcd", "cloud.pcd",
        text(PCD.format(n=350_000_000, kind="binary_compressed").encode() + struct.pack("<II9x", 9, 4_200_000_000)),
    ),
    "a point of many values": (
        "pcd", "cloud.pcd", text(PCD.format(n=1, kind="binary").replace("COUNT 1 1 1", "COUNT 1 1 99999") + "x" * 100),
    ),
    "binary PLY": ("ply", "cloud.ply", text(PLY.format("binary_little_endian"))),
    "ascii PLY": ("ply", "cloud.ply", text(PLY.format("ascii") + "1 2 3\n")),
    "NPZ that is nearly all air": ("npz", "cloud.npz", npz_bomb),
    "YAML of a million values": ("yaml", "target.yaml", text("a: [" + "1," * 1_000_000 + "1]\n")),
    "YAML nested deeply": ("yaml", "target.yaml", text("[" * 1_000_000)),
    "YAML of nested mappings": ("yaml", "scene.yaml", text("{a: " * 1_000_000)),
    "YAML with aliases of aliases": (
        "yaml", "target.yaml",
        text("a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12))),
    ),
    "metadata with aliases of aliases": (
        "bag", "folder/metadata.yaml",
        text("rosbag2_bagfile_information:\n  a0: &a0 [x]\n"
             + "".join(f"  a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12))),
    ),
    "metadata nested deeply": ("bag", "folder/metadata.yaml", text("[" * 200_000)),
    "JSON nested deeply": ("json", "any.json", text("[" * 1_000_000)),
    "JSON of nested mappings": ("json", "map.json", text('{"a":' * 1_000_000)),
    "an integer of a million digits": ("json", "map.json", text('{"schema": ' + "9" * 1_000_000 + "}")),
    "JSON with a key twice, the last of many": (
        "json", "any.json", text("{" + "".join(f'"{k}": 0, ' for k in range(300_000)) + '"0": 0}'),
    ),
    "motion capture of many markers, the last named twice": (
        "mocap", "a.tsv",
        text("FREQUENCY\t100\nMARKER_NAMES" + "".join(f"\t{k}" for k in [*range(100_000), 0]) + "\n" + "1\t" * 300_003),
    ),
    "an image of a thousand million pixels": ("image", "a.png", png_bomb),
    "a CSV line of a million names": ("csv", "cloud.csv", text("x,y,z" + ",a" * 1_000_000 + "\n")),
    "a trajectory in one line": ("trajectory", "a.tum", text("1 " * 2_000_000)),
    "a graph with a line of many numbers": ("trajectory", "a.g2o", text("FIX" + " 1" * 1_000_000)),
}  # fmt: skip


def test_promises_are_not_believed(tmp_path: Path) -> None:
    for library in ("cv2", "rosbags"):
        pytest.importorskip(library)
    jobs = {}
    for number, (name, (reader, form, write)) in enumerate(PROMISES.items()):
        path = tmp_path / str(number) / form
        path.parent.mkdir(parents=True)
        write(path)
        jobs[str(path)] = (name, reader, form)
    root = Path(__file__).parents[2]
    child = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(MEGABYTES)],
        input=json.dumps([[reader, form, path] for path, (_, reader, form) in jobs.items()]),
        capture_output=True, text=True, timeout=10 * SECONDS, check=False, cwd=root,
        env=os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert child.returncode == 0, child.stderr[-2000:]
    said = json.loads(child.stdout)
    for path, (name, _, form) in jobs.items():
        what, seconds = said[path]
        assert not what.startswith("WRONG"), f"{name}: {what[:300]}"
        assert seconds < SECONDS, f"{name}: {seconds:.0f} s"
        # Read may be: vertices that are held, an image (there are two ways), markers of one name (the first of them).
        if form not in ("a.g2o", "a.png", "a.tsv"):
            assert what != "read", name
            assert path.split("/")[-1] in what or "folder" in what, what[:300]
            assert "\n" not in what


def bombs() -> dict[str, Callable[[], tuple[Callable[[], object], bytes]]]:
    import bz2

    from lz4.frame import LZ4FrameDecompressor, compress
    from rosbags.rosbag2.storage_mcap import zstd

    zeros = bytes(4_000_000)
    return {
        "bz2": lambda: (bz2.BZ2Decompressor, bz2.compress(zeros)),
        "lz4": lambda: (LZ4FrameDecompressor, compress(zeros)),
        "zstd": lambda: (zstd.ZstdDecompressor, zstd.compress(zeros)),
    }


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_compressed_parts_of_bags_are_bounded(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rosbags")
    from optshape_graph.io.recordings import decompression

    decompressor, data = bombs()[kind]()
    assert decompression.bounded(decompressor, data) == bytes(4_000_000)
    if kind == "bz2":  # of several streams, as bz2 itself reads them
        assert decompression.bounded(decompressor, data + data) == bytes(8_000_000)
    with pytest.raises(ValueError, match="cut off"):
        decompression.bounded(decompressor, data[: len(data) // 2])
    monkeypatch.setattr(decompression, "LARGEST_PART", 1_000_000)
    with pytest.raises(ValueError, match="makes more than 1000000 bytes"):
        decompression.bounded(decompressor, data)


@pytest.mark.parametrize("storage", ["bz2", "lz4", "mcap-zstd", "message"])
def test_bags_are_read_through_the_bounds(storage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    from optshape_graph.errors import InputError
    from optshape_graph.io.recordings import Recording, decompression
    from tests.io.recordings.writing import maker, points

    ros1 = storage in ("bz2", "lz4")
    make = maker("ros1" if ros1 else "mcap")
    path = tmp_path / ("a.bag" if ros1 else "bag")
    if ros1:
        writer = Writer1(path)
        writer.set_compression(Writer1.CompressionFormat[storage.upper()])
    else:
        writer = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP)
        mode = CompressionMode.MESSAGE if storage == "message" else CompressionMode.STORAGE
        writer.set_compression(mode, CompressionFormat.ZSTD)
    cloud = make.cloud(100.0, points("velodyne", n=400))
    with writer:
        connection = writer.add_connection("/points", cloud.__msgtype__, typestore=make.store)
        writer.write(connection, 10**9, make.serialize(cloud))
    assert len(list(Recording(path).scans())) == 1
    monkeypatch.setattr(decompression, "LARGEST_PART", 1000)
    said = ""
    try:
        scans = Recording(path).scans()
        assert list(scans) == []
        said = str(scans.skipped)
    except InputError as error:
        said = str(error)
    assert "makes more than 1000 bytes" in said


def test_rosbags_itself_stays_as_it_is() -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    from optshape_graph.io.recordings.decompression import bounded_readers

    before = dict(rosbag1.decompressors), dict(storage_mcap.DECOMPRESSORS), dict(rosbag2.Reader.STORAGE_PLUGINS)
    names = dict(vars(rosbag2))
    assert rosbag1.Reader not in bounded_readers()
    assert before == (rosbag1.decompressors, storage_mcap.DECOMPRESSORS, rosbag2.Reader.STORAGE_PLUGINS)
    assert names == vars(rosbag2)


def test_hostile_files_leave_nothing_behind(tmp_path: Path) -> None:
    """A file is data: reading it runs nothing and writes nothing."""
    from tests.fuzz.readers import READERS

    work = tmp_path / "work"
    work.mkdir()
    mark = tmp_path / "pwned"
    command = f"touch {mark}"
    for reader, data in {
        "yaml": f"!!python/object/apply:os.system ['{command}']\n",
        "camera": f"schema: !!python/object/apply:os.system ['{command}']\n",
        "json": f"{{\"schema\": \"__import__('os').system('{command}')\"}}",
    }.items():
        READERS[reader].furnish(work)
        for form in range(len(READERS[reader].forms)):
            READERS[reader].read(bytes([form]) + data.encode(), work)

    class Command:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return os.system, (command,)

    np.savez(work / "cloud.npz", points=np.array([Command()], dtype=object), allow_pickle=True)
    content = (work / "cloud.npz").read_bytes()
    READERS["npz"].read(b"\0" + content, work)
    assert not mark.exists()
