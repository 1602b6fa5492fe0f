"""Which sensor's stamps are shifted against those of the others, where sightings do not agree as they are stamped."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.consensus import relative_pose
from optshape_graph.calibration.rig.hand_eye import hand_eye
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.calibration.rig.start import motions

FEWEST = 4
"""Sightings of two sensors that must agree at a shift."""

MOST_SHIFTS = 24
"""Shifts that are tried for two sensors, those that join most sightings first."""

AGREEING = {"sightings": 0.75, "motions": 0.4}
"""Share of two sensors' sightings that agree where their stamps are right; of motions fewer, for those that two views
of a symmetric target show may be of another of its vertices."""

MOST_COMPARED = 40
"""Sightings of two sensors that are compared at a shift, evenly over the session."""

NEAR = 0.25
"""Share of the least time between two views of a sensor by which stamps of one scene may differ."""

Track: TypeAlias = Mapping[tuple[str, float], Sighting]
"""One sensor's sightings by target and time."""


class Shift(NamedTuple):
    """By how much one sensor's stamps are ahead of another's.

    Attributes:
        by: seconds; or views, where there are no stamps.
        agree: number of sightings that agree on where the two sensors are, at this shift.
        of: number of sightings that it joins.
        what: they are: sightings of one target, or motions of the platform.
    """

    by: float
    agree: int
    of: int
    what: str = "sightings"


def shifted_stamps(sightings: Sequence[Sighting], platform_moves: bool = False) -> str:
    """Say which sensors' stamps are shifted, and by how much; "" where no shift explains why sightings do not agree.

    Two sensors whose sightings agree at another shift than none are not of one clock, or were paired one view off.
    Shifts add up along sensors that see the same targets; those of most sensors are taken for right.

    Args:
        sightings: of targets that stand still while they are seen.
        platform_moves: whether the platform moves from view to view, so that its motion joins sensors, too.
    """
    stamped = all(s.time is not None for s in sightings)
    if not stamped and len({(s.moment, s.sensor) for s in sightings}) == len({s.moment for s in sightings}):
        return ""  # no view says what it goes with
    tracks = _tracks(sightings, stamped)
    if len(tracks) < 2:
        return ""
    links = {
        (a, b): link
        for a, b in combinations(tracks, 2)
        for link in [
            _shift(tracks[a], tracks[b], by_sightings)
            or (_shift(tracks[a], tracks[b], by_motions) if platform_moves else None)
        ]
        if link is not None
    }
    ahead = _common(list(tracks), {pair: shift.by for pair, (shift, _) in links.items()})
    near = min(nearness(tracks[a], tracks[b]) for a, b in combinations(tracks, 2))
    groups: dict[float, list[str]] = {}
    for name, by in ahead.items():
        groups.setdefault(next((known for known in groups if abs(known - by) <= near), by), []).append(name)
    if len(groups) < 2:
        return ""
    right = max(groups.values(), key=len)
    said = []
    for by, names in groups.items():
        if names is right:
            continue
        shift, plain = max(
            (link for pair, link in links.items() if set(pair) & set(right) and set(pair) & set(names)),
            key=lambda link: link[0].agree, default=(None, None),
        )  # fmt: skip
        if shift is None or plain is None:
            continue
        what = "stamps" if stamped else "views"
        said.append(
            f"the {what} of {_listed(names)} are {_amount(by - ahead[right[0]], stamped)} those of {_listed(right)}: "
            f"{shift.agree} of {shift.of} {shift.what} agree on where the sensors are without that, "
            f"{f'{plain.agree} of {plain.of}' if plain.of else 'none'} as they are"
        )
    return "; ".join(said)


def _tracks(sightings: Sequence[Sighting], stamped: bool) -> dict[str, dict[tuple[str, float], Sighting]]:
    """Every sensor's sightings by target and time."""
    order = {moment: rank for rank, moment in enumerate(sorted({s.moment for s in sightings}))}
    tracks: dict[str, dict[tuple[str, float], Sighting]] = {}
    for s in sightings:
        time = s.time if stamped and s.time is not None else float(order[s.moment])
        tracks.setdefault(s.sensor, {}).setdefault((s.target.name, time), s)
    return tracks


