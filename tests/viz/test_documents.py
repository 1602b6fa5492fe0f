"""What there is to see in files: every result form, as the commands write it."""

import json
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.io import demo_folder, load_target, read_scan
from optshape_graph.io.documents import write_json
from optshape_graph.mapping import Landmark, Map, save_map
from optshape_graph.viz.documents import FORMS, spatial
from optshape_graph.viz.spatial import Lines, Points, by_range, ellipsoid
from tests.factors.support import TARGET
from tests.mapping.support import at, covariance
from tests.viz.results import write_results

DEMO = demo_folder()


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_results(tmp_path_factory.mktemp("results"))


def items(seen, prefix: str) -> list[Points | Lines]:
    found = [item for item in seen.items if item.name.startswith(prefix)]
    assert found, [item.name for item in seen.items]
    return found


def test_a_scan() -> None:
    seen = spatial(DEMO / "4m.pcd")
    (returns,) = items(seen, "scan")
    np.testing.assert_array_equal(returns.points, read_scan(DEMO / "4m.pcd").points)
    assert returns.colours.shape == returns.points.shape


def test_estimates_have_a_step_each(results) -> None:
    seen = spatial(results["estimate"])
    document = json.loads(results["estimate"].read_text())
    assert seen.steps == tuple(entry["scan"] for entry in document["scans"])
    assert seen.notes == ()
    for step, entry in enumerate(document["scans"]):
        mine = {item.name: item for item in seen.items if item.step == step}
        assert {"scan", "target/best", "target/axes", "target/3 sd", "target/edge points"} <= set(mine)
        np.testing.assert_allclose(mine["target/best"].strips[0][:-1], entry["vertices"])
        np.testing.assert_allclose(mine["target/edge points"].points, entry["edge_points"])


def test_the_runner_up_is_the_template_at_the_other_pose(results, tmp_path) -> None:
    document = json.loads(results["estimate"].read_text())
    T = np.array(document["scans"][0]["ambiguity"]["T_lidar_target"])
    (rival,) = [item for item in items(spatial(results["estimate"]), "target/runner-up") if item.step == 0]
    target = load_target(DEMO / "target.yaml")
    np.testing.assert_allclose(rival.strips[0][:-1], target.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-9)


def test_failed_scans_and_scans_that_are_gone_are_noted(results, tmp_path) -> None:
    document = json.loads(results["estimate"].read_text())
    for entry, name in zip(document["scans"], ("gone.pcd", "4m.pcd"), strict=True):
        entry["scan"] = f"/nowhere/{name}"
    document["scans"][1] |= dict.fromkeys(["T_lidar_target", "covariance", "vertices"]) | {"reason": "too few"}
    write_json(tmp_path / "e.json", document)
    (tmp_path / "4m.pcd").write_bytes((DEMO / "4m.pcd").read_bytes())
    seen = spatial(tmp_path / "e.json")
    assert seen.notes == (
        "scan not shown: /nowhere/gone.pcd is neither there nor beside e.json",
        "/nowhere/4m.pcd: no pose (too few)",
    )
    assert [item.step for item in items(seen, "scan")] == [1]
    (tmp_path / "4m.pcd").write_text("not a cloud")
    assert any("4m.pcd" in note and "scan not shown" in note for note in spatial(tmp_path / "e.json").notes)


def test_detections(results, tmp_path) -> None:
    seen = spatial(results["detect"])
    (found,) = json.loads(results["detect"].read_text())["scans"][0]["targets"]
    (returns,) = items(seen, "targets/0 paper/returns")
    assert len(returns.points) == len(found["return_indices"])
    T = np.array(found["T_lidar_target"])
    (shape,) = items(seen, "targets/0 paper/outline")
    np.testing.assert_allclose(shape.strips[0][:-1], load_target("paper").vertices @ T[:3, :3].T + T[:3, 3])
    # A target that is not built in needs its file; without it the pose is shown.
    document = json.loads(results["detect"].read_text())
    document["scans"][0]["targets"][0]["target"] = "mine"
    document["scans"][0]["scan"] = str(results["simulation"].with_suffix(".pcd"))
    write_json(tmp_path / "d.json", document)
    without = spatial(tmp_path / "d.json")
    assert without.notes == ("outline of 'mine' not shown: give its file with --target",)
    assert items(without, "targets/0 mine/axes")
    assert items(spatial(tmp_path / "d.json", {"mine": TARGET}), "targets/0 mine/outline")


