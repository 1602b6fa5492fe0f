"""What can't be used is refused before any scan is read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from optshape_graph import EstimationError, InputError
from optshape_graph.calibration.sensor import Distance
from optshape_graph.calibration.sensor.sources import Opened
from optshape_graph.io import load_sensor, load_target
from optshape_graph.io.recordings import Recording
from optshape_graph.io.sessions import Session, View

BOARDS = {"left": load_target("paper"), "right": load_target("square")}


def session(views: int = 8, shown: tuple[str, ...] = ("left", "right")) -> Session:
    """A session of so many views that show these of two boards."""
    seen = tuple(View(Path(f"{k}.pcd"), "roof", shown, where=f"session.yaml: views[{k}]") for k in range(views))
    return Session("s", Path("session.yaml"), {"roof": load_sensor("vlp16")}, {}, BOARDS, seen)


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    (tmp_path / "a.pcd").write_text("")
    (tmp_path / "timestamps.txt").write_text("0.0 a.pcd\n")
    return Recording(tmp_path)


def test_targets_are_called_as_the_session_calls_them() -> None:
    opened = Opened.of([session()], (), None)
    opened.check([Distance.parsed("left", "right/2", 3.0), Distance.parsed("left", "right", "3@7.pcd")], False)
    assert isinstance(opened.sources[0], Session)
    assert {name: target.name for name, target in opened.sources[0].targets.items()} == {
        "left": "left",
        "right": "right",
    }


@pytest.mark.parametrize(
    ("a", "b", "metres", "message"),
    [
        ("paper", "right", "3", "no board is called that; found left, right"),
        ("left/9", "right", "3", "has vertices 0 to 3; found 9"),
        ("left/0", "left/1", "3", "between two boards"),
        ("left", "right", "3@9.pcd", "no scan is called that; found 0.pcd, 1.pcd, 2.pcd"),
    ],
)
def test_distances_that_cannot_be(a: str, b: str, metres: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Opened.of([session()], (), None).check([Distance.parsed(a, b, metres)], False)


def test_boards_of_which_no_view_shows_both() -> None:
    apart = Opened.of([session(shown=("left",)), session(shown=("right",))], (), None)
    with pytest.raises(InputError, match="no scan is said to show both at once"):
        apart.check([Distance.parsed("left", "right", 3.0)], False)


def test_too_few_views_or_missing_crops() -> None:
    with pytest.raises(EstimationError, match="4 are in view at most"):
        Opened.of([session(2)], (), None).check([], False)
    with pytest.raises(InputError, match=r"views\[0\]: the view has no 'target_points'"):
        Opened.of([session()], (), None).check([], True)


def test_sources_that_do_not_go_together(recording: Recording) -> None:
    """Of the second one, too, before the first is read."""
    boards, vlp16 = tuple(BOARDS.values()), load_sensor("vlp16")
    of_session = Opened.of([recording, session()], boards, None)
    assert of_session.sensor.name == "vlp16"
    for sources, targets, sensor, options, message in (
        ([recording], boards, None, {}, "needs the sensor's file"),
        ([session(), recording], (), None, {}, "needs the targets to look for"),
        ([session(), recording], boards, None, {"topic": "/other"}, "no topic '/other'|topic"),
        ([recording], boards, vlp16, {"lidar": "roof"}, "only a session names LiDARs"),
        ([session()], (), None, {"topic": "/points"}, "only a recording has topics"),
        ([session()], (), None, {"lidar": "front"}, "no LiDAR 'front'"),
        ([session()], (), load_sensor("vlp32c"), {}, "another model"),
        ([], boards, vlp16, {}, "nothing to calibrate"),
        ([recording, recording], boards, vlp16, {}, "given twice"),
    ):
        with pytest.raises(InputError, match=message):
            Opened.of(sources, targets, sensor, **options)
    with pytest.raises(InputError, match="a recording has no 'target_points'"):
        of_session.check([], True)


def test_motion_capture_of_several_boards() -> None:
    several = replace(session(), mocap=object())  # type: ignore[arg-type]  # that there is any is enough
    with pytest.raises(InputError, match="used with one board; the sessions name left, right"):
        Opened.of([several], (), None).check([], False)


def test_clouds_of_two_sessions_count_once(tmp_path: Path) -> None:
    """A copy of a session's file shows nothing new."""
    (tmp_path / "3.pcd").write_text("")
    first = session()
    views = tuple(replace(view, scan=tmp_path / str(view.scan)) for view in first.views)
    sessions = [replace(first, path=Path(name), views=views) for name in ("session.yaml", "copy.yaml")]
    with pytest.raises(InputError, match=r"3\.pcd: given twice"):
        Opened.of(sessions, (), None)
