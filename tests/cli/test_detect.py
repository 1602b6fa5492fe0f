"""`optshape detect`: its JSON, its exit statuses, its one-line errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph import InputError
from optshape_graph.cli.main import cli
from optshape_graph.io import load_sensor, load_target, write_scan
from tests.detection.scenes import pose, scan_of

TARGET_KEYS = {"target", "T_lidar_target", "covariance", "equivalent_poses", "return_indices", "score"}


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    sensor = load_sensor("vlp32c")
    with_target = scan_of(sensor, [(load_target("square@1"), pose(6, 0, 0, 30, 10, 5))])
    write_scan(folder / "one.pcd", with_target.scan)
    np.save(folder / "surface.npy", with_target.surface)
    write_scan(folder / "none.pcd", scan_of(sensor, []).scan)
    (folder / "broken.pcd").write_text("not a cloud")
    return folder


def run(*arguments: object):
    return CliRunner().invoke(cli, ["detect", *map(str, arguments)], standalone_mode=False)


def test_json(clouds: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    result = run(
        clouds / "one.pcd", clouds / "none.pcd", "--target", "square@1", "--target", "triangle@1",
        "--sensor", "vlp32c", "--json", out,
    )  # fmt: skip
    assert result.exception is None
    assert result.return_value == 0
    assert "square@1" in result.output
    assert "none" in result.output
    document = json.loads(out.read_text())
    assert document["schema"] == "optshape/detect/1"
    one, none = document["scans"]
    assert one["scan"] == str(clouds / "one.pcd")
    (target,) = one["targets"]
    assert set(target) >= TARGET_KEYS
    assert target["target"] == "square@1"
    np.testing.assert_allclose(np.array(target["T_lidar_target"])[:3, 3], [6, 0, 0], atol=0.03)
    assert np.array(target["covariance"]).shape == (6, 6)
    assert np.array(target["equivalent_poses"]).shape == (4, 4, 4)
    assert (np.load(clouds / "surface.npy")[target["return_indices"]] == 0).mean() > 0.99
    assert 0 < target["score"] <= 1
    assert none["targets"] == []
    for scan in (one, none):
        assert all(rejected["reason"] for rejected in scan["rejected"])


def test_a_broken_file_leaves_the_others(clouds: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    result = run(clouds / "broken.pcd", clouds / "one.pcd", "--target", "square@1", "--sensor", "vlp32c", "--json", out)
    assert result.return_value == 3
    assert "broken.pcd" in result.output
    assert [len(scan["targets"]) for scan in json.loads(out.read_text())["scans"]] == [0, 1]


def test_an_ambiguous_shape_is_flagged(clouds: Path) -> None:
    """Two targets of one shape and different names cannot be told apart."""
    square = clouds / "same.yaml"
    square.write_text(
        "schema: optshape/target/1\nname: same\nvertices:\n"
        + "".join(f"  - [0.0, {y!r}, {z!r}]\n" for _, y, z in load_target("square@1").vertices.tolist())
    )
    result = run(clouds / "one.pcd", "--target", "square@1", "--target", square, "--sensor", "vlp32c")
    assert result.return_value == 3
    assert "ambiguous" in result.output


def test_bad_input(clouds: Path) -> None:
    assert isinstance(run(clouds / "broken.pcd", "--target", "square@1").exception, InputError)
    assert isinstance(run(clouds / "one.pcd", "--target", "no-such-target").exception, InputError)
    assert run(clouds / "one.pcd").exception is not None
