"""Session files of both forms, and what they may get wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import View, load_session
from tests.io.test_cameras import KALIBR, OWN
from tests.io.test_targets import SQUARE
from tests.shared import SHARED, needs_shared

SHORT = """\
schema: optshape/session/1
name: short
sensor: vlp16
target: board.yaml
camera: camera.yaml
views:
  - {scan: a.pcd, target_points: a_target.pcd, image: a.png}
  - {scan: b.pcd, stamp: 12.5}
"""
MOCAP = """\
schema: optshape/session/1
sensor: rear.yaml
target: board.yaml
scans:
  - {file: a.pcd, mocap_frame: 0}
  - {file: b.pcd, mocap_frame: 1}
mocap:
  file: markers.csv
  units: m
"""
GENERAL = """\
schema: optshape/session/1
lidars: {front: {sensor: vlp16}, rear: {sensor: rear.yaml}}
cameras: {left: camera.yaml, cam1: chain.yaml}
targets: {A: board.yaml, B: paper@0.5}
views:
  - {lidar: front, scan: a.pcd, camera: left, image: a.png, targets: [A, B], stamp: 12.3}
  - {lidar: rear, scan: b.pcd, camera: cam1, image: a.png, mocap_frame: 1}
mocap: {file: markers.csv, units: m, markers: {corner0: [A, 0], corner1: [B, 3]}}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with everything that the sessions above name."""
    (tmp_path / "board.yaml").write_text(SQUARE)
    (tmp_path / "camera.yaml").write_text(OWN)
    (tmp_path / "chain.yaml").write_text(KALIBR)
    (tmp_path / "rear.yaml").write_text("schema: optshape/sensor/1\nname: rear\nelevations_deg: [-1, 0, 1]\n")
    rows = [f"{frame},corner{k},{k},{frame},0" for frame in (0, 1) for k in range(4)]
    (tmp_path / "markers.csv").write_text("\n".join(["frame,marker,x,y,z", *rows]))
    for name in ("a.pcd", "b.pcd", "a_target.pcd", "a.png"):
        (tmp_path / name).touch()
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "session.yaml"
    path.write_text(text)
    return path


def test_short_form(folder: Path) -> None:
    session = load_session(write(folder, SHORT))
    assert session.name == "short"
    assert (list(session.lidars), list(session.targets), list(session.cameras)) == (["vlp16"], ["mine"], ["front"])
    assert session.mocap is None
    assert session.views == (
        View(folder / "a.pcd", "vlp16", ("mine",), "front", folder / "a.png", folder / "a_target.pcd"),
        View(folder / "b.pcd", "vlp16", ("mine",), stamp=12.5),
    )


def test_scans_with_marker_frames(folder: Path) -> None:
    session = load_session(write(folder, MOCAP))
    assert session.name == "session"
    assert [view.mocap_frame for view in session.views] == [0, 1]
    assert session.mocap is not None
    assert session.mocap.vertices == {f"corner{k}": ("mine", k) for k in range(4)}
    np.testing.assert_array_equal(session.mocap.markers.frames[1]["corner3"], [3, 1, 0])


def test_general_form(folder: Path) -> None:
    session = load_session(write(folder, GENERAL))
    assert {name: sensor.name for name, sensor in session.lidars.items()} == {"front": "vlp16", "rear": "rear"}
    assert {name: camera.model for name, camera in session.cameras.items()} == {
        "left": "pinhole",
        "cam1": "equidistant",
    }
    np.testing.assert_allclose(session.targets["B"].area, 0.5)
    assert session.views == (
        View(folder / "a.pcd", "front", ("A", "B"), "left", folder / "a.png", stamp=12.3),
        View(folder / "b.pcd", "rear", ("A", "B"), "cam1", folder / "a.png", mocap_frame=1),
    )
    assert session.mocap is not None
    assert session.mocap.vertices == {"corner0": ("A", 0), "corner1": ("B", 3)}


def test_corners_of_an_image(folder: Path) -> None:
    (folder / "a.csv").touch()
    session = load_session(write(folder, SHORT.replace("image: a.png", "image: a.png, corners: a.csv")))
    assert session.views[0].corners == folder / "a.csv"
    with pytest.raises(InputError, match=r"views\[0\]\.corners: no such file: .*z\.csv"):
        load_session(write(folder, SHORT.replace("image: a.png", "image: a.png, corners: z.csv")))


def test_markers_of_other_names_are_left_to_their_shape(folder: Path) -> None:
    markers = folder / "markers.csv"
    markers.write_text(markers.read_text().replace("corner3", "top"))
    session = load_session(write(folder, MOCAP))
    assert session.mocap is not None
    assert session.mocap.vertices == {}


def test_several_targets_leave_corners_open(folder: Path) -> None:
    session = load_session(write(folder, MOCAP.replace("target: board.yaml", "targets: {A: board.yaml, B: paper}")))
    assert session.mocap is not None
    assert session.mocap.vertices == {}


@needs_shared
def test_real_sessions() -> None:
    for number, views in ((1, 4), (3, 4), (5, 2)):
        session = load_session(SHARED / "data" / "mocap" / f"session{number}" / "session.yaml")
        assert session.name == f"umich-mocap-session{number}"
        assert len(session.views) == views
        assert session.mocap is not None
        assert session.mocap.vertices == {f"corner{k}": ("umich-large", k) for k in range(4)}
    session = load_session(SHARED / "data" / "camera" / "session.yaml")
    assert len(session.views) == 20
    assert all(view.image is not None and view.camera == "front" for view in session.views)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SHORT.replace("session/1", "target/1"), r"session\.yaml:1: schema: expected 'optshape/session/1'"),
        (
            SHORT.replace("sensor:", "sensro:"),
            r"session\.yaml:3: sensro: unknown key 'sensro' \(did you mean 'sensor'\?\)",
        ),
        (
            SHORT.replace("sensor: vlp16\n", ""),
            "a scan, but the session names no LiDAR",
        ),
        (SHORT.replace("target: board.yaml\n", ""), "expected 'target' or 'targets', found only: schema, name, sensor"),
        (
            SHORT.replace("sensor: vlp16", "sensor: vlp99"),
            r"session\.yaml:3: sensor: .*vlp99: no such file, and the built-in",
        ),
        (SHORT.replace("board.yaml", "nope.yaml"), r"session\.yaml:4: target: .*nope\.yaml: no such file"),
        (
            SHORT.replace("target: board.yaml", "target: camera.yaml"),
            r":4: target: .*camera\.yaml:1: schema: expected 'optshape/t",
        ),
        (SHORT.replace("camera.yaml", "nope.yaml"), r"session\.yaml:5: camera: .*nope\.yaml: no such file"),
        (SHORT.replace("camera.yaml", "chain.yaml"), "it has the cameras cam0, cam1: name one, as chain.yaml:cam0"),
        (SHORT + "lidars: {a: {sensor: vlp16}}\n", "expected 'sensor' or 'lidars', found both"),
        (SHORT + "scans: [{file: a.pcd}]\n", ":6: views: expected 'views' or 'scans', found both"),
        (SHORT[: SHORT.index("views")], "expected 'views' or 'scans', found (both|only: schema, name)"),
        (SHORT[: SHORT.index("views")] + "views: []\n", "views: expected a list of 1 or more elements, found 0"),
        (SHORT[: SHORT.index("views")] + "views: a.pcd\n", "views: expected a list, found 'a.pcd'"),
        (SHORT.replace("scan: b.pcd", "scan: c.pcd"), r"session\.yaml:8: views\[1\]\.scan: no such file: .*c\.pcd"),
        (SHORT.replace("scan: b.pcd", "scan: ."), r"views\[1\]\.scan: no such file"),
        (SHORT.replace("scan: b.pcd", "scan: 3"), r"views\[1\]\.scan: expected a text \(put it in quotes\), found 3"),
        (
            SHORT.replace("scan: b.pcd, ", ""),
            r"session\.yaml:8: views\[1\]: expected 'scan' or 'image' or 'mocap_frame', found only: stamp",
        ),
        (SHORT.replace("a.png", "z.png"), r"session\.yaml:7: views\[0\]\.image: no such file: .*z\.png"),
        (SHORT.replace("a_target", "z_target"), r"views\[0\]\.target_points: no such file"),
        (SHORT.replace("camera: camera.yaml\n", ""), r"views\[0\]\.image: an image, but the session names no camera"),
        (SHORT.replace("stamp: 12.5", "stamp: noon"), r"views\[1\]\.stamp: expected a finite number, found 'noon'"),
        (
            SHORT.replace("stamp: 12.5", "mocap_frame: 0"),
            r"mocap_frame: a marker frame, but the session has no motion capture",
        ),
        (SHORT.replace("stamp: 12.5", "lidar: rear"), r"views\[1\]\.lidar: no LiDAR 'rear'; the session has: vlp16"),
        (
            SHORT.replace("stamp: 12.5", "camera: front"),
            r"views\[1\]\.camera: the key 'image' is missing beside it",
        ),
        (
            SHORT.replace("stamp: 12.5", "targets: [B]"),
            r"views\[1\]\.targets\[0\]: no target 'B'; the session has: mine",
        ),
        (
            MOCAP.replace("mocap_frame: 1", "mocap_frame: 7"),
            r"session\.yaml:6: .*: no marker frame 7; the file has 2 frames, 0 to 1",
        ),
        (
            MOCAP.replace("mocap_frame: 1", "mocap_frame: -1"),
            "mocap_frame: expected an integer of at least 0, found -1",
        ),
        (MOCAP.replace("markers.csv", "nope.csv"), r"session\.yaml:8: mocap\.file: no such file: .*nope\.csv"),
        (MOCAP.replace("  units: m\n", ""), "mocap: the key 'units' is missing; expected one of m, cm, mm, as "),
        (
            MOCAP.replace("units: m", "units: ft"),
            r"session\.yaml:9: mocap\.units: expected one of: m, cm, mm, found 'ft'",
        ),
        (MOCAP.replace("units: m", "units: mm"), r"markers\.csv: the markers of frame 0 span 0\.003 m, read in 'mm'"),
        (
            GENERAL.replace("lidar: front, ", ""),
            r"session\.yaml:6: views\[0\]: the key 'lidar' is missing; .* front, rear",
        ),
        (
            GENERAL.replace("lidar: front", "lidar: side"),
            r"views\[0\]\.lidar: no LiDAR 'side'; the session has: front, rear",
        ),
        (
            GENERAL.replace("camera: left, ", ""),
            r"views\[0\]: the key 'camera' is missing; the session has several: left, cam1",
        ),
        (GENERAL.replace("camera: left", "camera: right"), "no camera 'right'; the session has: left, cam1"),
        (GENERAL.replace("[A, B]", "[A, C]"), r"views\[0\]\.targets\[1\]: no target 'C'; the session has: A, B"),
        (
            GENERAL.replace("{sensor: vlp16}", "{model: vlp16}"),
            r"lidars\.front\.model: unknown key 'model'; expected one of: sensor",
        ),
        (
            GENERAL.replace("[B, 3]", "[B, 4]"),
            r"session\.yaml:8: mocap\.markers\.corner1\[1\]: expected a vertex of 'B', 0 to 3",
        ),
        (GENERAL.replace("[B, 3]", "[C, 0]"), r"mocap\.markers\.corner1\[0\]: no target 'C'"),
        (GENERAL.replace("[B, 3]", "[A, 0]"), "a second marker at vertex 0 of 'A'"),
        (GENERAL.replace("[B, 3]", "B3"), "corner1: expected a list, found 'B3'"),
        (
            GENERAL.replace("[B, 3]", "[B]"),
            r"corner1: expected a list of 2 elements, found 1",
        ),
        (GENERAL.replace("corner1: [", "top: ["), "no marker 'top'; the file has: corner0, corner1, corner2, corner3"),
    ],
)
def test_files_that_are_refused(folder: Path, text: str, message: str) -> None:
    path = write(folder, text)
    with pytest.raises(InputError, match=message) as raised:
        load_session(path)
    assert str(folder) in str(raised.value)


# Paths that lead out


def elsewhere(tmp_path: Path) -> Path:
    """A file that no session of `tmp_path/campaign/one` has any business with."""
    (tmp_path / "private").mkdir()
    (tmp_path / "private" / "a.pcd").write_text("private")
    return tmp_path / "private" / "a.pcd"


@pytest.fixture
def nested(tmp_path: Path, folder: Path) -> Path:
    """The session's folder, two levels down."""
    inner = tmp_path / "campaign" / "one"
    inner.mkdir(parents=True)
    for file in [file for file in folder.iterdir() if file.is_file()]:
        file.rename(inner / file.name)
    return inner


