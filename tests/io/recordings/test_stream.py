import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.io.recordings.stream import BadMessage, Skipped, Stamped, Stream, followed, in_order


def kept(stamps: list[float]) -> tuple[list[float], Skipped]:
    skipped = Skipped()
    return [item.stamp for item in in_order([Stamped(s, None) for s in stamps], skipped, "test")], skipped


def test_increasing_stamps_are_all_kept():
    stamps = [k * 0.1 for k in range(100)]
    assert kept(stamps) == (stamps, Skipped())


def test_a_duplicate_costs_itself():
    result, skipped = kept([0.0, 0.1, 0.1, 0.2])
    assert result == [0.0, 0.1, 0.2]
    assert skipped == {"stamp duplicated": 1}


def test_a_stamp_that_goes_backward_costs_itself():
    result, skipped = kept([0.0, 0.1, 0.2, 0.15, 0.3, 0.4])
    assert result == [0.0, 0.1, 0.2, 0.3, 0.4]
    assert skipped == {"stamp goes backward": 1}


def test_a_stamp_in_the_far_future_costs_itself_even_as_the_first():
    for position in (0, 4, 8):  # of two left at the end, nothing tells which is wrong
        good = [k * 0.1 for k in range(10)]
        stamps = [*good[:position], 9999.0, *good[position:]]
        result, skipped = kept(stamps)
        assert result == good
        assert skipped == {"stamp ahead of those that follow": 1}


def test_a_stamp_a_little_ahead_costs_itself():
    good = [k * 0.1 for k in range(12)]
    result, skipped = kept([*good[:5], 0.75, *good[5:]])  # ahead of the three that follow
    assert result == good
    assert skipped == {"stamp ahead of those that follow": 1}


@given(
    st.lists(st.floats(-10, 1e4), min_size=0, max_size=3),
    st.lists(st.integers(0, 40), min_size=3, max_size=3),
)
def test_few_wrong_stamps_cost_no_more_than_themselves(wrong, positions):
    good = [100 + k * 0.1 for k in range(40)]
    stamps = list(good)
    for value, position in zip(wrong, positions, strict=False):
        stamps.insert(position, value)
    result, skipped = kept(stamps)
    assert all(a < b for a, b in itertools.pairwise(result))
    assert len(result) + skipped.total() == len(stamps)
    # A wrong stamp that happens to be in order is kept, and may push out a good one between it and the next.
    assert len(result) >= len(good) - len(wrong)


def test_counts_of_one_iteration_do_not_add_to_the_next():
    def read(skipped):
        skipped.add(BadMessage("empty"), "test")
        yield Stamped(1.0, "a")

    stream = Stream("test", read)
    for _ in range(2):
        assert [item.value for item in stream] == ["a"]
        assert stream.skipped == {"empty": 1}


def test_nothing_beyond_the_lookahead_is_read_before_it_is_wanted():
    read = []

    def items():
        for k in range(1000):
            read.append(k)
            yield Stamped(float(k), k)

    next(in_order(items(), Skipped(), "test"))
    assert len(read) <= 9


@pytest.mark.parametrize("back", [1.5, 37.0, 1e9])
def test_a_clock_that_is_set_back_is_followed(back):
    rng = np.random.default_rng(0)
    true = 1.7e9 + 0.1 * np.arange(60)
    shown = np.where(np.arange(60) < 25, true, true - back) + 1e-4 * rng.normal(size=60)
    stream = Stream("test", lambda _: iter([Stamped(float(s), k) for k, s in enumerate(shown)]))
    assert len(list(stream)) < 60  # as any other consumer has it
    following = stream.following()
    items = list(following)
    assert [item.value for item in items] == list(range(60))
    np.testing.assert_allclose([item.stamp for item in items], true, atol=1e-3)
    [jump] = following.jumps
    assert jump.seconds == pytest.approx(back, abs=1e-3)
    assert jump.stamp == pytest.approx(true[24], abs=1e-3)


@pytest.mark.parametrize("paused", [0.0, 7.0])
@pytest.mark.parametrize("forward", [0.0, 1.5, 37.0, 1e9])
def test_a_clock_that_is_set_forward_is_followed_by_the_recorders(forward, paused):
    """Stamps alone can't tell it from a pause of the recording, which is none."""
    rng, late = np.random.default_rng(0), np.arange(60) >= 25
    true = 1.7e9 + 0.1 * np.arange(60) + paused * late
    shown = true + forward * late + 1e-4 * rng.normal(size=60)
    received = true + 12.3 + 0.02 * rng.exponential(size=60)
    items = [Stamped(float(s), k, float(r)) for k, (s, r) in enumerate(zip(shown, received, strict=True))]
    following = Stream("test", lambda _: iter(items)).following()
    found = [item.stamp for item in following]
    np.testing.assert_allclose(found, true, atol=0.1 if paused and forward else 1e-3)
    assert [jump.seconds for jump in following.jumps] == ([pytest.approx(-forward, abs=0.1)] if forward else [])
    alone = Stream("test", lambda _: iter([Stamped(item.stamp, item.value) for item in items])).following()
    assert [item.stamp for item in alone] == list(shown)


def test_a_recorders_clock_that_is_none_says_nothing():
    stamps = [float(k) for k in range(40)]
    for received in ([0.0] * 40, [0.1 * s for s in stamps], [s + 3.0 * (k % 2) for k, s in enumerate(stamps)]):
        jumps = []
        items = [Stamped(s, None, r) for s, r in zip(stamps, received, strict=True)]
        assert [item.stamp for item in followed(items, jumps)] == stamps
        assert not jumps


def test_late_and_wrong_stamps_are_no_jumps():
    good = [k * 0.1 for k in range(40)]
    for wrong in ([0.3], [2.0, 1.9], [9999.0], [-5.0, -4.9]):
        stamps = [*good[:30], *wrong, *good[30:]]
        jumps = []
        assert [item.stamp for item in followed([Stamped(s, None) for s in stamps], jumps)] == stamps
        assert not jumps
