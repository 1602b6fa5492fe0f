"""`optshape extract`: cut a session out of a bag or a folder of clouds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say, say_passed_over, warn
from optshape_graph.cli.options import FOLDER, Number, example

if TYPE_CHECKING:
    from optshape_graph.io.mocap import MocapRecording
    from optshape_graph.io.recordings import Extraction, Recording

SOURCES = ("camera", "mocap")

OFFSET = Number(-1e11, 1e11)
"""Seconds between two clocks: one may count from 1970."""


@click.command(epilog=example("optshape extract drive.bag -o session --sensor vlp32c --target paper --every 0.5"))
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=FOLDER, help="Folder to write the session to.")
@click.option("--list", "listing", is_flag=True, help="List the topics and exit.")
@click.option("--sensor", "sensor_name", help="The LiDAR: built-in name or file.")
@click.option("--target", "target_names", multiple=True, help="Built-in name, NAME@AREA, or file. May be repeated.")
@click.option("--topic", "topics", multiple=True, help="Topic of scans, images or poses; not needed if there is "
              "only one of a kind. May be repeated.")  # fmt: skip
@click.option("--camera", "camera_file", type=click.Path(path_type=Path),
              help="Intrinsics (optshape/camera/1, ROS or Kalibr) instead of those in the recording.")  # fmt: skip
@click.option("--no-images", is_flag=True, help="Leave images out.")
@click.option("--mocap", "mocap_file", type=click.Path(path_type=Path),
              help="Motion capture: Qualisys .tsv or .mat, .c3d, Motive or Vicon .csv.")  # fmt: skip
@click.option("--body", multiple=True, metavar="MARKER",
              help="Marker on the moving sensor instead of on a target. May be repeated.")  # fmt: skip
@click.option("--clock-offset", "offsets", multiple=True, metavar="SOURCE=SECONDS",
              help="What to add to the times of `camera` or `mocap` to get the LiDAR's.")  # fmt: skip
@click.option("--estimate-clock-offset", "estimate", is_flag=True,
              help="Estimate the offset of motion capture from the turning of the sensor: its poses in the recording "
              "against the markers of --body (all, if it is left out).")  # fmt: skip
@click.option(
    "--tolerance",
    type=Number(0.0, 3600.0),
    default=0.05,
    show_default=True,
    metavar="SECONDS",
    help="Between a scan and its image.",
)
@click.option("--start", type=Number(0.0, 1e9), default=0.0, metavar="SECONDS", help="Since the first scan.")
@click.option(
    "--end", type=Number(0.0, math.inf, finite=False), default=math.inf, metavar="SECONDS", help="Since the first scan."
)
@click.option("--every", type=Number(0.0, 1e9), default=0.0, metavar="SECONDS", help="Smallest time between two views.")
def command(
    recording: Path,
    output: Path | None,
    listing: bool,
    sensor_name: str | None,
    target_names: tuple[str, ...],
    topics: tuple[str, ...],
    camera_file: Path | None,
    no_images: bool,
    mocap_file: Path | None,
    body: tuple[str, ...],
    offsets: tuple[str, ...],
    estimate: bool,
    tolerance: float,
    start: float,
    end: float,
    every: float,
) -> None:
    """Cut a session out of RECORDING: scans, and the images and markers of the same moments.

    RECORDING is a ROS 1 or ROS 2 bag, an .mcap file, or a folder of clouds with timestamps.txt. The stamp in
    a message's header counts. A scan becomes a view if everything asked for was recorded with it. What was paired and
    what was dropped is reported, and written to extract.json beside session.yaml. The exit status is 0 if there is a
    view.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_sensor, load_target
    from optshape_graph.io.recordings import Recording, Selection, extract_session

    opened = Recording(recording)
    if listing:
        for topic in opened.topics:
            say(f"{topic.kind:7} {topic.count if topic.count is not None else '':>8} {topic.name} ({topic.type})")
        return
    if output is None or sensor_name is None or not target_names:
        raise click.UsageError("--output, --sensor and --target are needed to write a session")
    named = {opened.named(topic).kind: topic for topic in topics}
    if len(named) < len(topics):
        raise click.UsageError(f"several --topic of one kind: {', '.join(topics)}")
    given = _offsets(offsets)
    Outputs([recording, camera_file, mocap_file]).folder("--output", output)
    if output.exists() and recording.is_dir() and output.resolve() == recording.resolve():
        raise click.UsageError(f"--output {output}: is the recording; name another folder")
    mocap = _mocap(mocap_file)
    if estimate:
        if mocap is None or "mocap" in given:
            raise click.UsageError("--estimate-clock-offset needs --mocap, and no --clock-offset mocap=...")
        given["mocap"] = _estimated(opened, mocap, body, named.get("pose"))
    camera, image_topic = (None, None) if no_images else _camera(opened, camera_file, named.get("image"))
    extraction = extract_session(
        opened,
        output,
        sensor=load_sensor(sensor_name),
        targets=[load_target(name) for name in target_names],
        scan_topic=named.get("scan"),
        image_topic=image_topic,
        camera=camera,
        camera_offset=given.get("camera", 0.0),
        mocap=None if mocap is None else _of_targets(mocap, body),
        mocap_offset=given.get("mocap", 0.0),
        selection=Selection(tolerance, start, end, every),
        track=_track,
    )
    _say(extraction)


