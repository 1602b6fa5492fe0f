"""`optshape map`: map targets and a trajectory from a recording or a session."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from optshape_graph.cli.console import SECONDS_BETWEEN, say, say_passed_over, terminal, warn
from optshape_graph.cli.html_report import conclude, report_option
from optshape_graph.cli.options import (
    FILE,
    JSON_FILE,
    POSITIVE,
    Number,
    example,
    force_option,
    outside_option,
    pool_options,
)
from optshape_graph.cli.plots import Pictures, plot_option

T = TypeVar("T")

if TYPE_CHECKING:
    from optshape_graph._arrays import Floats
    from optshape_graph.io.recordings import Recording
    from optshape_graph.io.sessions import Session
    from optshape_graph.mapping import Map
    from optshape_graph.mapping.recording import MapResult, Progress
    from optshape_graph.runs.workers import Pool


class Offset(click.ParamType):  # type: ignore[type-arg]  # generic in newer versions of click only
    """Seconds, or `auto`."""

    name = "offset"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Return the number that a text is, or `auto`."""
        return "auto" if value == "auto" else Number(-1e11, 1e11).convert(value, param, ctx)


@click.command(
    epilog=example("optshape map drive.bag --targets paper --sensor vlp32c --json map.json --tum trajectory.tum")
)
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--targets", "--target", "target_names", multiple=True,
              help="Built-in name, NAME@AREA, or file; may be repeated. A session names its own.")  # fmt: skip
@click.option("--sensor", "sensor_names", multiple=True,
              help="The LiDAR: built-in name or file; for several LiDARs one each, in the order of --scans. "
              "A session names its own.")  # fmt: skip
@click.option("--scans", "scan_topics", metavar="TOPIC", multiple=True,
              help="Not needed where there is only one; may be repeated, for several LiDARs on one robot.")  # fmt: skip
@click.option("--odometry", metavar="TOPIC|FILE",
              help="Topic of poses, or a file of them (TUM, EuRoC, Motive); `none` for none.  "
              "[default: the only topic of poses, if there is one]")  # fmt: skip
@click.option("--mounting", "mountings", nargs=6, type=Number(-1e4, 1e4), metavar="X Y Z ROLL PITCH YAW", multiple=True,
              help="Pose of the LiDAR on the body whose poses the odometry has: metres and degrees, R = Rx Ry Rz (not "
              "ROS's Rz Ry Rx: for that, `transforms` by --extrinsics); for several LiDARs one each, in the order of "
              "--scans.  [default: the recording's static transforms]")  # fmt: skip
@click.option("--extrinsics", type=FILE, help="Where LiDARs are: a file with `transforms`, such as a calibrated rig.")
@click.option("--clock-offset", type=Offset(), default="0", show_default=True, metavar="SECONDS|auto",
              help="What to add to the stamps of the odometry to get the LiDAR's; `auto`: estimated from how fast the "
              "robot turned by either (needs the extra `icp`).")  # fmt: skip
@click.option("--one-each", is_flag=True, help="There is one of each target: its name is the landmark's.")
@click.option("--known", type=FILE, help="Map to start from: surveyed landmarks, or made before.")
@click.option("--odometry-noise", nargs=2, type=Number(1e-6, 100.0), default=(0.02, 0.2), show_default=True,
              metavar="M DEG", help="Standard deviations per square root of a metre.")  # fmt: skip
@click.option("--keyframe", nargs=2, type=Number(0.0, 1e4), default=(0.5, 10.0), show_default=True, metavar="M DEG",
              help="Use a scan after having moved or turned this far.")  # fmt: skip
@click.option("--confirmations", type=click.IntRange(1, 1000), help="Sightings that must agree on a new landmark.  "
              "[default: 2; 1 without odometry]")  # fmt: skip
@click.option(
    "--lag", type=POSITIVE, metavar="SECONDS", help="Keep only the latest poses in the graph: bounded memory."
)
@click.option("--batch/--no-batch", default=True, show_default=True, help="Solve for everything at once at the end.")
@click.option("--as-built", type=Number(1e-6, 1.0), metavar="METRES",
              help="Refine the targets' vertices, which were built to this standard deviation.")  # fmt: skip
@pool_options
@click.option("--json", "json_file", type=JSON_FILE, help="Write the map (optshape/map/1); until it is whole, "
              "what was seen is kept in FILE.journal, from which the same command goes on.")  # fmt: skip
