"""Where landmarks are, in one array, and how far each may be off as seen from the newest pose.

A pairing of a sighting with a landmark passes the gate by its Mahalanobis distance in six degrees of freedom. That of
the place alone is no larger, and the covariance of a landmark's place as seen from the newest pose is no larger than
that of its last sighting and of the odometry since. So distance rules a landmark out, without a covariance of the
graph, which costs more the further back the landmark is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.factors import Summary
from optshape_graph.mapping.association import gate
from optshape_graph.mapping.track import Odometry, Sighting
from optshape_graph.se3 import inverse, skew

SLACK = 0.1
"""Metres by which a landmark may have moved since the array had it."""


class Places:
    """Places of landmarks by name, and what odometry may have drifted by since each was seen.

    Drift is summed from the first pose on, as variances over all axes: of the rotation, rad2, and of the translation,
    m2; and the way gone, m. A landmark's mark is the sum when it was last seen, less the variance of that sighting.
    """

    def __init__(self) -> None:
        self._number: dict[str, int] = {}
        self._names: list[str] = []
        self._templates: dict[str, int] = {}
        self._template: Ints = np.zeros(0, int)
        self._place = np.zeros((0, 3))
        self._mark = np.zeros((0, 3))
        self._surveyed = np.zeros((0, 2))  # variances of the prior, rotation and place; not a number: there is none
        self._gone = [np.zeros(3)]
        self._jumped = 0
        self._seen: dict[str, tuple[int, Summary]] = {}  # whose marks are not set yet

    def __len__(self) -> int:
        return len(self._number)

    # ---- in ----------------------------------------------------------------------------------------------------------

    def add(self, name: str, template: str, place: Floats, surveyed: Floats | None = None) -> None:
        """Add a landmark that was not seen yet.

        Args:
            name: of the landmark.
            template: name of its template.
            place: (3,) of its origin in the world, metres.
            surveyed: (6, 6) covariance with which it was known before; None: it was not.
        """
        self._number[name] = len(self._names)
        self._names.append(name)
        number = self._templates.setdefault(template, len(self._templates))
        self._template = np.append(self._template, number)
        self._place = np.vstack([self._place, place])
        self._mark = np.vstack([self._mark, _UNKNOWN])
        prior = np.full(2, np.nan) if surveyed is None else _variances(surveyed)
        self._surveyed = np.vstack([self._surveyed, prior])

    def remove(self, name: str) -> None:
        """Forget a landmark."""
        self._place[self._number.pop(name)] = np.nan  # no distance from it is small

    def start(self, covariance: Floats) -> None:
        """Note the covariance (6, 6) of the first pose in the world, in which surveyed landmarks are."""
        self._see_surveyed(0, *_variances(covariance), 0.0)

    def move(self, odometry: Odometry) -> None:
        """Add what odometry may have drifted by to a new pose."""
        step = [*_variances(odometry.covariance), float(np.linalg.norm(odometry.T_i_j[:3, 3]))]
        self._gone[odometry.j :] = [self._gone[odometry.i] + step]

    def jump(self, pose: int) -> None:
        """Note that nothing is known of the motion to a new pose, by its number."""
        self._gone[pose:] = [self._gone[pose - 1] if pose else np.zeros(3)]
        self._mark[:] = _UNKNOWN
        self._jumped = pose

    def see(self, name: str, pose: int, summary: Summary) -> None:
        """Note that a landmark was seen from a pose, by its number from 0."""
        self._seen.pop(name, None)
        self._seen[name] = pose, summary

    def _mark_seen(self) -> None:
        """Set the marks of what was seen since."""
        if not self._seen:
            return
        poses, summaries = zip(*self._seen.values(), strict=True)
        for name, pose, rotation, place, distance in zip(self._seen, poses, *_variances_of(summaries), strict=True):
            if name not in self._number or pose < self._jumped:
                continue
            number = self._number[name]
            prior = self._surveyed[number]
            if not np.isnan(prior[0]):  # it tells where the others are, too
                self._see_surveyed(pose, prior[0] + rotation, prior[1] + place, distance)
            self._mark[number] = self._gone[pose] - [0.0, place, 0.0]
        self._seen.clear()

    def _see_surveyed(self, pose: int, rotation: float, place: float, distance: float) -> None:
        rows = ~np.isnan(self._surveyed[:, 0])
        self._mark[rows] = self._gone[pose] - [rotation, place, distance]
        self._mark[rows, 1] -= self._surveyed[rows, 1]

    def put(self, T_world_target: Mapping[str, Floats]) -> float:
        """Set the places of landmarks, by their poses (4, 4); return how far one has moved at most, metres."""
        numbers = [self._number[name] for name in T_world_target]
        places = np.array(list(T_world_target.values())).reshape(-1, 4, 4)[:, :3, 3]
        moved = np.linalg.norm(places - self._place[numbers], axis=1).max(initial=0.0)
        self._place[numbers] = places
        return float(moved)

    # ---- out ---------------------------------------------------------------------------------------------------------

    def near(self, sighting: Sighting, T_world_lidar: Floats) -> list[str]:
        """Return the landmarks of a sighting's template that may pass the gate, the nearest first.

        Args:
            sighting: from the newest pose.
            T_world_lidar: (4, 4) newest pose.
        """
        self._mark_seen()
        _, variance, distance = _variances_of(sighting.summaries)
        seen = (T_world_lidar @ inverse(np.array([s.T_target_lidar for s in sighting.summaries])))[:, :3, 3]
        gone = self._gone[-1] - self._mark
        lever = gone[:, 2] + distance.max()
        reach = np.sqrt(gate(6) * (gone[:, 1] + gone[:, 0] * lever**2 + variance.max())) + SLACK
        apart = np.linalg.norm(self._place[:, None] - seen, axis=2).min(axis=1)
        near = np.flatnonzero((apart < reach) & (self._template == self._templates.get(sighting.target.name, -1)))
        return [self._names[k] for k in near[np.argsort(apart[near])].tolist()]

    def within(self, place: Floats, distance: float) -> list[str]:
        """Return the landmarks within a distance of a place (3,), metres."""
        apart = np.linalg.norm(self._place - place, axis=1)
        return [self._names[k] for k in np.flatnonzero(apart < distance + SLACK).tolist()]

    def apart(self, pose: int, distance: float) -> float:
        """Return how far off what was seen from a pose may seem from the newest one, metres, by odometry alone.

        Args:
            pose: number of the pose, from 0.
            distance: of what was seen, from the newest pose, metres.
        """
        if pose < self._jumped:
            return np.inf
        rotation, place, way = self._gone[-1] - self._gone[pose]
        return float(np.sqrt(gate(6) * (place + rotation * (way + distance) ** 2)))


UNMEASURED = 1e-6
"""Square root information, 1/rad or 1/m, of what a sighting does not measure: its variance is large, not infinite."""

_UNKNOWN = np.array([0.0, -np.inf, 0.0])
"""Mark of a landmark of which nothing is known: it may be anywhere."""


def _variances(covariance: Floats) -> tuple[float, float]:
    """Over all axes: of the rotation and of the translation."""
    return float(covariance[:3, :3].trace()), float(covariance[3:, 3:].trace())


def _variances_of(summaries: Sequence[Summary]) -> tuple[Floats, Floats, Floats]:
    """Variances (m,) of measured rotations, rad2, and of the targets' places, m2; and distances (m,), metres.

    The place p of the target, in the LiDAR's frame, moves by [p]x w - v with a right perturbation (w, v) of
    T_target_lidar.
    """
    place = inverse(np.array([summary.T_target_lidar for summary in summaries]))[:, :3, 3]
    root = np.linalg.inv(np.array([summary.sqrt_information for summary in summaries]) + UNMEASURED * np.eye(6))
    moved = skew(place) @ root[:, :3] - root[:, 3:]
    rotation = np.square(root[:, :3]).sum(axis=(1, 2))
    return rotation, np.square(moved).sum(axis=(1, 2)), np.asarray(np.linalg.norm(place, axis=1))
