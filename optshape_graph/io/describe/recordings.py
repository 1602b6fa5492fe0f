"""Facts about recordings: bags, captured packets and folders."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from optshape_graph.errors import OptshapeError
from optshape_graph.io.describe.clouds import guess_numbers, scan_facts
from optshape_graph.io.describe.facts import Facts, span_text


def recording_facts(path: Path) -> Facts:
    """Return the span and the topics of a recording, and the facts of the first scan of each topic of scans.

    Raises:
        InputError: as `Recording`.
        MissingExtraError: the library that reads bags is absent.
    """
    from optshape_graph.io.recordings import Recording

    recording = Recording(path)
    topics = recording.topics
    facts: Facts = {"form": _form_of_recording(path)}
    if span := recording.span:
        facts["recorded"] = span_text(*span)
    facts["topics"] = {
        topic.name: f"{topic.kind}, {topic.type}" + ("" if topic.count is None else f", {topic.count} messages")
        for topic in topics
    }
    listed = [{"name": t.name, "kind": t.kind, "type": t.type, "count": t.count} for t in topics]
    facts["numbers"] = {"topics": listed} | ({"span_s": [float(t) for t in span]} if span else {})
    if not topics:
        facts["problem"] = "nothing in it that is read: a folder of clouds needs timestamps.txt"
    for topic in topics:
        if topic.kind == "scan":
            facts[f"first scan of {topic.name}"] = dict(_first_scan(recording, topic.name))
    return facts


def _first_scan(recording: Any, topic: str) -> Iterator[tuple[str, Any]]:
    from optshape_graph.io.sensor_guess import guess_sensor

    stream = recording.scans(topic)
    try:
        first = next(iter(stream), None)
    except OptshapeError as error:
        yield "problem", str(error)
        return
    if first is None:
        yield "problem", f"no usable scan; {stream.skipped}"
        return
    yield "stamp", f"{first.stamp:.6f} s"
    if frame := recording.mounting_frame(topic):
        yield "frame", frame
    facts, guess = scan_facts(first.value), guess_sensor(first.value)
    numbers = {"stamp_s": first.stamp, **facts.pop("numbers"), **guess_numbers(guess)}
    yield from facts.items()
    yield "sensor", str(guess)
    yield "numbers", numbers


def _form_of_recording(path: Path) -> str:
    if path.is_dir():
        return "ROS 2 bag" if (path / "metadata.yaml").is_file() else "recording: a folder"
    if path.suffix.lower() == ".bag":
        return "ROS 1 bag"
    return "captured packets" if path.suffix.lower() not in (".mcap", ".db3") else f"ROS 2 bag ({path.suffix[1:]})"
