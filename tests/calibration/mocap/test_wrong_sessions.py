"""Sessions with one thing wrong are refused, flagged or mended, and it is named; right ones are not flagged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import optshape_graph
from optshape_graph.calibration.mocap import MocapCalibration, calibrate_mocap
from optshape_graph.calibration.verdict import NOT_TRUSTED, TRUSTED
from optshape_graph.errors import OptshapeError
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import synthetic_session
from tests.calibration.mocap.wrong_sessions import WRONG, Wrong, says
from tests.shared import SHARED, needs_shared

DEMO = Path(optshape_graph.__file__).parent / "data/demo"
RECORDED = ("session1", "session3")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Sessions of other sensors, targets and sizes, by name."""
    folders = {name: tmp_path_factory.mktemp(name) for name in ("small", "large", "symmetric")}
    synthetic_session(folders["small"], load_target("paper@0.7"), load_sensor("os1-128"), distances=(3, 4, 5.5), rng=11)
    synthetic_session(folders["large"], load_target("built@1.3"), load_sensor("hdl64e"), distances=(5, 7, 10), rng=12)
    synthetic_session(folders["symmetric"], load_target("square"), load_sensor("os0-128"), distances=(3, 4, 6), rng=13)
    return folders


def outcome(folder: Path) -> MocapCalibration | str:
    """The session's calibration, or why it is refused."""
    try:
        return calibrate_mocap(folder / "session.yaml")
    except OptshapeError as error:
        return str(error)


def check(wrong: Wrong, folder: Path) -> None:
    """The session in a folder, made wrong, is refused, flagged or mended, and what is wrong is said."""
    wrong.apply(folder)
    result = outcome(folder)
    if isinstance(result, str):
        assert says(result, wrong), result
        return
    said = [*result.warnings, *(item.reason for item in result.left_out)]
    assert any(says(text, wrong) for text in said), said
    assert result.verdict != TRUSTED
    if wrong.mended:
        assert result.verdict != NOT_TRUSTED, said
        truth = folder / "truth.json"
        if truth.exists():
            expected = np.array(json.loads(truth.read_text())["T_lidar_mocap"])
            T_mocap_target = result.scans[0].T_mocap_target[:, 3]
            # Where the targets stood, the frames agree to twice what markers are away from the vertices.
            assert np.linalg.norm((result.T_lidar_mocap - expected) @ T_mocap_target) < 0.03
    else:
        assert result.verdict == NOT_TRUSTED, said


@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.name)
def test_bundled_session(wrong: Wrong, tmp_path: Path) -> None:
    shutil.copytree(DEMO, tmp_path / "s")
    check(wrong, tmp_path / "s")


@needs_shared
@pytest.mark.parametrize("name", [pytest.param("session1", marks=pytest.mark.benchmark), "session3"])
@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.name)
def test_recorded_sessions(wrong: Wrong, name: str, tmp_path: Path) -> None:
    shutil.copytree(SHARED / "data/mocap" / name, tmp_path / "s")
    shutil.copy(SHARED / "data/mocap/target.yaml", tmp_path / "target.yaml")
    check(wrong, tmp_path / "s")


@pytest.mark.parametrize(
    "name", ["small", *(pytest.param(name, marks=pytest.mark.benchmark) for name in ("large", "symmetric"))]
)
@pytest.mark.parametrize("wrong", WRONG, ids=lambda wrong: wrong.name)
def test_other_sizes(wrong: Wrong, name: str, made: dict[str, Path], tmp_path: Path) -> None:
    if name == "symmetric" and wrong.name == "names shifted by one corner":
        pytest.skip("a square with its names shifted is the same square")
    shutil.copytree(made[name], tmp_path / "s")
    check(wrong, tmp_path / "s")


@needs_shared
@pytest.mark.parametrize("name", RECORDED)
def test_recorded_sessions_are_right(name: str) -> None:
    result = calibrate_mocap(SHARED / "data/mocap" / name / "session.yaml")
    assert result.verdict == TRUSTED, result.warnings
    assert result.left_out == ()


SENSORS = ("vlp32c", "os1-64", "hdl64e", "os0-128", "pandar64", "rs32")
TARGETS = ("built", "paper@0.7", "square", "triangle", "optimal", "built@1.3")


@pytest.mark.parametrize("seed", range(6))
def test_simulated_sessions_are_right(seed: int, tmp_path: Path) -> None:
    distances = np.round(3.0 + 0.3 * seed + np.arange(3) * 1.5, 1)
    target, sensor = load_target(TARGETS[seed]), load_sensor(SENSORS[seed])
    path = synthetic_session(tmp_path, target, sensor, distances=distances, rng=40 + seed)
    result = calibrate_mocap(path)
    assert result.verdict == TRUSTED, result.warnings
    assert result.left_out == ()


@pytest.mark.benchmark
def test_of_many_right_sessions_none_is_flagged(tmp_path: Path) -> None:
    """With those above they are 52, of any sensor, target and distance."""
    rng, flagged = np.random.default_rng(2026), {}
    for seed in range(44):
        sensor, target = SENSORS[rng.integers(6)], TARGETS[rng.integers(6)]
        distances = np.round(3.0 + 1.5 * rng.random() + np.arange(3) * 1.5, 1)
        path = synthetic_session(
            tmp_path / str(seed), load_target(target), load_sensor(sensor), distances=distances, rng=1000 + seed
        )
        result = calibrate_mocap(path)
        if result.verdict != TRUSTED or result.left_out:
            flagged[seed] = (sensor, target, result.warnings)
    assert not flagged
