"""Markers over time."""

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io.mocap import MocapRecording


def test_positions_between_frames_are_interpolated_and_gaps_stay_gaps():
    times = np.array([0.0, 0.01, 0.02, 0.03, 0.10, 0.11])
    positions = np.linspace([[0.0, 0, 0]], [[5.0, 0, 0]], 6)
    positions[2] = np.nan
    recording = MocapRecording(times, ("a",), positions, 100.0)
    wanted = np.array([-0.001, 0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.105, 0.11, 0.12])
    found = recording.at(wanted)[:, 0, 0]
    expected = [np.nan, 0.0, 0.5, 1.0, np.nan, np.nan, 3.0, np.nan, 4.5, 5.0, np.nan]
    assert np.allclose(found, expected, atol=1e-9, equal_nan=True)


def test_a_marker_that_is_not_there_is_named():
    recording = MocapRecording(np.zeros(1), ("a",), np.zeros((1, 1, 3)), 100.0)
    assert recording.select(["a"]).markers == ("a",)
    with pytest.raises(InputError, match="no marker 'b'; it has a"):
        recording.select(["b"])
