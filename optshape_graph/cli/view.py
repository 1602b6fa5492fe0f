"""`optshape view`: show a scan or a result in space, in Rerun or Open3D, or write it as a recording of Rerun."""

from __future__ import annotations

from pathlib import Path

import click

from optshape_graph.cli.console import say, warn
from optshape_graph.cli.options import FILE, example, force_option
from optshape_graph.names import shell_word


@click.command(epilog=example("optshape view poses.json --save poses.rrd"))
@click.argument("file", type=click.Path(path_type=Path), metavar="RESULT.json|SCAN")
@click.option("--target", "targets", multiple=True,
              help="Target file, for a result that names a target which is not built in; may be repeated.")  # fmt: skip
@click.option("--save", "recording", type=FILE, metavar="FILE.rrd",
              help="Write a recording for Rerun instead of opening a viewer.")  # fmt: skip
@click.option("--open3d", "with_open3d", is_flag=True, help="Open a window of Open3D instead of Rerun.")
@click.option("--scan", "step", type=click.IntRange(0, 1_000_000_000), default=0, show_default=True,
              help="Which scan of the result, counted from 0, with --open3d; Rerun has a slider.")  # fmt: skip
@force_option
def command(
    file: Path, targets: tuple[str, ...], recording: Path | None, with_open3d: bool, step: int, force: bool
) -> None:
    """Show a SCAN, or a RESULT of estimate, detect, map, calibrate mocap, calibrate camera or simulate, in space.

    Returns are coloured by range, edge points by the edge that they were taken for; fitted outlines are blue,
    runner-ups orange, and three circles enclose three standard deviations. Scans are found where the result says they
    are, or beside it.

    Rerun's viewer collects anonymous usage data unless told not to: rerun analytics disable.
    """
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io import load_target
    from optshape_graph.viz.documents import spatial

    if recording and with_open3d:
        raise click.UsageError("give either --save or --open3d")
    Outputs([file, *targets], force=force).file("--save", recording)
    seen = spatial(file, {target.name: target for target in map(load_target, targets)})
    for note in seen.notes:
        warn(note)
    if with_open3d:
        from optshape_graph.viz.open3d_view import show

        if seen.steps and step >= len(seen.steps):
            raise click.UsageError(f"--scan: the result has scans 0 to {len(seen.steps) - 1}, found {step}")
        show(seen, step, file.name)
        return
    from optshape_graph.viz.rerun_view import open_viewer, save_recording

    if recording:
        save_recording(seen, recording, file.name)
        say(f"recording: {recording} (open it with: rerun {shell_word(str(recording))})")
    else:
        open_viewer(seen, file.name)
