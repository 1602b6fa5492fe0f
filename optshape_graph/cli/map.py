"""`optshape map`: a map of targets and a trajectory, out of a recording or a session."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.options import outside_option
from optshape_graph.cli.plots import Pictures, plot_option

if TYPE_CHECKING:
    from collections.abc import Iterable

    from optshape_graph._arrays import Floats
    from optshape_graph.io.recordings import Recording, Stamped
    from optshape_graph.io.trajectories import Trajectory
    from optshape_graph.mapping.incremental import LandmarkSlam
    from optshape_graph.mapping.map import Map
    from optshape_graph.mapping.recording import OdometryTrack, Progress
    from optshape_graph.scan import Scan
    from optshape_graph.target import Target


MANY = 60
"""Scans from which on several processes are worth their start."""


@click.command()
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--targets", "--target", "target_names", multiple=True,
              help="Built-in name, NAME@AREA, or file; may be repeated. A session names its own.")  # fmt: skip
@click.option("--sensor", "sensor_name", help="The LiDAR: built-in name or file. A session names its own.")
@click.option("--scans", "scan_topic", metavar="TOPIC", help="Not needed where there is only one.")
@click.option("--odometry", metavar="TOPIC|FILE",
              help="Topic of poses, or a file of them (TUM, EuRoC, Motive); `none` for none.  "
              "[default: the only topic of poses, if there is one]")  # fmt: skip
@click.option("--mounting", nargs=6, type=float, metavar="X Y Z ROLL PITCH YAW",
              help="The LiDAR on the body that the odometry is of: metres and degrees.  "
              "[default: the recording's static transforms]")  # fmt: skip
@click.option("--one-each", is_flag=True, help="There is one of each target: its name is the landmark's.")
@click.option("--known", type=click.Path(path_type=Path), help="Map to start from: surveyed landmarks, or made before.")
@click.option("--odometry-noise", nargs=2, type=float, default=(0.02, 0.2), show_default=True, metavar="M DEG",
              help="Standard deviations per square root of a metre.")  # fmt: skip
@click.option("--keyframe", nargs=2, type=float, default=(0.5, 10.0), show_default=True, metavar="M DEG",
              help="Use a scan after having moved or turned this far.")  # fmt: skip
@click.option("--confirmations", type=click.IntRange(min=1), help="Sightings that must agree on a new landmark.  "
              "[default: 2; 1 without odometry]")  # fmt: skip
@click.option("--lag", type=float, metavar="SECONDS", help="Keep only the latest poses in the graph: bounded memory.")
@click.option("--batch/--no-batch", default=True, show_default=True, help="Solve for everything at once at the end.")
@click.option("--as-built", type=float, metavar="METRES",
              help="Refine the targets' vertices, which were built to this standard deviation.")  # fmt: skip
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Processes that detect targets.  [default: one for each core, for recordings of many scans]",
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write the map (optshape/map/1).")
@click.option("--tum", "tum_file", type=click.Path(path_type=Path), help="Write the trajectory.")
@click.option("--kitti", "kitti_file", type=click.Path(path_type=Path), help="Write the trajectory.")
@click.option("--g2o", "g2o_file", type=click.Path(path_type=Path), help="Write the pose graph.")
@plot_option("the map from above, and the structure of its graph")
@outside_option
def command(
    source: Path,
    allow_outside: bool,
    target_names: tuple[str, ...],
    sensor_name: str | None,
    scan_topic: str | None,
    odometry: str | None,
    mounting: tuple[float, ...] | None,
    one_each: bool,
    known: Path | None,
    odometry_noise: tuple[float, float],
    keyframe: tuple[float, float],
    confirmations: int | None,
    lag: float | None,
    batch: bool,
    as_built: float | None,
    workers: int | None,
    json_file: Path | None,
    tum_file: Path | None,
    kitti_file: Path | None,
    g2o_file: Path | None,
    plots: Path | None,
) -> None:
    """Map the targets that SOURCE saw, and where it saw them from.

    SOURCE is a session file (.yaml), a ROS 1 or ROS 2 bag, an .mcap file, or a folder of clouds with timestamps.txt.
    Scans are placed by odometry, and by what they have in common with others; without odometry, by that alone. Scans
    that cannot be used are skipped with a reason and counted. The exit status is 3 if no target was mapped.

    Example: optshape map drive.bag --targets paper --sensor vlp32c --json map.json --tum trajectory.tum
    """
    from math import radians

    from optshape_graph.mapping import LandmarkSlam, load_map, save_map, solve_batch
    from optshape_graph.mapping.recording import (
        KeyframePolicy,
        MotionNoise,
        Progress,
        build_map,
        keyframes,
        observe_all,
    )

    if as_built is not None and (lag is not None or not batch):
        raise click.UsageError("--as-built needs the batch solution, so no --lag and no --no-batch")
    scans, targets, track, expected, skipped = _open(
        source, target_names, sensor_name, scan_topic, odometry, mounting, allow_outside
    )
    slam = LandmarkSlam(
        load_map(known) if known else None,
        lag=lag,
        confirmations=confirmations or (2 if track else 1),
        name=source.stem,
    )
    policy = KeyframePolicy(keyframe[0], radians(keyframe[1]))
    noise = MotionNoise(odometry_noise[0], radians(odometry_noise[1]))
    progress = Progress()
    seen = observe_all(
        keyframes(scans, track, policy, progress),
        targets,
        one_each,
        as_built is not None,
        _processes(expected) if workers is None else workers,
        biases=batch and lag is None,
    )
    with _shown(progress, slam, expected) as report:
        build_map(slam, seen, noise, progress, report)
    slam.settle()
    result, graph = slam.map(), None
    if batch and lag is None and result.landmarks:
        solution = solve_batch(slam.problem(), as_built_sigma=as_built)
        result, graph = solution.map(), solution
    trajectory = result.trajectories[slam.name]
    if json_file:
        save_map(json_file, result)
    _write(trajectory, tum_file, kitti_file)
    if g2o_file:
        from optshape_graph.io.trajectories import write_g2o
        from optshape_graph.mapping.batch import pose_graph

        if graph is None:
            raise click.UsageError("--g2o needs the batch solution, and at least one landmark")
        write_g2o(g2o_file, pose_graph(graph))
    _say(result, slam, progress, skipped())
    if plots:
        from optshape_graph.viz.map import plot_map, plot_structure

        pictures = Pictures(plots)
        pictures.save("map", plot_map(result))
        if graph is not None:
            pictures.save("structure", plot_structure(graph.problem))
        pictures.tell()
    if not result.landmarks:
        click.get_current_context().exit(3)


def _processes(expected: int | None) -> int:
    """Processes for a recording: starting them takes about as long as detecting targets in MANY scans."""
    import os

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return cores if expected is None or expected >= MANY else 1


def _open(
    source: Path,
    target_names: tuple[str, ...],
    sensor_name: str | None,
    scan_topic: str | None,
    odometry: str | None,
    mounting: tuple[float, ...] | None,
    allow_outside: bool,
) -> tuple[Iterable[Stamped[Scan]], list[Target], OdometryTrack | None, int | None, Any]:
    """Scans, targets, odometry, the number of scans if it is known, and what says which messages were skipped."""
    from optshape_graph.io import load_sensor, load_session, load_target
    from optshape_graph.io.recordings import Recording, Skipped, Stamped
    from optshape_graph.io.trajectories import is_trajectory, read_trajectory
    from optshape_graph.mapping.recording import OdometryTrack, session_scans

    poses: Iterable[Stamped[Any]] | None = None
    if odometry is not None and is_trajectory(odometry):
        trajectory = read_trajectory(odometry)
        assert trajectory.stamps is not None  # what is read has them
        poses = [Stamped(float(stamp), T) for stamp, T in zip(trajectory.stamps, trajectory.poses, strict=True)]
    T_body_lidar = None if mounting is None else _placed(mounting)
    if source.suffix.lower() in (".yaml", ".yml", ".json"):
        if target_names or sensor_name or scan_topic:
            raise click.UsageError("a session file names its own targets, sensor and scans")
        session = load_session(source, allow_outside=allow_outside)
        missed = Skipped()
        return (
            session_scans(session, missed), list(session.targets.values()),
            None if poses is None else OdometryTrack(poses, T_body_lidar), len(session.views), lambda: missed,
        )  # fmt: skip
    if not target_names:
        raise click.UsageError("--targets is needed: what is to be looked for")
    recording = Recording(source)
    stream = recording.scans(scan_topic, None if sensor_name is None else load_sensor(sensor_name))
    if poses is None and odometry != "none" and (odometry or any(t.kind == "pose" for t in recording.topics)):
        poses = recording.poses(odometry)
        if T_body_lidar is None:
            T_body_lidar = _mounted(recording, scan_topic, odometry)
    targets = [load_target(name) for name in target_names]
    track = None if poses is None else OdometryTrack(poses, T_body_lidar)
    return stream, targets, track, stream.expected, lambda: stream.skipped


def _placed(mounting: tuple[float, ...]) -> Floats:
    from math import radians

    from optshape_graph.simulation import pose_from_rpy

    return pose_from_rpy(mounting[:3], [radians(angle) for angle in mounting[3:]])


def _mounted(recording: Recording, scan_topic: str | None, pose_topic: str | None) -> Floats | None:
    """T_body_lidar as the recording has it; None, and a word of warning, where it does not say."""
    found = recording.mounting(scan_topic, pose_topic)
    if found.T_body_lidar is None:
        if found.body and found.lidar:
            click.echo(
                f"warning: odometry is of '{found.body}', scans are in '{found.lidar}', and no static transform links "
                "them: taken for one frame; --mounting says where the LiDAR is",
                err=True,
            )
        return None
    if found.body != found.lidar:
        x, y, z = found.T_body_lidar[:3, 3]
        click.echo(f"'{found.lidar}' is at ({x:.3f}, {y:.3f}, {z:.3f}) m in '{found.body}', by its static transforms")
    return found.T_body_lidar


@contextmanager
def _shown(progress: Progress, slam: LandmarkSlam, expected: int | None) -> Iterator[Any]:
    """Show how far a run is, and what it has found."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = TextColumn("mapping"), BarColumn(), TextColumn("{task.fields[summary]}"), TimeRemainingColumn()
    console = Console(stderr=True)
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=expected, summary="")

        def report(now: Progress) -> None:
            summary = f"{now.scans} scans, {now.keyframes} keyframes, {now.sightings} sightings, "
            summary += f"{len(slam.landmark_names)} landmarks, {now.skipped.total()} skipped"
            bar.update(task, completed=now.scans, summary=summary)

        yield report


