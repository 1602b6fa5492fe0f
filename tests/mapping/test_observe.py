"""What keyframes show: several at once, one by one where a worker was killed; and targets in motion."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from optshape_graph.detection import detect_targets
from optshape_graph.mapping.keyframes import Keyframe, KeyframePolicy, Progress, keyframes
from optshape_graph.mapping.motion import deskew, estimate_moving
from optshape_graph.mapping.observe import Observed, observe, observe_all
from optshape_graph.mapping.odometry import OdometryTrack
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.tasks import Lost
from optshape_graph.runs.workers import Pool
from optshape_graph.scan import Scan
from optshape_graph.se3 import difference, inverse
from tests.mapping.test_recording import TARGET, drive


@pytest.fixture(scope="module")
def frames() -> list[Keyframe]:
    scans, poses = drive(4)
    return list(keyframes(scans, OdometryTrack(poses), KeyframePolicy(0.0), Progress()))


def poses_of(seen: Observed) -> np.ndarray:
    """T_target_lidar (n, 4, 4) of the sightings, from left to right."""
    found = np.array([sighting.measurements[0].T_target_lidar for sighting in seen.sightings])
    return found[np.argsort(inverse(found)[:, 1, 3])]


def test_several_at_once_as_one_by_one(frames: list[Keyframe]) -> None:
    """Poses agree to the rounding of what is solved side by side."""
    together = observe(frames, [TARGET], False, False)
    for frame, seen in zip(frames, together, strict=True):
        (alone,) = observe([frame], [TARGET], False, False)
        assert (seen.stamp, seen.distance, seen.failure) == (alone.stamp, alone.distance, alone.failure)
        assert len(seen.sightings) == 2
        assert np.abs(difference(poses_of(seen), poses_of(alone))).max() < 1e-6


def test_a_target_in_motion_is_estimated_as_it_was_fired(frames: list[Keyframe]) -> None:
    """The sighting is that of its returns at their own time, moved to the scan's stamp: to rounding."""
    frame = frames[1]
    assert frame.sweep is not None
    (seen,) = observe([frame], [TARGET], False, False)
    expected = []
    for one in detect_targets(deskew(frame.scan, frame.sweep), TARGET).found:
        estimate, at = estimate_moving(frame.scan.select(one.indices), TARGET, frame.sweep)
        expected.append(estimate.T_target_lidar @ frame.sweep.between(at, 0.0))
    found, wanted = poses_of(seen), np.array(expected)
    wanted = wanted[np.argsort(inverse(wanted)[:, 1, 3])]
    # Other returns at the rim, by an outline that lies a millimetre aside, would be more than rounding.
    assert np.abs(difference(found, wanted))[:, 3:].max() < 2e-3
    assert np.median(np.abs(difference(found, wanted))[:, 3:].max(axis=1)) < 1e-6


@dataclass(frozen=True)
class Killing(Pool):
    """A pool whose workers are killed by a scan, whatever is beside it."""

    stamp: float = 0.3

    def run(self, function: Callable[[Any], Any], tasks: Iterable[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
        for number, some in tasks:
            if any(abs(frame.stamp - self.stamp) < 1e-9 for frame in some):
                yield number, Lost("its worker was killed twice")
            else:
                yield number, function(some)


def test_only_the_scan_to_blame_is_lost(frames: list[Keyframe]) -> None:
    seen = list(observe_all(iter(frames), [TARGET], False, False, Killing()))
    assert [one.stamp for one in seen] == [frame.stamp for frame in frames]
    assert [one.failure for one in seen] == ["", "its worker was killed twice", "", ""]
    assert [len(one.sightings) for one in seen] == [2, 0, 2, 2]


def test_what_was_stopped_within_a_batch_is_done_again(
    frames: list[Keyframe], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches are fixed by the numbers of keyframes: what is restored and what is made again are the same bits."""
    monkeypatch.setattr("optshape_graph.mapping.observe.AT_ONCE", 2)

    def observed(journal: Journal) -> list[np.ndarray]:
        return [poses_of(one) for one in observe_all(iter(frames), [TARGET], False, False, journal=journal)]

    with Journal(tmp_path / "whole", {"form": "test"}, None) as journal:
        whole = observed(journal)
    with Journal(tmp_path / "half", {"form": "test"}, None) as journal:
        some = observe_all(iter(frames), [TARGET], False, False, journal=journal)
        next(some)
        some.close()
        assert journal.finished < len(frames)
    with Journal(tmp_path / "half", {"form": "test"}, None) as journal:
        again = observed(journal)
    np.testing.assert_array_equal(again, whole)


def test_a_scan_that_cannot_be_searched_costs_no_other(frames: list[Keyframe]) -> None:
    wrong = frames[0]._replace(scan=Scan(frames[0].scan.points, time=frames[0].scan.time))
    bad, good = observe([wrong, frames[1]], [TARGET], False, False)
    assert "no rings" in bad.failure
    assert not bad.sightings
    assert len(good.sightings) == 2
