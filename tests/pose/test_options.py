"""Each option does what it says: its default passes, and a value that is wrong by much is seen."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from optshape_graph import EstimationError, InputError, Scan
from optshape_graph.edges import extract_edge_points
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import PoseOptions, certify, estimate_pose
from optshape_graph.pose.sampling.firings import Firings
from optshape_graph.se3 import inverse
from optshape_graph.simulation import IDEAL, pose_from_rpy, simulate_target
from tests.pose.clouds import errors, simulated
from tests.pose.rosettes import rosette

PAPER = load_target("paper")
EXACT = replace(
    load_sensor("vlp32c"), range_noise=0.0, ring_bias=0.0, beam_divergence=0.0, beam_aperture=0.0,
    elevation_error=0.0, azimuth_error=0.0,
)  # fmt: skip


def normalised(scan: Scan, T: np.ndarray, options: PoseOptions) -> np.ndarray:
    """Errors of a pose in standard deviations (6,), rotation first."""
    estimate = estimate_pose(scan, PAPER, options=options)
    xi = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(estimate.T_lidar_target) @ T))
    return np.asarray(xi / np.sqrt(np.diag(estimate.covariance)))


@pytest.mark.slow
@pytest.mark.parametrize(("flatness", "low", "high"), [(1e-3, 0.6, 1.5), (3e-3, 0.0, 0.4), (3e-4, 0.6, 1.5)])
def test_flatness(flatness: float, low: float, high: float) -> None:
    """The place and tilt of a board that is rough by 1 mm, seen by a sensor without noise: mean square of 30 scans.

    The mean of 90 squares has a standard deviation of 0.15. A roughness stated too small is seen in the returns.
    """
    squared = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        T = pose_from_rpy([4.0, *rng.uniform(-0.1, 0.1, 2)], rng.normal(0.0, 0.1, 3))
        scan = simulate_target(PAPER, EXACT, T, noise=IDEAL)
        rough = scan.points * (1 + rng.normal(0.0, 1e-3, (len(scan), 1)) / (scan.points @ T[:3, 0])[:, None])
        squared.append(normalised(replace(scan, points=rough), T, PoseOptions(flatness=flatness))[1:4] ** 2)
    assert low < np.mean(squared) < high


def with_lost_ends(seed: int, returns: int) -> tuple[Scan, np.ndarray]:
    """A scan of an exact sensor that lost so many returns at an end of every fifth ring; and the true pose."""
    rng = np.random.default_rng(seed)
    T = pose_from_rpy([5.0, *rng.uniform(-0.1, 0.1, 2)], rng.normal(0.0, 0.2, 3))
    scan = simulate_target(PAPER, replace(EXACT, range_noise=1e-3), T, noise=IDEAL)
    assert scan.ring is not None
    azimuth, lost = np.arctan2(scan.points[:, 1], scan.points[:, 0]), np.zeros(len(scan), dtype=bool)
    for ring in np.unique(scan.ring)[seed % 5 :: 5]:
        rows = np.flatnonzero(scan.ring == ring)
        lost[rows[np.argsort(azimuth[rows])[:returns]]] = True
    return scan.select(~lost), T


@pytest.mark.parametrize(("lost_ends", "consistent"), [(0.1, True), (1e-100, False)])
def test_lost_ends(lost_ends: float, consistent: bool) -> None:
    """Mean square of the errors in the plane where an end in ten lost two returns, which is not to be unthinkable."""
    options = PoseOptions(lost_ends=lost_ends)
    squared = [normalised(*with_lost_ends(seed, 2), options)[[0, 4, 5]] ** 2 for seed in range(20)]
    assert (np.mean(squared) < 2.5) == consistent


@pytest.mark.parametrize(("last", "consistent"), [(3.0, True), (1.2, False)])
def test_lost_span(last: float, consistent: bool) -> None:
    """The boundary is up to three steps beyond an end that lost two returns."""
    options = PoseOptions(lost_span=(-1.0, last))
    squared = [normalised(*with_lost_ends(seed, 2), options)[[0, 4, 5]] ** 2 for seed in range(20)]
    assert (np.mean(squared) < 2.5) == consistent


def test_lost_ends_of_rays() -> None:
    """What it costs a pose that a ring ends a step too early: the logarithm of the densities' ratio."""
    T = pose_from_rpy([20.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    scan = simulate_target(PAPER, EXACT, T, noise=IDEAL)
    corners = (PAPER.vertices @ T[:3, :3].T + T[:3, 3])[None]
    for share in (0.02, 0.2):
        options = PoseOptions(lost_ends_of_rays=share)
        exact = Firings.of(
            scan, extract_edge_points(scan), options.flatness, options.lost_ends_of_rays, options.lost_span
        )
        lost = replace(exact, left=exact.left - np.eye(len(exact.left))[0])
        price = exact.log_likelihood(corners)[0] - lost.log_likelihood(corners)[0]
        assert price == pytest.approx(np.log((1 - share + share / 4) / (share / 4)), abs=0.01)


def test_strays() -> None:
    """A return in a thousand is off the target by a metre: the pose stays, and without strays there is none."""
    scan, T = rosette(PAPER, 8.0, 8000, 2)
    off = T[:3, 3] + T[:3, 1:3] @ np.array([1.5, 0.1])
    dirty = Scan(np.vstack([scan.points, off]))
    assert errors(estimate_pose(dirty, PAPER), T)[0] < errors(estimate_pose(scan, PAPER), T)[0] + 0.005
    with pytest.raises(EstimationError, match="not this target"):
        estimate_pose(dirty, PAPER, options=PoseOptions(strays=1e-9))


def test_min_explained() -> None:
    """A triangle is no quadrilateral: too few of its ring ends are explained."""
    scan, _ = simulated(6.0, (5, 0, 0), 1, "triangle")
    assert "not this target" in estimate_pose(scan, PAPER).reason
    assert "not this target" not in estimate_pose(scan, PAPER, options=PoseOptions(min_explained=0.01)).reason


def test_max_outside() -> None:
    """One return in twenty is off the target, and taken for a stray: then it is for the outline to say no."""
    scan, T = rosette(PAPER, 8.0, 4000, 2)
    count = len(scan) // 20
    off = T[:3, 3] + T[:3, 1:3] @ np.array([1.5, 0.1]) + np.linspace(0, 0.3, count)[:, None] * T[:3, 2]
    dirty = Scan(np.vstack([scan.points, off]))
    assert "outside the outline" in estimate_pose(dirty, PAPER, options=PoseOptions(strays=0.06)).reason
    loose = estimate_pose(dirty, PAPER, options=PoseOptions(strays=0.06, max_outside=0.1))
    assert "outside the outline" not in loose.reason


def test_ambiguity_margin() -> None:
    """The status turns where the margin does; by default at 150 to 1."""
    assert np.exp(PoseOptions().ambiguity_margin) == pytest.approx(150, abs=5)
    estimates = (estimate_pose(simulated(25.0, seed=seed)[0], PAPER) for seed in range(20))
    margin = next(e.ambiguity.margin for e in estimates if e.status == "ok" and np.isfinite(e.ambiguity.margin))
    scan = next(s for s in (simulated(25.0, seed=k)[0] for k in range(20)) if _margin(s) == margin)
    assert estimate_pose(scan, PAPER, options=PoseOptions(ambiguity_margin=margin - 0.1)).status == "ok"
    assert estimate_pose(scan, PAPER, options=PoseOptions(ambiguity_margin=margin + 0.1)).status == "ambiguous"


def _margin(scan: Scan, **changed: float) -> float:
    return estimate_pose(scan, PAPER, options=PoseOptions(**changed)).ambiguity.margin


def test_unobservable_sd() -> None:
    """An upright square's height is known to centimetres: enough by default, and not where millimetres are asked."""
    target = load_target("square")
    scan = simulate_target(target, load_sensor("vlp32c"), pose_from_rpy([6.0, 0.0, 0.2], [0.0, 0.0, 0.0]))
    assert estimate_pose(scan, target).status == "ok"
    strict = estimate_pose(scan, target, options=PoseOptions(unobservable_sd=5e-3))
    assert strict.status == "failed"
    assert "translation along z" in strict.reason


def test_certified_gap() -> None:
    """By default a pose a millimetre off is not certified; it is for who does not mind a metre."""
    scan, _ = simulated(6.0, seed=7)
    estimate = estimate_pose(scan, PAPER)
    assert estimate.certificate.certified
    weight = float((1 / estimate.edge_sigma**2).sum())
    for metres, limits in ((1e-3, {1e-4: False, 1.0: True}), (1e-5, {1e-8: False, 1e-4: True})):
        wrong = estimate.T_target_lidar @ gtsam.Pose3.Expmap(np.array([0, 0, 0, 0, metres, 0.0])).matrix()
        for limit, certified in limits.items():
            assert certify(estimate.measurement, wrong, weight, largest_gap=limit).certified == certified


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"flatness": 0.0}, "flatness is 0.0; expected a positive number"),
        ({"strays": float("nan")}, "strays is nan; expected a positive number"),
        ({"lost_span": (3.0, -1.0)}, r"lost_span is \(3.0, -1.0\); expected two numbers, the smaller first"),
    ],
)
def test_bad_options_are_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        PoseOptions(**values)


