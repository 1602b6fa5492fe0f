"""Judgements of shapes: score, symmetry, and the bound on their pose for a sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.bound import PoseBound, pose_bound
from optshape_graph.design.polygons import areas, centred, rotated
from optshape_graph.design.problem import orientations
from optshape_graph.design.rings import Rings, UniformRings
from optshape_graph.design.sensitivity import MU, cell_scores
from optshape_graph.design.symmetry import SelfRotation, nearest_self_rotation
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

SIX_ROTATIONS = np.radians([0.0, 60.0, 120.0, 180.0, 240.0, 300.0])
"""The orientations of the paper, rad."""

DEGREE = np.pi / 180


@dataclass(frozen=True)
class Cell:
    """One cell of a score: an orientation and the area that is lit.

    Attributes:
        orientation: angle by which the shape is turned about its area's centroid, rad.
        area: number of the strip or placement, from the lowest.
        score: the score there.
    """

    orientation: float
    area: int
    score: float


@dataclass(frozen=True)
class Judgement:
    """The judgement of a shape.

    Attributes:
        target: the shape, of its own area.
        six_rotations: the paper's score at unit area, worst over six rotations and five areas.
        every_degree: the score, worst over all orientations in steps of a degree.
        every_tenth: the score in steps of a tenth of a degree, which shows if the shape is good at whole degrees only.
        self_rotation: the rotation under which it is most like itself.
        bound: the Cramer-Rao bound on its pose, if a sensor was given.
    """

    target: Target
    six_rotations: float
    every_degree: float
    every_tenth: float
    self_rotation: SelfRotation
    bound: PoseBound | None = None


def judge(target: Target, sensor: SensorModel | None = None, distance: float = 10.0) -> Judgement:
    """Judge a shape.

    Args:
        target: the shape.
        sensor: the sensor for the bound on the pose, if any.
        distance: of the target from it, metres.
    """
    rings = UniformRings()
    return Judgement(
        target,
        worst_cell(target, SIX_ROTATIONS).score,
        worst_cell(target, orientations(rings, DEGREE)).score,
        worst_cell(target, orientations(rings, DEGREE / 10)).score,
        nearest_self_rotation(target.polygon),
        None if sensor is None else pose_bound(target, sensor, distance),
    )


def worst_cell(target: Target, turns: Floats, rings: Rings | None = None, mu: float = MU) -> Cell:
    """Return the worst cell of a shape, scaled to unit area and turned about its area's centroid.

    Args:
        target: the shape.
        turns: (R,) orientations, rad.
        rings: the rings; None: four in each of five strips.
        mu: weight of the chords.
    """
    scores = cell_scores(rotated(unit_area(target), turns), UniformRings() if rings is None else rings, mu)
    turn, area = np.unravel_index(int(scores.argmin()), scores.shape)
    return Cell(float(turns[turn]), int(area), float(scores[turn, area]))


def unit_area(target: Target) -> Floats:
    """Return the polygon (n, 2) scaled to unit area, about its area's centroid."""
    polygon = centred(target.polygon)
    return np.asarray(polygon / np.sqrt(areas(polygon)))
