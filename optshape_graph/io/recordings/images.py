"""Images and camera parameters of recordings. OpenCV is imported when pixels are wanted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optshape_graph.camera import CameraIntrinsics
from optshape_graph.errors import InputError
from optshape_graph.io.foreign_cameras import make_camera
from optshape_graph.io.image_files import decode_image, opencv
from optshape_graph.io.recordings.stream import BadMessage

Pixels = NDArray[np.uint8]

CHANNELS = {
    "mono8": 1, "8UC1": 1, "bgr8": 3, "8UC3": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
}  # fmt: skip
"""sensor_msgs/Image encodings that are read: bytes per pixel."""

CONVERSIONS = {
    "rgb8": "COLOR_RGB2BGR", "bgra8": "COLOR_BGRA2BGR", "rgba8": "COLOR_RGBA2BGR",
    "bayer_rggb8": "COLOR_BayerRGGB2BGR", "bayer_bggr8": "COLOR_BayerBGGR2BGR",
    "bayer_gbrg8": "COLOR_BayerGBRG2BGR", "bayer_grbg8": "COLOR_BayerGRBG2BGR",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class RawImage:
    """Pixels as the camera sent them.

    Attributes:
        encoding: as in sensor_msgs/image_encodings, one of `CHANNELS`.
        rows: (H, W * bytes per pixel) without the padding of rows.
    """

    encoding: str
    rows: Pixels

    def pixels(self) -> Pixels:
        """Return (H, W) of a grey image or (H, W, 3) in OpenCV's order (blue, green, red)."""
        channels = CHANNELS[self.encoding]
        values = self.rows if channels == 1 else self.rows.reshape(len(self.rows), -1, channels)
        if self.encoding not in CONVERSIONS:
            return values
        cv2 = opencv()
        return np.asarray(cv2.cvtColor(values, getattr(cv2, CONVERSIONS[self.encoding])), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class CompressedImage:
    """An image as a file would hold it.

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
    if message.encoding not in CHANNELS:
        raise BadMessage("unknown image encoding", f"'{message.encoding}'; expected one of {', '.join(CHANNELS)}")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * CHANNELS[message.encoding]
    if height * width == 0:
        raise BadMessage("empty", f"{height} x {width} pixels")
    if step < row or len(message.data) < (height - 1) * step + row:
        raise BadMessage("truncated", f"{len(message.data)} bytes for {height} rows of {step}, {row} of them pixels")
    rows = np.ndarray((height, row), np.uint8, message.data, strides=(step, 1))
    return RawImage(message.encoding, np.ascontiguousarray(rows))


def compressed_image(message: Any) -> CompressedImage:
    """Return the image of a sensor_msgs/CompressedImage; its first bytes say what it is, not `format`.

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
