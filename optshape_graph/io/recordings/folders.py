"""Recordings as folders: clouds or images with a file of timestamps, and trajectories.

A folder is a topic of clouds or of images if it has a file of timestamps. The clouds or images may be in its subfolder
`data`, as in KITTI; a video with a stamp for each frame may stand for images. A recording is such a folder, or a folder
of such folders. TUM trajectories (`*.tum`) in it are its topics of poses. Nothing outside the folder is read, even if a
file of timestamps or a link leads there.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

from optshape_graph.errors import InputError
from optshape_graph.io.clouds import ENDINGS, read_scan
from optshape_graph.io.files import inside, is_file, read_bytes, read_text
from optshape_graph.io.image_files import read_video
from optshape_graph.io.recordings.images import CompressedImage, RawImage
from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped
from optshape_graph.io.recordings.topics import Kind, Topic
from optshape_graph.io.times import parse_stamp
from optshape_graph.io.trajectories import read_tum
from optshape_graph.sensor import SensorModel

STAMP_FILES = ("timestamps.txt", "timestamps.csv", "times.txt", "times.csv")
CLOUD_SUFFIXES = tuple(ending for ending in ENDINGS if ending != ".txt")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
VIDEO_SUFFIXES = (".mp4", ".avi", ".mkv", ".mov", ".m4v")


class Folder:
    """A recording that is a folder.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def topics(self) -> tuple[Topic, ...]:
        """Folders with timestamps, and trajectories."""
        topics = [self._files(folder) for folder in (self.path, *sorted(self.path.iterdir())) if folder.is_dir()]
        tum = [Topic(file.name, "pose", ".tum", len(read_tum(file))) for file in sorted(self.path.glob("*.tum"))]
        return (*(topic for topic in topics if topic is not None), *tum)

    def _files(self, folder: Path) -> Topic | None:
        if _stamp_file(folder, self.path) is None:
            return None
        suffixes = [file.suffix.lower() for file in _data(folder)]
        counted: dict[Kind, int] = {
            "scan": sum(suffix in CLOUD_SUFFIXES for suffix in suffixes),
            "image": sum(suffix in IMAGE_SUFFIXES for suffix in suffixes),
        }
        videos = [file for file in _data(folder) if file.suffix.lower() in VIDEO_SUFFIXES]
        if len(videos) == 1 and not any(counted.values()):
            name = "." if folder == self.path else folder.name
            return Topic(name, "image", videos[0].suffix.lower(), len(_lines(_stamp_file(folder, self.path) or Path())))
        kind = max(counted, key=lambda kind: counted[kind])
        name = "." if folder == self.path else folder.name
        common = max(set(suffixes), key=suffixes.count, default="")
        return Topic(name, kind, common, counted[kind]) if counted[kind] else None

    def read(self, topic: Topic, skipped: Skipped, sensor: SensorModel | None = None) -> Iterator[Stamped[Any]]:
        """Yield the values of a topic in the order of its timestamps: `Scan`, `Image` or a (4, 4) pose.

        Raises:
            InputError: the timestamps do not fit the files, or lead out of the folder.
        """
        if topic.kind == "pose":
            trajectory = read_tum(self._inside(self.path / topic.name))
            assert trajectory.stamps is not None  # TUM has them
            yield from map(Stamped, trajectory.stamps.tolist(), trajectory.poses)
            return
        if topic.kind == "image" and topic.type in VIDEO_SUFFIXES:
            yield from self._frames(topic)
            return
        for stamp, file in self._stamped_files(topic):
            self._inside(file)
            try:
                value = self._read(file, topic.kind, sensor, skipped.unused)
            except InputError as error:
                problem = "unreadable file" if is_file(file) else "file missing"
                skipped.add(BadMessage(problem, str(error)), str(file))
                continue
            yield Stamped(stamp, value)

    def _frames(self, topic: Topic) -> Iterator[Stamped[RawImage]]:
        """Yield the frames of a folder's video, one for each stamp."""
        folder = self.path / topic.name
        stamp_file = _stamp_file(folder, self.path)
        assert stamp_file is not None  # it is what made the folder a topic
        (video,) = (file for file in _data(folder) if file.suffix.lower() in VIDEO_SUFFIXES)
        lines = _lines(stamp_file)
        stamps = [_stamp(words[0], f"{stamp_file}:{number}") for number, words in lines]
        count = 0
        for count, pixels in enumerate(read_video(self._inside(video)), 1):
            if count > len(stamps):
                break
            yield Stamped(stamps[count - 1], RawImage("bgr8", pixels.reshape(len(pixels), -1)))
        if count != len(stamps):
            raise InputError(f"{stamp_file}: {len(stamps)} stamps for the {count} frames of {video}")

    @staticmethod
    def _read(file: Path, kind: Kind, sensor: SensorModel | None, unused: Counter[str]) -> Any:
        if kind == "scan":
            return read_scan(file, sensor, unused=unused)
        suffix = ".png" if file.suffix.lower() == ".png" else ".jpg"
        return CompressedImage(read_bytes(file), suffix)

    def _stamped_files(self, topic: Topic) -> list[tuple[float, Path]]:
        folder = self.path / topic.name
        stamp_file = _stamp_file(folder, self.path)
        assert stamp_file is not None  # it is what made the folder a topic
        suffixes = CLOUD_SUFFIXES if topic.kind == "scan" else IMAGE_SUFFIXES
        files = [file for file in _data(folder) if file.suffix.lower() in suffixes]
        lines = _lines(stamp_file)
        if any(len(words) > 1 for _, words in lines):
            where = files[0].parent
            return [_named(words, where, f"{stamp_file}:{number}") for number, words in lines]
        if len(lines) != len(files):
            raise InputError(
                f"{stamp_file}: {len(lines)} stamps for {len(files)} files in {files[0].parent}; expected one for "
                "each file, in the order of their names, or lines of a stamp and a file name"
            )
        return [(_stamp(words[0], f"{stamp_file}:{n}"), file) for (n, words), file in zip(lines, files, strict=True)]

    def _inside(self, file: Path) -> Path:
        return inside(file, self.path, "the recording's folder")


