"""Boards that stood still are placements; those that were carried, or moved while they should stand, are named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from optshape_graph._arrays import Floats
from optshape_graph.calibration.sensor.placements import Placement, Sighting, placed, runs_of
from optshape_graph.calibration.sensor.reading import of_session
from optshape_graph.calibration.sensor.rest import at_rest, standing
from optshape_graph.io import load_target, write_scan
from optshape_graph.io.sessions import Session, View
from optshape_graph.pose import estimate_pose
from optshape_graph.runs.kept import Kept
from optshape_graph.se3 import exp
from tests.calibration.sensor.units import Unit
from tests.calibration.sensor.units import placed as drawn

SD = np.array([0.004, 0.004, 0.004, 0.003, 0.003, 0.003])
"""Of the poses: rad and metres."""


@pytest.fixture(scope="module")
def unit() -> Unit:
    return Unit.drawn("vlp32c", np.random.default_rng(11))


@pytest.fixture(scope="module", params=["paper", "square"])
def one(unit: Unit, request: pytest.FixtureRequest) -> Sighting:
    rng, board = np.random.default_rng(12), load_target(request.param)
    returns = unit.scan(board, drawn(unit.sensor, 3.0, 4.0, rng), rng)
    return Sighting(0, "", estimate_pose(returns, board), returns)


def track(
    one: Sighting,
    poses: Sequence[Floats],
    rng: np.random.Generator,
    times: Sequence[float] = (),
    place: int | None = None,
) -> list[Sighting]:
    """Sightings of a board at poses that are measured with noise; a symmetric board's any way round."""
    found = []
    for k, T in enumerate(poses):
        turns = one.estimate.target.symmetry_transforms
        T = T @ exp(SD * rng.normal(size=6)) @ turns[rng.integers(len(turns))]
        estimate = replace(one.estimate, T_lidar_target=T, covariance=np.diag(SD**2))
        time = float(times[k]) if len(times) else None
        found.append(Sighting(k, f"{k}.pcd", estimate, one.returns, time=time, place=place))
    return found


def judged(sightings: Sequence[Sighting]) -> tuple[tuple[Placement, ...], list[str]]:
    runs, carried = standing(runs_of(sightings))
    placements, moved = at_rest(placed(runs))
    return placements, carried + moved


def anywhere(unit: Unit, count: int, rng: np.random.Generator) -> list[Floats]:
    return [drawn(unit.sensor, 2.5, 5.0, rng) for _ in range(count)]


def along(T: Floats, step: float, count: int) -> list[Floats]:
    """Poses of a board that goes to the side by a step in each revolution."""
    return [T @ exp(np.array([0, 0, 0, 0, k * step, 0])) for k in range(count)]


