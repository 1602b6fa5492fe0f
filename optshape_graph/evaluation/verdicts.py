"""Verdicts: what a result means, in one sentence that a technician can act on, and what to do next.

They are made from a result's plain form (`to_dict`, or its JSON file), so that a command and a report agree.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError

Level = Literal["Good", "Usable with care", "Not usable"]

SPARSE = 5
"""Fewer scans or views are too few to check the result."""

FEW_RETURNS = 30
"""With fewer returns on a target, the first advice is to get more."""

TURNED = 45.0
"""A pose with a larger error, degrees, is a different one."""

MOSTLY = 0.9
"""Share of a cell's scans that should be ok."""

TOO_SURE = 1.25
"""Covariances count as too small if the normalised error squared exceeds this, per degree of freedom."""

LOOK_AT = {
    "surface": "whether the target is flat",
    "raised frame": "the frame around the target",
    "mixed ends": "what touches the target's outline",
    "off the plane": "what else is among the returns",
    "in front": "what stands before the target",
    "two sheets": "whether anything moved",
    "edges": "whether this is the target's shape, and nothing moved",
    "strain": "whether anything moved, and the target is built as drawn",
    "size": "the target's size",
    "run of ends": "what hides a part of the target",
    "cut": "how the returns were cut out",
    "cut short": "how the returns were cut out",
    "missing side": "how the returns were cut out",
    "missing rings": "how the returns were cut out",
    "outside": "what else is among the returns",
    "frame": "whether the points are in the sensor's own frame",
    "mirrored": "how the target hangs",
}
"""What to look at first, by the kind of a fit's flag."""

OUTSTANDING = 3.0
"""A scan is named if its error is so many times the median."""


@dataclass(frozen=True)
class Verdict:
    """What a result means.

    Attributes:
        level: whether to use it.
        sentence: the reason, with numbers.
        advice: what to do next, most useful first; may be empty.
    """

    level: Level
    sentence: str
    advice: tuple[str, ...] = ()

    @property
    def line(self) -> str:
        """Level, reason and first advice in one line."""
        return f"{self.level}: {self.sentence}" + (f"; {self.advice[0]}" if self.advice else "")


def verdict_of(document: Mapping[str, Any]) -> Verdict:
    """Return the verdict on a result.

    Args:
        document: what `optshape estimate`, `detect`, `calibrate`, `map`, `evaluate` or `design choose` writes as JSON.

    Raises:
        InputError: another form.
    """
    kind = kind_of(document)
    if kind not in _JUDGES:
        raise InputError(f"'{document.get('schema')}': expected the result of {', '.join(JUDGED)}")
    return _JUDGES[kind](document)


def kind_of(document: Mapping[str, Any]) -> str:
    """Return KIND from a document's schema, `optshape/KIND/1`."""
    return str(document.get("schema", "")).removeprefix("optshape/").partition("/")[0]


def _counted(count: int, one: str, more: str = "") -> str:
    return f"{count} {one if count == 1 else more or one + 's'}"


def _estimate(document: Mapping[str, Any]) -> Verdict:
    scans = document["scans"]
    ok = [scan for scan in scans if scan["status"] == "ok"]
    sizes = _sizes(ok)
    reasons = Counter(
        str(flag["kind"])
        for scan in scans
        for flag in (scan.get("fit") or {}).get("flags", ())
        if scan["status"] == "doubtful"
    )
    advice = []
    others = sum("not this target" in (scan.get("reason") or "") for scan in scans if scan["status"] == "failed")
    if others:
        advice.append(f"check --target: the returns of {_counted(others, 'scan')} do not fit it")
    if reasons:
        kind, count = reasons.most_common(1)[0]
        doubtful = _counted(count, "scan is doubtful", "scans are doubtful")
        advice.append(f"look at {LOOK_AT.get(kind, repr(kind))} first: {doubtful} for it ('{kind}')")
    counted = [scan for scan in scans if scan["status"] != "ok" and scan["n_returns"] is not None]
    few = [scan for scan in counted if scan["n_returns"] < FEW_RETURNS]
    if few:
        have = _counted(len(few), "scan has", "scans have")
        advice.append(f"{have} fewer than {FEW_RETURNS} returns: nearer, or a larger target")
    if any(scan["status"] == "ambiguous" for scan in scans):
        advice.append("where a scan is ambiguous take a nearer one, a less symmetric target, or add scans of the place")
    return _of_share(
        len(ok), len(scans), f"{'scan has' if len(scans) == 1 else 'scans have'} a pose to be relied on", sizes, advice
    )


