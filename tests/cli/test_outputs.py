"""Every file that a command writes in a form of this package fits its schema, and every key is described there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph.cli.main import COMMANDS, cli
from optshape_graph.io import demo_folder, load_sensor, load_target, write_scan
from tests.io.schema_support import complaint

pytest.importorskip("jsonschema")
for library in ("cv2", "rosbags", "pyarrow", "matplotlib", "ezdxf"):
    pytest.importorskip(library)

DEMO = demo_folder()
ROOT = Path(__file__).parents[2]

RUNS: dict[str, tuple[str, set[str]]] = {
    "estimate": (
        "estimate {demo}/4m.pcd {demo}/8m.pcd {bad} --target {demo}/target.yaml --sensor {demo}/sensor.yaml "
        "--json {out}/a.json",
        {"estimate"},
    ),
    "detect": (
        "detect {scene} {empty} {bad} --target square@1 --target triangle@1 --sensor vlp32c --json {out}/a.json",
        {"detect"},
    ),
    "calibrate mocap": ("calibrate mocap {session} --estimate-scale --json {out}/a.json", {"mocap"}),
    "calibrate camera": ("calibrate camera {camera} --use-target-points --json {out}/a.json", {"camera-calibration"}),
    "calibrate sensor": (
        "calibrate sensor {session} -o {out}/a.yaml --json {out}/a.json", {"sensor-calibration", "sensor"},
    ),
    "calibrate rig": ("calibrate rig {rig} --use-target-points --json {out}/a.json", {"rig"}),
    "design optimise": (
        "design optimise --starts 1 --rings 1 3 --area 0.5 --sides 3 -o {out}/a.yaml", {"target", "design-start"},
    ),
    "design score": ("design score square paper@0.5 --sensor vlp16 --distance 6 -o {out}/a.json", {"design-scores"}),
    "design export": ("design export paper@0.3 --format svg -o {out}/a.svg", {"target"}),
    "design study": (
        "design study --shapes 0 --distances 8 --placements 1 -o {out}", {"design-study", "sweep", "sweep-task"},
    ),
    "simulate": ("simulate --range 6 --noise sensor --remove-rings 3 -o {out}/a.pcd", {"simulation"}),
    "simulate a scene": ("simulate --scene {scene_file} -o {out}/a.pcd", {"simulation"}),
    "extract": (
        "extract {bag} -o {out}/cut --sensor {four} --target paper --target square",
        {"session", "extract", "sensor", "target", "camera"},
    ),
    "map": ("map {session} --one-each --json {out}/a.json --tum {out}/a.tum --g2o {out}/a.g2o", {"map"}),
    "merge": ("merge {one} {two} --json {out}/a.json", {"map"}),
    "report": ("report {one} -o {out}/a.html", set()),
    "evaluate simulation": (
        "evaluate simulation --distance 4 --rpy 0 0 0 --noise 0 --seeds 1 --method global -o {out} --json {out}/a.json",
        {"sweep", "sweep-task", "simulation-evaluation"},
    ),
    "evaluate mocap": ("evaluate mocap {demo} --json {out}/a.json -o {out}/tables", {"mocap-evaluation"}),
    "demo": ("demo -o {out}", {"mocap"}),
    "info": ("info {session} {bag} {scene_file} --json {out}/a.json", {"info"}),
    "doctor": ("doctor --json {out}/a.json", {"doctor"}),
}  # fmt: skip
"""A run of every command: its arguments, and the forms that it must have written."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """What the runs read."""
    from tests.calibration.session_support import write_session
    from tests.cli.test_calibrate_rig import write_session as write_rig
    from tests.cli.test_extract import SENSOR, recording
    from tests.detection.scenes import pose, scan_of
    from tests.fuzz.readers import SCENE
    from tests.mapping.test_map import a_map

    folder = tmp_path_factory.mktemp("inputs")
    sensor = load_sensor("vlp32c")
    write_scan(folder / "scene.pcd", scan_of(sensor, [(load_target("square@1"), pose(6, 0, 0, 30, 10, 5))]).scan)
    write_scan(folder / "empty.pcd", scan_of(sensor, []).scan)
    (folder / "bad.pcd").write_text("not a cloud")
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "four.yaml").write_text(SENSOR)
    lines = (DEMO / "session.yaml").read_text().replace(", mocap_frame: 7", "")  # one scan takes no part
    for file in DEMO.iterdir():
        (folder / "demo" / file.name).parent.mkdir(exist_ok=True)
        (folder / "demo" / file.name).write_bytes(file.read_bytes())
    (folder / "demo" / "session.yaml").write_text(lines)
    (folder / "camera").mkdir()
    session = write_session(folder / "camera")
    (session / "3.png").write_bytes(b"broken")
    (folder / "rig").mkdir()
    rig = write_rig(folder / "rig")
    for name in ("one", "two"):
        a_map("abc", session=name).save(folder / f"{name}.json")
    return {
        "one": folder / "one.json", "two": folder / "two.json",
        "demo": DEMO, "session": folder / "demo" / "session.yaml", "camera": session / "session.yaml", "rig": rig,
        "scene": folder / "scene.pcd", "empty": folder / "empty.pcd", "bad": folder / "bad.pcd",
        "scene_file": folder / "scene.yaml", "four": folder / "four.yaml", "bag": recording(folder),
    }  # fmt: skip


@pytest.mark.parametrize("name", RUNS)
def test_what_commands_write_fits(
    name: str, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "doctor":
        from optshape_graph.cli import environment

        monkeypatch.setattr(environment, "import_all", lambda names: dict.fromkeys(names, environment.Found("9.0")))
    line, expected = RUNS[name]
    arguments = [word.format(out=tmp_path, **inputs) for word in line.split()]
    result = CliRunner().invoke(cli, arguments, standalone_mode=False)
    assert result.exception is None, result.exception
    written = [path for path in tmp_path.rglob("*") if path.suffix in (".json", ".yaml")]
    found = set()
    for path in written:
        assert complaint(path) is None
        found.add(path.read_text().split("optshape/")[1].split("/")[0])
    assert found == expected
    assert not list(tmp_path.rglob("*.tmp"))


def test_every_command_is_run() -> None:
    assert {line.split()[0] for line, _ in RUNS.values()} >= set(COMMANDS) - {"completion", "view"}


def test_truths_of_simulated_sessions_fit(tmp_path: Path) -> None:
    from optshape_graph.evaluation.camera_session import synthetic_camera_session
    from optshape_graph.simulation import synthetic_session
    from tests.calibration.camera.support import BOARD, FISHEYE, T_CAMERA_LIDAR

    synthetic_session(tmp_path / "a", load_target("built"), load_sensor("vlp32c"), distances=(4.0,))
    synthetic_camera_session(tmp_path / "b", BOARD, load_sensor("vlp16"), FISHEYE, np.asarray(T_CAMERA_LIDAR), views=1)
    for path in tmp_path.rglob("*.yaml"):
        assert complaint(path) is None
    for folder in "ab":
        assert complaint(tmp_path / folder / "truth.json") is None


SCAN = DEMO / "4m.pcd"


@pytest.mark.parametrize("command", ["estimate", "info", "detect"])
def test_json_on_standard_output_is_alone_there(command: str, tmp_path: Path) -> None:
    """The tables go to standard error then, and no file named "-" is made."""
    of_target = [] if command == "info" else ["--target", "paper", "--sensor", "vlp32c"]
    ran = subprocess.run(
        [sys.executable, "-m", "optshape_graph", command, str(SCAN), *of_target, "--json", "-"],
        capture_output=True, text=True, check=False, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert ran.returncode in (0, 3), ran.stderr
    assert json.loads(ran.stdout)["schema"] == f"optshape/{command}/1"
    assert SCAN.name in ran.stderr
    assert not list(tmp_path.iterdir())


def test_other_outputs_are_files() -> None:
    ran = CliRunner().invoke(cli, ["estimate", str(SCAN), "--target", "paper", "--report", "-"])
    assert ran.exit_code == 2
    assert "expected the name of a file, found '-'" in ran.output