@pytest.mark.parametrize("seed", range(20))
def test_revolutions_of_boards_that_stay_are_placements(unit: Unit, one: Sighting, seed: int) -> None:
    """Eight of each at most take part; no board is named, without stamps or with stamps of ten revolutions a second."""
    rng = np.random.default_rng([13, seed])
    poses = [T for T in anywhere(unit, 7, rng) for _ in range(10)]
    for times in ((), 0.1 * np.arange(70) + 5.0 * (np.arange(70) // 10)):
        placements, left_out = judged(track(one, poses, rng, times))
        assert [len(found.sightings) for found in placements] == [8] * 7
        assert left_out == []


def test_single_revolutions_of_boards_that_were_set_down_anew(unit: Unit, one: Sighting) -> None:
    rng = np.random.default_rng(14)
    for times in ((), np.arange(12.0)):
        placements, left_out = judged(track(one, anywhere(unit, 12, rng), rng, times))
        assert len(placements) == 12
        assert left_out == []


@pytest.mark.parametrize(("step", "stamped"), [(0.03, False), (0.1, False), (0.03, True), (0.1, True), (0.5, True)])
def test_boards_that_are_carried_are_named(unit: Unit, one: Sighting, step: float, stamped: bool) -> None:
    """Between two placements where they stood, which count."""
    rng = np.random.default_rng(15)
    first, last = anywhere(unit, 2, rng)
    poses = [first] * 6 + along(anywhere(unit, 1, rng)[0], step, 9) + [last] * 6
    placements, left_out = judged(track(one, poses, rng, 0.1 * np.arange(21) if stamped else ()))
    assert [found.moment for found in placements] == [0, 15]
    assert len(left_out) == 1
    assert left_out[0].startswith(f"9 sightings of {one.estimate.target.name} from 6.pcd to 14.pcd: it did not stand")


def test_small_steps_are_placements_if_stamps_say_so(unit: Unit, one: Sighting) -> None:
    rng = np.random.default_rng(16)
    placements, left_out = judged(track(one, along(anywhere(unit, 1, rng)[0], 0.1, 9), rng, 5.0 * np.arange(9)))
    assert (len(placements), left_out) == (9, [])


@pytest.mark.parametrize("moved", [0, 0.03, 0.05, 1.0])
def test_a_board_that_moved_where_it_is_said_to_stay(unit: Unit, one: Sighting, moved: float) -> None:
    """After five of ten revolutions, or evenly, or turned about its normal."""
    rng = np.random.default_rng(17)
    T, sideways, about = anywhere(unit, 1, rng)[0], np.array([0, 0, 0, 0, moved, 0]), np.array([moved, 0, 0, 0, 0, 0])
    for poses in (
        [T] * 5 + [T @ exp(sideways)] * 5,
        along(T, moved / 9, 10),
        [T] * 5 + [T @ exp(2 * about)] * 5,
        [T, T @ exp(2 * sideways)],
    ):
        placements, left_out = judged(track(one, poses, rng, place=3))
        if moved == 0:
            assert (len(placements), left_out) == (1, [])
        elif moved != 1.0 or len(one.estimate.target.symmetry_transforms) == 1:
            assert placements == ()
            assert len(left_out) == 1
            assert "while it should stand still" in left_out[0]


def test_one_wrong_pose_does_not_part_a_placement(unit: Unit, one: Sighting) -> None:
    rng = np.random.default_rng(18)
    T, other = anywhere(unit, 2, rng)
    placements, left_out = judged(track(one, [T] * 5 + [other] + [T] * 5, rng))
    assert [len(found.sightings) for found in placements] == [8]
    assert left_out == [f"1 sighting of {one.estimate.target.name} in 5.pcd: it did not stand still"]


def test_markers_tell_whether_a_board_stays(unit: Unit, one: Sighting) -> None:
    """To five millimetres, where poses alone leave two centimetres; they are taken on average."""
    rng = np.random.default_rng(19)
    T, corners = anywhere(unit, 1, rng)[0], np.array(one.estimate.target.vertices)
    seen = track(one, [T] * 8, rng)
    markers = [corners + 0.001 * rng.normal(size=corners.shape) + (0.01 if k > 3 else 0.0) for k in range(8)]
    markers[0][1] = np.nan
    placements, _ = judged([replace(s, markers=m) for s, m in zip(seen, markers, strict=True)])
    assert [len(found.sightings) for found in placements] == [4, 4]
    np.testing.assert_allclose(placements[0].markers, np.nanmean(markers[:4], axis=0))


def test_what_a_session_says(unit: Unit, tmp_path: Path) -> None:
    """Views of one stamp are of one place, views that are moving of none; the rest is told by the poses."""
    rng, board = np.random.default_rng(20), load_target("paper")
    a, b, c, d = anywhere(unit, 4, rng)
    views = []
    for k, (T, stamp, moving) in enumerate(
        [(a, 1.0, False)] * 3 + [(b, None, False)] * 3 + [(c, 4.0, True)] + [(d, 5.0, False), (c, 5.0, False)]
    ):
        file = tmp_path / f"{k}.pcd"
        write_scan(file, unit.scan(board, T, rng))
        views.append(View(file, "roof", ("paper",), target_points=file, stamp=stamp, moving=moving))
    session = Session("s", tmp_path / "session.yaml", {"roof": unit.sensor}, {}, {"paper": board}, tuple(views))

    def found(session: Session) -> tuple[list[int], list[str]]:
        placements, left_out = of_session(session, (), True, lambda done, total: None, Kept())
        return [len(one.sightings) for one in placements], left_out

    counts, left_out = found(session)
    assert counts == [3, 3]
    assert left_out[0] == "6.pcd: the session says that it is moving"
    assert left_out[1].startswith("paper from 7.pcd to 8.pcd: it moved by")
    counts, left_out = found(replace(session, static=frozenset({"paper"})))
    assert counts == []
    assert left_out[1].startswith("paper from 0.pcd to 8.pcd: it moved by")
    counts, _ = found(replace(session, static=frozenset({"paper"}), platform_moves=True))
    assert counts == [3, 3]