def _detect(document: Mapping[str, Any]) -> Verdict:
    scans = document["scans"]
    found = [target for scan in scans for target in scan.get("targets", ())]
    ok = [target for target in found if target["status"] == "ok"]
    empty = [scan["scan"] for scan in scans if not scan.get("targets")]
    advice = []
    if empty:
        why = Counter(
            str(rejected.get("reason", "")).split(":")[0]
            for scan in scans
            if not scan.get("targets")
            for rejected in scan.get("rejected", ())
        )
        said = f" (mostly rejected: {why.most_common(1)[0][0]})" if why else ""
        advice.append(f"nothing was found in {len(empty)} of {len(scans)} scans{said}")
    if len(ok) < len(found):
        doubtful = _counted(
            len(found) - len(ok), "target is doubtful: its reason is", "targets are doubtful: their reasons are"
        )
        advice.append(f"{doubtful} in the table")
    if not found:
        return Verdict("Not usable", f"no target was found in {_counted(len(scans), 'scan')}", tuple(advice))
    return _of_share(
        len(ok),
        len(found),
        f"targets found in {_counted(len(scans), 'scan')} are to be relied on",
        _sizes(ok),
        advice,
    )


def _mocap(document: Mapping[str, Any]) -> Verdict:
    mean, count = document["mean"], len(document["scans"])
    sentence = (
        f"{count} scans agree with the markers to {1e3 * mean['e_t_m']:.1f} mm and {mean['e_r_deg']:.2f} deg, each "
        "compared in a frame fitted to the others"
    )
    advice = [f"{item['scan']} was left out: {item['reason']}" for item in document.get("left_out", ())]
    if count < SPARSE:
        advice.insert(0, f"take at least {SPARSE} scans, at several ranges and tilts")
    level = _level(str(document.get("verdict", "to be trusted")), document.get("warnings", ()), count)
    return Verdict(level, sentence, (*advice, *map(str, document.get("warnings", ()))))


def _sensor(document: Mapping[str, Any]) -> Verdict:
    rings = [ring for ring in document["rings"] if ring["before_mm"] is not None]
    before, after = (float(np.sqrt(np.mean([ring[key] ** 2 for ring in rings]))) for key in ("before_mm", "after_mm"))
    sentence = (
        f"{len(document['placements'])} placements: rings are {after:.1f} mm off boards that took no part, "
        f"{before:.1f} mm by the given file"
    )
    level = _level(str(document["verdict"]), document["warnings"], len(document["placements"]))
    return Verdict(level, sentence, tuple(map(str, document["warnings"])))


def _camera(document: Mapping[str, Any]) -> Verdict:
    left_out = document["cross_validation"]
    used = [view for view in document["views"] if view["used"]]
    ranges = _ranges(used)
    level = _level(str(document.get("verdict", "to be trusted")), document.get("warnings", ()), len(used))
    sentence = (
        f"{len(used)} of {len(document['views'])} views {'take part' if level == 'Not usable' else 'agree'}, "
        f"{left_out['mean_centre_error_mm']:.1f} mm and "
        f"{left_out['mean_normal_error_deg']:.2f} deg on views left out{ranges}"
    )
    advice = []
    directions = document.get("directions") or [{}]
    if directions[0].get("direction"):
        sentence += f"; least known: {directions[0]['direction']} ({1e3 * directions[0]['sigma_m']:.1f} mm sd)"
    place = document.get("next_placement")
    if place:
        x, y, z = (row[3] for row in place["T_lidar_target"][:3])
        advice.append(
            f"add a view with the target at ({x:.1f}, {y:.1f}, {z:.1f}) m, turned {place['yaw_deg']:+.0f} and tilted "
            f"{place['pitch_deg']:+.0f} deg"
        )
    advice += [f"{view['scan']} was not used: {view['reason']}" for view in document["views"] if not view["used"]]
    return Verdict(level, sentence, (*advice, *map(str, document.get("warnings", ()))))


