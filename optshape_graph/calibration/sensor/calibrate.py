"""Calibration of a sensor from boards that stood still: solve, judge by placements left out, and make the file."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.agreement import find_agreement
from optshape_graph.calibration.mocap.comparison import MocapScan
from optshape_graph.calibration.sensor.graph import Joint, Known, solve
from optshape_graph.calibration.sensor.held_out import IN_TURN, posterior_of, that_help
from optshape_graph.calibration.sensor.known import Distance, known_beside
from optshape_graph.calibration.sensor.noise import Sampling, drift_of, sampling
from optshape_graph.calibration.sensor.placements import Placement
from optshape_graph.calibration.sensor.reading import of_recording, of_session
from optshape_graph.calibration.sensor.result import PlacementResult, SensorCalibration
from optshape_graph.calibration.sensor.seen import Seen
from optshape_graph.calibration.sensor.sources import FEWEST, Opened, Source, too_few
from optshape_graph.calibration.sensor.told import directions, mean_range_is_told, silent_rings
from optshape_graph.calibration.sensor.unknowns import (
    COMMON,
    EDGE_SYSTEMATIC,
    Deviation,
    prior_sds,
    with_mean_range_open,
)
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError
from optshape_graph.factors import AZIMUTH, EDGE_OFFSET, ELEVATION, RANGE_BIAS
from optshape_graph.io.recordings import Recording
from optshape_graph.io.sessions import Session
from optshape_graph.runs.kept import Kept
from optshape_graph.scan import put_right
from optshape_graph.sensor import SensorModel
from optshape_graph.target import Target

LEFT_OUT = 3
"""Every so many-th moment, or session, is left out together, to judge what the others say."""

FEW = 60
"""Placements up to which every moment is left out once; of more, one part is enough."""

ENOUGH = 15
"""Placements below which the result is read with care."""

DRIFT_ROUNDS, SMALL_DRIFT = 4, 5e-4
"""How often the drift of range biases is estimated at most, and its change that is none, metres."""


def calibrate_sensor(
    sources: Source | Sequence[Source],
    targets: Target | Sequence[Target] = (),
    sensor: SensorModel | None = None,
    *,
    lidar: str | None = None,
    topic: str | None = None,
    distances: Sequence[Distance] = (),
    use_target_points: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    kept: Kept | None = None,
) -> SensorCalibration:
    """Calibrate a LiDAR's rings by boards that stood still in front of it.

    Args:
        sources: sessions and recordings of the sensor, by path or opened.
        targets: the boards to look for; of sessions those that they name, if none are given.
        sensor: the sensor's file, the prior; None: that of the first session.
        lidar: which LiDAR of the sessions; None: the only one.
        topic: of the scans of recordings; None: the only one.
        distances: between boards, measured.
        use_target_points: take the crops by hand of sessions instead of looking for the boards.
        progress: called with the number of scans done, and their total.
        kept: what was found in a run that was stopped, and is in this one (`runs.kept.keeping`); None: it is not kept.

    Raises:
        InputError: a source that can't be read or used, no sensor, or sensors that differ.
        EstimationError: too few placements, or no solution.
    """
    every = [sources] if isinstance(sources, str | Path | Session | Recording) else sources
    wanted = [targets] if isinstance(targets, Target) else targets
    opened = Opened.of(every, wanted, sensor, lidar, topic)
    opened.check(distances, use_target_points)
    placements: list[Placement] = []
    left_out: list[str] = []
    numbers: list[range] = []
    for source in opened.sources:
        if isinstance(source, Session):
            found, gone = of_session(source, opened.targets, use_target_points, progress, kept or Kept())
        else:
            found, gone = of_recording(source, topic, opened.targets, opened.sensor, progress, kept or Kept())
        numbers.append(range(len(placements), len(placements) + len(found)))
        # Moments of different sources are different moments.
        offset = 1 + max((one.moment for p in placements for one in p.sightings), default=-1)
        placements += [_later(placement, offset) for placement in found]
        left_out += gone
    return calibrate_placements(placements, opened.sensor, distances, numbers, left_out)


def calibrate_placements(
    placements: Sequence[Placement],
    sensor: SensorModel,
    distances: Sequence[Distance] = (),
    sources: Sequence[Sequence[int]] = (),
    left_out: Sequence[str] = (),
) -> SensorCalibration:
    """Calibrate a sensor by placements that are estimated already.

    Args:
        placements: of boards.
        sensor: its file, the prior.
        distances: between boards, measured.
        sources: numbers of the placements of each session or recording; none: all are of one, without motion capture.
        left_out: what took no part, in words.

    Raises:
        EstimationError: too few placements, or no solution.
    """
    if len(placements) < FEWEST:
        reasons = "".join(f"; {text}" for text in left_out[:3])
        raise too_few(f"found {len(placements)}{reasons}")
    captured = [numbers for numbers in sources if any(placements[p].markers is not None for p in numbers)]
    tied = [(numbers, _frame(placements, numbers)) for numbers in captured]
    known = known_beside(placements, distances, tied)
    prior = with_mean_range_open(sensor) if distances or captured else sensor
    joint, drift = _solved(placements, prior, known)
    if prior is not sensor and not mean_range_is_told(joint, prior):
        prior = sensor
        joint, drift = _solved(placements, prior, known)
    seen, start = joint.seen, _starts(placements)
    folds = _folds(seen, start, _turns(placements, sources))
    kept, worth = that_help(folds)
    before, after = _ring_residuals(folds, kept, sensor.n_rings)
    held = tuple(kind for kind in IN_TURN if kind not in kept)
    mean, covariance = posterior_of(joint, joint.errors, kept)
    joint = replace(joint, beta=mean, covariance=covariance)
    deviations = {kind: Deviation.of(prior, kind, joint.errors, mean, covariance) for kind in COMMON}
    sampled = sampling(seen, sensor.n_rings)
    calibrated = _calibrated(sensor, deviations, joint, sampled, drift, kept)
    result = SensorCalibration(
        sensor=calibrated,
        given=sensor,
        placements=tuple(
            PlacementResult(
                placement.sightings[0].name, placement.target.name, placement.distance, len(placement.sightings),
                sum(len(one.returns) for one in placement.sightings), worth.get(p),
            )
            for p, placement in enumerate(placements)
        ),
        directions=directions(deviations),
        silent=silent_rings(deviations.values()),
        sampling=sampled,
        drift=drift,
        before=before,
        after=after,
        left_out=tuple(left_out),
        findings=(),
    )  # fmt: skip
    return replace(result, findings=tuple(_findings(result, joint, held)))


def _starts(placements: Sequence[Placement]) -> dict[int, Floats]:
    """T_target_lidar (4, 4) of each placement to start from."""
    return {p: placement.sightings[0].estimate.T_target_lidar for p, placement in enumerate(placements)}


def _solved(placements: Sequence[Placement], sensor: SensorModel, known: Known) -> tuple[Joint, float]:
    """The solution, and what each placement has of its own in each ring's range bias, a standard deviation, metres."""
    start = _starts(placements)
    seen = [
        Seen.of(put_right(replace(one.returns, sensor=sensor)), placement.target, p, start[p])
        for p, placement in enumerate(placements)
        for one in placement.sightings
    ]
    joint, drift = solve(seen, start, known), 0.0
    for _ in range(DRIFT_ROUNDS):
        more = drift_of(joint)
        if abs(more - drift) < SMALL_DRIFT:
            break
        drift = more
        joint = solve([one.drifting(drift) for one in joint.seen], joint.T_target_lidar, known)
    return joint, drift


