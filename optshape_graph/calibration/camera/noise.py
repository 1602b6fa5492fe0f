"""The noise of pixels, from how well the images' own poses fit them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optshape_graph.calibration.camera.sightings import View
from optshape_graph.calibration.images.projection import project
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.se3 import apply

PRIOR_RESIDUALS = 20.0
"""Residuals' worth of trust in the noise that the pixels are stated with."""


def with_estimated_pixel_noise(views: Sequence[View]) -> list[View]:
    """Scale the pixels' noise, one factor for each camera, to what is left when every image is fitted by itself."""
    factors = noise_factors([view.image for view in views if view.image is not None])
    return [
        view if view.image is None else replace(view, image=scaled(view.image, factors[view.image.camera.name]))
        for view in views
    ]


def noise_factors(images: Sequence[TargetInImage]) -> dict[str, float]:
    """Return by camera what the standard deviations of pixels are to be multiplied by."""
    sums: dict[str, float] = {}
    freedom: dict[str, float] = {}
    for image in images:
        T, points = image.poses[0].T_camera_target, image.points
        errors = project(image.camera, apply(T, points.points)) - points.pixels
        whitened = np.einsum("nij,nj->ni", points.sqrt_information, errors)
        # A point of an edge measures across it only: one residual, not two.
        strength = np.linalg.svd(points.sqrt_information, compute_uv=False)
        name = image.camera.name
        sums[name] = sums.get(name, PRIOR_RESIDUALS) + float((whitened**2).sum())
        freedom[name] = freedom.get(name, PRIOR_RESIDUALS) + float((strength > 0.01 * strength.max()).sum() - 6)
    return {name: float(np.sqrt(sums[name] / freedom[name])) for name in sums}


def scaled(image: TargetInImage, factor: float) -> TargetInImage:
    """Return an image whose pixels have so many times the standard deviation."""
    poses = tuple(replace(pose, information=pose.information / factor**2) for pose in image.poses)
    return replace(image, points=image.points.scaled_noise(factor), poses=poses)
