"""Points and lines in the Rerun viewer, or as its recording (.rrd)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from optshape_graph.errors import InputError, missing_extra
from optshape_graph.io.files import write_atomically
from optshape_graph.viz.spatial import Points, Spatial, require_screen

if TYPE_CHECKING:
    import rerun

TIMELINE = "scan"
"""Name of the slider that goes through the scans of a result."""

LOOPBACK = "127.0.0.1"

SECONDS = 30.0
"""Seconds that the viewer may take to start."""


def save_recording(seen: Spatial, path: str | Path, name: str = "optshape") -> None:
    """Write a recording for Rerun, whole or not at all.

    Args:
        seen: what to show.
        path: ends in .rrd.
        name: of the recording.

    Raises:
        MissingExtraError: Rerun is absent.
        InputError: another ending, or the place cannot be written.
    """
    if Path(path).suffix.lower() != ".rrd":
        raise InputError(f"{path}: a recording of Rerun ends in .rrd")
    stream = _stream(name)
    memory = stream.memory_recording()
    _log(stream, seen)
    write_atomically(path, memory.drain_as_bytes())


def open_viewer(seen: Spatial, name: str = "optshape") -> None:
    """Open the viewer in a window of its own, and go on. It listens to this machine only.

    Args:
        seen: what to show.
        name: of the recording.

    Raises:
        MissingExtraError: Rerun is absent.
        InputError: there is no screen, or the viewer could not be started.
    """
    stream = _stream(name)
    require_screen("Rerun's viewer")
    try:
        stream.connect_grpc(f"rerun+http://{LOOPBACK}:{_start_viewer()}/proxy")
    except Exception as error:  # any error of the system: no program, no permission
        raise InputError(
            f"the Rerun viewer could not be started ({error}); write a file instead: --save FILE.rrd"
        ) from error
    _log(stream, seen)
    stream.flush()


def _start_viewer() -> int:
    """Start the viewer on the loopback only (its default is all interfaces); return its port once it listens.

    Raises:
        OSError: it ended, or does not listen.
    """
    import socket
    import subprocess
    import sys
    import time

    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        port: int = free.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--bind", LOOPBACK, "--port", str(port)]
    nothing = subprocess.DEVNULL
    viewer = subprocess.Popen(command, start_new_session=True, stdin=nothing, stdout=nothing, stderr=nothing)
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline:
        if viewer.poll() is not None:
            raise OSError(f"it ended with exit status {viewer.returncode}")
        try:
            socket.create_connection((LOOPBACK, port), 1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            return port
    viewer.kill()
    raise OSError(f"it does not listen after {SECONDS:.0f} s")


def _stream(name: str) -> rerun.RecordingStream:
    stream: rerun.RecordingStream = _rerun().RecordingStream("optshape")
    stream.send_recording_name(name)
    return stream


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as cause:
        raise missing_extra("rerun-sdk", "view", cause) from cause
    return rerun


def _log(stream: rerun.RecordingStream, seen: Spatial) -> None:
    rr = _rerun()
    stream.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for item in seen.items:
        if item.step is not None:
            stream.set_time(TIMELINE, sequence=item.step)
        shape: Any
        if isinstance(item, Points):
            shape = rr.Points3D(item.points, colors=item.colours, radii=item.radius)
        else:
            labels = [item.label] + [""] * (len(item.strips) - 1) if item.label else None
            shape = rr.LineStrips3D(item.strips, colors=item.colours, radii=item.radius, labels=labels)
        stream.log(_path(item.name), shape, static=item.step is None)
    for step, text in enumerate(seen.steps):
        stream.set_time(TIMELINE, sequence=step)
        stream.log("about", rr.TextDocument(text))
    if seen.notes:
        stream.log("notes", rr.TextDocument("\n".join(seen.notes)), static=True)


def _path(name: str) -> str:
    """Return the entity path of a name whose parts may have any characters."""
    rr = _rerun()
    return "/".join(rr.escape_entity_path_part(part) for part in name.split("/"))
