"""Rigs with one thing wrong that the views themselves show: stamps, lenses, targets that moved; it is named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optshape_graph.calibration.images.planar_pose import planar_poses
from optshape_graph.calibration.rig.sightings import Sighting, TargetInMarkers
from optshape_graph.calibration.rig.stamps import shifted_stamps
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rigs import SimulatedRig, placements, two_targets
from optshape_graph.io import load_target
from optshape_graph.se3 import apply, exp, inverse, transform
from tests.calibration.rig.support import among, calibrated, errors, seen

LIDARS = {"front": "vlp16", "rear": "vlp32c"}


@pytest.fixture(scope="module")
def rig():
    return SimulatedRig.drawn(np.random.default_rng(15), LIDARS, ("left",))


@pytest.fixture(scope="module")
def sightings(rig):
    """Of two LiDARs, a camera, and a body of motion capture."""
    rng = np.random.default_rng(16)
    placed, targets = placements(10, rng, (-10.0, 90.0)), two_targets()
    T_body_base = inverse(exp([0.1, -0.2, 0.4, 0.3, -0.1, 0.2]))
    found = seen(rig, targets, placed, rng)
    for k, (T_base_target, _) in enumerate(placed):
        target, T = replace(targets["A"], name="A"), T_body_base @ T_base_target
        points = apply(T, target.vertices) + rng.normal(0.0, 1e-3, (len(target), 3))
        markers = TargetInMarkers(points, np.arange(len(target)), 1e-3, T, 1e-6 * np.eye(6), 1e-8 * np.eye(6))
        found.append(Sighting("pod", target, k, f"A@{k}", markers, f"frame {k}", float(k)))
    return found


def shifted(sightings, sensor, moments, seconds=None):
    """One sensor's sightings, taken for those of other moments."""
    return [
        replace(
            s, moment=s.moment + moments, placement=f"{s.target.name}@{s.moment + moments}",
            time=None if seconds is None else s.time + seconds,
        ) if s.sensor == sensor else replace(s, time=None if seconds is None else s.time)
        for s in sightings
    ]  # fmt: skip


@pytest.mark.parametrize("sensor", ["front", "rear", "left", "pod"])
@pytest.mark.parametrize(("moments", "seconds", "said"), [
    (1, 1.0, "the stamps of '{}' are 1 s ahead of those of "), (1000, -12.25, "the stamps of '{}' are 12.25 s behind "),
    (-1, None, "the views of '{}' are 1 place behind those of "),
])  # fmt: skip
def test_a_sensor_whose_stamps_are_shifted_is_named(sightings, sensor, moments, seconds, said):
    assert said.format(sensor) in shifted_stamps(shifted(sightings, sensor, moments, seconds))


def test_stamps_that_are_right_are_not_named(sightings):
    assert shifted_stamps(sightings) == ""
    assert shifted_stamps([]) == ""


def test_a_shift_is_named_where_it_is_all_that_is_wrong(rig, sightings):
    wrong = [s for s in shifted(sightings, "rear", 1, 1.0) if s.sensor != "pod"]
    with pytest.raises(EstimationError, match="the stamps of 'rear' are 1 s ahead of those of 'front', 'left'"):
        calibrated(rig, wrong)


def test_a_shift_among_targets_that_stay_is_named(rig):
    """Two of three views agree as they are stamped: there is a result, which is not to be trusted."""
    rng = np.random.default_rng(18)
    pair = replace(rig, lidars={"front": rig.lidars["front"]})
    placed = [poses for poses in placements(5, rng, (0.0, 80.0)) for _ in range(3)]
    stay = [replace(s, placement=s.target.name) for s in seen(pair, two_targets(), placed, rng)]
    wrong = [replace(s, moment=s.moment + 1, time=s.time + 1) if s.sensor == "left" else s for s in stay]
    result = calibrated(pair, wrong)
    assert not result.trusted
    assert any("the stamps of 'left' are 1 s ahead of those of 'front'" in text for text in result.warnings)