@click.option("--tum", "tum_file", type=FILE, help="Write the trajectory.")
@click.option("--kitti", "kitti_file", type=FILE, help="Write the trajectory.")
@click.option("--g2o", "g2o_file", type=FILE, help="Write the pose graph.")
@force_option
@report_option
@plot_option("the map from above, and the structure of its graph")
@outside_option
def command(
    source: Path,
    allow_outside: bool,
    target_names: tuple[str, ...],
    sensor_names: tuple[str, ...],
    scan_topics: tuple[str, ...],
    odometry: str | None,
    mountings: tuple[tuple[float, ...], ...],
    extrinsics: Path | None,
    clock_offset: float | Literal["auto"],
    one_each: bool,
    known: Path | None,
    odometry_noise: tuple[float, float],
    keyframe: tuple[float, float],
    confirmations: int | None,
    lag: float | None,
    batch: bool,
    as_built: float | None,
    pool: Pool | None,
    json_file: Path | None,
    tum_file: Path | None,
    kitti_file: Path | None,
    g2o_file: Path | None,
    force: bool,
    html: Path | None,
    plots: Path | None,
) -> int:
    """Map the targets in SOURCE, and the trajectory from which they were seen.

    SOURCE is a session file (.yaml), a ROS 1 or ROS 2 bag, an .mcap file, or a folder of clouds with timestamps.txt.
    Poses of scans come from odometry and from targets that several scans see; without odometry, from targets alone.
    Scans that cannot be used are skipped with a reason and counted. With several LiDARs, poses are those of the first.
    The exit status is 3 if no target was mapped, or the map is not to be trusted, with the reason.
    """
    from math import radians

    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_sensor, load_target
    from optshape_graph.io.recordings import Recording
    from optshape_graph.mapping import load_map
    from optshape_graph.mapping.recording import KeyframePolicy, MotionNoise, map_recording, read_extrinsics
    from optshape_graph.runs.files import fingerprint
    from optshape_graph.runs.interruption import going_on
    from optshape_graph.runs.journal import Journal, journal_of

    for option, given in (("--as-built", as_built), ("--g2o", g2o_file)):
        if given is not None and (lag is not None or not batch):
            raise click.UsageError(f"{option} needs the batch solution, so no --lag and no --no-batch")
    files = _files(source)
    inputs = [odometry, *sensor_names, *target_names]
    outputs = Outputs([*files, known, extrinsics, *inputs], force=force)
    outputs.file("--json", json_file, "map")
    for option, file in (("--tum", tum_file), ("--kitti", kitti_file), ("--g2o", g2o_file)):
        outputs.file(option, file)
    outputs.file("--report", html)
    outputs.folder("--plot", plots)
    targets = tuple(map(load_target, target_names))
    sensors = _of_each("--sensor", list(map(load_sensor, sensor_names)), scan_topics, common=True)
    transforms = read_extrinsics(extrinsics) if extrinsics else None
    opened = _opened(source, target_names, sensor_names, scan_topics, allow_outside)
    names = scan_topics if isinstance(opened, Recording) else tuple(opened.lidars)
    placed = _of_each("--mounting", list(map(_placed, mountings)), names)
    describe = {
        "form": "map", "targets": target_names, "sensor": sensor_names, "scans": scan_topics, "odometry": odometry,
        "mounting": mountings, "clock_offset": clock_offset, "one_each": one_each, "noise": odometry_noise,
        "keyframe": keyframe, "shapes": as_built is not None, "biases": batch and lag is None,
        "files": fingerprint([*map(str, [*files, *filter(None, [extrinsics])]), *filter(None, inputs)]),
    }  # fmt: skip
    with (
        Journal(journal_of(json_file), describe, None) as journal,
        _shown() as report,
        going_on(lambda: journal.advice(f"{journal.finished} keyframes were looked at")),
    ):
        result = map_recording(
            opened,
            targets,
            sensors,
            scans=scan_topics or None,
            odometry=odometry,
            mounting=placed,
            extrinsics=transforms,
            clock_offset=clock_offset,
            known=load_map(known) if known else None,
            one_each=one_each,
            keyframe=KeyframePolicy(keyframe[0], radians(keyframe[1])),
            noise=MotionNoise(odometry_noise[0], radians(odometry_noise[1])),
            confirmations=confirmations,
            lag=lag,
            batch=batch,
            as_built_sigma=as_built,
            pool=pool,
            journal=journal,
            report=report,
        )
        _write(result, json_file, tum_file, kitti_file, g2o_file)
        journal.remove()
    _say(result, known is not None)
    pictures = _draw(result, plots) if plots else ()
    conclude({**_document(result), "trajectory": [{}] * len(result.trajectory)}, html, pictures)
    return 3 if result.problems else 0


def _files(source: Path) -> list[Path]:
    """Return the files that a source consists of."""
    return sorted(path for path in source.rglob("*") if path.is_file()) if source.is_dir() else [source]


def _opened(
    source: Path,
    target_names: tuple[str, ...],
    sensor_names: tuple[str, ...],
    scan_topics: tuple[str, ...],
    allow_outside: bool,
) -> Session | Recording:
    from optshape_graph.io import load_session
    from optshape_graph.io.recordings import Recording

    if source.suffix.lower() in (".yaml", ".yml", ".json"):
        if target_names or sensor_names or scan_topics:
            raise click.UsageError("a session file names its own targets, sensor and scans")
        return load_session(source, allow_outside=allow_outside)
    if not target_names:
        raise click.UsageError("--targets is needed: what is to be looked for")
    return Recording(source)


