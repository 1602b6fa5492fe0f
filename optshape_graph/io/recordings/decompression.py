"""Bounded decompression of bags, since a thousand bytes can expand to a thousand million.

rosbags decompresses a chunk or a message whole, without a limit. Copies of its readers get bounded decompressors here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec, module_from_spec
from types import SimpleNamespace
from typing import Any

LARGEST_PART = 1 << 29
"""Bytes that a chunk or a message has at most: recorders write chunks of a few megabytes, and no message is half a
GB."""


def bounded(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """Return data, of one stream or several, decompressed.

    Args:
        decompressor: makes an incremental decompressor of the standard library's kind.
        data: compressed.

    Raises:
        ValueError: cut off, or of more than `LARGEST_PART` bytes.
    """
    parts, size = [], 0
    while data:
        stream = decompressor()
        part = stream.decompress(data, max_length=LARGEST_PART + 1 - size)
        size += len(part)
        if size > LARGEST_PART:
            raise ValueError(f"a compressed part makes more than {LARGEST_PART} bytes")
        if not stream.eof:
            raise ValueError("a compressed part is cut off")
        parts.append(part)
        data = stream.unused_data
    return b"".join(parts)


@cache
def bounded_readers() -> tuple[Any, Any]:
    """Return the readers of ROS 1 and of ROS 2 bags, with bounded decompressors.

    They come from copies of rosbags' modules, so that rosbags itself stays unchanged for its other users in this
    process.
    """
    from bz2 import BZ2Decompressor

    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # no stubs

    rosbag1, rosbag2 = _copy("rosbags.rosbag1.reader"), _copy("rosbags.rosbag2.reader")
    mcap = _copy("rosbags.rosbag2.storage_mcap")
    zstd = mcap.zstd  # the standard library's, or its backport
    rosbag1.decompressors["bz2"] = lambda data: bounded(BZ2Decompressor, data)
    rosbag1.decompressors["lz4"] = lambda data: bounded(LZ4FrameDecompressor, data)
    mcap.DECOMPRESSORS["lz4"] = lambda data, _: bounded(LZ4FrameDecompressor, data)
    mcap.DECOMPRESSORS["zstd"] = lambda data, _: bounded(zstd.ZstdDecompressor, data)
    rosbag2.DirectoryReader.STORAGE_PLUGINS["mcap"] = rosbag2.Reader.STORAGE_PLUGINS[".mcap"] = mcap.McapReader
    rosbag2.zstd = SimpleNamespace(open=zstd.open, decompress=lambda data: bounded(zstd.ZstdDecompressor, data))
    return rosbag1.Reader, rosbag2.Reader


def _copy(name: str) -> Any:
    """Return a module with globals of its own."""
    spec = find_spec(name)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