def _later(placement: Placement, offset: int) -> Placement:
    return replace(placement, sightings=tuple(replace(one, moment=one.moment + offset) for one in placement.sightings))


def _frame(placements: Sequence[Placement], numbers: Sequence[int]) -> Floats:
    """T_lidar_mocap (4, 4), roughly, of the placements that a frame saw."""
    scans = []
    for p in numbers:
        first = placements[p].sightings[0]
        assert first.markers is not None
        scans.append(MocapScan(first.name, first.estimate, first.markers))
    return find_agreement(scans, "the session").T_lidar_mocap


def _turns(placements: Sequence[Placement], sources: Sequence[Sequence[int]]) -> list[set[int]]:
    """Numbers of the placements that are left out in turn: those of some moments, or of some sessions.

    Of sessions, if none has most of the placements: a sensor keeps its errors from one to the next.
    """
    n = len(placements)
    if max(map(len, sources), default=n) <= n * (LEFT_OUT - 1) / LEFT_OUT:
        unit, turns = {p: k for k, numbers in enumerate(sources) for p in numbers}, LEFT_OUT
    else:
        order = {moment: k for k, moment in enumerate(sorted({placement.moment for placement in placements}))}
        unit, turns = {p: order[one.moment] for p, one in enumerate(placements)}, LEFT_OUT if n <= FEW else 1
    parts = [{p for p, k in unit.items() if k % LEFT_OUT == turn} for turn in range(turns)]
    return [part for part in parts if 0 < len(part) < n]


def _folds(seen: Sequence[Seen], start: Mapping[int, Floats], turns: Sequence[set[int]]) -> list[tuple[Joint, Joint]]:
    """Leave out some placements in turn: solve them by themselves, and all others."""

    def of(chosen: set[int]) -> Joint:
        return solve([one for one in seen if one.placement in chosen], {p: start[p] for p in sorted(chosen)})

    return [(of(part), of(set(start) - part)) for part in turns]


def _ring_residuals(
    folds: Sequence[tuple[Joint, Joint]], kinds: Collection[str], n_rings: int
) -> tuple[Floats, Floats]:
    """Root mean square (R,) of how far rings are behind the boards left out, before and after, metres."""
    squares, counts = np.zeros((2, n_rings)), np.zeros(n_rings)
    for judged, trained in folds:
        mean, _ = posterior_of(trained, judged.errors, kinds)
        found = dict(zip(judged.errors, mean.tolist(), strict=True))
        for one in judged.seen:
            T = judged.T_target_lidar[one.placement]
            for k, beta in enumerate(({}, found)):
                rings, residual = one.ring_residuals(T, beta)
                squares[k, rings] += residual**2
            counts[rings] += 1
    with np.errstate(invalid="ignore"):
        before, after = np.sqrt(squares / np.where(counts > 0, counts, np.nan))
    return before, after