def _shift(a: Track, b: Track, agreement: Callable[[Track, Track, float], Shift]) -> tuple[Shift, Shift] | None:
    """The shift of b's stamps at which the two agree, none if they do without, and how far they do; None: at none."""
    plain = agreement(a, b, 0.0)
    if _good(plain):
        return plain, plain
    apart = np.sort([t - s for target, s in a for other, t in b if agreement is by_motions or other == target])
    near, tried = nearness(a, b), list[Shift]()
    first, last = np.searchsorted(apart, apart - near), np.searchsorted(apart, apart + near, side="right")
    for number in np.lexsort([np.abs(apart), first - last]):
        if last[number] - first[number] < FEWEST or len(tried) == MOST_SHIFTS:
            break
        by = float(np.median(apart[first[number] : last[number]]))
        if all(abs(by - other.by) > near for other in tried):
            tried.append(agreement(a, b, by))
    best = max(filter(_good, tried), key=lambda shift: shift.agree, default=None)
    if best is None:
        return (plain, plain) if 0 < plain.of < FEWEST else None
    return best, plain


def _good(shift: Shift) -> bool:
    return shift.agree >= max(AGREEING[shift.what] * shift.of, FEWEST)


def nearness(a: Track, b: Track) -> float:
    """Return by how much stamps of two sensors may differ and still be of one scene."""
    gaps = [np.diff(sorted({time for _, time in track})) for track in (a, b)]
    return NEAR * float(np.min(np.concatenate(gaps), initial=1.0))


def by_sightings(a: Track, b: Track, by: float) -> Shift:
    """Return how many sightings agree on where two sensors are, b's stamps being ahead by so much."""
    near, pairs = nearness(a, b) if by else 0.0, list[tuple[Floats, Floats]]()
    for (target, time), s in a.items():
        others = [(abs(t - by - time), t) for name, t in b if name == target]
        off, t = min(others, default=(np.inf, 0.0))
        if off <= near:
            other = b[target, t]
            pairs.append((s.poses[:1] if s.relative and other.relative else s.poses, other.poses))
    if not pairs:
        return Shift(by, 0, 0)
    pairs = pairs[:: -(-len(pairs) // MOST_COMPARED)]
    found = relative_pose([one for one, _ in pairs], [other for _, other in pairs])
    return Shift(by, int(found.inlier.sum()), len(pairs))


def by_motions(a: Track, b: Track, by: float) -> Shift:
    """Return how many motions of the platform agree on where two sensors are, b's stamps being ahead by so much."""
    near = nearness(a, b) if by else 0.0
    of_a, of_b = (_motions(track) for track in (a, b))
    starts = np.array(list(of_b)).reshape(-1, 2) - by
    pairs = []
    for times, T in of_a.items():
        off = np.abs(starts - times).max(axis=1, initial=0.0)
        if len(off) and off.min() <= near:
            pairs.append((T, list(of_b.values())[int(off.argmin())]))
    found = hand_eye(pairs)
    return Shift(by, found.agree, found.of, "motions") if found else Shift(by, 0, 0, "motions")


def _motions(track: Track) -> dict[tuple[float, float], Floats]:
    """How a sensor moved (4, 4), by the times between which it did."""
    times = {sighting.moment: time for (_, time), sighting in track.items()}
    return {(times[m], times[n]): T for (m, n), T in motions(list(track.values()))}


def _common(names: Sequence[str], links: Mapping[tuple[str, str], float]) -> dict[str, float]:
    """By how much each sensor's stamps are ahead of the first's, as far as links reach."""
    ahead = {names[0]: 0.0}
    for _ in names:
        for (a, b), by in links.items():
            if a in ahead:
                ahead.setdefault(b, ahead[a] + by)
            elif b in ahead:
                ahead.setdefault(a, ahead[b] - by)
    return ahead


def _amount(by: float, stamped: bool) -> str:
    size = f"{abs(by):.9g} s" if stamped else f"{abs(by):g} place{'s' if abs(by) > 1 else ''}"
    return f"{size} {'ahead of' if by > 0 else 'behind'}"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
