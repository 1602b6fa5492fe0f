"""Pixels of image files. OpenCV decodes them, after the sizes that their headers state were checked.

OpenCV itself allocates the size in a header before it looks at the data: up to a thousand million pixels, and 4 GB for
a chunk of a PNG file.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.files import read_head

LARGEST_IMAGE = 1 << 28
"""Pixels that an image has at most; the largest sensors of industrial cameras have 250 million."""

FORMATS = "PNG, JPEG, BMP, TIFF or PNM"

_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")


def decode_image(data: bytes, name: str, channels: int | None = None) -> NDArray[np.uint8]:
    """Return the pixels of an image file's bytes, 8 bit: (h, w) if grey, else (h, w, 3) blue, green, red.

    Args:
        data: a PNG, JPEG, BMP, TIFF or PNM file.
        name: the file, for messages.
        channels: 1: the image is made grey; 3: it is made blue, green, red; None: it stays as it is.

    Raises:
        InputError: another format, damaged, or of more than `LARGEST_IMAGE` pixels.
        MissingExtraError: OpenCV is absent.
    """
    cv2 = opencv()
    size = image_size(data)
    if size is None:
        raise InputError(f"{name}: not an image that OpenCV can read ({len(data)} bytes); expected {FORMATS}")
    width, height = size
    if not 0 < width * height <= LARGEST_IMAGE:
        raise InputError(f"{name}: {width} x {height} pixels; expected at most {LARGEST_IMAGE} in all")
    log = cv2.utils.logging
    level = log.setLogLevel(0)  # the error reports what is wrong, not standard error
    modes = {1: cv2.IMREAD_GRAYSCALE, 3: cv2.IMREAD_COLOR, None: cv2.IMREAD_ANYCOLOR}
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), modes[channels])
    except cv2.error as error:
        raise InputError(f"{name}: damaged image of {width} x {height} pixels ({error.err})") from error
    finally:
        log.setLogLevel(level)
    if pixels is None:
        raise InputError(f"{name}: damaged image of {width} x {height} pixels ({len(data)} bytes)")
    return np.asarray(pixels, dtype=np.uint8)


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height that an image file states; None: an unknown format, or a file that is cut off."""
    try:
        if data.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = _png_size(data)
        elif data.startswith(b"\xff\xd8\xff"):
            height, width = _jpeg_size(data)
        elif data.startswith(b"BM"):
            (header,) = struct.unpack_from("<I", data, 14)
            width, height = struct.unpack_from("<HH" if header == 12 else "<ii", data, 18)
        elif data[:4] in (b"II*\0", b"MM\0*"):
            width, height = _tiff_size(data)
        elif found := _PNM.match(data):
            width, height = int(found[1]), int(found[2])
        else:
            return None
    except (struct.error, IndexError, KeyError):
        return None
    return int(width), abs(int(height))  # the sign in a BMP tells which row is first


def read_video(path: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a video file, (h, w, 3) blue, green, red, 8 bit.

    Raises:
        InputError: no such file, not a video of a known container, or without a frame that can be decoded.
        MissingExtraError: OpenCV is absent.
    """
    head = read_head(path, 16)
    if not (head[4:8] == b"ftyp" or (head[:4] == b"RIFF" and head[8:12] == b"AVI ") or head[:4] == b"\x1aE\xdf\xa3"):
        # OpenCV's decoders would also follow a playlist of addresses
        raise InputError(f"{path}: not a video; expected MP4, AVI or MKV")
    cv2 = opencv()
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = (int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if not capture.isOpened() or not 0 < width * height <= LARGEST_IMAGE:
            raise InputError(f"{path}: a video that OpenCV cannot read ({width} x {height} pixels)")
        while True:
            there, pixels = capture.read()
            if not there:
                return
            yield np.asarray(pixels, dtype=np.uint8)
    finally:
        capture.release()


def opencv() -> Any:
    """Return the module cv2.

    Raises:
        MissingExtraError: OpenCV is absent.
    """
    try:
        import cv2
    except ImportError as cause:
        raise missing_extra("opencv-python-headless", "camera", cause) from cause
    return cv2


def tag_dictionary(name: str) -> Any:
    """Return OpenCV's predefined dictionary of a name such as `APRILTAG_36h11` or `4X4_50`.

    Raises:
        InputError: OpenCV has none of that name.
        MissingExtraError: OpenCV is absent.
    """
    cv2 = opencv()
    known = {key.lower(): key for key in dir(cv2.aruco) if key.startswith("DICT_")}
    key = known.get(f"DICT_{name}".lower())
    if key is None:
        names = ", ".join(sorted(key.removeprefix("DICT_") for key in known.values()))
        raise InputError(f"no tag dictionary '{name}'; expected one of {names}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, key))


def tag_cells(dictionary: str, number: int) -> NDArray[np.bool_]:
    """Return the (m, m) cells of a tag, its black border included, top row first: True where it is white.

    Raises:
        InputError: no such dictionary, or no such tag in it.
        MissingExtraError: OpenCV is absent.
    """
    tags = tag_dictionary(dictionary)
    count = len(tags.bytesList)
    if not 0 <= number < count:
        raise InputError(f"tag dictionary '{dictionary}': no tag {number}; it has 0 to {count - 1}")
    return np.asarray(tags.generateImageMarker(number, tags.markerSize + 2, borderBits=1) > 127)


def _png_size(data: bytes) -> tuple[int, int]:
    """Return width and height from the first chunk, if all chunks up to the last are there (PNG, section 5.3)."""
    at, kind = 8, b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        at += 12 + length
        if at > len(data) or (kind == b"IEND" and length):
            raise IndexError("a chunk ends beyond the file, or the last one is not empty")
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Return height and width from the first start-of-frame segment (ITU T.81, B.2.2)."""
    at = 2
    while data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            return height, width
        at += 2 + length
    raise IndexError("no frame")


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Return width and height from the first directory (TIFF 6.0, section 2)."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (entries,) = struct.unpack_from(order + "H", data, at)
    sizes: dict[int, int] = {}
    for k in range(entries):
        tag, kind, _ = struct.unpack_from(order + "HHI", data, at + 2 + 12 * k)
        if tag in (256, 257):
            (sizes[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 10 + 12 * k)
    return sizes[256], sizes[257]
