"""What a file or folder is, in a few facts: its form, fields and units, rings, times, frames, topics and spans."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.files import ENDINGS, form_of_head
from optshape_graph.io.describe.clouds import cloud_facts
from optshape_graph.io.describe.documents import document_facts
from optshape_graph.io.describe.facts import Facts
from optshape_graph.io.describe.images import image_facts, video_facts
from optshape_graph.io.describe.mocap import mocap_facts
from optshape_graph.io.describe.recordings import recording_facts
from optshape_graph.io.describe.texts import text_facts
from optshape_graph.io.files import read_head

_IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")


_VIDEOS = (".mp4", ".avi", ".mkv", ".mov", ".m4v")


_DOCUMENTS = (".yaml", ".yml", ".json", ".xml", ".ini")


_MOCAP = {".c3d": "C3D motion capture", ".mat": "Qualisys MAT motion capture", ".trc": "TRC motion capture",
          ".tsv": "Qualisys TSV motion capture"}  # fmt: skip


def describe(path: str | Path, columns: list[str] | None = None) -> Facts:
    """Return what a file or folder is.

    Args:
        path: any file that the package reads, or a folder: a bag, or a recording.
        columns: names of a cloud's columns that has none, in order.

    Raises:
        InputError: no such file, or of no form that is read; the message says what it looks like.
        MissingExtraError: the library that reads it is absent.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    head = b"" if path.is_dir() else read_head(path, 64)
    form = form_of_head(head)
    suffix = path.suffix.lower()
    if path.is_dir() or form in ("packets", "bag") or suffix in (".bag", ".mcap", ".db3"):
        return recording_facts(path)
    if suffix in _IMAGES or head.startswith((b"\x89PNG", b"\xff\xd8\xff")):
        return image_facts(path)
    if suffix in _VIDEOS:
        return video_facts(path)
    if suffix in _MOCAP:
        return mocap_facts(path, _MOCAP[suffix])
    if head.lstrip().lower().startswith((b"<!doctype html", b"<html")):
        return {"form": "web page (as --report writes it)", "bytes": path.stat().st_size}
    if suffix in _DOCUMENTS or head[:1] in (b"{", b"<"):
        return document_facts(path)
    if form is not None or (suffix in ENDINGS and ENDINGS[suffix] != "text"):
        return cloud_facts(path, columns)
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: a binary file of no form that is read here; it begins with {head[:8].hex(' ')}")
    return text_facts(path, columns)