def _calibrated(
    sensor: SensorModel,
    deviations: Mapping[str, Deviation],
    joint: Joint,
    sampled: Sampling,
    drift: float,
    kept: Collection[str],
) -> SensorModel:
    """The sensor's file with what was found; of what clouds are reported by, that is kept beside it."""
    nothing = np.zeros(sensor.n_rings)
    offsets = nothing if sensor.azimuth_offsets is None else sensor.azimuth_offsets
    reported = sensor.as_reported
    elevations = sensor.elevations + deviations[ELEVATION].mean
    if (np.diff(elevations) <= 0).any():
        k = int((np.diff(elevations) <= 0).argmax())
        raise EstimationError(f"rings {k} and {k + 1} would cross: the boards do not fit sensor '{sensor.name}'")
    edge = next(i for i, error in enumerate(joint.errors) if error.kind == EDGE_OFFSET)
    sds = {kind: of.parts if kind in kept else prior_sds(sensor, kind) for kind, of in deviations.items()}
    edge_sd = float(np.sqrt(joint.covariance[edge, edge])) * sensor.edge_offset_sd
    changes: dict[str, Any] = {
        "range_bias": (nothing if sensor.range_bias is None else sensor.range_bias) + deviations[RANGE_BIAS].mean,
        "range_bias_sd": np.hypot(sds[RANGE_BIAS][0], drift),
        "elevations": elevations,
        "elevation_sd": sds[ELEVATION][0],
        "azimuth_offsets": offsets + deviations[AZIMUTH].mean,
        "azimuth_sd": sds[AZIMUTH][0],
        "common_range_sd": sds[RANGE_BIAS][1],
        "common_elevation_sd": sds[ELEVATION][1],
        "common_azimuth_sd": sds[AZIMUTH][1],
        "range_trend_sd": sds[RANGE_BIAS][2],
        "elevation_trend_sd": sds[ELEVATION][2],
        "azimuth_trend_sd": sds[AZIMUTH][2],
        "reported_elevations": reported.elevations,
        "reported_azimuth_offsets": nothing if reported.azimuth_offsets is None else reported.azimuth_offsets,
        "edge_offset": sensor.edge_offset + float(joint.beta[edge]) * sensor.edge_offset_sd,
        "edge_offset_sd": float(np.hypot(edge_sd, EDGE_SYSTEMATIC)),
        "range_noise": sampled.noise_over(sensor.range_noise),
        "azimuth_step": sampled.azimuth_step,
    }
    if sampled.firing_times is not None and sampled.firing_sd is not None and sampled.firing_period is not None:
        known = np.isfinite(sampled.firing_times)
        given = nothing if sensor.firing_phases is None else sensor.firing_phases
        changes["firing_phases"] = np.where(known, sampled.firing_times / sampled.firing_period, given)
        changes["firing_sd"] = np.where(known, sampled.firing_sd / sampled.firing_period, 0.0)
        changes["firing_period"] = sampled.firing_period
    return replace(sensor, **changes)


def _findings(result: SensorCalibration, joint: Joint, kept_as_given: Sequence[str]) -> list[Finding]:
    """Say what is wrong with a calibration, and what it could not tell."""
    found = []
    if not result.helps:
        found.append(
            Finding(
                "placements that took no part do not become likelier by the calibration of the others (logarithm: "
                f"{result.gain:+.1f}): did boards move, or are they not as their files say?",
                True,
            )
        )
    elif kept_as_given:
        found.append(
            Finding(
                f"left as the file has them, since placements left out do not become likelier by them: "
                f"{', '.join(kept_as_given)}",
                False,
            )
        )
    if not joint.settled:
        found.append(Finding("the solution did not settle: more placements, at other distances and rolls", False))
    if len(result.placements) < ENOUGH:
        found.append(Finding(f"{len(result.placements)} placements; some 20 are better", False))
    held = [one.name for one in result.directions if not one.told]
    if held:
        found.append(Finding(f"held at its prior, since the boards can't tell: {', '.join(held)}", False))
    if result.silent:
        numbers = ", ".join(map(str, result.silent[:8])) + (" ..." if len(result.silent) > 8 else "")
        found.append(Finding(f"rings that hardly hit a board keep what the file says: {numbers}", False))
    sampled, given = result.sampling, result.given
    if given.azimuth_step is not None and abs(sampled.azimuth_step - given.azimuth_step) > 0.02 * given.azimuth_step:
        found.append(
            Finding(
                f"azimuth step {np.degrees(sampled.azimuth_step):.4f} deg, {np.degrees(given.azimuth_step):.4f} in the "
                "file: another rate of turning?",
                False,
            )
        )
    return found
