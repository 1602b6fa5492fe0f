"""What a rig's calibration says about itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from optshape_graph._arrays import Floats
from optshape_graph.calibration.camera.sightings import TargetInScan
from optshape_graph.calibration.free_shape import wrong_size
from optshape_graph.calibration.rig.reading import Read
from optshape_graph.calibration.rig.result import RigCalibration, RingError
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.solution import RigSolution
from optshape_graph.calibration.verdict import Finding, of_doubts
from optshape_graph.errors import EstimationError

FEWEST, ENOUGH = 3, 8
"""Sightings that a sensor must have, and from which the result is not worth a warning."""

SURE = 1e-3
"""Probability by chance below which sightings scatter more than they should."""

GRAVE_SCATTER = 9.0
"""Mean square of what sightings are off by, in their standard deviations, from which something is wrong."""

GRAVE_SHARE = 1 / 3
"""Share of the sightings left out, from which the rest is not to be trusted."""

LOOSE = 0.1
"""Standard deviation of a pair's worst direction, metres, or rad times the targets' distance, that is grave."""

FOREIGN = 4.0
"""Mean square of a LiDAR's ring errors, in what its sensor file lets expect, from which the file is another's."""


def scatter_of(solved: RigSolution) -> tuple[float, int]:
    """Return the mean square of what sightings are off by, in their standard deviations, and its degrees of freedom."""
    graph = solved.graph
    still = [n for n in solved.chi2 if n not in graph.twists]
    placements = {graph.start.sightings[n].placement for n in still}
    freedom = 6 * (len(still) - len(placements) - len(graph.sensors) - len(graph.moments))
    if freedom <= 0:  # what moves is smoothed, and by how much was estimated
        return 1.0, 1
    return sum(solved.chi2[n] for n in still) / freedom, freedom


def widening(scatter: float, freedom: int) -> float:
    """Return the factor on the covariance: what sightings scatter by, where that is more than chance."""
    return scatter if chi2.sf(scatter * freedom, freedom) < SURE else 1.0


def judge(calibration: RigCalibration, used: Sequence[Sighting], freedom: int) -> tuple[Finding, ...]:
    """Say what is wrong, or has to be known before trusting the result.

    Args:
        calibration: with everything but its findings.
        used: the sightings that take part.
        freedom: degrees of freedom of its scatter.
    """
    findings = [Finding(f"not observable: {text}", True) for text in calibration.unobservable]
    findings += [*_of_numbers(calibration), *_of_pairs(calibration), *_of_targets(used), *_of_rings(calibration)]
    if contradicting := calibration.contradicting:
        first = contradicting[0]
        text = f"{len(contradicting)} of {len(calibration.sightings)} sightings contradict the others and take no part"
        grave = len(contradicting) > GRAVE_SHARE * len(calibration.sightings)
        findings.append(Finding(f"{text}; the first: '{first.sensor}' in {first.file}: {first.reason}", grave))
    if widening(calibration.scatter, freedom) > 1:
        text = (
            f"sightings are off by {np.sqrt(calibration.scatter):.1f} of their standard deviations, root mean square: "
            "the covariances are widened by that"
        )
        findings.append(Finding(text, calibration.scatter > GRAVE_SCATTER))
    return tuple(findings)


def _of_numbers(calibration: RigCalibration) -> list[Finding]:
    """Say which sensors have few sightings that take part."""
    findings = []
    for sensor in calibration.sensors:
        if sensor.sightings < ENOUGH:
            text = f"{sensor.sightings} sightings of '{sensor.name}' take part; {ENOUGH} are wanted, turned freely"
            findings.append(Finding(text, sensor.sightings < FEWEST))
    return findings


def _of_pairs(calibration: RigCalibration) -> list[Finding]:
    base = calibration.names[0]
    findings = []
    for name in calibration.names[1:]:
        worst = calibration.directions(base, name)[0]
        if worst.sigma_m > LOOSE:
            findings.append(Finding(f"'{name}' against '{base}' is hardly known: {worst.text} (sd)", True))
    return findings


def _of_rings(calibration: RigCalibration) -> list[Finding]:
    """Say which LiDARs' rings are off by far more than their sensor files let expect."""
    findings = []
    for sensor in calibration.sensors:
        for kind in dict.fromkeys(ring.kind for ring in sensor.rings):
            square, rings = _square([ring for ring in sensor.rings if ring.kind == kind])
            if rings >= 3 and square > FOREIGN:
                text = (
                    f"errors of {kind} of '{sensor.name}' are {np.sqrt(square):.1f} times as large as its sensor file "
                    "lets expect: is it the file of this model?"
                )
                findings.append(Finding(text, square > FOREIGN**2))
    return findings


