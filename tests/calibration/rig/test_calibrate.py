"""A rig of two LiDARs and a camera, eight placements: small enough for every run; see `test_numbers` for statistics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optshape_graph import UnobservableError
from optshape_graph.calibration.rig import RigCalibration
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.rigs import SimulatedRig, placements, two_targets
from optshape_graph.io import load_target
from optshape_graph.io.sessions import About
from optshape_graph.se3 import exp, inverse, transform
from tests.calibration.rig.support import among, calibrated, errors, seen

LIDARS = {"front": "vlp16", "rear": "vlp32c"}

SMALL = 3 * np.sqrt(20 / 8)
"""A single rig of eight placements may be off by three times what thirty rigs of twenty are, root mean square."""

LL, LC = SMALL * np.array([2.5, 0.045]), SMALL * np.array([3.0, 0.05])
"""Translation, mm, and rotation, deg, in a sector: between LiDARs, and to a camera."""


@pytest.fixture(scope="module")
def rig():
    return SimulatedRig.drawn(np.random.default_rng(5), LIDARS, ("left",))


@pytest.fixture(scope="module")
def sightings(rig):
    rng = np.random.default_rng(6)
    return seen(rig, two_targets(), placements(8, rng, (-10.0, 90.0)), rng)


@pytest.fixture(scope="module")
def result(rig, sightings):
    return calibrated(rig, sightings)


def test_all_sensors_are_found(rig, result):
    found = errors(rig, result)
    assert (found["LL"][:, :2] < LL).all()
    assert (found["LC"][:, :2] < LC).all()
    assert np.mean([row[2] for rows in found.values() for row in rows]) < 3.0  # chi-square of 6, thrice: p < 1e-3
    assert result.trusted
    assert not result.contradicting


def test_both_directions_have_their_covariance(result):
    T, covariance = result.transform("front", "left")
    U, other = result.transform("left", "front")
    assert np.allclose(T @ U, np.eye(4), atol=1e-12)
    x = np.linalg.cholesky(covariance)[:, 2]
    y = np.linalg.inv(U) @ np.linalg.inv(T @ exp(x))  # inverse(T Exp(x)) = U Exp(y)
    assert np.allclose(y, np.linalg.inv(U) @ exp(np.zeros(6)) @ np.linalg.inv(T @ exp(x)))
    assert np.trace(other) > 0


def test_it_is_saved_and_loaded(result, tmp_path):
    result.save(tmp_path / "rig.json")
    assert RigCalibration.load(tmp_path / "rig.json") == result
    assert len(result.to_dataframe()) == 3
    assert "RigCalibration(front, rear, left" in repr(result)
    assert "<table>" in result._repr_html_()


def test_its_document_says_what_is_needed(result):
    document = result.to_dict()
    assert [(one["a"], one["b"]) for one in document["transforms"]] == [
        ("front", "rear"), ("front", "left"), ("rear", "left")
    ]  # fmt: skip
    one = document["transforms"][0]
    assert np.allclose(np.array(one["T_a_b"]) @ np.array(one["T_b_a"]), np.eye(4), atol=1e-9)
    assert one["frame"] == "rear"
    assert one["sd_m"]["x"] == pytest.approx(np.sqrt(one["covariance"][3][3]))
    assert one["time_offset_s"] == 0.0
    assert document["next_placement"]["expected_sigma_m"] < document["next_placement"]["sigma_m"]
    assert set(document["mean"]) == {"front", "rear", "left"}


def test_the_next_placement_brings_what_it_promises(rig, sightings, result):
    """The stated standard deviation, rings' errors and the lens being as unknown as they are."""
    advice, rng = result.next_placement, np.random.default_rng(7)
    T = rig.T_base_sensor[advice.sensor] @ advice.T_sensor_target
    new = seen(rig, {advice.target: two_targets()[advice.target]}, [[T]], rng)
    assert set(advice.seen_by) <= {s.sensor for s in new}
    again = calibrated(rig, [*sightings, *(replace(s, moment=99, placement=f"{s.target.name}@99") for s in new)])
    assert again.directions(*advice.pair)[0].sigma_m == pytest.approx(advice.expected_sigma_m, rel=0.15)
    assert advice.expected_sigma_m < 0.95 * advice.sigma_m


def test_ring_errors_are_estimated_beside(rig, result):
    """Errors of rings that hit the targets come out better than the sensor file knows them: sd 1 in its unit."""
    (sensor,) = [one for one in result.sensors if one.name == "rear"]
    for kind, truth in (
        ("range bias", rig.range_bias["rear"] / rig.lidars["rear"].ring_bias),
        ("elevation", rig.angle_errors["rear"].elevation / rig.lidars["rear"].elevation_error),
    ):
        known = [ring for ring in sensor.rings if ring.kind == kind and ring.sigma < 0.5]
        assert len(known) > 8
        off = np.array([ring.value - truth[ring.ring] for ring in known])
        assert np.sqrt(np.mean(np.square(off))) < 0.6
        assert 0.2 < np.mean(np.square(off / [ring.sigma for ring in known])) < 2.0