def test_methods_and_backends_that_do_not_exist_are_refused() -> None:
    scan, _ = simulated(6.0, seed=5)
    with pytest.raises(InputError, match="method is 'best'; expected one of 'global', 'paper'"):
        estimate_pose(scan, PAPER, method="best")
    with pytest.raises(InputError, match="backend is 'mosek'; expected one of 'closed-form', 'clarabel', 'cvxpy'"):
        estimate_pose(scan, PAPER, backend="mosek")
    with pytest.raises(InputError, match="backend is 'mosek'"):
        certify(estimate_pose(scan, PAPER).measurement, np.eye(4), 1.0, "mosek")


def test_largest_sds() -> None:
    """What is less certain than asked is not ok, and its reason says which direction, how far, and from what."""
    scan, _ = simulated(12.0, (10, 20, 0), 3)
    estimate = estimate_pose(scan, PAPER)
    assert estimate.status == "ok"
    turn, shift = (np.sqrt(np.linalg.eigvalsh(estimate.covariance[k : k + 3, k : k + 3])[-1]) for k in (0, 3))
    for sd, options in (
        (turn, PoseOptions(largest_turn_sd=0.9 * turn)),
        (shift, PoseOptions(largest_shift_sd=0.9 * shift / PAPER.circumradius)),
    ):
        strict = estimate_pose(scan, PAPER, options=options)
        assert strict.status == "ambiguous"
        assert strict.reason.startswith("too uncertain: ")
        assert f"{estimate.edge_points.n_rings} rings" in strict.reason
        assert sd > 0
