from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given

from optshape_graph import InputError
from optshape_graph.factors import (
    AZIMUTH,
    EDGE_OFFSET,
    ELEVATION,
    RANGE_BIAS,
    BiasedMeasurement,
    SharedError,
    TemplateMeasurement,
    edge_rows,
    fuse_static,
    plane_rows,
    range_directions,
    ring_bias_columns,
)
from optshape_graph.factors.plane_returns import returns_on_plane
from optshape_graph.factors.static import seen_scale
from optshape_graph.io import load_sensor
from optshape_graph.scan import Scan
from optshape_graph.se3 import adjoint, inverse
from tests.factors.support import TARGET, edge_points, log, minimise, random_pose, seeds

N_RINGS = 6


def rows_of(points, edge, ring, T):
    A, r = edge_rows(points, TARGET.normals[edge], TARGET.offsets[edge])
    P, s = plane_rows(points)
    normals = np.vstack(
        [np.column_stack([np.zeros(len(edge)), TARGET.normals[edge]]), np.tile([1.0, 0.0, 0.0], (len(edge), 1))]
    )
    B = ring_bias_columns(np.tile(points, (2, 1)), normals, np.tile(ring, 2), N_RINGS, T)
    return np.vstack([A, P]), B, np.append(r, s)


def scan(rng, T, n=48, noise=0.01, bias=None):
    points, edge = edge_points(rng, np.linalg.inv(T), n, noise=noise)
    ring = np.arange(n) // len(TARGET) % N_RINGS
    if bias is not None:
        points = points + bias[ring, None] * range_directions(points)
    return points, edge, ring


@given(seeds)
def test_one_scan_is_whitened_by_the_full_covariance(seed):
    rng = np.random.default_rng(seed)
    T, sigma, sigma_bias = random_pose(rng), 0.01, rng.uniform(0, 0.03, N_RINGS)
    A, B, r = rows_of(*scan(rng, T), T)
    fused = fuse_static([BiasedMeasurement.from_rows(A / sigma, B / sigma, r / sigma, T)], sigma_bias)
    covariance = sigma**2 * np.eye(len(r)) + (B * sigma_bias**2) @ B.T
    W = np.linalg.inv(np.linalg.cholesky(covariance))
    whitened = TemplateMeasurement.from_rows(W @ A, W @ r, T)
    scale = np.abs(whitened.quadratic()).max()
    np.testing.assert_allclose(fused.quadratic(), whitened.quadratic(), atol=1e-9 * scale)
    assert fused.n_rows == whitened.n_rows


def test_columns_are_the_derivative_by_the_ring_biases():
    rng = np.random.default_rng(0)
    T = random_pose(rng)
    points, edge, ring = scan(rng, T)
    _, B, _ = rows_of(points, edge, ring, T)

    def residual(bias):
        moved = points + bias[ring, None] * range_directions(points)
        A, _, r = rows_of(moved, edge, ring, T)
        return A @ T[:3].T.ravel() + r

    numerical = np.stack([(residual(1e-4 * e) - residual(-1e-4 * e)) / 2e-4 for e in np.eye(N_RINGS)], axis=1)
    np.testing.assert_allclose(B, numerical, atol=1e-9)


def test_without_bias_scans_add_up_and_with_it_they_do_not():
    rng = np.random.default_rng(1)
    T, sigma, sigma_bias = random_pose(rng), 0.01, 0.02
    scans = [rows_of(*scan(rng, T), T) for _ in range(400)]
    measurements = [BiasedMeasurement.from_rows(A / sigma, B / sigma, r / sigma, T) for A, B, r in scans]
    plain = sum(
        (TemplateMeasurement.from_rows(A / sigma, r / sigma, T) for A, _, r in scans[1:]),
        TemplateMeasurement.from_rows(scans[0][0] / sigma, scans[0][2] / sigma, T),
    )
    unbiased = fuse_static(measurements, 0.0)
    np.testing.assert_allclose(unbiased.quadratic(), plain.quadratic(), atol=1e-9 * np.abs(plain.quadratic()).max())

    one, many = (np.linalg.inv(fuse_static(m, sigma_bias).information(T)) for m in (measurements[:1], measurements))
    naive = np.linalg.inv(plain.information(T))
    # The floor is the covariance that the biases alone cause when the noise has averaged away.
    ratios = np.linalg.eigvalsh(np.linalg.solve(naive, many))
    assert ratios.max() > 20.0
    assert (np.linalg.eigvalsh(one - many) > 0).all()