def test_left_out_placements_agree_with_the_covariances(result):
    squares = [one.chi_square for one in result.sightings if one.chi_square is not None]
    assert len(squares) > 15
    assert min(squares) > 0.0  # the prediction's covariance is that of a badly conditioned matrix
    assert 0.3 < np.mean(squares) / 6 < 1.7


def test_a_sighting_of_something_else_is_left_out(rig, sightings):
    number = next(k for k, s in enumerate(sightings) if s.sensor == "rear")
    scan = sightings[number].seen
    shifted = exp([0, 0, 0.05, 0.1, 0, 0.1])
    wrong = replace(
        scan,
        T_lidar_target=scan.T_lidar_target @ shifted,
        persistent=scan.persistent.substituted(shifted),
    )
    broken = [replace(s, seen=wrong) if k == number else s for k, s in enumerate(sightings)]
    result = calibrated(rig, broken)
    assert [one.file for one in result.contradicting] == [sightings[number].file]
    assert "disagrees with the others by 0.1" in result.contradicting[0].reason
    assert any("1 of " in warning and "contradict the others" in warning for warning in result.warnings)
    assert (errors(rig, result)["LL"][:, :2] < LL).all()


def test_sensors_that_nothing_connects_are_named(rig, sightings):
    apart = [s for s in sightings if (s.sensor == "left") == (s.moment > 3)]
    with pytest.raises(UnobservableError, match="nothing connects 'left' with 'front', 'rear'"):
        calibrated(rig, apart)


def test_one_placement_is_not_enough(rig, sightings):
    alone = [s for s in sightings if s.placement == sightings[0].placement]
    with pytest.raises(
        EstimationError, match=r"one placement only \(0_front_A\); a rig calibration needs two at least"
    ):
        calibrated(rig, alone)


def test_an_initial_transform_stands_in_for_what_connects(rig, sightings):
    """It is where the graph starts: what targets tell is taken all the same."""
    about = About("front", "left", rig.pair("front", "left") @ exp([0.02, 0, 0.02, 0.05, 0, 0]))
    result = calibrated(rig, sightings, initial=(about,))
    assert (errors(rig, result)["LC"][:, :2] < LC).all()


def test_lidars_that_never_see_a_target_at_once_are_joined_by_motion():
    """The platform turns among four targets; the front LiDAR is given what is ahead, the rear one what is behind."""
    rng = np.random.default_rng(9)
    rig = SimulatedRig.drawn(rng, LIDARS, ())
    targets = {name: load_target(shape) for name, shape in zip("ABCD", ("paper@1", "square@1") * 2, strict=True)}
    standing = dict(zip(targets, placements(1, rng, count=4)[0], strict=True))
    turns = Rotation.from_euler(
        "ZYX", np.column_stack([np.linspace(0, 330, 12), rng.uniform(-12, 12, (12, 2))]), degrees=True
    ).as_matrix()
    poses = [transform(R, [*rng.uniform(-0.6, 0.6, 2), 0.0]) for R in turns]
    sightings = among(rig, targets, standing, poses, rng, {"front": 1.0, "rear": -1.0})
    result = calibrated(rig, sightings, platform_moves=True)
    (row,) = errors(rig, result)["LL"]
    assert row[0] < 3 * 4.0
    assert row[1] < 3 * 0.06
    assert row[2] < 4.0


def test_a_target_that_moved_though_it_was_said_to_stay_is_found_and_named(rig):
    rng = np.random.default_rng(2)
    targets = {"A": load_target("paper@1")}
    placed = placements(6, rng, (20.0, 60.0), count=1)
    stays = [placed[0], placed[0], placed[0], [placed[0][0] @ exp([0, 0, 0, 0, 0.15, 0.1])], *placed[4:]]
    sightings = seen(rig, targets, stays, rng)
    said = [replace(s, placement="A") if s.moment < 4 else s for s in sightings]
    result = calibrated(rig, said)
    (warning,) = [text for text in result.warnings if "was said to stay" in text]
    assert "target 'A' was said to stay, but moved by 0.1" in warning
    assert "between 2_" in warning
    assert "and 3_" in warning
    assert errors(rig, result)["LL"][:, 2].max() < 4.0  # six placements of one target only


def test_transform_is_of_sensors_there_are(result):
    from optshape_graph import InputError

    with pytest.raises(InputError, match="no sensor 'top'; the rig has: front, rear, left"):
        result.transform("front", "top")
    assert np.allclose(inverse(result.transform("front", "rear")[0]), result.transform("rear", "front")[0])


def test_six_placements_are_solved_for_clouds_as_they_come_too():
    """Rings that are a centimetre off contradict each other there, which is no reason to doubt any of them."""
    rng = np.random.default_rng(5)
    drawn = SimulatedRig.drawn(rng, {"front": "vlp16", "rear": "vlp32c"}, ("left",))
    placed = placements(6, rng)
    result = calibrated(drawn, seen(drawn, two_targets(), placed, np.random.default_rng(0)))
    off = inverse(result.as_they_come("front", "rear")) @ drawn.pair("front", "rear")
    assert np.linalg.norm(off[:3, 3]) < 0.03
