"""Decompression of LibLZF's format, which binary_compressed PCD files use; LibLZF itself does it where installed.

The format: a control byte below 32 is followed by that many literal bytes plus one; any other holds in its upper
three bits the length of a copy, minus two (seven: one more byte is added), and in the lower five the high bits of the
distance back, minus one, whose low byte follows.
"""

from __future__ import annotations

import importlib.util

from optshape_graph.errors import InputError

_LARGEST_COPY = 264
"""Bytes that three compressed bytes can expand to."""


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes that `data` expands to.

    Raises:
        InputError: the data are damaged, or expand to another number of bytes.
    """
    if size > len(data) * _LARGEST_COPY // 3 + _LARGEST_COPY:
        raise InputError(f"{len(data)} compressed bytes cannot make {size}")
    if size and importlib.util.find_spec("lzf") is not None:
        import lzf

        try:
            made = lzf.decompress(data, size)
        except ValueError:
            made = None
        if made is not None and len(made) == size:
            return bytes(made)
    return decompress_slowly(data, size)


def decompress_slowly(data: bytes, size: int) -> bytes:
    """Return the same as `lzf_decompress` without the library: fifty times slower, but errors say what is damaged.

    Raises:
        InputError: as `lzf_decompress`.
    """
    out, i, n = bytearray(), 0, len(data)
    try:
        while i < n:
            control = data[i]
            i += 1
            if control < 32:
                out += data[i : i + control + 1]
                i += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:
                length += data[i]
                i += 1
            distance = ((control & 31) << 8 | data[i]) + 1
            i += 1
            start = len(out) - distance
            if start < 0:
                raise InputError(f"damaged compressed data: a copy from {-start} bytes before the beginning")
            if distance >= length:
                out += out[start : start + length]
            else:  # the copy overlaps what it writes: a repetition
                pattern = bytes(out[start:])
                out += (pattern * (length // distance + 1))[:length]
    except IndexError as error:
        raise InputError("damaged compressed data: it ends within an instruction") from error
    if len(out) != size or i != n:
        raise InputError(f"damaged compressed data: it makes {len(out)} bytes, expected {size}")
    return bytes(out)
