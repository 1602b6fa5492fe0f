import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from optshape_graph import InputError, SensorModel
from optshape_graph.design.family import Family
from optshape_graph.design.judgement import SIX_ROTATIONS
from optshape_graph.design.polygons import centred, rotated, strictly_convex
from optshape_graph.design.problem import orientations
from optshape_graph.design.released import released_cost, sphere_grid
from optshape_graph.design.rings import SensorRings, UniformRings
from optshape_graph.design.sensitivity import cell_scores, edge_crossings, quadratic_forms, worst_motions
from tests.design.test_family import PUBLISHED
from tests.shared import SHARED, needs_shared

SQUARE = Family(4).nominal
SHAPES = np.concatenate([Family(4).polygons(list(PUBLISHED.values())), SQUARE[None]])


def random_convex(rng, count, sides=5):
    family, found = Family(sides), []
    while len(found) < count:
        values = [rng.uniform(0, 6.3), rng.normal(0, 0.5), np.exp(rng.normal(0, 0.3)), *rng.normal(0, 0.3, 2)]
        if family.depths(values).min() > 0.1:
            found.append(family.polygons(values)[0])
    return np.array(found)


def moved(polygon, motion, t):
    """The polygon moved by expm(t motion), by the closed form of SE(2)."""
    omega, u, v = motion
    angle = omega * t
    c, s = np.cos(angle), np.sin(angle)
    V = np.array([[np.sinc(angle / np.pi), -(1 - c) / angle], [(1 - c) / angle, np.sinc(angle / np.pi)]]) * t
    return polygon @ np.array([[c, s], [-s, c]]) + V @ [u, v]


def test_gradient_equals_finite_differences_in_1000_random_cases():
    rng = np.random.default_rng(0)
    worst, checked = 0.0, 0
    for polygon in random_convex(rng, 1100):
        low, high = polygon[:, 1].min(), polygon[:, 1].max()
        heights = np.array([[rng.uniform(low, high)]])
        motion = rng.normal(size=3)
        motion /= np.linalg.norm(motion)
        crossings = edge_crossings(polygon, heights)
        h = 1e-6
        ahead, behind = (edge_crossings(moved(polygon, motion, t), heights) for t in (h, -h))
        if not (np.array_equal(ahead.hit, crossings.hit) and np.array_equal(behind.hit, crossings.hit)):
            continue  # a vertex passes the ring: there is no derivative
        numeric = ((ahead.x - behind.x) / (2 * h))[crossings.hit]
        exact = crossings.motion(motion[None])[..., 0][crossings.hit]
        # Relative to the size of the derivative: edges nearly level move fast and curve.
        worst = max(worst, float(np.abs((numeric - exact) / np.maximum(1.0, np.abs(exact))).max()))
        checked += 1
    assert checked >= 1000
    assert worst <= 1e-6


def test_smallest_eigenvalue_is_the_minimum_over_the_sphere():
    forms = quadratic_forms(edge_crossings(SHAPES, UniformRings().heights(*heights_of(SHAPES)))).reshape(-1, 3, 3)
    smallest = np.linalg.eigvalsh(forms)[:, 0]
    grid = sphere_grid(361)
    for form, value in zip(forms, smallest, strict=True):
        energies = np.einsum("gi,ij,gj->g", grid, form, grid)
        assert energies.min() >= value - 1e-12
        # A grid of half a degree leaves at most (half a step's diagonal)^2 of the largest eigenvalue above it.
        assert energies.min() - value <= 1e-3 * max(1.0, np.linalg.eigvalsh(form)[-1])


def heights_of(polygons):
    return polygons[..., 1].min(axis=-1), polygons[..., 1].max(axis=-1)


def test_eigenvalue_equals_a_refined_grid_to_a_thousandth():
    """A dense grid about the worst motion: never below the eigenvalue, and equal to 1e-3 of it."""
    rng = np.random.default_rng(2)
    rings = UniformRings()
    for polygon in centred(random_convex(rng, 40, sides=4)):
        forms = quadratic_forms(edge_crossings(polygon, rings.heights(*heights_of(polygon))))
        for form, motion in zip(forms, worst_motions(polygon, rings), strict=True):
            value = np.linalg.eigvalsh(form)[0]
            around = motion + 1e-3 * sphere_grid(61)
            around /= np.linalg.norm(around, axis=1, keepdims=True)
            dense = np.concatenate([sphere_grid(61), around, motion[None]])
            energies = np.einsum("gi,ij,gj->g", dense, form, dense)
            assert energies.min() >= value - 1e-9 * np.trace(form)
            assert energies.min() <= value * (1 + 1e-3) + 1e-9 * np.trace(form)


def test_published_values():
    rings = UniformRings()
    costs = [released_cost(shape, SIX_ROTATIONS, rings) for shape in SHAPES]
    np.testing.assert_allclose(costs, [-19.99, -18.30, -2.54], rtol=5e-3)
    scores = cell_scores(rotated(SHAPES, SIX_ROTATIONS), rings).min(axis=(1, 2))
    np.testing.assert_allclose(scores, [0.0157, 0.0174, 0.0040], rtol=2e-2)