def test_consistent_when_every_scan_shares_the_biases():
    rng = np.random.default_rng(2)
    T, sigma, sigma_bias = random_pose(rng), 0.01, 0.03
    fused, naive = [], []
    for _ in range(200):
        bias = sigma_bias * rng.normal(size=N_RINGS)
        scans = [rows_of(*scan(rng, T, bias=bias), T) for _ in range(5)]
        group = [BiasedMeasurement.from_rows(A / sigma, B / sigma, r / sigma, T) for A, B, r in scans]
        apart = [m.marginal(sigma_bias) for m in group]
        for results, measurement in ((fused, fuse_static(group, sigma_bias)), (naive, sum(apart[1:], apart[0]))):
            best = minimise(measurement, T, 5)
            error = log(np.linalg.inv(T) @ best)
            results.append(error @ measurement.information(best) @ error)
    # The mean of 200 chi-square(6) has standard deviation sqrt(12 / 200) = 0.24: four of them.
    assert np.mean(fused) == pytest.approx(6.0, abs=1.0)
    assert np.mean(naive) > 8.0


def test_equal_errors_are_the_same():
    rng = np.random.default_rng(4)
    T = random_pose(rng)
    A, B, r = rows_of(*scan(rng, T), T)
    names = [SharedError(RANGE_BIAS, ring=i) for i in range(N_RINGS)]
    seen = [0, 2, 5]  # the second scan hit the target with these rings only, and lists them its own way
    rows = np.flatnonzero(B[:, [1, 3, 4]].any(axis=1) == 0)
    whole = BiasedMeasurement.from_rows(A, B, r, T, names) + BiasedMeasurement.from_rows(A[rows], B[rows], r[rows], T)
    apart = [
        BiasedMeasurement.from_rows(A, B, r, T),
        BiasedMeasurement.from_rows(A[rows], B[rows][:, seen[::-1]], r[rows], T, [names[i] for i in seen[::-1]]),
    ]
    sigma = np.linspace(0.01, 0.05, N_RINGS)
    np.testing.assert_allclose(
        fuse_static(apart, sigma).quadratic(), whole.marginal(sigma).quadratic(), atol=1e-9 * len(r) * 100
    )
    other = BiasedMeasurement.from_rows(A, B[:, :1], r, T, [SharedError("inset")])
    assert (apart[0] + other).shared == (*names, SharedError("inset"))


def test_errors_that_mean_different_things_do_not_add():
    """Bands of elevation of two scans overlap without being the same; a ring's bias is none of a band's."""
    rng = np.random.default_rng(5)
    T = random_pose(rng)
    A, B, r = rows_of(*scan(rng, T), T)

    def of(*errors):
        return BiasedMeasurement.from_rows(A, B[:, : len(errors)], r, T, errors)

    whole, low = SharedError(RANGE_BIAS), SharedError(RANGE_BIAS, band=(0.0, 0.1))
    other, ring = SharedError(RANGE_BIAS, band=(0.01, 0.11)), SharedError(RANGE_BIAS, ring=2)
    offset = SharedError(EDGE_OFFSET)
    assert (of(whole, low) + of(low, whole)).shared == (whole, low)
    assert (of(ring) + of(offset)).shared == (ring, offset)
    for mine, theirs in (((whole, low), (whole, other)), ((low,), (ring,)), ((whole,), (ring, offset))):
        with pytest.raises(InputError, match="mean different things do not add: range bias"):
            of(*mine) + of(*theirs)
    alone = of(whole, low).without([low]) + of(whole, other).without([other])
    assert alone.shared == (whole,)


def test_a_shared_error_says_what_it_is_in_words():
    assert str(SharedError(EDGE_OFFSET)) == "edge offset"
    assert str(SharedError(RANGE_BIAS, ring=7)) == "range bias of ring 7"
    assert str(SharedError(RANGE_BIAS, band=(0.0, np.radians(0.5)))) == "range bias between 0.000 and 0.500 deg"
    assert len({SharedError(RANGE_BIAS, ring=7), SharedError(RANGE_BIAS, ring=7), SharedError(RANGE_BIAS)}) == 2


def test_bad_input():
    rng = np.random.default_rng(3)
    points, edge, ring = scan(rng, np.eye(4))
    A, B, r = rows_of(points + 1.0, edge, ring, np.eye(4))
    measurement = BiasedMeasurement.from_rows(A, B, r, np.eye(4))
    with pytest.raises(InputError, match="no measurement"):
        fuse_static([], 0.01)
    with pytest.raises(InputError, match=r"19 columns; expected 13, and one for each of: inset, range bias of ring 3$"):
        BiasedMeasurement.from_rows(A, B, r, np.eye(4), [SharedError("inset"), SharedError(RANGE_BIAS, ring=3)])
    with pytest.raises(InputError, match=r"shared error 'ring 1'; expected a SharedError"):
        BiasedMeasurement.from_rows(A, B[:, :1], r, np.eye(4), ["ring 1"])
    with pytest.raises(InputError, match="finite numbers >= 0"):
        measurement.marginal(-0.1)
    with pytest.raises(InputError, match="rings run from 0 to 5; expected 0 to 4"):
        ring_bias_columns(points, np.ones_like(points), ring, 5, np.eye(4))
    with pytest.raises(InputError, match="12 columns"):
        BiasedMeasurement(np.eye(12), 1, np.eye(4), ())


