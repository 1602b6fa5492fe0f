"""How a placement's sightings are read together."""

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.connection import read
from optshape_graph.se3 import exp


@dataclass(frozen=True)
class Seen:
    sensor: str
    poses: Floats
    relative: bool


def test_of_readings_alike_the_target_as_its_file_has_it() -> None:
    """A pattern that lies half a centimetre off its board's middle fits as well turned by half as not."""
    T, half = exp([0.1, 0.2, 0.3, 3.0, 0.4, 0.1]), exp([np.pi, 0, 0, 0, 0, 0])
    off = exp([0, 0, 0, 0, 0.005, 0])
    scan = Seen("lidar", np.stack([T, T @ half]), True)
    for turned in (False, True):
        image = Seen("camera", np.stack([T @ off, T @ half] if turned else [T, T @ half @ off]), False)
        _, chosen = read([scan, image], {"lidar": np.eye(4), "camera": np.eye(4)})
        assert [number for _, number, _ in chosen] == [0, 0]
        assert all(agrees for *_, agrees in chosen)


def test_an_image_that_knows_the_target_turns_the_scan() -> None:
    T, half = exp([0.1, 0.2, 0.3, 3.0, 0.4, 0.1]), exp([np.pi, 0, 0, 0, 0, 0])
    scan, image = Seen("lidar", np.stack([T, T @ half]), True), Seen("camera", (T @ half)[None], False)
    pose, chosen = read([scan, image], {"lidar": np.eye(4), "camera": np.eye(4)})
    assert [number for _, number, _ in chosen] == [1, 0]
    assert np.allclose(pose, T @ half)
