"""`optshape merge`: maps in, one map out."""

import numpy as np
import pytest
from click.testing import CliRunner

from optshape_graph.cli.main import cli
from optshape_graph.mapping import load_map, merge_maps
from tests.mapping.test_map import a_map


@pytest.fixture
def files(tmp_path):
    frame = np.eye(4)
    frame[:3, 3] = [3.0, -2.0, 0.5]
    maps = [a_map("abc", session="one"), a_map("bcd", frame, 1, session="two"), a_map("def", frame, 2, session="three")]
    for number, one in enumerate(maps):
        one.save(tmp_path / f"{number}.json")
    return tmp_path, maps


def test_maps_become_one(files):
    folder, maps = files
    names = [str(folder / f"{k}.json") for k in range(3)]
    result = CliRunner().invoke(
        cli, ["merge", *names, "--json", str(folder / "all.json"), "--report", str(folder / "all.html")]
    )
    assert result.exit_code == 0, result.output
    assert "Good: 6 landmarks, known to" in result.output
    assert "6 landmarks, known to" in (folder / "all.html").read_text()
    assert "6 landmarks, 3 sessions" in result.output
    found = load_map(folder / "all.json")
    assert [landmark.id for landmark in found.landmarks] == list("abcdef")
    assert set(found.trajectories) == {"one", "two", "three"}
    expected = merge_maps(merge_maps(maps[0], maps[1]), maps[2])
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6, atol=1e-12)


def test_what_cannot_be_merged_is_said(files):
    folder, _ = files
    for arguments, message in (
        ([folder / "0.json"], "two or more"),
        ([folder / "0.json", folder / "2.json"], "no landmark in common"),
        ([folder / "0.json", folder / "0.json"], "both maps have a session 'one'"),
    ):
        result = CliRunner().invoke(cli, ["merge", *map(str, arguments), "--json", str(folder / "out.json")])
        assert result.exit_code  # 2 for usage, and by `main` for input
        assert message in result.output + str(result.exception)
        assert not (folder / "out.json").exists()