def _write(trajectory: Trajectory, tum: Path | None, kitti: Path | None) -> None:
    from optshape_graph.io.trajectories import write_kitti, write_tum

    if tum:
        write_tum(tum, trajectory)
    if kitti:
        write_kitti(kitti, trajectory)


def _say(result: Map, slam: LandmarkSlam, progress: Progress, messages: Any) -> None:
    click.echo(
        f"{progress.scans} scans, {progress.keyframes} keyframes, {progress.sightings} sightings: "
        f"{len(result.landmarks)} landmarks, {len(result.trajectories[slam.name])} poses"
    )
    for landmark in result.landmarks:
        x, y, z = landmark.T_world_target[:3, 3]
        sd = landmark.covariance[3:, 3:].trace() ** 0.5
        click.echo(f"  {landmark.id}: ({x:.3f}, {y:.3f}, {z:.3f}) m +- {sd:.3f}, {landmark.observations} observations")
    if slam.counts:
        click.echo("  " + ", ".join(f"{count} {what}" for what, count in slam.counts.items()))
    for reason, count in (*progress.skipped.items(), *messages.items()):
        click.echo(f"  {count} scans skipped: {reason}")
    if not result.landmarks and progress.keyframes:
        click.echo(
            "  no target was seen: `optshape detect` on one of the scans says what each surface lacks"
            if not progress.sightings
            else "  sightings did not agree on a landmark: is the odometry the LiDAR's (--mounting), its noise right?"
        )
