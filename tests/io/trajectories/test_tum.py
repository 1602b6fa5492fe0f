"""TUM trajectories."""

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import trajectories as tr
from tests.io.trajectories.poses import poses


def test_tum_round_trip(tmp_path):
    stamps = 1.7e9 + np.cumsum(np.random.default_rng(1).uniform(0.01, 0.2, 50))
    tr.write_tum(tmp_path / "a.tum", tr.Trajectory(poses(50), stamps))
    back = tr.read_tum(tmp_path / "a.tum")
    assert np.abs(back.stamps - stamps).max() < 2.5e-7  # float64 at 1.7e9 s
    assert np.abs(back.poses - poses(50)).max() < 1e-13  # quaternion to matrix and back


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("1 0 0 0 0 0 0", "expected 8 numbers"),
        ("1 0 0 0 0 0 0 x", "could not convert"),
        ("1 0 0 nan 0 0 0 1", "not a finite"),
        ("1 0 0 0 0 0 0 0", "norm 0"),
        ("1 0 0 0 0 0 0 2", "norm 2"),
        ("0.5 0 0 0 0 0 0 1", "does not exceed"),
    ],
)
def test_bad_tum_lines_are_named(tmp_path, line, complaint):
    file = tmp_path / "bad.tum"
    file.write_text(f"# stamp\n0.9 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(InputError, match=complaint) as error:
        tr.read_tum(file)
    assert "bad.tum" in str(error.value)
