"""Calibration of a rig: any sensors that targets connect, in one graph, and judged by itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.lens import LensChange, LensCheck, check_lenses
from optshape_graph.calibration.camera.noise import noise_factors, scaled
from optshape_graph.calibration.camera.session import Progress
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.discrepancy import settled
from optshape_graph.calibration.rig.graph import Options, RigGraph
from optshape_graph.calibration.rig.judgement import (
    check_numbers,
    check_sensors,
    judge,
    middle_of,
    scatter_of,
    widening,
)
from optshape_graph.calibration.rig.left_out import Off, left_out
from optshape_graph.calibration.rig.moved import moved_about_platform, moved_before_platform
from optshape_graph.calibration.rig.moving import Clocks, connect, solve_moving
from optshape_graph.calibration.rig.next_placement import suggest_placement
from optshape_graph.calibration.rig.reading import Read, read_sightings
from optshape_graph.calibration.rig.result import RigCalibration, RigSensor, RingError, SightingResult
from optshape_graph.calibration.rig.robust import solve_robustly
from optshape_graph.calibration.rig.sightings import Kind, Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.stamps import shifted_stamps
from optshape_graph.calibration.rig.start import Start, connected_by, find_start
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.factors import RANGE_BIAS
from optshape_graph.io.passed_over import PassedOver
from optshape_graph.io.sessions import About, Session, load_session
from optshape_graph.runs.kept import Kept
from optshape_graph.se3 import inverse

MANY = 0.2
"""Share of a sensor's sightings that contradict the others from which its stamps may be shifted."""


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


@dataclass(frozen=True, eq=False, repr=False)
class SolvedRig(Value):
    """A rig's graph, solved.

    Attributes:
        sensors: names, the base first.
        solved: the graph, with the sightings that take part.
        left: why the others do not, by number.
        clocks: what is known of the sensors'.
        findings: what was seen on the way.
    """

    sensors: tuple[str, ...]
    solved: RigSolution
    left: Mapping[int, str]
    clocks: Clocks
    findings: tuple[Finding, ...]

    @property
    def graph_as_they_come(self) -> RigGraph:
        """The graph for clouds whose rings nobody corrects: all of them are off, and none is to count less for it."""
        graph = self.solved.graph
        return replace(graph, options=replace(graph.options, as_they_come=True), discrepancy={}, loss=np.inf)


def solve_rig(read: Read, session: Session, options: Options) -> SolvedRig:
    """Connect a rig's sensors, and solve its graph; see `calibrate`.

    Args:
        read: the sightings.
        session: what else is said of them.
        options: what is assumed.

    Raises:
        EstimationError: there is one placement only, a sensor saw no target, or the views contradict each other; the
            message begins with the session's file, and names the sensors whose stamps are shifted, if that explains it.
        UnobservableError: nothing connects some sensor with the others.
    """
    try:
        return _solve_rig(read, session, options)
    except EstimationError as error:
        where = f"{session.path}: "
        if shifted := shifted_stamps([s for s in read.sightings if not s.moving], session.platform_moves):
            raise EstimationError(where + shifted) from error
        text = where + str(error).removeprefix(where)
        if isinstance(error, UnobservableError):
            raise UnobservableError(text, error.directions) from error
        raise EstimationError(text) from error


def _solve_rig(read: Read, session: Session, options: Options) -> SolvedRig:
    sightings, findings = _with_pixel_noise(read.sightings), list[Finding]()
    if read.unusable:
        count, first = len(read.unusable), read.unusable[0]
        text = f"{count} file{'s' if count > 1 else ''} of the session cannot be used; the first: {first}"
        findings.append(Finding(text, False))
    check_numbers(sightings, str(session.path))
    check_sensors(read, str(session.path))
    lenses = check_lenses(s.seen for s in sightings if isinstance(s.seen, TargetInImage))
    moving = [sighting for sighting in sightings if sighting.moving]
    still = [sighting for sighting in sightings if not sighting.moving]
    if not session.platform_moves:
        still, moved = moved_before_platform(still)
        findings += moved
    # Clocks are told against that of a sensor that saw something move.
    base = moving[0].sensor if moving and all(s.sensor != read.sensors[0] for s in moving) else read.sensors[0]
    sensors = (base, *(name for name in read.sensors if name != base))
    places, offsets = _about(base, session.initial), dict[str, float]()
    if moving:
        if still:
            places = connected_by(still, base, places, session.platform_moves)
        places, offsets, moving = connect(moving, base, places)
    start = find_start(still, base, places, session.platform_moves, sensors)
    graph = RigGraph(start, base, options, free_lenses=frozenset(lens.camera for lens in lenses if lens.contradicted))
    if session.platform_moves:
        graph, moved = moved_about_platform(graph)
        findings += moved
    if moving:
        solved, clocks = solve_moving(graph, moving, offsets)
        return SolvedRig(sensors, solved, {}, clocks, (*findings, *_of_lenses(lenses, solved)))
    solved, left = solve_robustly(graph)
    seen = Counter(s.sensor for s in start.sightings)
    contradicting = Counter(start.sightings[number].sensor for number in left)
    if any(contradicting[name] > MANY * seen[name] for name in seen):
        shifted = shifted_stamps(still, session.platform_moves)
        findings += [Finding(shifted, True)] if shifted else []
    findings += [*_of_lenses(lenses, solved), *_of_discrepancies(solved)]
    return SolvedRig(sensors, solved, left, Clocks(), tuple(findings))


def _of_discrepancies(solved: RigSolution) -> list[Finding]:
    return [
        Finding(
            f"the scans of '{name}' are off by more than its sensor file lets expect: by {found.translation * 1e3:.1f} "
            f"mm and {np.degrees(found.rotation):.2f} deg more (sd), which the covariances allow for",
            False,
        )
        for name, found in solved.graph.discrepancy.items()
    ]


def _with_pixel_noise(sightings: Sequence[Sighting]) -> list[Sighting]:
    """Scale the pixels' noise of each camera to what is left when every image is fitted by itself."""
    factors = noise_factors([s.seen for s in sightings if isinstance(s.seen, TargetInImage)])
    return [
        replace(s, seen=scaled(s.seen, factors[s.sensor])) if isinstance(s.seen, TargetInImage) else s
        for s in sightings
    ]


def _of_lenses(lenses: Sequence[LensCheck], solved: RigSolution) -> list[Finding]:
    """Say which lenses were refined, and forbid to trust those that became another."""
    given = {
        s.seen.camera.name: s.seen.camera for s in solved.graph.start.sightings if isinstance(s.seen, TargetInImage)
    }
    findings = []
    for lens in lenses:
        if lens.contradicted and lens.camera in given:
            change = LensChange.of(given[lens.camera], solved.lens(given[lens.camera]))
            text = (
                f"the images of '{lens.camera}' contradict its lens as given ({lens.rms_px:.2f} px, "
                f"{lens.refined_rms_px:.2f} with another): it was refined, {change.text}, and the result belongs to "
                f"the refined lens{'; calibrate the camera again' if change.far else ''}"
            )
            findings.append(Finding(text, change.far))
    return findings


def _about(base: str, initial: Sequence[About]) -> dict[str, Floats]:
    """T_base_sensor (4, 4) of the sensors that the session says enough of."""
    found, before = {base: np.eye(4)}, 0
    while len(found) > before:
        before = len(found)
        for about in initial:
            if about.a in found and about.b not in found:
                found[about.b] = found[about.a] @ about.T_a_b
            elif about.b in found and about.a not in found:
                found[about.a] = found[about.b] @ inverse(about.T_a_b)
    del found[base]
    return found


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
