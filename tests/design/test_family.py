import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from optshape_graph import InputError
from optshape_graph.design.family import Family
from optshape_graph.design.polygons import areas, strictly_convex

PUBLISHED = {
    "paper": (2.9656, 0.0240, 0.7546, 0.2946, 0.3483),
    "built": (1.9685, 0.0255, 0.7553, 0.3068, 0.3663),
}

parameters = st.tuples(
    st.floats(-3.1, 3.1), st.floats(-2, 2), st.floats(0.4, 2.5), st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)
)


@settings(deadline=None)
@given(st.integers(3, 9), parameters)
def test_images_are_convex_and_of_unit_area(sides, values):
    family = Family(sides)
    if family.depths(values).min() < 0.05:
        return
    image = family.polygons(values)
    assert image.shape == (1, sides, 2)
    np.testing.assert_allclose(areas(image), 1.0, rtol=1e-12)
    assert strictly_convex(image).all()


@settings(deadline=None)
@given(st.integers(4, 7), parameters, st.floats(0.2, 5.0), st.floats(-3, 3))
def test_parameters_invert_polygons_up_to_translation_and_scale(sides, values, scale, shift):
    family = Family(sides)
    if family.depths(values).min() < 0.1:
        return
    found = family.parameters(scale * family.polygons(values)[0] + [shift, -shift])
    # Linear solves of a few digits' condition.
    np.testing.assert_allclose(found, values, atol=1e-7)


def test_a_triangle_is_an_affine_image():
    polygon = np.array([[0.0, 0.0], [2.0, 0.3], [0.4, 1.1]])
    found = Family(3).parameters(polygon)
    np.testing.assert_array_equal(found[3:], 0.0)
    image = Family(3).polygons(found)[0]
    np.testing.assert_allclose(image - image.mean(0), (polygon - polygon.mean(0)) / np.sqrt(areas(polygon)), atol=1e-12)


def test_any_convex_quadrilateral_is_in_the_family():
    rng = np.random.default_rng(3)
    for _ in range(200):
        polygon = rng.normal(size=(4, 2))
        if not strictly_convex(polygon):
            continue
        image = Family(4).polygons(Family(4).parameters(polygon))[0]
        expected = polygon / np.sqrt(areas(polygon))
        np.testing.assert_allclose(image - image.mean(0), expected - expected.mean(0), atol=1e-6)


def test_centre_maps_to_the_crossing_of_the_diagonals():
    for values in PUBLISHED.values():
        a, b, c, d = Family(4).polygons(values)[0]
        assert abs(a[0] * c[1] - a[1] * c[0]) < 1e-12
        assert abs(b[0] * d[1] - b[1] * d[0]) < 1e-12


@pytest.mark.parametrize(
    ("polygon", "why"),
    [
        ([[0, 0], [1, 0], [0.2, 0.2], [0, 1]], "not convex"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "self-intersecting"),
        ([[0, 0], [0, 0], [1, 0], [0, 1]], "an edge of length zero"),
        ([[0, 0], [0, 1], [1, 1], [1, 0]], "clockwise"),
        ([[0, 0], [1, 0], [2, 0], [3, 0]], "on a line"),
    ],
)
def test_shapes_outside_the_family_are_refused(polygon, why):
    with pytest.raises(InputError, match="no convex projective image"):
        Family(4).parameters(np.array(polygon, dtype=float))


def test_a_pentagon_that_is_no_projective_image_of_a_regular_one_is_refused():
    polygon = Family(5).nominal.copy()
    polygon[0] *= 1.2
    with pytest.raises(InputError, match="regular 5-gon"):
        Family(5).parameters(polygon)


def test_parameters_out_of_bounds_are_refused():
    with pytest.raises(InputError, match=r"not convex; found -0\.5"):
        Family(4).polygons([0.0, 0.0, 1.0, 1.8, 1.2])
    with pytest.raises(InputError, match="lambda is positive; found -1"):
        Family(4).polygons([0.0, 0.0, -1.0, 0.0, 0.0])
    with pytest.raises(InputError, match="found 4 numbers"):
        Family(4).polygons([0.0, 0.0, 1.0, 0.0])
    with pytest.raises(InputError, match="at least 3 sides; found 2"):
        Family(2)
    with pytest.raises(InputError, match="expected 4 vertices"):
        Family(4).parameters(np.zeros((5, 2)))
