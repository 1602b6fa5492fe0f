"""The offset between the clocks of scans and odometry, from the motion that both saw."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import InputError, UnobservableError
from optshape_graph.io import load_sensor
from optshape_graph.io.recordings.stream import Jump, Stamped
from optshape_graph.mapping.clocks import Clocks, offset_of
from optshape_graph.se3 import exp
from optshape_graph.simulation import Box, ConstantTwist, NoiseModel, Scene, simulate
from tests.mapping.support import at

COARSE = replace(load_sensor("vlp16"), azimuth_step=np.radians(1.0))
STEP = 0.005


def drive(seconds: float, turning: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps (N,), poses (N, 4, 4) and twists (N, 6) of a robot that turns to and fro, or not."""
    stamps = np.arange(0.0, seconds, STEP)
    twists = np.zeros((len(stamps), 6))
    twists[:, 3] = 0.4
    if turning:
        twists[:, 2] = 0.3 * np.sin(2 * np.pi * 0.17 * stamps) + 0.4 * np.sin(2 * np.pi * 0.31 * stamps + 1.0)
    poses = [np.eye(4)]
    for twist in twists[:-1]:
        poses.append(poses[-1] @ exp(STEP * twist))
    return stamps, np.array(poses), twists


def recorded(turning: bool, offset: float) -> tuple[list[Stamped], list[Stamped]]:
    """Return scans, ten a second, and poses of odometry by a clock that is behind by an offset, seconds."""
    stamps, poses, twists = drive(7.0, turning)
    scene, noise, rng = Scene((), (Box(np.array([14.0, 11.0, 4.0]), at(1.0, 1.0, 0.3, 0.6)),)), NoiseModel.of(COARSE), 0
    scans = []
    for k in range(20, len(stamps) - 20, 20):
        motion = ConstantTwist(poses[k], twists[k])
        scans.append(Stamped(float(stamps[k]), simulate(scene, COARSE, motion, noise=noise, rng=rng + k).scan))
    return scans, [Stamped(float(stamps[k]) - offset, poses[k]) for k in range(0, len(stamps), 4)]


def test_the_offset_is_estimated():
    """Registered forward in time it is 5 to 10 ms late; with what it is backward, within its deviation."""
    pytest.importorskip("kiss_icp")
    scans, poses = recorded(turning=True, offset=1234.56)
    found = offset_of(scans, poses)
    assert found.seconds == pytest.approx(1234.56, abs=2.0 * found.standard_deviation)
    assert found.seconds == pytest.approx(1234.56, abs=0.01)
    assert 0.001 < found.standard_deviation < 0.02


def test_without_turning_no_offset_can_be_told():
    pytest.importorskip("kiss_icp")
    scans, poses = recorded(turning=False, offset=0.0)
    with pytest.raises(UnobservableError, match="hardly turned"):
        offset_of(scans[:15], poses)
    with pytest.raises(InputError, match="2 poses of odometry"):
        offset_of(scans[:5], poses[:2])
    with pytest.raises(InputError, match="0 scans with the times"):
        offset_of([replace(scan, value=replace(scan.value, time=None)) for scan in scans[:5]], poses)


def test_clocks_in_words_and_as_data():
    clocks = Clocks((0.0, 9.0), (-100.0, -91.0), 100.0, 0.004, {"/points": (Jump(3.0, 3600.0),)})
    lines = clocks.lines()
    assert lines[0] == "scans are from 0.000 to 9.000 s, odometry is from -100.000 to -91.000 s"
    assert "100.0000 s (estimated, +- 0.0040 s)" in lines[1]
    assert lines[2] == "/points: its clock was set back by 3600.000 s at 3.000 s; taken to have gone on"
    assert clocks.to_dict()["set_back"] == [{"topic": "/points", "stamp": 3.0, "seconds": 3600.0}]
    assert Clocks().lines() == []
