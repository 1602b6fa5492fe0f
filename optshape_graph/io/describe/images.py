"""Facts about images and videos."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.describe.facts import Facts
from optshape_graph.io.files import read_bytes


def image_facts(path: Path) -> Facts:
    """Return the size of an image.

    Raises:
        InputError: no image of a known form.
    """
    from optshape_graph.io.image_files import FORMATS, image_size

    size = image_size(read_bytes(path))
    if size is None:
        raise InputError(f"{path}: no image of a known form; expected {FORMATS}")
    return {"form": "image", "size": f"{size[0]} x {size[1]} pixels"}


def video_facts(path: Path) -> Facts:
    """Return the size of a video's images.

    Raises:
        InputError: no video, or one without an image that can be decoded.
        MissingExtraError: OpenCV is absent.
    """
    from optshape_graph.io.image_files import read_video

    for pixels in read_video(path):
        height, width = pixels.shape[:2]
        form = "video (a folder with it and timestamps.txt is a recording)"
        return {"form": form, "size": f"{width} x {height} pixels"}
    raise InputError(f"{path}: a video without a frame that can be decoded")
