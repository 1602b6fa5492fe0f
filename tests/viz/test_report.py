"""One file, whole, safe and readable: parsed as HTML, with nothing fetched from anywhere."""

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import InputError, estimate_pose, load_sensor, load_target
from optshape_graph.evaluation.verdicts import LOOK_AT, verdict_of
from optshape_graph.pose import fit
from optshape_graph.simulation import pose_from_rpy, simulate_target
from optshape_graph.viz.report import caption_of, plan_view, write_report

COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 4e-6, 1e-6]).tolist()


def pose(x, y=0.0):
    T = np.eye(4)
    T[:2, 3] = x, y
    return T.tolist()


def scan(name, status="ok", x=5.0, flags=(), n=100):
    return {
        "scan": name, "target": "paper", "status": status, "reason": "" if status == "ok" else "a fold of 5 mm",
        "T_lidar_target": pose(x), "covariance": COVARIANCE, "n_returns": n,
        "fit": {"flags": [{"kind": kind, "excess": 2.0, "reason": "x"} for kind in flags]},
    }  # fmt: skip


ESTIMATE = {"schema": "optshape/estimate/1", "scans": [scan("a.pcd"), scan("b.pcd", x=9.0)]}
DOUBTFUL = {
    "schema": "optshape/estimate/1",
    "scans": [scan("a.pcd"), scan("b.pcd", "doubtful", flags=["surface"]), scan("<b>&.pcd", "ambiguous", n=9)],
}
MOCAP = {
    "schema": "optshape/mocap/1", "verdict": "to be trusted", "warnings": [],
    "mean": {"rmse_m": 0.01, "e_t_m": 0.0047, "e_r_deg": 0.6},
    "scans": [{"scan": f"{k}.pcd", "rmse_m": 0.01, "e_t_m": 0.005, "e_r_deg": 0.5, "T_lidar_target": pose(4.0 + k)}
              for k in range(6)],
    "T_lidar_mocap": pose(1.0), "covariance": COVARIANCE, "left_out": [],
}  # fmt: skip
MAP = {
    "schema": "optshape/map/1", "trajectory": [{}] * 7,
    "landmarks": [{"id": "A", "T_world_target": pose(1.0), "covariance": COVARIANCE, "observations": 1}],
}  # fmt: skip
SIZE = {
    "target": "pose-optimal", "area_m2": 0.5, "width_m": 1.0, "height_m": 0.7, "centre_above_sensor_m": -0.1,
    "bound_e_r_95_deg": 1.0, "bound_e_t_95_m": 0.01, "e_r_95_deg": 1.1, "e_t_95_m": 0.011, "ok": 100, "ambiguous": 0,
    "failed": 0, "does_it": True,
}  # fmt: skip
CHOICE = {"schema": "optshape/design-choice/1", "range_m": 6.0, "scans": 100, "chosen": SIZE,
          "smaller": [{**SIZE, "e_r_95_deg": None, "e_t_95_m": None, "does_it": False}]}  # fmt: skip


CELL = {
    "method": "global", "noise": "sensor", "orientation": "face", "range_m": 20.0, "scans": 10, "ok": 10, "doubtful": 0,
    "ambiguous": 0, "failed": 0, "rmse_m_median": 0.01, "rmse_m_p95": 0.02, "e_t_m_median": 0.005, "e_t_m_p95": 0.01,
    "e_r_deg_median": 0.5, "e_r_deg_p95": 1.0, "worst_ok_e_r_deg": 1.2, "nees_per_dof": 1.0, "nees_low": 0.8,
    "nees_high": 1.2,
}  # fmt: skip
SWEEP = {"schema": "optshape/simulation-evaluation/1", "target": "paper", "sensor": None, "draws": 10, "seed": 0,
         "cells": [CELL, {**CELL, "range_m": 40.0, "ok": 6, "ambiguous": 4}]}  # fmt: skip
NOTHING = {
    f"{prefix}{name}": None for prefix in ("reference_", "published_") for name in ("rmse_m", "e_t_m", "e_r_deg")
}
COMPARED = {
    "schema": "optshape/mocap-evaluation/1", "mean": MOCAP["mean"], "reference_mean": None, "left_out": [],
    "scans": [{"session": "s", "scan": f"{k}.pcd", "distance_m": 5.0, "n_points": 99,
               "rmse_m": 0.05 if k == 3 else 0.01, "e_t_m": 0.005, "e_r_deg": 0.5, **NOTHING} for k in range(6)],
}  # fmt: skip