def _stamp_file(folder: Path, top: Path) -> Path | None:
    """Return the file with the stamps of a folder's files: in the folder or, for KITTI's odometry, in the one above."""
    own = next((folder / name for name in STAMP_FILES if (folder / name).is_file()), None)
    if own is not None or folder == top:
        return own
    above = next((top / name for name in STAMP_FILES if (top / name).is_file()), None)
    return above if above is not None and len(_lines(above)) == len(_data(folder)) > 0 else None


def _data(folder: Path) -> list[Path]:
    """Return the files that timestamps belong to, sorted by name, with numbers in names sorted as numbers."""
    data = folder / "data" if (folder / "data").is_dir() else folder
    return sorted((file for file in data.iterdir() if file.is_file() and file.name not in STAMP_FILES), key=_order)


def _order(file: Path) -> tuple[object, ...]:
    """Return the key by which names sort as numbers: scan_2 before scan_10, and 1.25 before 1.5."""
    if re.fullmatch(r"\d+(\.\d+)?", file.stem):
        return (0, float(file.stem), file.name)
    return (1, *((1, int(part), "") if part.isdigit() else (0, 0, part) for part in _digits(file.name)), file.name)


def _digits(name: str) -> list[str]:
    return [part for part in re.split(r"([0-9]+)", name) if part]


def _lines(file: Path) -> list[tuple[int, list[str]]]:
    """Return the number and the words of every line that is not empty or a comment; a header is a comment."""
    lines: list[tuple[int, list[str]]] = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        words = re.sub(r"(\d{4}-\d\d-\d\d) (?=\d)", r"\1T", line).replace(",", " ").split()
        header = not lines and not any(character.isdigit() for character in line)
        if words and not line.startswith("#") and not header:
            lines.append((number, words))
    return lines


def _named(words: list[str], folder: Path, where: str) -> tuple[float, Path]:
    """Return stamp and file of a line that has both, in either order."""
    if len(words) != 2:
        raise InputError(f"{where}: expected a stamp and a file name, found {' '.join(words)!r}")
    stamp, name = words if parse_stamp(words[0]) is not None else reversed(words)
    return _stamp(stamp, where), folder / name


def _stamp(word: str, where: str) -> float:
    stamp = parse_stamp(word)
    if stamp is None:
        raise InputError(f"{where}: expected a stamp, found '{word}'")
    return stamp