def _of_each(option: str, values: list[T], names: tuple[str, ...], common: bool = False) -> T | dict[str, T] | None:
    """Return an option's value for the one LiDAR, or its values by LiDAR; with `common`, one value may hold for all.

    Raises:
        UsageError: another number of values than LiDARs.
    """
    if not values:
        return None
    if len(values) == 1 and (common or len(names) <= 1):
        return values[0]
    if len(values) != len(names):
        raise click.UsageError(f"{option} is given {len(values)} times, for {len(names) or 1} LiDARs")
    return dict(zip(names, values, strict=True))


def _placed(mounting: tuple[float, ...]) -> Floats:
    from math import radians

    from optshape_graph.simulation import pose_from_rpy

    return pose_from_rpy(mounting[:3], [radians(angle) for angle in mounting[3:]])


@contextmanager
def _shown() -> Iterator[Callable[[Progress], None]]:
    """Show the progress of a run and what it has found: a bar on a terminal, else a line a minute."""

    def summary(now: Progress) -> str:
        return (
            f"{now.scans} scans, {now.keyframes} keyframes, {now.sightings} sightings, {now.landmarks} landmarks, "
            f"{now.skipped.total()} skipped"
        )

    if not terminal():
        said = time.monotonic()

        def line(now: Progress) -> None:
            nonlocal said
            if time.monotonic() - said >= SECONDS_BETWEEN:
                said = time.monotonic()
                warn(f"mapping: {summary(now)}")

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("mapping"), BarColumn(), TextColumn("{task.fields[summary]}"), TimeRemainingColumn()
    with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None, summary="")
        yield lambda now: bar.update(task, completed=now.scans, total=now.expected, summary=summary(now))


def _document(result: MapResult) -> dict[str, Any]:
    """Return the map's document, with the facts of the run."""
    report = {
        "problems": list(result.problems), "warnings": list(result.warnings), "clocks": result.clocks.to_dict(),
        **result.passed_over.to_dict(),
    }  # fmt: skip
    return {**result.map.to_dict(), "report": report}


def _write(result: MapResult, json_file: Path | None, tum: Path | None, kitti: Path | None, g2o: Path | None) -> None:
    from optshape_graph.io.documents import write_json
    from optshape_graph.io.trajectories import write_g2o, write_kitti, write_tum
    from optshape_graph.mapping.batch import pose_graph

    if json_file:
        write_json(json_file, _document(result))
    if tum:
        write_tum(tum, result.trajectory)
    if kitti:
        write_kitti(kitti, result.trajectory)
    if g2o and result.solution is not None:
        write_g2o(g2o, pose_graph(result.solution))
    elif g2o:
        warn(f"{g2o}: not written, for no landmark was mapped")


def _draw(result: MapResult, plots: Path) -> list[Path]:
    from optshape_graph.viz.map import plot_map, plot_structure

    pictures = Pictures(plots)
    pictures.save("map", plot_map(result.map))
    if result.solution is not None:
        pictures.save("structure", plot_structure(result.solution.problem))
    pictures.tell()
    return pictures.paths


def say_landmarks(result: Map, frame: str) -> None:
    """Print a line for each landmark of a map, in a frame that is named."""
    if result.landmarks:
        say(f"  landmarks in the frame of {frame}, with the largest standard deviation of each position:")
    for landmark in result.landmarks:
        x, y, z = landmark.position
        sd = 1e3 * float(landmark.covariance.diagonal()[3:].max() ** 0.5)
        say(f"  {landmark.id}: ({x:.3f}, {y:.3f}, {z:.3f}) m +- {sd:.1f} mm, {landmark.observations} observations")


_BECAME = {
    "matched": "of known landmarks",
    "new": "of new ones",
    "pending": "that waited for others to agree",
    "rejected": "that contradict the map",
}
"""What became of sightings, in words."""


def _say(result: MapResult, known: bool) -> None:
    progress, found = result.progress, result.mounting
    if found is not None and found.T_body_lidar is not None and found.body != found.lidar:
        x, y, z = found.T_body_lidar[:3, 3]
        say(f"'{found.lidar}' is at ({x:.3f}, {y:.3f}, {z:.3f}) m in '{found.body}', by its static transforms")
    for warning in result.warnings:
        warn(f"warning: {warning}")
    say(
        f"{progress.scans} scans, {progress.keyframes} keyframes, {progress.sightings} sightings: "
        f"{len(result.map.landmarks)} landmarks, {len(result.trajectory)} poses"
    )
    for line in result.clocks.lines():
        say(f"  {line}")
    say_landmarks(result.map, "the known map" if known else "the first pose")
    if result.counts:
        said = (f"{count} {_BECAME.get(what, what)}" for what, count in result.counts.items())
        say(f"  sightings: {', '.join(said)}")
    say_passed_over(result.passed_over)
    if not result.map.landmarks and progress.keyframes:
        say(
            "  no target was seen: `optshape detect` on one of the scans says what each surface lacks"
            if not progress.sightings
            else "  sightings did not agree on a landmark: is the odometry the LiDAR's (--mounting), its noise right?"
        )
    for problem in result.problems:
        warn(f"not to be trusted: {problem}")