def _offsets(offsets: tuple[str, ...]) -> dict[str, float]:
    given = {}
    for text in offsets:
        source, _, seconds = text.partition("=")
        try:
            given[source] = OFFSET.convert(seconds, None, None)
        except click.BadParameter as error:
            raise click.UsageError(f"--clock-offset {text}: expected SOURCE=SECONDS") from error
        if source not in SOURCES:
            raise click.UsageError(f"--clock-offset {text}: the source is one of {', '.join(SOURCES)}")
    return given


def _mocap(file: Path | None) -> MocapRecording | None:
    from optshape_graph.io.mocap import read_mocap

    return None if file is None else read_mocap(file)


def _of_targets(mocap: MocapRecording, body: tuple[str, ...]) -> MocapRecording:
    if body:
        mocap.select(body)  # an error if one of them is missing
    return mocap.select([marker for marker in mocap.markers if marker not in body])


def _estimated(recording: Recording, mocap: MocapRecording, body: tuple[str, ...], topic: str | None) -> float:
    from optshape_graph.io.recordings import estimate_mocap_offset

    found = estimate_mocap_offset(recording, mocap.select(body) if body else mocap, topic, _track)
    say(
        f"clock offset of mocap: {found.seconds:.4f} s +- {found.standard_deviation:.4f} "
        f"(correlation {found.correlation:.3f}, elsewhere at most {found.runner_up:.3f}, over {found.overlap:.0f} s)"
    )
    return found.seconds


def _camera(recording: Recording, file: Path | None, topic: str | None) -> tuple[Any, str | None]:
    """Return the intrinsics and the topic of images; if there are none, warn and return nothing."""
    from optshape_graph.errors import InputError
    from optshape_graph.io import load_camera

    if topic is None and file is None and not any(t.kind == "image" for t in recording.topics):
        return None, None
    try:
        chosen = recording.topic("image", topic).name
        return (load_camera(file) if file else recording.camera_of(chosen)), chosen
    except InputError as error:
        if topic is not None or file is not None:
            raise
        warn(f"images are left out: {error}")
        return None, None


def _track(items: Iterable[Any], doing: str, total: int | None) -> Iterable[Any]:
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    hidden = not console.is_terminal
    return track(items, description=doing, total=total, console=console, transient=True, disable=hidden)


def _say(extraction: Extraction) -> None:
    say(f"{extraction.session}: {extraction.views} views of {extraction.scans} scans")
    if len(extraction.lags):
        say(f"  images are {abs(extraction.lags).mean() * 1e3:.1f} ms from their scans, "
                   f"{abs(extraction.lags).max() * 1e3:.1f} at most")  # fmt: skip
    if extraction.thinned:
        say(f"  {extraction.thinned} left out by --every")
    for reason, count in extraction.dropped.items():
        say(f"  {count} dropped: {reason}")
    say_passed_over(extraction.passed_over)
