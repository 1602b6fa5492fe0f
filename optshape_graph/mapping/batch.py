"""The whole map at once, over all sessions: measurements as terms of the engine, odometry and priors as factors."""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.factors import SummaryFactor
from optshape_graph.factors._rows import gaussian
from optshape_graph.factors.static import RANGE_BIAS
from optshape_graph.graph import SharedErrors, State, Templates, solve
from optshape_graph.mapping.batch_solution import BatchSolution, Keys, Residual, pose_graph
from optshape_graph.mapping.incremental_graph import LOSS
from optshape_graph.mapping.shapes import AsBuilt
from optshape_graph.mapping.smoother import joint_prior, sqrt_information
from optshape_graph.mapping.track import MappingProblem

__all__ = ["BatchSolution", "Residual", "factor_graph", "pose_graph", "solve_batch"]


def solve_batch(
    problem: MappingProblem, *, robust: bool = True, as_built_sigma: float | None = None, ring_biases: bool = True
) -> BatchSolution:
    """Solve for all poses and landmarks.

    Args:
        problem: of one or several sessions.
        robust: Huber's loss on every match, as in the incremental solver; otherwise least squares.
        as_built_sigma: standard deviation of the vertices about the template, metres: refines the vertices of each
            landmark whose sightings have their `shape`; None: templates are exact.
        ring_biases: whether the biases that a LiDAR's rings keep are solved for, by sightings that have them
            (`Sighting.biased`); otherwise each match takes them for its own.

    Raises:
        InputError: nothing to solve for.
        EstimationError: a measurement is not finite.
    """
    if not problem.tracks or not sum(len(track.stamps) for track in problem.tracks):
        raise InputError("a map without a pose: nothing to solve for")
    keys, loss = Keys.of(problem), LOSS if robust else np.inf
    values, factors = _initial(problem, keys), _factors(problem, keys)

    as_built = AsBuilt.of(problem, keys, as_built_sigma)
    as_built.insert(values)
    for prior in as_built.priors():
        factors.push_back(prior)
    biased = {
        k: measurement
        for k, (_, match) in enumerate(problem.matches)
        if ring_biases and k not in as_built.numbers and (measurement := match.biased) is not None
    }
    of_ranges = [m.without([error for error in m.shared if error.kind != RANGE_BIAS]) for m in biased.values()]
    shared = SharedErrors.of(
        of_ranges,
        [keys.chain(*problem.matches[k]) for k in biased],
        [keys.biases[problem.matches[k][0], problem.matches[k][1].sighting.lidar] for k in biased],
        loss,
    )
    shared.insert(values)
    taken = {*as_built.numbers, *biased}
    plain = [k for k in range(len(problem.matches)) if k not in taken]
    alone = Templates.of(
        [problem.matches[k][1].measurement for k in plain], keys.chains([problem.matches[k] for k in plain]), loss
    )

    solution = solve(values, [as_built, shared, alone], factors, keys.names(problem))
    models: Any = solution.models
    ranges = dict(zip(shared.keys, shared.errors, strict=True))
    judged = list(zip((as_built.numbers, list(biased), plain), models, strict=True))
    return BatchSolution(problem, solution, keys, as_built.refined(problem, solution.values), judged, biased, ranges)


def factor_graph(problem: MappingProblem) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return a problem as plain GTSAM factors and initial values, for those who own their graph.

    Every match is a compiled Between factor, summarised at the initial values: make them again (`SummaryFactor`) when
    those have moved.
    """
    keys = Keys.of(problem)
    graph, values = _factors(problem, keys), _initial(problem, keys)
    loss = gtsam.noiseModel.mEstimator.Huber.Create(LOSS)
    H = keys.chains(problem.matches).at(State.of(values))
    for (t, match), T in zip(problem.matches, H, strict=True):
        k_target, k_lidar = keys.landmarks[match.landmark], keys.poses[t][match.pose]
        graph.push_back(SummaryFactor(match.measurement, k_target, k_lidar, T, loss))
    return graph, values


def _initial(problem: MappingProblem, keys: Keys) -> gtsam.Values:
    values = gtsam.Values()
    for own, track in zip(keys.poses, problem.tracks, strict=True):
        for key, T in zip(own, track.T_world_lidar, strict=True):
            values.insert(key, gtsam.Pose3(T))
    for name, T in problem.T_world_target.items():
        values.insert(keys.landmarks[name], gtsam.Pose3(T))
    return values


def _factors(problem: MappingProblem, keys: Keys) -> gtsam.NonlinearFactorGraph:
    """Odometry, starts, and what was known of landmarks."""
    graph = gtsam.NonlinearFactorGraph()
    for own, track in zip(keys.poses, problem.tracks, strict=True):
        if track.start is not None:
            noise = gaussian(sqrt_information(track.start.covariance))
            graph.push_back(gtsam.PriorFactorPose3(own[0], gtsam.Pose3(track.start.T_world_lidar), noise))
        for odometry in track.odometry:
            noise = gaussian(odometry.sqrt_information)
            graph.push_back(
                gtsam.BetweenFactorPose3(own[odometry.i], own[odometry.j], gtsam.Pose3(odometry.T_i_j), noise)
            )
    known = problem.known
    if known is not None and known.landmarks:
        ids = [keys.landmarks[landmark.id] for landmark in known.landmarks]
        for factor in joint_prior(ids, [m.T_world_target for m in known.landmarks], known.covariance):
            graph.push_back(factor)
    return graph