def test_the_truth_of_a_simulation(results) -> None:
    seen = spatial(results["simulation"])
    (shape,) = items(seen, "targets/0 paper")
    truth = json.loads(results["simulation"].read_text())["targets"][0]["vertices"]
    np.testing.assert_allclose(shape.strips[0][:-1], truth)
    assert items(seen, "scan")


def test_motion_capture_shows_where_the_target_stood(results) -> None:
    seen = spatial(results["mocap"])
    document = json.loads(results["mocap"].read_text())
    layout = np.array(document["marker_layout"])
    for entry in document["scans"]:
        T = np.array(entry["T_lidar_target"])
        (markers,) = items(seen, f"targets/{entry['scan']}/markers")
        np.testing.assert_allclose(markers.points, layout @ T[:3, :3].T + T[:3, 3])
    assert items(seen, "motion capture/3 sd")


def test_a_motion_capture_result_without_poses_is_noted(results, tmp_path) -> None:
    document = json.loads(results["mocap"].read_text())
    for entry in document["scans"]:
        del entry["T_lidar_target"]
    write_json(tmp_path / "old.json", document)
    assert len(spatial(tmp_path / "old.json").notes) == 8


def test_a_map(results, tmp_path) -> None:
    seen = spatial(results["map"])
    assert items(seen, "trajectories/")
    assert items(seen, "landmarks/")
    save_map(tmp_path / "m.json", Map((Landmark("a", TARGET, at(3.0, 4.0, 0.5), covariance([0.1] * 6)),)))
    (shape,) = items(spatial(tmp_path / "m.json"), "landmarks/a/outline")
    np.testing.assert_allclose(shape.strips[0].mean(axis=0)[:2], [3.0, 4.0], atol=0.5)


def test_cameras(camera_calibration, tmp_path) -> None:
    write_json(tmp_path / "camera.json", camera_calibration.to_dict())
    seen = spatial(tmp_path / "camera.json")
    T = np.linalg.inv(camera_calibration.transform("front", camera_calibration.lidars[0])[0])
    (pyramid,) = items(seen, "cameras/front/sees")
    np.testing.assert_allclose(pyramid.strips[1][0], T[:3, 3], atol=1e-9)
    middle = pyramid.strips[0][:-1].mean(axis=0) - T[:3, 3]
    assert middle @ T[:3, 2] > 0.3  # ahead of the camera
    assert items(seen, "next placement/")


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"schema": "optshape/sweep/1"}, r"'optshape/sweep/1' cannot be shown in space; expected one of: optshape/est"),
        ({"schema": "optshape/estimate/2"}, "cannot be shown"),
        ({"schema": "optshape/estimate/1"}, "the key 'scans' is missing"),
        ({"schema": "optshape/estimate/1", "scans": [{"scan": "a"}]}, r"scans\[0\]: the key 'T_lidar_target'"),
        ({"schema": "optshape/detect/1", "scans": 3}, "expected a list"),
        ({}, "the key 'schema' is missing"),
        ([], "expected a mapping"),
    ],
)
def test_other_documents_are_refused(tmp_path, document, message) -> None:
    (tmp_path / "x.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=message):
        spatial(tmp_path / "x.json")


def test_every_form_is_tested(results) -> None:
    assert set(FORMS) == {*results, "camera-calibration", "rig"}


def test_an_ellipsoid_has_the_covariance_s_axes() -> None:
    shape = ellipsoid("e", at(1.0, 2.0, 0.3), covariance([0.1, 0.1, 0.1, 0.3, 0.2, 0.1]))
    reach = [np.linalg.norm(strip - [1.0, 2.0, 0.0], axis=1).max() for strip in shape.strips]
    assert sorted(reach) == pytest.approx([0.6, 0.9, 0.9])


def test_colours_of_ranges_run_from_near_to_far() -> None:
    colours = by_range(np.array([[1.0, 0, 0], [3.0, 0, 0], [9.0, 0, 0]]))
    assert colours[0].tolist() == [68, 1, 84]
    assert colours[1].tolist() == [33, 145, 140]
    assert colours[2].tolist() == [253, 231, 37]
    assert by_range(np.zeros((0, 3))).shape == (0, 3)
