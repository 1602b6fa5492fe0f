"""Outputs of a command, checked before the work: place, rights, room on the disk, and files that would be lost."""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from optshape_graph.errors import InputError

OF_INPUTS = frozenset({
    ".pcd", ".ply", ".npz", ".npy", ".csv", ".bin", ".las", ".laz", ".pcap", ".bag", ".mcap", ".db3", ".yaml", ".yml",
    ".json", ".xml", ".png", ".jpg", ".jpeg", ".tif", ".tiff", ".c3d", ".tsv", ".mat", ".trc", ".stl", ".obj", ".ipynb",
    ".py", ".md", ".txt",
})  # fmt: skip
"""Endings of files that may hold a user's work: they are replaced only with `--force`."""

JOURNALED = ("estimate", "detect", "map", "mocap", "camera-calibration", "rig", "sensor-calibration")
"""Forms of which finished parts are kept in a journal beside the file until it is whole."""

LEAST_ROOM = 1 << 20
"""Bytes that must be free on the disk."""


class Outputs:
    """The outputs of one run of a command.

    An existing file is replaced if it is an older result of the same form, or if inputs never have its ending; any
    other file only with `force`. An input is never replaced.

    Args:
        inputs: files that the command reads, including lists of files (`@list`). The files that a session or a scene
            names are inputs, too.
        force: replace existing files.
    """

    def __init__(self, inputs: Iterable[str | Path | None] = (), *, force: bool = False) -> None:
        given = [Path(str(path).removeprefix("@")) for path in inputs if path is not None]
        named = [other for path in given for other in _named_in(path)]
        self._inputs = {key: path for path in [*given, *named] if (key := _identity(path))}
        self._force = force
        self._named: dict[Path, str] = {}
        self._files: set[Path] = set()

    def file(
        self, option: str, path: Path | None, form: str = "", *, bytes_needed: int = LEAST_ROOM, replace: bool = True
    ) -> None:
        """Check a file.

        Args:
            option: that names it, for messages.
            path: of the file; None: nothing is written.
            form: kind of our own that it is, such as "estimate"; "": another program's.
            bytes_needed: its approximate size.
            replace: whether an older result of that form may be replaced without `force`.

        Raises:
            InputError: it cannot be written, is an input, or would replace something else.
        """
        if path is None:
            return
        self._check_name(option, path, form in JOURNALED)
        self._files.add(path.resolve())
        if path.is_dir():
            raise InputError(f"{option} {path}: expected the name of a file, found a folder")
        if (identity := _identity(path)) in self._inputs:
            raise InputError(f"{option} {path}: is an input ({self._inputs[identity]}); choose another name")
        if _is_special(path):
            return  # /dev/stdout
        if path.exists() and not self._force and not (replace and _is_older(path, form)):
            raise InputError(f"{option} {path}: is there, and no older result of this command; --force writes over it")
        if path.exists() and not os.access(path, os.W_OK):
            raise InputError(f"{option} {path}: cannot be written (Permission denied)")
        _check_folder(option, path.parent, bytes_needed)

    def folder(
        self, option: str, path: Path | None, files: Iterable[str] = (), form: str = "", *, replace: bool = True
    ) -> None:
        """Check a folder, which may be missing, and the files that will be written into it.

        Args:
            option: that names it, for messages.
            path: of the folder; None: nothing is written.
            files: names of the files in it.
            form: kind of our own that these are.
            replace: whether older ones may be replaced without `force`.

        Raises:
            InputError: it cannot be written, or is a file; or one of the files would be lost.
        """
        if path is None:
            return
        self._check_name(option, path)
        place = path
        while not _exists(place) and place != place.parent:
            place = place.parent
        if not place.is_dir():
            raise InputError(f"{option} {path}: {place} is a file, not a folder")
        _check_folder(option, place, LEAST_ROOM)
        for name in files:
            if _exists(path / name):
                self.file(option, path / name, form, replace=replace)

    def new(self, option: str, path: Path) -> None:
        """Check a file that a command makes beside others: it is replaced only with `force`.

        Args:
            option: that leads to it, for messages.
            path: of the file.

        Raises:
            InputError: it is there, is an input, or cannot be written.
        """
        self.file(option, path, replace=False)

    def picture(self, option: str, path: Path | None) -> None:
        """Check a picture: an older one of that name is replaced, an input never.

        Args:
            option: that names it, for messages.
            path: of the picture; None: none is written. Its folder is made.

        Raises:
            InputError: it cannot be written, or is an input.
        """
        if path is not None:
            forced, self._force = self._force, True
            self.folder(option, path.parent, [path.name])
            self._force = forced

    def _check_name(self, option: str, path: Path, journaled: bool = False) -> None:
        try:
            place = path.resolve()
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"{option} {str(path)!r}: not the name of a file ({error})") from error
        if inside := self._files.intersection(place.parents):
            raise InputError(f"{option} {path}: leads into {inside.pop()}, which is the output of another option")
        if place in self._named and self._named[place] != option:
            raise InputError(f"{option} {path}: is the output of {self._named[place]}, too")
        self._named[place] = option
        if journaled:
            self._named[place.with_name(f"{place.name}.journal")] = f"{option}, until it is whole"


def _named_in(path: Path) -> list[Path]:
    """Return the files that a session or a scene names."""
    from optshape_graph.io.documents import named_files
    from optshape_graph.io.files import read_head

    if path.suffix.lower() not in (".yaml", ".yml", ".json"):
        return []
    with suppress(InputError):  # reported when it is read
        if re.search(rb"optshape/(session|scene)/", read_head(path, 4096)):
            return named_files(path)
    return []


def _identity(path: Path) -> tuple[int, int] | None:
    """Return device and number of a file, the same for every name of it; None: there is no file."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        return None
    return state.st_dev, state.st_ino


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _is_special(path: Path) -> bool:
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _is_older(path: Path, form: str) -> bool:
    """Return whether a file is empty, an older result of a form, or of a kind that is never an input."""
    if path.stat().st_size == 0:
        return True
    if form:
        with path.open("rb") as stream:
            return f"optshape/{form}/".encode() in stream.read(4096)
    return path.suffix.lower() not in OF_INPUTS


def _check_folder(option: str, folder: Path, bytes_needed: int) -> None:
    """Try to write in a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
        free = shutil.disk_usage(folder).free
    except (OSError, ValueError) as error:
        said = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{option}: nothing can be written to {folder} ({said})") from error
    if free < bytes_needed:
        raise InputError(f"{option}: {free} bytes are free at {folder}; about {bytes_needed} are needed")
