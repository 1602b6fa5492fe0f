"""LZF decompression against the C library's own output, and against a compressor that uses every instruction."""

from __future__ import annotations

import contextlib

import lzf
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.clouds.lzf import decompress_slowly, lzf_decompress


def compress(data: bytes) -> bytes:
    """Longest match found by plain search, else literals."""
    out, literals, i = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            out.extend([len(run) - 1, *run])
        literals.clear()

    while i < len(data):
        for length in (264, 100, 40, 9, 8, 5, 3):
            if length > len(data) - i:
                continue
            start = data.rfind(data[i : i + length], max(0, i - 8192), i + length - 1)
            if start >= 0:
                flush()
                distance = i - start - 1
                high = distance >> 8
                out.extend([(length - 2) << 5 | high] if length < 9 else [7 << 5 | high, length - 9])
                out.append(distance & 255)
                i += length
                break
        else:
            literals.append(data[i])
            i += 1
    flush()
    return bytes(out)


def test_output_of_liblzf() -> None:
    text = b"the ring, the ring, the ring of a ring; " + b"a" * 64
    packed = bytes.fromhex("0a7468652072696e672c2074e0080904206f662061601d023b2061e03600e0095de00171e04167016161")
    assert lzf_decompress(packed, 208) == text * 2


@given(st.lists(st.sampled_from([b"a", b"bc", b"ring", b"0" * 300, bytes(range(256))]), max_size=8).map(b"".join))
def test_round_trip(data: bytes) -> None:
    assert lzf_decompress(compress(data), len(data)) == decompress_slowly(compress(data), len(data)) == data


@given(st.binary(max_size=2000))
def test_what_the_library_compresses(data: bytes) -> None:
    packed = lzf.compress(data, 2 * len(data) + 64)
    if packed:
        assert lzf_decompress(packed, len(data)) == decompress_slowly(packed, len(data)) == data


@given(st.binary(max_size=200), st.integers(1, 2000))
def test_library_and_fallback_take_the_same(data: bytes, size: int) -> None:
    outcomes = []
    for decompress in (lzf_decompress, decompress_slowly):
        try:
            outcomes.append(decompress(data, size))
        except InputError:
            outcomes.append(None)
    assert outcomes[0] == outcomes[1]


@given(st.binary(max_size=200), st.integers(0, 2000))
def test_any_bytes_are_decompressed_or_refused(data: bytes, size: int) -> None:
    with contextlib.suppress(InputError):
        assert len(lzf_decompress(data, size)) == size


@pytest.mark.parametrize(
    ("data", "size", "message"),
    [
        (b"\x00a", 10**12, "2 compressed bytes cannot make 1000000000000"),
        (b"\x00a", 2, "it makes 1 bytes, expected 2"),
        (b"\x05a", 6, "it makes 1 bytes, expected 6"),
        (b"\x20", 3, "ends within an instruction"),
        (b"\x20\x05", 3, "from 6 bytes before the beginning"),
    ],
)
def test_damaged_data(data: bytes, size: int, message: str) -> None:
    with pytest.raises(InputError, match=message):
        lzf_decompress(data, size)