@given(seeds)
def test_marginalised_in_two_steps_or_in_one_and_substituted(seed):
    rng = np.random.default_rng(seed)
    T, H, left, right = (random_pose(rng) for _ in range(4))
    A, B, r = rows_of(*scan(rng, T), T)
    biased = BiasedMeasurement.from_rows(A / 0.01, 0.02 * B / 0.01, r / 0.01, T)
    some = biased.without([SharedError(RANGE_BIAS, ring=ring) for ring in (1, 4, 99)])
    assert some.shared == tuple(SharedError(RANGE_BIAS, ring=ring) for ring in (0, 2, 3, 5))
    assert some.marginal(1.0).error(H) == pytest.approx(biased.marginal(1.0).error(H), rel=1e-8)
    moved = biased.substituted(left, right)
    assert moved.marginal(1.0).error(H) == pytest.approx(biased.marginal(1.0).error(left @ H @ right), rel=1e-8)
    np.testing.assert_allclose(left @ moved.T_target_lidar @ right, T, atol=1e-9)


@given(seeds)
def test_a_displacement_widens_once_however_many_scans(seed):
    """The minimum stays; the covariance of the pose grows by the same for one scan and for five."""
    rng = np.random.default_rng(seed)
    T, effect = random_pose(rng), np.zeros((6, 1))
    effect[3] = 0.02
    one = [BiasedMeasurement.from_rows(A / 0.01, np.zeros((len(r), 0)), r / 0.01, T, [])
           for A, _, r in (rows_of(*scan(rng, T), T) for _ in range(5))]  # fmt: skip
    for many in (one[:1], one):
        sharp = fuse_static(many, 1.0)
        minimum = minimise(sharp, T)
        wide = fuse_static([m.displaced([SharedError("shift")], effect, minimum) for m in many], 1.0)
        np.testing.assert_allclose(wide.gradient(minimum), 0.0, atol=1e-4 * np.sqrt(np.trace(sharp.information(T))))
        Ad = adjoint(inverse(minimum))
        grown = np.linalg.inv(wide.information(minimum)) - np.linalg.inv(sharp.information(minimum))
        np.testing.assert_allclose(grown, Ad @ effect @ effect.T @ Ad.T, rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize(("size", "seen"), [(1.0, 1.0), (2.0, 2.0), (3.0, 3.0)])
def test_errors_are_as_large_as_scans_show_them(size, seen):
    """Half a size either way in the median of 60 scenes; range biases are called elevations here."""
    rng, found = np.random.default_rng(7), []
    for _ in range(60):
        T = random_pose(rng)
        scans = [rows_of(*scan(rng, T, bias=0.0 * np.ones(N_RINGS)), T) for _ in range(10)]
        moved = size * rng.normal(size=N_RINGS)
        measurements = [
            BiasedMeasurement.from_rows(
                A / 0.01, 0.02 * B / 0.01, (r - 0.02 * B @ moved) / 0.01, T,
                [SharedError(ELEVATION, ring=ring) for ring in range(N_RINGS)],
            )
            for A, B, r in scans
        ]  # fmt: skip
        found.append(seen_scale(sum(measurements[1:], measurements[0]), ELEVATION, 1.0))
    assert np.median(found) == pytest.approx(seen, abs=0.5 * seen)


@pytest.mark.parametrize(
    ("trend", "of_ring", "error"),
    [
        ("range_trend_sd", "range_bias_sds", RANGE_BIAS),
        ("elevation_trend_sd", "elevation_sds", ELEVATION),
        ("azimuth_trend_sd", "azimuth_sds", AZIMUTH),
    ],
)
def test_a_trend_is_all_rings_off_by_their_elevations(trend, of_ring, error):
    """Its column is the sum of the rings', each as often as a trend of its size moves it, to rounding."""
    rng = np.random.default_rng(3)
    sensor = replace(load_sensor("vlp16"), **{trend: 0.02})
    ring = np.repeat(np.arange(16), 4)
    points = np.column_stack([np.full(64, 5.0), rng.normal(size=64), 5.0 * np.tan(sensor.elevations[ring])])
    normal = np.array([0.8, 0.36, 0.48])
    returns = returns_on_plane(Scan(points, ring=ring, sensor=sensor), normal, 4.0).with_angles(normal, ring, sensor)
    moved = np.zeros((64, len(returns.errors)))
    np.put_along_axis(moved, returns.which, returns.moved, axis=1)
    column = dict(zip(returns.errors, moved.T, strict=True))
    sds = getattr(sensor, of_ring)
    of_rings = sum(column[SharedError(error, ring=k)] * 0.02 * sensor.trend[k] / sds[k] for k in range(16))
    assert column[SharedError(f"trend of {error}")] == pytest.approx(of_rings, abs=1e-12)
