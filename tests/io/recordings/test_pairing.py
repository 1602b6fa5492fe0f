import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.io.recordings.stream import nearest, pair, spaced

STAMPS = st.lists(st.integers(0, 500), unique=True, max_size=30).map(lambda s: np.sort(np.array(s, float)) / 100)


@given(STAMPS, STAMPS)
def test_nearest_is_nearest(stamps, others):
    if len(others):
        found = others[nearest(stamps, others)]
        assert np.allclose(
            np.abs(found - stamps), np.abs(others - stamps[:, None]).min(axis=1, initial=np.inf), atol=1e-12
        )


@given(STAMPS, STAMPS, st.sampled_from([0.01, 0.05, 1.0]))
def test_pairs_are_one_to_one_and_within_tolerance(stamps, others, tolerance):
    paired = pair(stamps, others, tolerance)
    chosen = paired[paired >= 0]
    assert len(set(chosen.tolist())) == len(chosen)
    assert (np.abs(others[chosen] - stamps[paired >= 0]) <= tolerance).all()


def test_a_slower_camera_pairs_with_the_scans_nearest_to_its_images():
    scans, images = np.arange(0, 1, 0.1), np.array([0.02, 0.31, 0.59])
    assert pair(scans, images, 0.05).tolist() == [0, -1, -1, 1, -1, -1, 2, -1, -1, -1]


def test_spacing_keeps_every_scan_of_the_nominal_interval():
    stamps = 1.7e9 + np.arange(100) * 0.1
    assert spaced(stamps, 0.5).sum() == 20
    assert spaced(stamps, 0.0).all()