@pytest.mark.parametrize("key", ["scan: a.pcd", "target: board.yaml", "camera: camera.yaml", "image: a.png"])
def test_paths_that_climb_out_are_refused_unless_allowed(tmp_path: Path, nested: Path, key: str) -> None:
    name, file = key.split(": ")
    (tmp_path / "private").mkdir()
    (nested / file).rename(tmp_path / "private" / file)
    path = write(nested, SHORT.replace(key, f"{name}: ../../private/{file}"))
    with pytest.raises(
        InputError, match=r"session\.yaml:\d.*leads out of its folder and the one above.*--allow-outside"
    ):
        load_session(path)
    assert load_session(path, allow_outside=True).views


def test_links_out_are_refused_unless_allowed(tmp_path: Path, nested: Path) -> None:
    (nested / "a.pcd").unlink()
    (nested / "a.pcd").symlink_to(elsewhere(tmp_path))
    path = write(nested, SHORT)
    with pytest.raises(InputError, match=r"session\.yaml:7: views\[0\]\.scan: .*a\.pcd: leads out of .*private/a\.pcd"):
        load_session(path)
    assert load_session(path, allow_outside=True).views[0].scan == nested / "a.pcd"


def test_links_within_the_campaign_and_whole_paths_are_followed(tmp_path: Path, nested: Path) -> None:
    (nested / "board.yaml").rename(nested.parent / "board.yaml")  # what the sessions of a campaign share
    (nested / "b.pcd").unlink()
    (nested / "b.pcd").symlink_to(nested / "a.pcd")
    text = SHORT.replace("target: board.yaml", "target: ../board.yaml").replace(
        "scan: a.pcd", f"scan: {elsewhere(tmp_path)}"
    )
    assert load_session(write(nested, text)).views[0].scan == tmp_path / "private" / "a.pcd"


def test_a_loop_of_links_is_an_error(nested: Path) -> None:
    (nested / "a.pcd").unlink()
    (nested / "a.pcd").symlink_to(nested / "a.pcd")
    with pytest.raises(InputError, match=r"a\.pcd"):
        load_session(write(nested, SHORT))
