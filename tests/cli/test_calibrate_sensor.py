"""`optshape calibrate sensor`: the file is written where it helps, and says so where it doesn't."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import EstimationError, InputError
from optshape_graph.cli.main import cli
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import synthetic_session
from tests.io.schema_support import complaint

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("session")
    return synthetic_session(
        folder, load_target("paper"), load_sensor("vlp16"), distances=(2.5, 3.0, 3.5, 4.0), rng=np.random.default_rng(4)
    )


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(cli, [str(argument) for argument in arguments], standalone_mode=False)
    if result.exception:
        raise result.exception
    return result.return_value, " ".join(result.output.split())


def test_a_session_with_motion_capture(session: Path, tmp_path: Path) -> None:
    code, output = run(
        "calibrate", "sensor", session, "-o", tmp_path / "mine.yaml", "--json", tmp_path / "a.json", "--plot",
        tmp_path / "pictures",
    )  # fmt: skip
    document = json.loads((tmp_path / "a.json").read_text())
    assert complaint(tmp_path / "a.json") is None
    assert code == (0 if document["helps"] else 3), output
    assert (tmp_path / "mine.yaml").exists() == document["helps"]
    assert {path.name for path in (tmp_path / "pictures").iterdir()} == {"residuals.png", "rings.png"}
    assert "Rings of" in output
    assert len(document["placements"]) == 8
    if document["helps"]:
        assert complaint(tmp_path / "mine.yaml") is None
        assert load_sensor(tmp_path / "mine.yaml").range_bias is not None


def test_one_placement_is_not_enough(tmp_path: Path) -> None:
    few = synthetic_session(tmp_path / "few", load_target("paper"), load_sensor("vlp16"), distances=(3.0,), rng=1)
    with pytest.raises(EstimationError, match="needs 6 placements"):
        run("calibrate", "sensor", few, "-o", tmp_path / "mine.yaml")
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--sensor", "vlp32c"), "is another model than"),
        (("--lidar", "roof"), "no LiDAR 'roof'"),
        (("--distance", "paper", "square", "3"), "board 'square': no board is called that; found paper"),
        (("--distance", "paper/7", "paper", "3"), "vertices 0 to 3; found 7"),
        (("--distance", "paper/1", "paper", "3"), "expected one between two boards"),
        (("--distance", "paper", "square", "far"), "expected positive numbers"),
        (("--topic", "/points"), "only a recording has topics"),
        (("--use-target-points",), r"session\.yaml:\d+.* no 'target_points', which were asked for"),
    ],
)
def test_what_cannot_be(
    session: Path, tmp_path: Path, arguments: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refused before the work: no scan is read."""
    monkeypatch.setattr("optshape_graph.calibration.sensor.reading.load_mocap_scans", None)
    with pytest.raises(InputError, match=message):
        run("calibrate", "sensor", session, "-o", tmp_path / "mine.yaml", *arguments)


def test_a_sensor_file_is_yaml(session: Path, tmp_path: Path) -> None:
    """Refused before the work."""
    with pytest.raises(InputError, match="expected a name ending in"):
        run("calibrate", "sensor", session, "-o", tmp_path / "mine.json")


def test_a_recording_needs_sensor_and_targets(tmp_path: Path) -> None:
    (tmp_path / "clouds").mkdir()
    (tmp_path / "clouds" / "timestamps.txt").write_text("")
    with pytest.raises(InputError):
        run("calibrate", "sensor", tmp_path / "clouds", "paper", "-o", tmp_path / "mine.yaml")
