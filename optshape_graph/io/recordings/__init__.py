"""Recordings: bags, captured packets and folders are read; sessions of what belongs together in time are cut out."""

from optshape_graph.io.recordings.clocks import ClockOffset, estimate_clock_offset, marker_rotations
from optshape_graph.io.recordings.extraction import Extraction, Selection, estimate_mocap_offset, extract_session
from optshape_graph.io.recordings.images import CompressedImage, Image, RawImage
from optshape_graph.io.recordings.recording import Recording
from optshape_graph.io.recordings.stream import Skipped, Stamped, Stream
from optshape_graph.io.recordings.topics import Mounting, Topic

__all__ = [
    "ClockOffset",
    "CompressedImage",
    "Extraction",
    "Image",
    "Mounting",
    "RawImage",
    "Recording",
    "Selection",
    "Skipped",
    "Stamped",
    "Stream",
    "Topic",
    "estimate_clock_offset",
    "estimate_mocap_offset",
    "extract_session",
    "marker_rotations",
]
