"""Facts about motion capture."""

from __future__ import annotations

from pathlib import Path

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.describe.facts import Facts, span_text
from optshape_graph.io.files import read_bytes
from optshape_graph.io.mocap import MocapRecording, form_of, read_mocap, read_motive_bodies


def mocap_facts(path: Path, form: str) -> Facts:
    """Return what a motion-capture file holds: markers, frames, rate, times, gaps; of Motive, rigid bodies as well.

    Args:
        path: the file.
        form: what to call it.

    Raises:
        InputError: as `read_mocap`.
        MissingExtraError: the library that reads C3D or MAT is absent.
    """
    if path.suffix.lower() in (".csv", ".txt") and form_of(decode(read_bytes(path))) == "motive":
        times, bodies = read_motive_bodies(path)
        facts: Facts = {"form": "Motive motion capture", "rigid bodies": ", ".join(bodies) or "none"}
        try:
            return facts | _mocap_facts(read_mocap(path))
        except InputError:
            return facts | {"markers": "none", "frames": len(times)}
    return {"form": form, **_mocap_facts(read_mocap(path))}


def _mocap_facts(recording: MocapRecording) -> Facts:
    start, end = float(recording.times[0]), float(recording.times[-1])
    gaps = 1 - float(recording.seen.mean())
    return {
        "markers": ", ".join(recording.markers), "frames": len(recording.times), "rate": f"{recording.rate:g} Hz",
        "times": span_text(start, end), "gaps": f"{gaps:.1%} of all positions",
        "numbers": {"stamps": len(recording.times), "span_s": [start, end],
                    "rate_hz": float(recording.rate), "gap_share": gaps},
    }  # fmt: skip
