"""From sightings to a rig that is solved: connected, read in that light, without what contradicts, and said so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.camera.factors import LENS
from optshape_graph.calibration.camera.lens import LensChange, LensCheck, check_lenses
from optshape_graph.calibration.camera.noise import noise_factors, scaled
from optshape_graph.calibration.images.reading import TargetInImage
from optshape_graph.calibration.rig.graph import Options, RigGraph
from optshape_graph.calibration.rig.judgement import (
    check_numbers,
    check_sensors,
    scatter_of,
)
from optshape_graph.calibration.rig.moved import moved_about_platform, moved_before_platform
from optshape_graph.calibration.rig.moving import Clocks, connect, solve_moving
from optshape_graph.calibration.rig.reading import Read
from optshape_graph.calibration.rig.robust import solve_robustly
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.rig.solve import solve_graph
from optshape_graph.calibration.rig.stamps import shifted_stamps
from optshape_graph.calibration.rig.start import connected_by, find_start
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import EstimationError, UnobservableError
from optshape_graph.io.sessions import About, Session
from optshape_graph.se3 import inverse

MANY = 0.2
"""Share of a sensor's sightings that contradict the others from which its stamps may be shifted, or its lens be
another."""

SCATTERED = 9.0
"""Chi-square per degree of freedom of all sightings beyond which none of them stands out, and another lens may be why:
it is if it makes the chi-square so many times less."""

OPEN_M, OPEN = (0.005, 0.1), 1.5
"""Standard deviation, metres, of a camera's place for what its images leave open of its lens, from which it is said,
and from which it is grave; and how many times that for the lens as given it is at least."""

CHANCE = 1e-3
"""Probability by chance of so much better a fit with another lens, under which it is another."""


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
        return SolvedRig(
            sensors, solved, {}, clocks, (*findings, *_of_lenses(lenses, solved), *_of_open_lenses(solved))
        )
    solved, left = _with_lenses_that_agree(graph)
    if _contradicting(start.sightings, left):
        shifted = shifted_stamps(still, session.platform_moves)
        findings += [Finding(shifted, True)] if shifted else []
    findings += [*_of_lenses(lenses, solved), *_of_open_lenses(solved), *_of_discrepancies(solved)]
    return SolvedRig(sensors, solved, left, Clocks(), tuple(findings))


def _with_lenses_that_agree(graph: RigGraph) -> tuple[RigSolution, dict[int, str]]:
    """Solve; where views contradict each other, and fewer would under other lenses, or far less, with those."""
    cameras = frozenset(s.sensor for s in graph.start.sightings if isinstance(s.seen, TargetInImage))
    free = replace(graph, free_lenses=cameras)
    try:
        solved, left = solve_robustly(graph)
    except EstimationError:
        if cameras == graph.free_lenses:
            raise
        return solve_robustly(free)
    scatter = scatter_of(solved)[0]
    doubtful = cameras & _contradicting(graph.start.sightings, left) or scatter > SCATTERED
    if cameras != graph.free_lenses and doubtful:
        with suppress(EstimationError):
            other, fewer = solve_robustly(free)
            if len(fewer) < len(left) or SCATTERED * scatter_of(other)[0] < scatter:
                return other, fewer
    return solved, left


def _contradicting(sightings: Sequence[Sighting], left: Mapping[int, str]) -> set[str]:
    """Names of the sensors of whose sightings many contradict the others."""
    seen, contradicting = Counter(s.sensor for s in sightings), Counter(sightings[number].sensor for number in left)
    return {name for name in seen if contradicting[name] > MANY * seen[name]}


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
    checks, findings = {lens.camera: lens for lens in lenses}, []
    for camera in sorted(solved.graph.free_lenses & given.keys()):
        change, check = LensChange.of(given[camera], solved.lens(given[camera])), checks.get(camera)
        if check is not None and check.contradicted:
            why = (
                f"the images of '{camera}' contradict its lens as given ({check.rms_px:.2f} px, "
                f"{check.refined_rms_px:.2f} with another)"
            )
        elif change.far:
            why = f"views agree only where the lens of '{camera}' is another than given"
        else:
            continue
        text = (
            f"{why}: it was refined, {change.text}, and the result belongs to the refined lens"
            f"{'; calibrate the camera again' if change.far else ''}"
        )
        findings.append(Finding(text, change.far))
    return findings


def _of_open_lenses(solved: RigSolution) -> list[Finding]:
    """Say which cameras are known only if their lenses are as given: others fit better, or their images hardly tell.

    Covariances are for lenses as given. A focal length that is off by half a percent moves a camera by two centimetres
    at four metres, and a few images agree with it.
    """
    graph = solved.graph
    used = {number: graph.start.sightings[number] for number in solved.chi2}
    lenses = {s.sensor: s.seen.camera for s in used.values() if isinstance(s.seen, TargetInImage)}
    findings = []
    for camera in sorted(lenses.keys() - graph.free_lenses):
        with suppress(EstimationError):
            freed = replace(graph, free_lenses=graph.free_lenses | {camera})
            free = solve_graph(freed, used, solved.solution.values)
            count = sum(s.sensor == camera for s in used.values())
            findings += _of_open_lens(
                camera, count, LensChange.of(lenses[camera], free.lens(lenses[camera])), solved, free
            )
    return findings


def _of_open_lens(camera: str, count: int, change: LensChange, solved: RigSolution, free: RigSolution) -> list[Finding]:
    """Judge one camera by its solution under the lens as given, and under a free one."""
    gain = 2.0 * (solved.solution.error - free.solution.error)
    if change.far and chi2_distribution.sf(gain, len(LENS)) < CHANCE:
        text = f"views fit far better where the lens of '{camera}' is another than given ({change.text}): calibrate it"
        return [Finding(text, True)]
    if camera not in solved.graph.sensors:
        return []
    key = [solved.graph.sensors[camera]]
    covariances = [one.solution.system.covariance(key)[3:, 3:] for one in (solved, free)]
    given, open_m = (float(np.sqrt(np.linalg.eigvalsh(C)[-1])) for C in covariances)
    if open_m < max(OPEN_M[0], OPEN * given):
        return []
    text = (
        f"'{camera}' is there only if its lens is as given: its {count} images leave open of it "
        f"what moves it by {1e3 * open_m:.0f} mm (sd); calibrate the camera, or add tilted views, near and far"
    )
    return [Finding(text, open_m > OPEN_M[1])]


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
