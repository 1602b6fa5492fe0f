"""Groups of consecutive rows: what they sum to is what a loop over them does."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.groups import Groups, Layout

COUNTS = st.lists(st.integers(1, 9), min_size=1, max_size=12)


@given(COUNTS, st.integers(0, 2**32 - 1))
def test_sums_medians_and_products_are_those_of_each_group(counts: list[int], seed: int) -> None:
    groups, rng = Groups(np.array(counts)), np.random.default_rng(seed)
    a, b = rng.normal(size=(sum(counts), 3)), rng.normal(size=(sum(counts), 2))
    parts = np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    among = rng.uniform(size=sum(counts)) < 0.7
    np.testing.assert_allclose(groups.sum(a), [a[rows].sum(axis=0) for rows in parts], atol=1e-12)
    np.testing.assert_array_equal(groups.sum(among), [among[rows].sum() for rows in parts])
    np.testing.assert_allclose(groups.mean(a[:, 0]), [a[rows, 0].mean() for rows in parts], atol=1e-12)
    np.testing.assert_allclose(groups.median(a[:, 0]), [np.median(a[rows, 0]) for rows in parts])
    some = [np.median(a[rows][among[rows], 0]) if among[rows].any() else np.inf for rows in parts]
    np.testing.assert_allclose(groups.median(a[:, 0], among), some)
    np.testing.assert_allclose(groups.products(a, b), [a[rows].T @ b[rows] for rows in parts], atol=1e-12)
    np.testing.assert_array_equal(groups.each(np.arange(len(counts))), groups.of_row)
    np.testing.assert_array_equal(np.column_stack([groups.first, groups.last]), [(rows[0], rows[-1]) for rows in parts])


@given(st.lists(COUNTS, min_size=1, max_size=5))
def test_layouts_side_by_side_come_apart_again(scans: list[list[int]]) -> None:
    layouts = [Layout(Groups(np.array(counts)), Groups(np.array([len(counts)]))) for counts in scans]
    together = Layout.side_by_side(layouts)
    assert together.scans.counts.tolist() == [sum(counts) for counts in scans]
    assert [together.of_scan(k) for k in range(len(scans))] == layouts
