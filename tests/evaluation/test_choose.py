import numpy as np
import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph.evaluation.choose import SCANS, Wish, choose_target
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target


@pytest.fixture(scope="module")
def told():
    """Progress of the choice: scans done, and all."""
    return []


@pytest.fixture(scope="module")
def choice(told):
    wish = Wish(load_sensor("vlp32c"), 8.0, np.radians(2.0), 0.03)
    return choose_target(wish, [load_target("pose-optimal")], progress=lambda *counts: told.append(counts))


def test_progress_is_told_at_every_scan(choice, told):
    done, total = np.array(told).T
    assert len(told) >= 2 * SCANS // 4
    assert (np.diff(done) > 0).all()
    assert (done < total).all()


def test_what_is_chosen_does_it_and_the_next_smaller_does_not(choice):
    chosen, (smaller, nearer) = choice.chosen, choice.smaller[0]
    assert chosen.passes
    assert len(chosen.statuses) == SCANS
    assert chosen.statuses.count("ok") >= 95
    assert chosen.quantile(chosen.e_r) <= choice.wish.rotation
    assert chosen.quantile(chosen.e_t) <= choice.wish.translation
    assert not smaller.passes
    assert smaller.target.area == pytest.approx(chosen.target.area / 1.12**2)
    assert nearer <= 8.0


def test_the_numbers_are_plain(choice):
    document = choice.to_dict()
    assert document["schema"] == "optshape/design-choice/1"
    assert document["chosen"]["does_it"] is True
    assert document["chosen"]["ok"] + document["chosen"]["ambiguous"] + document["chosen"]["failed"] == SCANS
    assert [entry["does_it"] for entry in document["smaller"]] == [False, False]


def test_what_cannot_be_done_is_said():
    wish = Wish(load_sensor("vlp16"), 60.0, np.radians(0.2), 0.005)
    with pytest.raises(EstimationError, match=r"no target of up to 8 m2 does it at 60 m with 'vlp16'.*nearer"):
        choose_target(wish, [load_target("pose-optimal")])


def test_wishes_that_are_none():
    sensor = load_sensor("vlp16")
    with pytest.raises(InputError, match="rotation: expected a positive number; found -1"):
        Wish(sensor, 10.0, -1.0, 0.02)
    with pytest.raises(InputError, match="azimuth step"):
        Wish(sensor.with_azimuth_step(None), 10.0, 0.1, 0.02)
