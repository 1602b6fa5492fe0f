"""What the sensor's errors do to the residuals of a target: plane rows, edge rows, and what they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.sensor import SensorModel

FLATNESS = 1e-3
"""Standard deviation, metres, of what no sensor file states: how flat and how true to drawing a target is."""

LOST_RETURNS = 0.1
"""Share of ring ends whose return is not within a step of the edge: lost at the edge, or mixed with the background."""

LOST_SPAN = (-1.0, 3.0)
"""Where those lie, in azimuth steps inside the edge."""


@dataclass(frozen=True)
class EdgeNoise:
    """How ring ends scatter about the edge beside the quantisation along the ring.

    A return near an edge comes from part of the beam. Which part decides is a matter of reflectance and threshold,
    so the edge seems to lie further out or in, across the edge: by something common to a scan, and by something
    of each point's own. Both are uniform over less than the beam, so phi / sqrt 12 covers either.

    Attributes:
        common: standard deviation of the offset that all edge points of a scan share, rad.
        own: standard deviation of each edge point's offset, rad.
        floor: standard deviation across the edge at any range, metres.
    """

    common: float
    own: float
    floor: float

    @classmethod
    def of(cls, sensor: SensorModel | None) -> EdgeNoise:
        """Derive it from the beam's divergence and the range noise; an unknown sensor has a beam of 3 mrad."""
        divergence = sensor.beam_divergence if sensor else 3e-3
        range_noise = sensor.range_noise if sensor else 0.01
        return cls(
            common=divergence / np.sqrt(12),
            own=divergence / np.sqrt(12),
            floor=float(np.hypot(FLATNESS, 0.5 * range_noise)),
        )


@dataclass(frozen=True, eq=False)
class PlaneNoise:
    """Whitened rows of every return against the target's plane, and the ring biases they share.

    Attributes:
        points: (N, 3) returns, LiDAR frame, metres.
        sigma: (N,) standard deviation of each return's distance from the plane, metres.
        bias: (N, R) how far a unit of each ring's bias moves each return off the plane, in units of `sigma`.
    """

    points: Floats
    sigma: Floats
    bias: Floats


def plane_noise(points: Floats, ring: Ints | None, normal: Floats, sensor: SensorModel | None) -> PlaneNoise:
    """Noise of returns across the plane they lie on.

    A range error moves a return along its ray, so across the plane by the cosine of the incidence.

    Args:
        points: (N, 3) metres, LiDAR frame.
        ring: (N,), or None: one bias for all.
        normal: (3,) unit normal of the plane, LiDAR frame.
        sensor: its noise and bias; None: a centimetre each.
    """
    range_noise, ring_bias = (sensor.range_noise, sensor.ring_bias) if sensor else (0.01, 0.01)
    cosine = np.abs(points @ normal) / np.linalg.norm(points, axis=1)
    sigma = np.hypot(range_noise * cosine, FLATNESS)
    _, inverse = np.unique(np.zeros(len(points)) if ring is None else ring, return_inverse=True)
    bias = np.zeros((len(points), int(inverse.max()) + 1))
    bias[np.arange(len(points)), inverse] = ring_bias * cosine / sigma
    return PlaneNoise(points, sigma, bias)
