"""Sessions as files: motion-capture bodies, views that share files, what moves."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from optshape_graph.calibration.rig import calibrate_rig
from optshape_graph.calibration.rig.reading import read_sightings
from optshape_graph.errors import InputError
from optshape_graph.evaluation.rigs import Carried, SimulatedRig, placements, two_targets, write_rig_session
from optshape_graph.io import load_session, write_scan
from optshape_graph.se3 import apply, difference, exp, inverse

BODY = {"m1": [0.0, 0.0, 0.0], "m2": [0.25, 0.02, 0.0], "m3": [0.0, 0.2, 0.05], "m4": [0.1, 0.1, 0.2]}
T_BASE_BODY = exp([0.1, -0.2, 0.4, 0.3, -0.1, 0.2])
NOISE = 0.5e-3


@pytest.fixture(scope="module")
def rig():
    return SimulatedRig.drawn(np.random.default_rng(5), {"front": "vlp16"}, ())


@pytest.fixture(scope="module")
def session(rig, tmp_path_factory) -> Path:
    """A LiDAR and a body on a platform that is carried about in a room with motion capture; markers at A's vertices."""
    folder, rng = tmp_path_factory.mktemp("mocap"), np.random.default_rng(6)
    placed = placements(10, rng, (-60.0, 60.0))
    path = write_rig_session(folder, rig, two_targets(), placed, seed=2)
    target = two_targets()["A"]
    layout = target.vertices + rng.normal(0.0, 0.01, target.vertices.shape)
    lines = ["frame,marker,x,y,z"]
    for k, (T_base_target, _) in enumerate(placed):
        T_room_base = exp(rng.normal(0.0, 0.5, 6))
        marks = dict(zip(BODY, apply(T_room_base @ T_BASE_BODY, np.array(list(BODY.values()))), strict=True))
        at = rig.T_base_sensor["front"] @ inverse(rig.T_base_sensor["front"]) @ T_base_target
        marks |= {f"a{v}": p for v, p in enumerate(apply(T_room_base @ at, layout))}
        for name, point in marks.items():
            x, y, z = point + rng.normal(0.0, NOISE, 3)
            lines.append(f"{k},{name},{x:.6f},{y:.6f},{z:.6f}")
    (folder / "markers.csv").write_text("\n".join(lines) + "\n")
    document = yaml.safe_load(path.read_text())
    document["views"] += [{"mocap_frame": k, "targets": ["A"], "stamp": k} for k in range(len(placed))]
    markers = {f"a{v}": ["A", v] for v in range(len(target))}
    document["mocap"] = {"file": "markers.csv", "units": "m", "markers": markers, "bodies": {"pod": BODY}}
    path.write_text(yaml.safe_dump(document))
    return path


def test_a_body_of_motion_capture_is_a_sensor(rig, session):
    result = calibrate_rig(session, use_target_points=True)
    assert result.names == ("front", "pod")
    assert result.sensors[1].kind == "mocap body"
    T, covariance = result.transform("front", "pod")
    x = difference(inverse(rig.T_base_sensor["front"]) @ T_BASE_BODY, T)
    assert np.linalg.norm(x[3:]) < 0.012
    assert np.degrees(np.linalg.norm(x[:3])) < 0.4
    assert x @ np.linalg.solve(covariance, x) / 6 < 4.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: d["mocap"]["bodies"].update(pod={"m1": [0, 0, 0], "m2": [1, 0, 0], "x": [0, 1, 0]}),
            "no marker 'x'",
        ),
        (lambda d: d["mocap"]["bodies"].update(pod={"m1": [0, 0, 0], "m2": [1, 0, 0], "m3": [2, 0, 0]}), "on one line"),
        (lambda d: d["mocap"]["bodies"].update(front=BODY), "two sensors called 'front'"),
        (lambda d: d["mocap"].pop("markers"), "markers that belong to no target"),
    ],
)
def test_bodies_that_are_refused(session, change, message):
    document = yaml.safe_load(session.read_text())
    change(document)
    path = session.with_name("wrong.yaml")
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=message):
        read_sightings(load_session(path), True)


def test_what_moves_is_seen_at_a_time_of_its_own(rig, tmp_path):
    rng = np.random.default_rng(3)
    path, target = Carried.drawn(rng), two_targets()["A"]
    plain = write_rig_session(tmp_path, rig, {"A": target}, placements(1, rng, (-10, 10), count=1))
    scan = rig.moving_scan("front", target, path, 0.4, rng, "moving")
    write_scan(tmp_path / "moving.pcd", scan)
    document = yaml.safe_load(plain.read_text())
    view = {"scan": "moving.pcd", "target_points": "moving.pcd", "stamp": 12.5, "moving": True}
    document["views"], document["cameras"] = [view], {}
    document["lidars"]["rear"] = "vlp32c"
    view["lidar"] = "front"
    plain.write_text(yaml.safe_dump(document))
    (sighting,) = read_sightings(load_session(plain), True).sightings
    assert sighting.moving
    assert sighting.time == pytest.approx(12.5 + scan.time.mean(), abs=1e-4)  # a crop is cleaned first
    del view["stamp"]
    plain.write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=r"session\.yaml:\d+: views\[0\]: a view that is 'moving' needs a 'stamp'"):
        read_sightings(load_session(plain), True)
