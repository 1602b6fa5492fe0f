"""Noise models."""

from __future__ import annotations

import gtsam

from optshape_graph._arrays import Floats


def gaussian(S: Floats, loss: gtsam.noiseModel.mEstimator.Base | None = None) -> gtsam.noiseModel.Base:
    """Return the noise of square root information S, which may be singular, with a robust loss if one is given."""
    noise = gtsam.noiseModel.Gaussian.SqrtInformation(S, False)
    return noise if loss is None else gtsam.noiseModel.Robust.Create(loss, noise)
