"""The rig's graph, solved: sightings as terms, what they share with its prior, and the minimum."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import D, K, M, O, P

from optshape_graph.calibration.camera.factors import LENS, OFFSET_SIGMA_M
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.graph import RigGraph, places_of
from optshape_graph.calibration.rig.points import Corners, Marked, Points, Seen
from optshape_graph.calibration.rig.sightings import Sighting, TargetInMarkers
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.tracks import Smooth, Timed
from optshape_graph.errors import EstimationError
from optshape_graph.graph import Chain, Inverse, SharedErrors, Term, solve

MARKERS_OFF = 0.03
"""Standard deviation of a marker's place about its vertex along each axis, metres."""


def solve_graph(graph: RigGraph, used: Collection[int] | None = None, at: gtsam.Values | None = None) -> RigSolution:
    """Minimise over the sightings, or over those of some numbers.

    Args:
        graph: the sightings.
        used: their numbers; None: all.
        at: where to start; None: where the start is.

    Raises:
        EstimationError: the minimum is not found.
    """
    everything = range(len(graph.start.sightings))
    numbers = list(everything) if used is None else [n for n in everything if n in used]
    scans = [n for n in numbers if n in graph.measurements]
    others = [n for n in numbers if n not in graph.measurements]
    seen = [graph.start.sightings[n] for n in numbers]
    shared = SharedErrors.of(
        [graph.measurements[n] for n in scans],
        [graph.chain(graph.start.sightings[n]) for n in scans],
        [graph.lidars[graph.start.sightings[n].sensor] for n in scans],
        graph.loss,
    )
    points = [_points(graph, n) for n in others]
    term = Points.of(
        [one for one, _ in points],
        [_inverse(graph.chain(graph.start.sightings[n])) for n in others],
        [keys for _, keys in points],
        graph.loss,
    )
    values, factors = _values(graph, seen, {key for _, keys in points for key in keys})
    shared.insert(values)
    motion = _motion(graph, set(numbers))
    for key, twist in [(graph.twist_key(n), graph.twists[n]) for n in numbers if n in graph.twists]:
        values.insert(key, twist)
    if at is not None:
        for key in [key for key in gtsam.utilities.allPose3s(values).keys() if at.exists(key)]:  # noqa: SIM118 - no mapping
            values.update(key, at.atPose3(key))
    terms: list[Term] = [shared, term, *motion]
    solution = solve(values, terms, factors, graph.names())
    if not solution.converged:
        raise EstimationError("the rig's graph did not converge: views contradict each other")
    return RigSolution(graph, solution, tuple(scans), tuple(others))


def _motion(graph: RigGraph, used: Collection[int]) -> list[Smooth]:
    """How targets move from sighting to sighting."""
    terms = []
    for track in graph.tracks:
        kept = [(n, time) for n, time in zip(track.numbers, track.times, strict=True) if n in used]
        poses = [(graph.placements[graph.start.sightings[n].placement], graph.twist_key(n)) for n, _ in kept]
        pairs = list(pairwise(poses))
        seconds = np.diff([time for _, time in kept])
        if pairs:
            pose_keys, twist_keys = ([(a[k], b[k]) for a, b in pairs] for k in (0, 1))
            terms.append(Smooth.of(pose_keys, twist_keys, seconds, np.array(graph.density)))
    return terms


def _points(graph: RigGraph, number: int) -> tuple[Seen, list[int]]:
    """What an image or markers say, and the keys of what they share with others."""
    sighting = graph.start.sightings[number]
    seen, keys = _seen(graph, sighting)
    if number in graph.twists and sighting.sensor != graph.base:
        return Timed(seen, graph.twists[number]), [*keys, D(graph.camera_number(sighting.sensor))]
    return seen, keys


def _seen(graph: RigGraph, sighting: Sighting) -> tuple[Seen, list[int]]:
    seen, number = sighting.seen, graph.targets[sighting.target.name]
    if isinstance(seen, TargetInImage):
        points = seen.points.relabelled(sighting.S)
        keys = [O(number)] * points.printed
        if sighting.sensor not in graph.free_lenses:
            return Corners(points, seen.camera), keys
        numbers = graph.places[sighting.target.name]
        places = np.array([numbers[place] for place in places_of(points)])
        return Corners(points, seen.camera, places), [*keys, P(number), K(graph.camera_number(sighting.sensor))]
    assert isinstance(seen, TargetInMarkers)
    near = sighting.target.vertices[seen.vertices]
    return Marked.of(seen.points, near, seen.vertices, seen.sigma, seen.of_body), [M(number)]


def _values(
    graph: RigGraph, seen: Sequence[Sighting], shared: Collection[int]
) -> tuple[gtsam.Values, gtsam.NonlinearFactorGraph]:
    """Initial values, and the priors of what sightings of points share."""
    start, values, factors = graph.start, gtsam.Values(), gtsam.NonlinearFactorGraph()
    poses = {graph.placements[s.placement]: start.T_world_target[s.placement] for s in seen}
    poses |= {graph.sensors[s.sensor]: start.T_base_sensor[s.sensor] for s in seen if s.sensor in graph.sensors}
    poses |= {graph.moments[s.moment]: start.T_world_base[s.moment] for s in seen if s.moment in graph.moments}
    for key, T in poses.items():
        values.insert(key, gtsam.Pose3(T))
    sizes = {name: len(s.target) for s in seen for name in [s.target.name]}
    sigmas = {O(number): np.array(OFFSET_SIGMA_M[1:]) for number in graph.targets.values()}
    sigmas |= {M(n): np.full(3 * sizes[name], MARKERS_OFF) for name, n in graph.targets.items() if name in sizes}
    sigmas |= {P(graph.targets[name]): np.ones(3 * len(places)) for name, places in graph.places.items()}
    sigmas |= {K(graph.camera_number(name)): np.ones(len(LENS)) for name in graph.free_lenses}
    sigmas |= {D(graph.camera_number(name)): np.ones(1) for name in start.T_base_sensor}
    for key in sorted(shared):
        values.insert(key, np.zeros(len(sigmas[key])))
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas[key])
        factors.push_back(gtsam.PriorFactorVector(key, np.zeros(len(sigmas[key])), noise))
    return values, factors


def _inverse(chain: Chain) -> Chain:
    """The chain of the inverse pose."""
    return [step.key if isinstance(step, Inverse) else Inverse(int(step)) for step in reversed(chain)]  # type: ignore[arg-type]  # a key