@pytest.mark.parametrize(("off", "images", "said"), [
    (1.03, 100, "the images of 'left' contradict its lens as given"),
    (1.06, 4, "where the lens of 'left' is another than given"),
    (1.01, 4, "views fit far better where the lens of 'left' is another than given"),
])  # fmt: skip
def test_a_lens_that_is_off_is_not_to_be_trusted(rig, sightings, off, images, said):
    """Many images show it by themselves; few do by what other sensors see."""

    def with_lens(s):
        camera = s.seen.camera
        K = np.array(camera.K)
        K[[0, 1], [0, 1]] *= off
        camera = replace(camera, K=K)
        return replace(s, seen=replace(s.seen, camera=camera, poses=planar_poses(s.seen.points, camera)))

    alone = replace(rig, lidars={"front": rig.lidars["front"]})
    kept = [s for s in sightings if s.sensor == "front" or (s.sensor == "left" and s.moment < images)]
    result = calibrated(alone, [with_lens(s) if s.sensor == "left" else s for s in kept])
    assert not result.trusted
    assert any(said in text and "focal length by" in text for text in result.warnings)


def test_a_lens_that_few_images_tell_is_said_to_be_taken_as_given(rig, sightings):
    """Two images of one target agree with a lens that moves the camera by more than is stated; thirty don't."""
    alone = replace(rig, lidars={"front": rig.lidars["front"]})
    few = [
        s for s in sightings if s.sensor == "front" or (s.sensor == "left" and s.moment < 2 and s.target.name == "A")
    ]
    warnings = calibrated(alone, few).warnings
    assert any("'left' is there only if its lens is as given" in text for text in warnings)
    assert not any("lens" in text for text in calibrated(alone, sightings).warnings)


@pytest.fixture(scope="module")
def room():
    """Two LiDARs on a platform that turns among four targets: what they see before the third is moved, and after."""
    rng = np.random.default_rng(17)
    rig = SimulatedRig.drawn(rng, LIDARS, ())
    targets = {name: load_target(shape) for name, shape in zip("ABCD", ("square@1", "paper@1") * 2, strict=True)}
    standing = dict(zip(targets, placements(1, rng, count=4)[0], strict=True))
    ypr = np.column_stack([rng.uniform(-180, 180, 16), rng.uniform(-12, 12, (16, 2))])
    turns = Rotation.from_euler("ZYX", ypr, degrees=True).as_matrix()
    poses = [transform(R, [*rng.uniform(-0.7, 0.7, 2), 0.0]) for R in turns]
    moved = {**standing, "B": standing["B"] @ exp([0.0, 0.0, 0.0, 0.0, 0.12, 0.09])}
    return rig, *(
        among(rig, targets, where, poses, rng, {"front": 1.0, "rear": side})
        for where, side in ((standing, 1.0), (moved, 1.0), (standing, -1.0))
    )


def test_a_target_that_moved_while_the_platform_did_is_named(room):
    rig, before, after, _ = room
    result = calibrated(rig, [*(s for s in before if s.moment < 8), *(s for s in after if s.moment >= 8)], True)
    (said,) = [text for text in result.warnings if "was said to stay" in text]
    assert "target 'B' was said to stay, but moved by 0.1" in said
    assert errors(rig, result)["LL"][0, 2] < 4.0
    assert not any("was said to stay" in text for text in calibrated(rig, before, True).warnings)


def test_a_scan_that_is_read_wrong_while_the_platform_moves_is_left_out(room):
    rig, before, _, _ = room
    number = next(k for k, s in enumerate(before) if s.sensor == "rear" and s.target.name == "D" and s.moment > 6)
    scan, turned = before[number].seen, exp([0.5, 0.0, 1.2, 0.2, 0.3, 0.1])
    wrong = replace(
        scan, T_lidar_target=scan.T_lidar_target @ turned, persistent=scan.persistent.substituted(turned),
        uncorrected=scan.uncorrected.substituted(turned),
    )  # fmt: skip
    broken = [replace(s, seen=wrong) if k == number else s for k, s in enumerate(before)]
    result = calibrated(rig, broken, platform_moves=True)
    assert [one.file for one in result.contradicting] == [before[number].file]
    assert errors(rig, result)["LL"][0, 2] < 4.0


@pytest.mark.parametrize("overlapping", [True, False])
def test_shifted_stamps_are_named_while_the_platform_moves(room, overlapping):
    """LiDARs that never see a target at once are joined by their motion, and so are their stamps."""
    rig, before, _, apart = room
    views = before if overlapping else apart
    wrong = [replace(s, moment=s.moment + 1, time=s.time + 1) if s.sensor == "rear" else s for s in views]
    with pytest.raises(EstimationError, match="the stamps of 'rear' are 1 s ahead of those of 'front'"):
        calibrated(rig, wrong, platform_moves=True)
