"""`optshape demo`: the main job on bundled scans, with pictures and what they show."""

from __future__ import annotations

from pathlib import Path

import click

from optshape_graph.cli.console import say, warn
from optshape_graph.cli.options import FOLDER, example, force_option

EXPLANATION = """\
What this was: eight scans of a target with motion-capture markers near its vertices, simulated with a VLP-32C at 4 to
10 m, face-on and angled. The first table compares where the LiDAR sees the target with where the markers say it is:
RMSE of the vertices, translation e_t, rotation e_r. The transforms lead from one system to the other.

The folder has:
  mocap.json      all numbers, with covariances
"""

PICTURES = """\
  fit.png         one scan: its returns, and the template fitted to them, from the front and from the side
  errors.png      the first table as a picture
  placements.png  from above: the target by the LiDAR (outlines) and by the markers (circles) in one frame
  markers.png     how far each marker is from its vertex: they are near the vertices, not on them

Your own: optshape estimate SCAN.pcd --target board.yaml --sensor vlp32c --plot pictures
"""


@click.command(epilog=example("optshape demo -o optshape-demo"))
@click.option("-o", "--output", type=FOLDER, default=Path("optshape-demo"),
              show_default=True, help="Folder for the results.")  # fmt: skip
@force_option
@click.pass_context
def command(ctx: click.Context, output: Path, force: bool) -> int:
    """Calibrate a bundled session of a LiDAR to motion capture: a result and pictures, in seconds.

    An older demo in the folder is replaced; other files of the same names only with --force.
    """
    from optshape_graph.cli import calibrate_mocap
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.errors import InputError, MissingExtraError
    from optshape_graph.io import demo_folder, load_session, read_scan
    from optshape_graph.pose import estimate_pose

    outputs = Outputs(force=force)
    outputs.folder("--output", output, ["mocap.json"], "mocap")
    if not (output / "mocap.json").exists():  # then pictures are nobody's older demo
        outputs.folder("--output", output, ["fit.png", "errors.png", "placements.png", "markers.png"], replace=False)
    session = load_session(demo_folder() / "session.yaml")
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{output}: cannot be made ({error.strerror})") from error
    plots: Path | None = output
    try:
        from optshape_graph.viz.style import new_figure

        new_figure()
    except MissingExtraError as error:
        plots = None
        warn(f"no pictures: {error}")
    status: int = ctx.invoke(
        calibrate_mocap.command,
        session=session.path,
        estimate_scale=False,
        json_path=output / "mocap.json",
        plots=plots,
    )
    if plots:
        from optshape_graph.viz.pose import plot_fit
        from optshape_graph.viz.style import save_figure

        view = session.views[3]
        scan = read_scan(view.cloud, session.lidars[view.lidar])
        figure = plot_fit(scan, estimate_pose(scan, next(iter(session.targets.values()))))
        say(f"picture: {save_figure(figure, output / 'fit.png')}")
    say(f"result: {output / 'mocap.json'}")
    click.echo()
    click.echo(EXPLANATION, nl=False)
    if plots:
        click.echo(PICTURES)
        say(f"Look at {output / 'fit.png'} first.")
    return status
