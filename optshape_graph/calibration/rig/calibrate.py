"""Calibration of a rig: any sensors that targets connect, in one graph, and judged by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.session import Progress
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.discrepancy import settled
from optshape_graph.calibration.rig.graph import Options
from optshape_graph.calibration.rig.judgement import (
    judge,
    middle_of,
    scatter_of,
    widening,
)
from optshape_graph.calibration.rig.left_out import Off, left_out
from optshape_graph.calibration.rig.moving import Clocks
from optshape_graph.calibration.rig.next_placement import suggest_placement
from optshape_graph.calibration.rig.reading import Read, read_sightings
from optshape_graph.calibration.rig.result import RigCalibration, RigSensor, RingError, SightingResult
from optshape_graph.calibration.rig.sightings import Kind, Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.solved import solve_rig
from optshape_graph.calibration.rig.start import Start
from optshape_graph.factors import RANGE_BIAS
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import Session, load_session
from optshape_graph.runs.kept import Kept


def calibrate_rig(
    session: str | Path | Session,
    *,
    use_target_points: bool = False,
    range_bias_sigma: float = Options.range_bias_sigma,
    progress: Progress | None = None,
    kept: Kept | None = None,
) -> RigCalibration:
    """Calibrate where a session's LiDARs, cameras and motion-capture bodies are to one another.

    Views of one stamp see one scene. Sensors need not overlap: each needs a target that it saw in one place with a
    sensor that is connected; or, on a platform that moves, targets that stay.

    Args:
        session: its file, or what `load_session` returned.
        use_target_points: take the targets' returns from the views' manual crops.
        range_bias_sigma: standard deviation of a range bias that all rings of a LiDAR have alike, metres, beside what
            its sensor file says of each ring's own.
        progress: called with how many images and scans are done, and how many there are.
        kept: what a run that was stopped found in scans and images, and this one finds (`runs.kept.keeping`); None: it
            is not kept.

    Raises:
        InputError: a session that can't be read or used as it is.
        EstimationError: no target was found, there is one placement only, or the views contradict each other.
        UnobservableError: nothing connects some sensor with the others; it is named.
    """
    loaded = session if isinstance(session, Session) else load_session(session)
    passed_over = PassedOver()
    read = read_sightings(loaded, use_target_points, progress, passed_over, kept)
    result = calibrate(read, loaded, Options(range_bias_sigma))
    return replace(result, passed_over=passed_over)


def calibrate(read: Read, session: Session, options: Options | None = None) -> RigCalibration:
    """Calibrate a rig from what its sensors saw.

    Args:
        read: the sightings.
        session: what else is said of them: the names of its sensors, and whether the platform moves.
        options: what is assumed; None: as by default.

    Raises:
        EstimationError: there is one placement only, or the views contradict each other.
        UnobservableError: nothing connects some sensor with the others.
    """
    rig = solve_rig(read, session, options or Options())
    solved, sensors = rig.solved, rig.sensors
    start = solved.graph.start
    scatter, freedom = scatter_of(solved)
    as_they_come = settled(rig.graph_as_they_come, set(solved.chi2), solved.solution.values)
    result = RigCalibration(
        sensors=tuple(_sensor(name, session, solved, as_they_come, rig.clocks) for name in sensors),
        covariance=_covariance(solved, sensors, widening(scatter, freedom)),
        time_covariance=_time_covariance(sensors, rig.clocks),
        middle=middle_of(start.sightings, start.T_base_sensor),
        scatter=scatter,
        sightings=_results(start, solved, rig.left),
        unobservable=tuple(direction.text for direction in solved.solution.unobservable),
        next_placement=None,
        findings=rig.findings,
    )
    result = replace(result, next_placement=suggest_placement(result, solved))
    used = [start.sightings[number] for number in solved.chi2]
    return replace(result, findings=(*rig.findings, *judge(result, used, freedom)))


def _sensor(name: str, session: Session, solved: RigSolution, as_they_come: RigSolution, clocks: Clocks) -> RigSensor:
    used = [s for number in solved.chi2 if (s := solved.graph.start.sightings[number]).sensor == name]
    kind: Kind = "lidar" if name in session.lidars else "camera" if name in session.cameras else "mocap body"
    errors = solved.ring_errors(name) if any(isinstance(s.seen, TargetInScan) for s in used) else {}
    lens = next((solved.lens(s.seen.camera) for s in used if isinstance(s.seen, TargetInImage)), None)
    # In the graph a range bias is what is to be added to a range.
    rings = tuple(
        RingError(error.kind, error.ring, -value if error.kind == RANGE_BIAS else value, sigma)
        for error, (value, sigma) in sorted(errors.items(), key=lambda item: (item[0].kind, item[0].ring or -1))
    )
    T, T_come = solved.T_base_sensor(name), as_they_come.T_base_sensor(name)
    return RigSensor(name, kind, T, T_come, clocks.offsets.get(name, 0.0), len(used), rings, lens)


def _covariance(solved: RigSolution, sensors: Sequence[str], factor: float) -> Floats:
    """Joint covariance of the right perturbations of T_base_sensor of all but the base.

    What is not observable has that of a vanishing prior: a kilometre, or a thousand turns.
    """
    keys = [solved.graph.sensors[name] for name in sensors[1:]]
    return factor * solved.solution.system.covariance(keys)


def _time_covariance(sensors: Sequence[str], clocks: Clocks) -> Floats:
    """Covariance of the offsets of all but the base; 0 where they are not told."""
    covariance = np.zeros((len(sensors) - 1,) * 2)
    places = [sensors.index(name) - 1 for name in clocks.names]
    covariance[np.ix_(places, places)] = clocks.covariance
    return covariance


def _results(start: Start, solved: RigSolution, left: Mapping[int, str]) -> tuple[SightingResult, ...]:
    off = left_out(solved)
    results = []
    for number, sighting in enumerate(start.sightings):
        reason = left.get(number, "" if number in solved.chi2 else "no other sighting of the placement is left")
        results.append(_result(sighting, number in solved.chi2, reason, off.get(number)))
    alone = "no other sensor saw the placement"
    return (*results, *(_result(sighting, False, alone, None) for sighting in start.alone))


def _result(sighting: Sighting, used: bool, reason: str, off: Off | None) -> SightingResult:
    numbers = (None, None, None) if off is None else (off.centre_m, off.turn_deg, off.chi_square)
    return SightingResult(
        sighting.sensor, sighting.target.name, sighting.placement, sighting.file, used, reason, *numbers
    )
