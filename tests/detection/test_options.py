"""Every setting does what it says: moved to where it is wrong, a scene that the default handles comes out otherwise."""

from dataclasses import fields, replace

import numpy as np
import pytest

from optshape_graph import Scan
from optshape_graph.detection import DetectionOptions, Detections, detect_targets
from optshape_graph.detection.results import Evidence
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.pose import PoseOptions
from optshape_graph.simulation import Box
from tests.detection.scenes import BOARD, pose, scan_of
from tests.shared import SHARED

VLP32C, VLP16 = load_sensor("vlp32c"), load_sensor("vlp16")
PAPER, SQUARE = load_target("paper@1"), load_target("square@1")
T = pose(6, 0, 0.1, 20, 10, 15)
DEFAULTS = DetectionOptions()


def free() -> tuple[Scan, list]:
    return scan_of(VLP32C, [(PAPER, T)], seed=1).scan, [PAPER]


def slanted() -> tuple[Scan, list]:
    return scan_of(VLP32C, [(PAPER, pose(5, 0, 0.1, 0, 0, 55))], seed=1).scan, [PAPER]


def with_pole() -> tuple[Scan, list]:
    at = pose(8, 0.2, 0, 0, 0, -5)
    pole = Box(np.array([0.05, 0.05, 1.8]), pose(*(at[:3, 3] + 0.05 * at[:3, 0] - [0, 0, 0.9])))
    return scan_of(VLP32C, [(SQUARE, at)], pole, seed=2).scan, [SQUARE]


def with_arm() -> tuple[Scan, list]:
    at = pose(2.5, 0, 0.1, 20, 10, 15)
    return scan_of(VLP16, [(BOARD, at)], Box(np.array([0.04, 0.6, 0.08]), at @ pose(0, 0.55, 0))).scan, [BOARD]


def before_a_wall() -> tuple[Scan, list]:
    return scan_of(VLP32C, [(PAPER, pose(6, 0, 0.1, 15, 0, 0))], Box(np.array([0.2, 8, 5]), pose(6.3, 0, 0.5))).scan, [
        PAPER
    ]


def behind_a_post() -> tuple[Scan, list]:
    post = Box(np.array([0.05, 0.05, 3.0]), pose(5.0, -0.3, 0.0))
    return scan_of(VLP32C, [(PAPER, T)], post).scan, [PAPER]


def beyond_the_lowest_ring() -> tuple[Scan, list]:
    return scan_of(VLP16, [(SQUARE, pose(2.2, 0, -0.35, 45, 0, 10))]).scan, [SQUARE]


def among_others() -> tuple[Scan, list]:
    return free()[0], [PAPER, SQUARE, load_target("built@1")]


def in_the_hands() -> tuple[Scan, list]:
    """A recorded board that blooms, held before a body."""
    if not SHARED.is_dir():
        pytest.skip("the real recordings are not beside the checkout (../shared is absent)")
    folder = SHARED / "data" / "handheld"
    scan = sorted(folder.glob("scan*.pcd"))[1]
    return read_scan(scan, load_sensor(folder / "os1-gen1.sensor.yaml")), [load_target(folder / "board.yaml")]


WRONG = [
    ("longest_gap", 0.5, free), ("steepest", np.radians(5.0), slanted), ("jump_sigmas", 0.3, free),
    ("fewest_returns", 60, free), ("rings_apart", 0, free),
    ("patch_sigmas", 0.1, free), ("band_sigmas", 0.2, free), ("warp", 1e-6, free), ("fewest_rings", 40, free),
    ("size_seen", 1.3, free), ("size_excess", -0.4, free), ("thickest_limb", 3.0, with_arm),
    ("limb_slack", -20.0, with_arm), ("rim", 0.01, free), ("side_strip", 2.0, before_a_wall),
    ("hung_before", 2.0, before_a_wall),
    ("pierced_share", 0.1, with_pole), ("first_look", 1.1, free),
    ("least_evidence", Evidence(*[2.0] * 10), free), ("sure_evidence", Evidence(*[2.0] * 10), free),
    ("pose", PoseOptions(ambiguity_margin=1e9), free), ("size_seen_hidden", 1.3, behind_a_post),
    ("size_seen_cut", 1.3, beyond_the_lowest_ring), ("first_look_odds", -1e3, among_others),
    ("tilt_window", 1e-4, in_the_hands), ("grazing", 0.1, in_the_hands), ("pierced_rays", 1000, in_the_hands),
    ("rounds", 0, in_the_hands),
]  # fmt: skip


def outcome(detections: Detections) -> list:
    found = [(one.target.name, one.status, len(one.indices), one.evidence) for one in detections.found]
    return [found, [(one.reason, one.n_returns) for one in detections.rejected]]


@pytest.mark.parametrize(("name", "value", "scene"), WRONG, ids=[name for name, *_ in WRONG])
def test_a_wrong_value_is_seen(name: str, value: object, scene) -> None:
    scan, targets = scene()
    wrong = outcome(detect_targets(scan, targets, replace(DEFAULTS, **{name: value})))
    assert wrong != outcome(detect_targets(scan, targets, DEFAULTS))


def test_every_setting_is_tried() -> None:
    assert {field.name for field in fields(DEFAULTS)} == {name for name, *_ in WRONG}
