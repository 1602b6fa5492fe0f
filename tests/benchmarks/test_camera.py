"""The whole calibration of a real session against reading its images and finding the corners alone."""

from time import perf_counter

import pytest

from optshape_graph.calibration.camera.calibrate import calibrate
from optshape_graph.calibration.camera.session import read_views
from optshape_graph.calibration.images.reading import ImageTask, find_targets
from optshape_graph.io import load_session
from tests.shared import SHARED, needs_shared


@pytest.mark.benchmark
@needs_shared
def test_calibration_against_its_images():
    """Twenty views, full scans, cross-validation included: at most three times as long."""
    session = load_session(SHARED / "data/camera/session.yaml")
    (camera,), (target,) = session.cameras.values(), session.targets.values()
    start = perf_counter()
    find_targets([ImageTask(view.image, target, camera) for view in session.views])
    images = perf_counter() - start
    start = perf_counter()
    calibrate(read_views(session))
    whole = perf_counter() - start
    print(f"images {images:.1f} s, whole calibration {whole:.1f} s: {whole / images:.2f} times")
    assert whole < 3 * images
