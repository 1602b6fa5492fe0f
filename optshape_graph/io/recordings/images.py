"""Images and camera parameters of recordings. OpenCV is imported when pixels are wanted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Value
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.foreign_cameras import make_camera
from optshape_graph.io.image_files import decode_image, opencv
from optshape_graph.io.recordings.stream import BadMessage

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Encoding:
    """The layout of pixels in a message.

    Attributes:
        channels: values of a pixel.
        bits: of a value, 8 or 16.
        conversion: OpenCV's name of the conversion to blue, green, red; "": none is needed.
        rows: rows of bytes for a row of pixels; more than one if the colours follow the brightness of all pixels.
    """

    channels: int
    bits: int = 8
    conversion: str = ""
    rows: float = 1.0


def _encodings() -> dict[str, Encoding]:
    known = {
        "mono8": Encoding(1), "8UC1": Encoding(1), "bgr8": Encoding(3), "8UC3": Encoding(3),
        "rgb8": Encoding(3, 8, "COLOR_RGB2BGR"), "bgra8": Encoding(4, 8, "COLOR_BGRA2BGR"),
        "8UC4": Encoding(4, 8, "COLOR_BGRA2BGR"), "rgba8": Encoding(4, 8, "COLOR_RGBA2BGR"),
        "mono16": Encoding(1, 16), "16UC1": Encoding(1, 16), "bgr16": Encoding(3, 16),
        "rgb16": Encoding(3, 16, "COLOR_RGB2BGR"), "bgra16": Encoding(4, 16, "COLOR_BGRA2BGR"),
        "rgba16": Encoding(4, 16, "COLOR_RGBA2BGR"),
        "yuv422": Encoding(2, 8, "COLOR_YUV2BGR_UYVY"), "uyvy": Encoding(2, 8, "COLOR_YUV2BGR_UYVY"),
        "yuv422_yuy2": Encoding(2, 8, "COLOR_YUV2BGR_YUY2"), "yuyv": Encoding(2, 8, "COLOR_YUV2BGR_YUY2"),
        "nv12": Encoding(1, 8, "COLOR_YUV2BGR_NV12", 1.5), "nv21": Encoding(1, 8, "COLOR_YUV2BGR_NV21", 1.5),
    }  # fmt: skip
    for order in ("rggb", "bggr", "gbrg", "grbg"):
        for bits in (8, 16):
            known[f"bayer_{order}{bits}"] = Encoding(1, bits, f"COLOR_Bayer{order.upper()}2BGR")
    return known


ENCODINGS = _encodings()
"""sensor_msgs/Image encodings that are read (sensor_msgs/image_encodings.hpp)."""


@dataclass(frozen=True, eq=False, repr=False)
class RawImage(Value):
    """Pixels as the camera sent them.

    Attributes:
        encoding: as in sensor_msgs/image_encodings, one of `ENCODINGS`.
        rows: (H, W * bytes per pixel) without the padding of rows; more rows if colours follow (`Encoding.rows`).
        big_endian: whether values of 16 bits have their larger byte first.
    """

    encoding: str
    rows: Pixels
    big_endian: bool = False

    def pixels(self) -> Pixels:
        """Return (H, W) of a grey image or (H, W, 3) in OpenCV's order (blue, green, red).

        Of 16 bits the eight highest that are in use are kept: cameras of 10 or 12 bits leave the upper ones empty.
        """
        how = ENCODINGS[self.encoding]
        values: NDArray[Any] = self.rows
        if how.bits == 16:
            values = values.view(">u2" if self.big_endian else "<u2").astype(np.uint16)
            values = (values >> max(int(values.max(initial=0)).bit_length() - 8, 0)).astype(np.uint8)
        if how.channels > 1:
            values = values.reshape(len(values), -1, how.channels)
        if not how.conversion:
            return np.asarray(values, dtype=np.uint8)
        cv2 = opencv()
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(values), getattr(cv2, how.conversion)), dtype=np.uint8)


@dataclass(frozen=True, eq=False, repr=False)
class CompressedImage(Value):
    """An image as the content of a file.

    Attributes:
        data: the bytes of a JPEG or PNG file.
        suffix: what such a file's name ends with, ".jpg" or ".png".
    """

    data: bytes
    suffix: str

    def pixels(self) -> Pixels:
        """Return (H, W) of a grey image or (H, W, 3) in OpenCV's order.

        Raises:
            BadMessage: the bytes do not decode.
        """
        try:
            return decode_image(self.data, f"{len(self.data)} bytes")
        except InputError as error:
            raise BadMessage("undecodable image", str(error)) from error


Image = RawImage | CompressedImage


def raw_image(message: Any) -> RawImage:
    """Return the image of a sensor_msgs/Image.

    Raises:
        BadMessage: encoding not read here, no pixels, or data shorter than declared.
    """
    how = ENCODINGS.get(message.encoding)
    if how is None:
        raise BadMessage(
            "image encoding that is not read", f"'{message.encoding}'; expected one of {', '.join(ENCODINGS)}"
        )
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * how.channels * how.bits // 8
    if height * width == 0:
        raise BadMessage("empty", f"{height} x {width} pixels")
    if (how.rows > 1 or "YUV" in how.conversion) and (width % 2 or height % 2):
        raise BadMessage("malformed image", f"{width} x {height} pixels of '{message.encoding}'; expected even numbers")
    if how.rows > 1 and step == width * 3 // 2:  # some drivers count the colours into the step
        step = width
    height = int(height * how.rows)
    if step < row or len(message.data) < (height - 1) * step + row:
        raise BadMessage("truncated", f"{len(message.data)} bytes for {height} rows of {step}, {row} of them pixels")
    rows = np.ndarray((height, row), np.uint8, message.data, strides=(step, 1))
    return RawImage(message.encoding, np.ascontiguousarray(rows), bool(message.is_bigendian))


def compressed_image(message: Any) -> CompressedImage:
    """Return the image of a sensor_msgs/CompressedImage; its first bytes tell the format, not its field `format`.

    Raises:
        BadMessage: neither JPEG nor PNG.
    """
    data = bytes(message.data)
    for magic, suffix in ((b"\xff\xd8\xff", ".jpg"), (b"\x89PNG\r\n\x1a\n", ".png")):
        if data.startswith(magic):
            return CompressedImage(data, suffix)
    raise BadMessage("undecodable image", f"{len(data)} bytes of format '{message.format}': neither JPEG nor PNG")


def camera_intrinsics(message: Any, name: str) -> CameraIntrinsics:
    """Return the intrinsics of a sensor_msgs/CameraInfo (ROS 1 spells K and D in capitals, ROS 2 does not).

    Args:
        message: the deserialised message.
        name: of the camera.

    Raises:
        BadMessage: not calibrated, of binned or cropped images, or of a distortion model that is not read here.
    """
    K, D = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)
    if max(message.binning_x, message.binning_y) > 1 or message.roi.width or message.roi.height:
        raise BadMessage("intrinsics of binned or cropped images", f"binning {message.binning_x} x {message.binning_y}")
    try:
        return make_camera(name, message.distortion_model, int(message.width), int(message.height), K, D)
    except InputError as error:
        raise BadMessage("camera not calibrated", str(error)) from error


def encode_png(pixels: Pixels) -> bytes:
    """Return a PNG file of (H, W) or (H, W, 3) pixels in OpenCV's order."""
    ok, data = opencv().imencode(".png", pixels)
    if not ok:
        raise BadMessage("undecodable image", f"pixels of shape {pixels.shape} make no PNG file")
    return bytes(data)
