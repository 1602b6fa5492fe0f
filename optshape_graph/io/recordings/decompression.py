"""Bounds on what a bag's compressed parts become: a thousand bytes can hold a thousand million.

rosbags decompresses a chunk or a message whole, whatever it makes. Its tables of decompressors take bounded ones here.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

LARGEST_PART = 1 << 29
"""Bytes that a chunk or a message may have: recorders write chunks of a few megabytes, and no message is half a GB."""


def bounded(decompressor: Callable[[], Any], data: bytes) -> bytes:
    """Return what data, of one stream or several, were made of.

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
def bound_rosbags() -> None:
    """Put bounded decompressors in the place of rosbags' own, once in a process."""
    from bz2 import BZ2Decompressor

    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]  # no stubs
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    zstd: Any = storage_mcap.zstd  # type: ignore[attr-defined]  # the standard library's, or its backport
    rosbag1.decompressors["bz2"] = lambda data: bounded(BZ2Decompressor, data)
    rosbag1.decompressors["lz4"] = lambda data: bounded(LZ4FrameDecompressor, data)
    storage_mcap.DECOMPRESSORS["lz4"] = lambda data, _: bounded(LZ4FrameDecompressor, data)
    storage_mcap.DECOMPRESSORS["zstd"] = lambda data, _: bounded(zstd.ZstdDecompressor, data)
    of_messages = SimpleNamespace(open=zstd.open, decompress=lambda data: bounded(zstd.ZstdDecompressor, data))
    setattr(rosbag2, "zstd", of_messages)  # noqa: B010 - the stubs know it as a module
