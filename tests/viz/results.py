"""Results of every kind, as the commands write them."""

from pathlib import Path

from click.testing import CliRunner

from optshape_graph.cli.main import cli
from optshape_graph.io import demo_folder

DEMO = demo_folder()


def command(*arguments: object) -> None:
    result = CliRunner().invoke(cli, [str(a) for a in arguments], standalone_mode=False)
    assert result.exception is None, result.exception


def write_results(folder: Path) -> dict[str, Path]:
    """Write a result of every kind; return their paths, by kind."""
    paths = {kind: folder / f"{kind}.json" for kind in ("estimate", "detect", "map", "mocap")}
    command("estimate", DEMO / "4m.pcd", DEMO / "8m.pcd", "--target", DEMO / "target.yaml", "--sensor", "vlp32c",
            "--json", paths["estimate"])  # fmt: skip
    (folder / "scene.yaml").write_text(
        "schema: optshape/scene/1\n"
        "targets: [{target: paper, position: [6, 0, 0], rpy_deg: [10, 5, 20]}]\n"
        "floor: {height: -1.5}\nwalls: [{size: [12, 4], position: [9, 0, 0]}]\n"
    )
    command("simulate", "--scene", folder / "scene.yaml", "-o", folder / "simulation.pcd")
    paths["simulation"] = folder / "simulation.json"
    command("detect", folder / "simulation.pcd", "--target", "paper", "--sensor", "vlp32c", "--json", paths["detect"])
    command("calibrate", "mocap", DEMO / "session.yaml", "--json", paths["mocap"])
    command("map", DEMO / "session.yaml", "--one-each", "--json", paths["map"])
    return paths