class Checker(HTMLParser):
    VOID = frozenset({"meta", "img"})

    def __init__(self):
        super().__init__()
        self.open, self.text, self.sources = [], [], []

    def handle_starttag(self, tag, attrs):
        self.sources += [value for key, value in attrs if key in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(path):
    checker = Checker()
    checker.feed(path.read_text(encoding="utf-8"))
    assert checker.open == []
    assert all(source.startswith("data:image/") for source in checker.sources)
    return " ".join(checker.text)


@pytest.mark.parametrize(
    "document", [ESTIMATE, DOUBTFUL, MOCAP, MAP, CHOICE, SWEEP, COMPARED], ids=lambda document: document["schema"]
)
def test_a_report_is_one_sound_file_that_says_the_verdict(tmp_path, document):
    path = tmp_path / "report.html"
    verdict = write_report(path, document, command="optshape estimate 'a b.pcd' --target paper")
    text = read(path)
    assert verdict.sentence in text
    assert "optshape estimate 'a b.pcd' --target paper" in text
    assert all(advice in text for advice in verdict.advice)
    assert "http" not in re.sub(r"http-equiv", "", path.read_text())
    assert "@media print" in path.read_text()


def test_pictures_are_inside(tmp_path):
    picture = tmp_path / "fit.png"
    picture.write_bytes(b"\x89PNG...")
    write_report(tmp_path / "r.html", ESTIMATE, [picture])
    picture.unlink()
    assert "data:image/png;base64,iVBORy4uLg==" in (tmp_path / "r.html").read_text()


def test_a_good_result_is_good():
    assert verdict_of(ESTIMATE).line == (
        "Good: 2 of 2 scans have a pose to be relied on, at 5.0 to 9.0 m; "
        "standard deviations of up to 2.0 mm and 0.57 deg"
    )
    one = {**ESTIMATE, "scans": ESTIMATE["scans"][:1]}
    assert verdict_of(one).line.startswith("Good: 1 of 1 scan has a pose to be relied on, at 5.0 m; standard")
    assert verdict_of(MOCAP).line.startswith("Good: 6 scans agree with the markers to 4.7 mm and 0.60 deg")


def test_a_doubtful_one_says_what_to_do():
    verdict = verdict_of(DOUBTFUL)
    assert verdict.level == "Not usable"
    assert verdict.advice[0] == "look at whether the target is flat first: 1 scan is doubtful for it ('surface')"
    assert "fewer than 30 returns: nearer, or a larger target" in verdict.advice[1]
    few = {**MOCAP, "scans": MOCAP["scans"][:3]}
    assert verdict_of(few).level == "Usable with care"
    assert verdict_of({**MOCAP, "verdict": "not to be trusted"}).level == "Not usable"
    assert verdict_of(MAP).advice == ("1 landmark was seen in one scan only (A): drive past again",)


def test_another_target_is_told():
    """Of a scan that failed no flag is named: what is to be checked is the target."""
    T = pose_from_rpy([5.0, 0.1, 0.0], [0.1, 0.2, 0.1])
    scan = replace(simulate_target(load_target("triangle"), load_sensor("vlp32c"), T), name="a.pcd")
    estimate = estimate_pose(scan, load_target("square"))
    assert estimate.status == "failed"
    assert estimate.fit.flags
    verdict = verdict_of({"schema": "optshape/estimate/1", "scans": [estimate.to_dict()]})
    assert verdict.advice[0] == "check --target: the returns of 1 scan do not fit it"
    assert not any("doubtful" in advice for advice in verdict.advice)


def test_every_flag_has_what_to_look_at():
    source = (Path(fit.__file__)).read_text()
    assert set(re.findall(r'Flag\("([^"]+)"', source)) <= LOOK_AT.keys()


def test_an_evaluation_says_where_it_fails():
    assert verdict_of(SWEEP).line == (
        "Usable with care: 16 of 20 scans of 'paper' end ok; normalised errors squared are 1.00 per degree of freedom, "
        "1 where covariances are right; at 40 m, face, 6 of 10 are ok: a larger target, or a nearer place"
    )
    turned = {**SWEEP, "cells": [{**CELL, "worst_ok_e_r_deg": 170.0}]}
    assert verdict_of(turned).level == "Not usable"
    assert "more than 45 deg off at 20 m face" in verdict_of(turned).advice[0]
    assert verdict_of({**SWEEP, "cells": [{**CELL, "nees_per_dof": 2.0}]}).level == "Usable with care"
    assert verdict_of(COMPARED).advice == ("look at s/3.pcd first: 50 mm, 5.0 times the median, at 5.0 m",)
    assert verdict_of({**COMPARED, "mean": None, "scans": []}).level == "Not usable"


def test_captions_say_how_to_read_a_picture():
    assert caption_of("8m_angled_edges").startswith("8m_angled: which edge each end of a ring")
    assert caption_of("map").startswith("Landmarks, the way each faces")
    assert caption_of("000_0_board") == "000 0 board"


def test_columns_without_a_word_are_left_out(tmp_path):
    write_report(tmp_path / "r.html", ESTIMATE)
    assert "reason" not in read(tmp_path / "r.html")


def test_nothing_found_is_not_usable():
    empty = {
        "schema": "optshape/detect/1",
        "scans": [{"scan": "a", "targets": [], "rejected": [{"reason": "size: 2 m"}]}],
    }
    assert verdict_of(empty).line == (
        "Not usable: no target was found in 1 scan; nothing was found in 1 of 1 scans (mostly rejected: size)"
    )


def test_the_plan_shows_every_place():
    places = np.array([[4.0, 1.0, 0.0], [8.0, -2.0, 0.0], [3.0, 0.0, 0.0]])
    svg = plan_view(places)
    assert svg.count('r="4"') == 3
    assert ">LiDAR<" in svg


def test_other_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="'optshape/target/1': expected the result of"):
        write_report(tmp_path / "r.html", {"schema": "optshape/target/1"})