def _rig(document: Mapping[str, Any]) -> Verdict:
    pairs, warnings = document["transforms"], [str(warning) for warning in document["warnings"]]
    both = [np.array(pair[key]) for pair in pairs for key in ("covariance", "covariance_T_b_a") if key in pair]
    degrees, metres = (max(_largest(one[k : k + 3, k : k + 3]) for one in both) for k in (0, 3))
    placements = len({one["placement"] for one in document.get("sightings", ()) if one["used"]})
    sentence = (
        f"{_counted(len(pairs), 'pair')} of sensors by {_counted(placements, 'placement')}, known to "
        f"{1e3 * metres:.1f} mm and {np.degrees(degrees):.3f} deg (largest standard deviation)"
    )
    return Verdict(_level(document["verdict"], warnings, placements), sentence, tuple(warnings))


def _largest(covariance: np.ndarray) -> float:
    """The largest standard deviation along any direction."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))


def _map(document: Mapping[str, Any]) -> Verdict:
    landmarks = document["landmarks"]
    if not landmarks:
        return Verdict("Not usable", "the map has no landmark", ("detect the targets in single scans first",))
    sd = [1e3 * np.sqrt(np.diag(np.array(one["covariance"]))[3:].max()) for one in landmarks if "covariance" in one]
    once = [one["id"] for one in landmarks if one.get("observations", 2) == 1]
    known = (
        f", known to {np.median(sd):.1f} mm (median of the largest standard deviation), the worst to {max(sd):.1f} mm"
    )
    poses = len(document.get("trajectory", ()))
    sentence = f"{_counted(len(landmarks), 'landmark')}{known if sd else ''}; {poses} poses of the trajectory"
    advice = (
        [
            f"{_counted(len(once), 'landmark was', 'landmarks were')} seen in one scan only ({', '.join(once[:3])}): "
            "drive past again"
        ]
        if once
        else []
    )
    problems = [str(problem) for problem in (document.get("report") or {}).get("problems", ())]
    warnings = [str(warning) for warning in (document.get("report") or {}).get("warnings", ())]
    level: Level = "Not usable" if problems else "Usable with care" if once or warnings else "Good"
    return Verdict(level, sentence, (*problems, *warnings, *advice))


def _choice(document: Mapping[str, Any]) -> Verdict:
    chosen = document["chosen"]
    sentence = (
        f"{chosen['target']} of {chosen['area_m2']:.2f} m2 does it at {document['range_m']:g} m: {chosen['ok']} of "
        f"{document['scans']} simulated scans ok, 95 % within {chosen['e_r_95_deg']:.2f} deg and "
        f"{1e3 * chosen['e_t_95_m']:.0f} mm"
    )
    height = chosen["centre_above_sensor_m"]
    side = "above" if height >= 0 else "below"
    return Verdict("Good", sentence, (f"hang its origin {abs(height):.2f} m {side} the sensor",))


def _simulation(document: Mapping[str, Any]) -> Verdict:
    cells = [cell for cell in document["cells"] if cell["method"] == "global"] or document["cells"]
    count, ok = (sum(cell[name] for cell in cells) for name in ("scans", "ok"))
    turned = [cell for cell in cells if (cell["worst_ok_e_r_deg"] or 0.0) > TURNED]
    given = [cell for cell in cells if cell["nees_per_dof"] is not None]
    nees = np.average([cell["nees_per_dof"] for cell in given], weights=[cell["scans"] for cell in given] or None)
    worst = min(cells, key=lambda cell: cell["ok"] / cell["scans"])
    sentence = (
        f"{ok} of {count} scans of '{document['target']}' end ok; normalised errors squared are {nees:.2f} per degree "
        "of freedom, 1 where covariances are right"
    )
    advice = []
    if turned:
        places = ", ".join(f"{cell['range_m']:g} m {cell['orientation']}" for cell in turned[:3])
        advice.append(f"poses that are ok are more than {TURNED:g} deg off at {places}: do not rely on them there")
    if worst["ok"] < MOSTLY * worst["scans"]:
        advice.append(
            f"at {worst['range_m']:g} m, {worst['orientation']}, {worst['ok']} of {worst['scans']} are ok: a larger "
            "target, or a nearer place"
        )
    if nees > TOO_SURE:
        advice.append("covariances are too small: widen them by that factor")
    level: Level = "Not usable" if turned or ok < count / 2 else "Usable with care" if advice else "Good"
    return Verdict(level, sentence, tuple(advice))


def _mocap_evaluation(document: Mapping[str, Any]) -> Verdict:
    scans, mean = document["scans"], document["mean"]
    left_out = [f"{item['scan']} was left out: {item['reason']}" for item in document["left_out"]]
    if mean is None:
        return Verdict("Not usable", "no scan could be compared with its markers", tuple(left_out))
    sentence = (
        f"{len(scans)} scans agree with the markers to {1e3 * mean['rmse_m']:.1f} mm (vertices), "
        f"{1e3 * mean['e_t_m']:.1f} mm and {mean['e_r_deg']:.2f} deg in the mean, each compared in a frame fitted to "
        "the others"
    )
    other = document["reference_mean"]
    if other is not None:
        sentence += (
            f"; the reference to {1e3 * other['rmse_m']:.1f} mm, {1e3 * other['e_t_m']:.1f} mm and "
            f"{other['e_r_deg']:.2f} deg in the same way"
        )
    worst = max(scans, key=lambda scan: scan["rmse_m"])
    times = worst["rmse_m"] / float(np.median([scan["rmse_m"] for scan in scans]))
    advice = []
    if times > OUTSTANDING:
        advice.append(
            f"look at {worst['session']}/{worst['scan']} first: {1e3 * worst['rmse_m']:.0f} mm, {times:.1f} times the "
            f"median, at {worst['distance_m']:.1f} m"
        )
    if len(scans) < SPARSE:
        advice.append(f"take at least {SPARSE} scans, at several ranges and tilts")
    level: Level = "Usable with care" if advice or left_out else "Good"
    return Verdict(level, sentence, (*advice, *left_out))


def _of_share(good: int, count: int, what: str, sizes: str, advice: list[str]) -> Verdict:
    level: Level = "Good" if count and good == count else "Usable with care" if good > count / 2 else "Not usable"
    return Verdict(level, f"{good} of {count} {what}{sizes}", tuple(advice))


def _level(said: str, warnings: Any, count: int) -> Level:
    if "not to be trusted" in said:
        return "Not usable"
    return "Usable with care" if len(warnings) or count < SPARSE else "Good"


def _sizes(entries: list[Any]) -> str:
    """Return ranges and standard deviations of poses in words; empty without poses."""
    if not entries:
        return ""
    T, C = (np.array([entry[key] for entry in entries]) for key in ("T_lidar_target", "covariance"))
    distances = np.linalg.norm(T[:, :3, 3], axis=1)
    variances = np.diagonal(C, axis1=1, axis2=2)
    return (
        f", at {_span(distances, 1)} m; standard deviations of up to "
        f"{1e3 * np.sqrt(variances[:, 3:].max()):.1f} mm and {np.degrees(np.sqrt(variances[:, :3].max())):.2f} deg"
    )


def _span(values: Sequence[float] | Floats, digits: int) -> str:
    """Return the smallest and the largest of values, or one number where they look the same."""
    return " to ".join(dict.fromkeys(f"{value:.{digits}f}" for value in (min(values), max(values))))


def _ranges(views: list[Any]) -> str:
    distances = [view["distance_m"] for view in views if view.get("distance_m")]
    return f"; range {_span(distances, 0)} m covered" if distances else ""


_JUDGES: dict[str, Callable[[Mapping[str, Any]], Verdict]] = {
    "estimate": _estimate,
    "detect": _detect,
    "mocap": _mocap,
    "sensor-calibration": _sensor,
    "camera-calibration": _camera,
    "rig": _rig,
    "map": _map,
    "design-choice": _choice,
    "simulation-evaluation": _simulation,
    "mocap-evaluation": _mocap_evaluation,
}

JUDGED = tuple(sorted(_JUDGES))
"""Forms for which there are verdicts."""