@needs_shared
def test_published_parameters_are_those_of_the_reference_file():
    import yaml

    document = yaml.safe_load((SHARED / "reference" / "targets.yaml").read_text())
    assert {key.split("_")[0]: tuple(value) for key, value in document["parameters"].items()} == PUBLISHED


def test_worst_over_all_orientations_of_known_shapes():
    every_degree = orientations(UniformRings(), np.pi / 180)
    scores = cell_scores(rotated(centred(SHAPES), every_degree), UniformRings()).min(axis=(1, 2))
    np.testing.assert_allclose(scores, [0.0122, 0.0129, 0.0040], rtol=5e-3)


def test_half_a_turn_of_orientations_is_enough():
    full = cell_scores(rotated(centred(SHAPES), np.radians(np.arange(360.0))), UniformRings())
    np.testing.assert_allclose(full[:, :180], full[:, 180:, ::-1], rtol=1e-7, atol=1e-9)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000))
def test_score_against_a_plain_loop(seed):
    polygon = centred(random_convex(np.random.default_rng(seed), 1, sides=5))[0]
    mine = cell_scores(polygon, UniformRings(3, 2))
    (low, high), width = (polygon[:, 1].min(), polygon[:, 1].max()), np.ptp(polygon[:, 0])
    for area in range(3):
        A, chords = np.zeros((3, 3)), 0.0
        for ring in (1, 2):
            y = low + (high - low) * (area + ring / 3) / 3
            ends = []
            for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
                if (a[1] - y) * (b[1] - y) < 0:
                    m = (b[0] - a[0]) / (b[1] - a[1])
                    x = a[0] + m * (y - a[1])
                    J = np.array([-y - m * x, 1.0, -m])
                    A += np.outer(J, J)
                    ends.append(x)
            chords += abs(ends[0] - ends[1])
        expected = width / (high - low) * np.linalg.eigvalsh(A)[0] + 1e-3 * chords
        # The smallest eigenvalue is good to the rounding of the largest.
        assert mine[area] == pytest.approx(expected, rel=1e-9, abs=1e-12 * np.trace(A))


def test_shapes_that_are_no_targets_score_nothing():
    bad = np.array(
        [
            [[0, 0], [1, 0], [0.2, 0.2], [0, 1]],  # not convex
            [[0, 0], [1, 1], [1, 0], [0, 1]],  # self-intersecting
            [[0, 0], [0, 0], [1, 0], [0, 1]],  # an edge of length zero
            [[0, 0], [1, 0], [2, 0], [1, 1]],  # a vertex that is none
            [[0, 0], [0, 1], [1, 1], [1, 0]],  # clockwise
        ],
        dtype=float,
    )
    assert not strictly_convex(bad).any()
    np.testing.assert_array_equal(cell_scores(bad, UniformRings()), 0.0)


def test_a_circle_moves_only_by_translation():
    """Rotation about the centre of a many-sided polygon moves its edge points next to nothing."""
    polygon = Family(720).nominal
    crossings = edge_crossings(polygon, UniformRings(1, 5).heights(*heights_of(polygon)))
    assert np.abs(crossings.motion(np.array([[1.0, 0.0, 0.0]]))).max() < 0.02
    assert cell_scores(polygon, UniformRings(1, 5), mu=0.0).max() < 1e-3


def test_rings_that_miss_the_shape_score_nothing():
    sensor = SensorModel(np.radians([-30.0, 30.0]))
    rings = SensorRings.of(sensor, 10.0, placements=1)
    np.testing.assert_array_equal(cell_scores(SQUARE, SensorRings(rings.plane_heights, rings.shifts)), 0.0)
    one_ring = SensorRings(np.array([0.1]), np.array([0.0]))
    # One ring leaves motions unseen: what remains is its chord.
    np.testing.assert_allclose(cell_scores(SQUARE, one_ring), 1e-3, atol=1e-12)


def test_sensor_rings_are_the_sensors():
    sensor = SensorModel(np.radians([-2.0, -1.0, 0.0, 1.0, 3.0]))
    rings = SensorRings.of(sensor, 10.0, height=0.0, placements=4, area=4.0)
    gap = 10 * np.tan(np.radians(1.0))
    np.testing.assert_allclose(rings.shifts, gap * np.arange(4) / 4)
    heights = rings.heights(np.float64(-1.0), np.float64(1.0))
    assert heights.shape == (5, 4)
    # Scores are at unit area: half of the lengths at 4 m2.
    np.testing.assert_allclose(heights[:, 0], 10 * np.tan(sensor.elevations) / 2)
    assert cell_scores(rotated(SHAPES, np.array([0.0, 0.3])), rings).shape == (3, 2, 4)


def test_rings_refuse_nonsense():
    with pytest.raises(InputError, match="0 areas of 4 rings"):
        UniformRings(0, 4)
    with pytest.raises(InputError, match="positive distance and area"):
        SensorRings.of(SensorModel(np.array([0.0, 0.1])), -1.0)
    with pytest.raises(InputError, match="two rings"):
        SensorRings.of(SensorModel(np.array([0.0])), 1.0)
