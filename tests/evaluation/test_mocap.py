"""Table II: several sessions, another method's estimates, scans that take no part."""

import json
import shutil

import numpy as np
import pytest

from optshape_graph import InputError
from optshape_graph.evaluation.mocap import evaluate_mocap, find_sessions, load_reference, mean_errors
from optshape_graph.io import load_sensor, load_target
from optshape_graph.simulation import synthetic_session
from tests.shared import SHARED, needs_shared


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    for seed, distances in enumerate([(4.0, 6.0), (8.0,)]):
        name = f"session{seed}"
        synthetic_session(
            folder / name, load_target("built"), load_sensor("vlp32c"), distances=distances, rng=seed, name=name
        )
    (folder / "notes").mkdir()
    return folder


def true_poses(recordings, path):
    """The truth of the sessions, in the form of another method's estimates."""
    poses = {
        f"{folder.name}/{scan}": {"T_lidar_target_paper": T}
        for folder in recordings.glob("session*")
        for scan, T in json.loads((folder / "truth.json").read_text())["T_lidar_target"].items()
    }
    path.write_text(json.dumps(poses))
    return load_reference(path)


def test_every_scan_of_every_session_has_a_row(recordings, tmp_path):
    seen = []
    rows, left_out = evaluate_mocap(
        find_sessions(recordings), true_poses(recordings, tmp_path / "truth.json"), lambda *done: seen.append(done)
    )
    assert left_out == []
    assert [f"{row['session']}/{row['scan']}" for row in rows] == [
        "session0/4m.pcd", "session0/4m_angled.pcd", "session0/6m.pcd", "session0/6m_angled.pcd",
        "session1/8m.pcd", "session1/8m_angled.pcd",
    ]  # fmt: skip
    assert seen == sorted(seen)
    assert seen[-1] == (6, 6)
    for row in rows:
        assert row["rmse_m"] < 0.05
        assert row["rmse_pct"] == pytest.approx(100 * row["rmse_m"] / row["distance_m"])
        assert row["e_q_m"] == pytest.approx(np.radians(0.2) * row["distance_m"])
        # What the truth leaves is the markers' place about the vertices, 1.5 cm, of which the template fit sees a part.
        assert row["reference_rmse_m"] < 0.015
        assert row["published_rmse_m"] is None
    assert mean_errors(rows)["rmse_m"] == pytest.approx(np.mean([row["rmse_m"] for row in rows]))
    assert mean_errors(rows, "published_") is None


def test_a_session_with_one_scan_of_use_is_left_out(recordings, tmp_path):
    shutil.copytree(recordings / "session1", tmp_path / "alone")
    path = tmp_path / "alone" / "session.yaml"
    path.write_text(path.read_text().replace(", mocap_frame: 1", ""))
    rows, left_out = evaluate_mocap(find_sessions(tmp_path / "alone"))
    assert rows == []
    assert [(item.scan, item.reason) for item in left_out] == [
        ("alone/8m_angled.pcd", "the session gives it no mocap_frame"),
        ("alone/8m.pcd", "no other scan of the session can be used"),
    ]


def test_what_is_missing_is_named(recordings, tmp_path):
    with pytest.raises(InputError, match="found none"):
        find_sessions(tmp_path)
    with pytest.raises(InputError, match=r"no estimate of 'session0/4m\.pcd'"):
        evaluate_mocap(find_sessions(recordings), {})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "a mapping"),
        ('{"a/b.pcd": {"T": 1}}', r"a/b\.pcd: the key 'T_lidar_target_paper' is missing"),
        ('{"a/b.pcd": {"T_lidar_target_paper": [[1, 0], [0, 1]]}}', "4 elements"),
        ('{"a/b.pcd": {"T_lidar_target_paper": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}}', "a rigid transform"),
    ],
)
def test_a_reference_that_is_none_is_refused(tmp_path, text, message):
    path = tmp_path / "reference.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_reference(path)


@needs_shared
def test_the_recordings_are_those_of_table_2_and_the_papers_estimates_have_the_known_errors():
    reference = load_reference(SHARED / "reference" / "mocap_paper_estimates.json")
    rows, left_out = evaluate_mocap(find_sessions(SHARED / "data" / "mocap"), reference)
    assert left_out == []
    assert len(rows) == 10
    published = json.loads((SHARED / "reference" / "mocap_paper_estimates.json").read_text())
    for row in rows:
        known = published[f"{row['session']}/{row['scan']}"]
        assert [row[f"published_{name}"] for name in ("rmse_m", "e_t_m", "e_r_deg")] == [
            known["rmse_m"], known["e_t_m"], known["e_r_deg"],
        ]  # fmt: skip
    # The means that the reference's description states, to its digits.
    theirs = mean_errors(rows, "reference_")
    assert (round(theirs["rmse_m"], 3), round(theirs["e_t_m"], 3), round(theirs["e_r_deg"], 1)) == (0.036, 0.019, 3.4)
    ours = mean_errors(rows)
    assert ours["rmse_m"] < 0.026
    assert ours["e_r_deg"] < 2.4
