"""A camera calibration, made once."""

import numpy as np
import pytest

from optshape_graph.calibration.camera import CameraCalibration
from optshape_graph.calibration.camera.calibrate import calibrate
from tests.calibration.camera.support import PINHOLE, synthetic_views


@pytest.fixture(scope="session")
def camera_calibration() -> CameraCalibration:
    from dataclasses import replace

    views = synthetic_views(6, np.random.default_rng(0), replace(PINHOLE, name="front"))
    return calibrate(views)
