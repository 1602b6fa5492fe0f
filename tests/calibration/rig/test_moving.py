"""A target carried before a LiDAR and a camera: few sightings, for every run; see `test_numbers` for statistics."""

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph import UnobservableError
from optshape_graph.calibration.rig.moving import connect
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rigs import Carried, SimulatedRig, two_targets
from optshape_graph.se3 import inverse
from tests.calibration.rig.support import calibrated, errors, moving

OFFSET = 0.043


@pytest.fixture(scope="module")
def rig():
    rng = np.random.default_rng(1)
    drawn = SimulatedRig.drawn(rng, {"front": "vlp16"}, ("left",))
    # The camera looks ahead, where the target is carried.
    front, left = (drawn.T_base_sensor[name] for name in ("front", "left"))
    ahead = np.array(left)
    ahead[:3, :3] = front[:3, :3] @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    return replace(drawn, T_base_sensor={**drawn.T_base_sensor, "left": ahead})


@pytest.fixture(scope="module")
def sightings(rig):
    rng = np.random.default_rng(2)
    target = replace(two_targets()["A"], name="A")
    return moving(rig, target, Carried.drawn(rng), 35, {"left": OFFSET}, rng)


def test_a_start_needs_no_guess(rig, sightings):
    places, offsets, _ = connect(sightings, "front", {})
    assert offsets["left"] == pytest.approx(OFFSET, abs=0.02)
    off = inverse(places["left"]) @ rig.pair("front", "left")
    assert np.linalg.norm(off[:3, 3]) < 0.05


def test_the_clock_and_the_place_are_found(rig, sightings):
    result = calibrated(rig, sightings)
    offset, sd = result.time_offset("front", "left")
    assert sd < 2e-3
    assert abs(offset - OFFSET) < 4 * sd
    assert result.time_offset("left", "front")[0] == -offset
    (row,) = errors(rig, result)["LC"]
    assert row[0] < 15.0
    assert row[2] < 4.0


def test_stamps_of_another_clock_are_named(rig, sightings):
    far = [replace(s, time=s.time + 1e5) if s.sensor == "left" else s for s in sightings]
    with pytest.raises(EstimationError, match=r"the stamps of 'front' run from .* to 1000\d\d.* of another clock"):
        calibrated(rig, far)
    near = [replace(s, time=s.time + 1.6) if s.sensor == "left" else s for s in sightings]
    with pytest.raises(UnobservableError, match="at no offset of their clocks within 1 s alike"):
        connect(near, "front", {})