def _square(rings: Sequence[RingError]) -> tuple[float, int]:
    """Mean of the squares of errors that the session tells, their own uncertainty taken off, and their number."""
    known = [ring for ring in rings if ring.sigma < 0.7]
    return (float(np.mean([ring.value**2 for ring in known])) if known else 0.0), len(known)


def check_sensors(read: Read, where: str) -> None:
    """Raise if a sensor saw no target at all.

    Raises:
        EstimationError: names it, and says why its first view shows none.
    """
    seeing = {sighting.sensor for sighting in read.sightings}
    for name in read.sensors:
        if name not in seeing:
            why = next((text for sensor, _, text in read.problems if sensor == name), "no view is of it")
            raise EstimationError(f"{where}: '{name}' saw no target: {why}")


def check_numbers(sightings: Sequence[Sighting], where: str) -> None:
    """Raise if there is one placement only, or if a sensor saw what moves at other times than all others.

    Raises:
        EstimationError: one placement, or none; or stamps that never meet.
    """
    placements = dict.fromkeys((s.placement, s.moment) for s in sightings)
    if len(placements) < 2:
        seen = f"one placement only ({sightings[0].file})" if sightings else "no target seen"
        raise EstimationError(f"{where}: {seen}; a rig calibration needs two at least, and ten to be trusted")
    times: dict[str, list[float]] = {}
    for sighting in sightings:
        if sighting.moving and sighting.time is not None:
            times.setdefault(sighting.sensor, []).append(sighting.time)
    for name, own in times.items():
        others = [time for other, found in times.items() if other != name for time in found]
        if others and (min(own) > max(others) or max(own) < min(others)):
            raise EstimationError(
                f"{where}: the stamps of '{name}' run from {min(own):.3f} to {max(own):.3f} s, those of others from "
                f"{min(others):.3f} to {max(others):.3f} s: of another clock?"
            )


def _of_targets(sightings: Sequence[Sighting]) -> list[Finding]:
    """Say that scans do not fit their targets, where many do not; and which target's file is of another size.

    Args:
        sightings: those that take part.
    """
    scans = [(s.target, s.seen) for s in sightings if isinstance(s.seen, TargetInScan)]
    findings = of_doubts([seen.doubt for _, seen in scans])
    if findings:
        targets = {target.name: target for target, _ in scans}
        texts = [wrong_size([seen.own for of, seen in scans if of.name == name], one) for name, one in targets.items()]
        findings += [Finding(text, True) for text in texts if text]
    return findings


def middle_of(sightings: Sequence[Sighting], T_base_sensor: Mapping[str, Floats]) -> Floats:
    """Return the mean distance of targets ahead of where most of them are (3,), metres, the base's frame.

    Targets all around have their mean near the sensors themselves: then the nearest to it that is as far as they are.
    """
    centres = np.array([(T_base_sensor[s.sensor] @ s.pose)[:3, 3] for s in sightings])
    mean, distance = centres.mean(axis=0), float(np.median(np.linalg.norm(centres, axis=1)))
    length = float(np.linalg.norm(mean))
    return np.asarray(mean if length > 0.5 * distance else mean * distance / max(length, 1e-9))
