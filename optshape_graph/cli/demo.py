"""`optshape demo`: the main job on bundled scans, with pictures, and what one sees in them."""

from __future__ import annotations

from pathlib import Path

import click

EXPLANATION = """\
What this was: eight scans of a target with motion-capture markers near its vertices, simulated with a VLP-32C at 4 to
10 m, face-on and angled. The first table compares where the LiDAR sees the target with where the markers say it is:
RMSE of the vertices, translation e_t, rotation e_r. The transforms are how the two systems stand to each other.

What there is in the folder:
  mocap.json      all numbers, with covariances
"""

PICTURES = """\
  fit.png         one scan: its returns, and the template fitted to them, from the front and from the side
  errors.png      the first table as a picture
  placements.png  from above: the target by the LiDAR (outlines) and by the markers (circles) in one frame
  markers.png     how far each marker is from its vertex: they are near the vertices, not on them

Your own: optshape estimate SCAN.pcd --target board.yaml --sensor vlp32c --plot pictures
"""


@click.command()
@click.option("-o", "--output", type=click.Path(file_okay=False, path_type=Path), default=Path("optshape-demo"),
              show_default=True, help="Folder for the results.")  # fmt: skip
@click.pass_context
def command(ctx: click.Context, output: Path) -> int:
    """Calibrate a bundled session of a LiDAR to motion capture: a result and pictures, in seconds."""
    from optshape_graph.cli import calibrate_mocap
    from optshape_graph.errors import InputError, MissingExtraError
    from optshape_graph.io import demo_folder, load_session, read_scan
    from optshape_graph.pose import estimate_pose

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
        click.echo(f"optshape: no pictures: {error}", err=True)
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
        scan = read_scan(view.scan, session.lidars[view.lidar])
        figure = plot_fit(scan, estimate_pose(scan, next(iter(session.targets.values()))))
        click.echo(f"picture: {save_figure(figure, output / 'fit.png')}")
    click.echo(f"result: {output / 'mocap.json'}\n")
    click.echo(EXPLANATION, nl=False)
    if plots:
        click.echo(PICTURES)
        click.echo(f"Look at {output / 'fit.png'} first.")
    return status
