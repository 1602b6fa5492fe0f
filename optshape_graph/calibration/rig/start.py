"""A start for the rig's graph, from nothing: where sensors, targets and the platform are, and how to read sightings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.connection import connected, read
from optshape_graph.calibration.consensus import CUT, TIE, TOLERANCES, distances
from optshape_graph.calibration.rig.hand_eye import Motion, hand_eye
from optshape_graph.calibration.rig.sightings import Sighting
from optshape_graph.errors import UnobservableError
from optshape_graph.se3 import inverse


@dataclass(frozen=True, eq=False, repr=False)
class Start(Value):
    """Where the graph starts.

    Attributes:
        sightings: those that take part, each read in the way that agrees best.
        alone: those of placements that no other sensor saw, which say nothing.
        T_base_sensor: (4, 4) of every sensor.
        T_world_base: (4, 4) of the platform at every moment; empty where it stands still.
        T_world_target: (4, 4) of every placement.
        strangers: numbers of the sightings that do not agree.
    """

    sightings: tuple[Sighting, ...]
    alone: tuple[Sighting, ...]
    T_base_sensor: Mapping[str, Floats]
    T_world_base: Mapping[int, Floats]
    T_world_target: Mapping[str, Floats]
    strangers: frozenset[int]


def find_start(
    sightings: Sequence[Sighting], base: str, about: Mapping[str, Floats], platform_moves: bool, needed: Sequence[str]
) -> Start:
    """Connect all sensors, and read every sighting in that light.

    Args:
        sightings: of all sensors.
        base: whose frame is the platform's.
        about: T_base_sensor (4, 4) of sensors that is known beforehand.
        platform_moves: whether the platform moves from moment to moment.
        needed: names of all sensors.

    Raises:
        EstimationError: the placements contradict each other.
        UnobservableError: nothing connects some sensor with the base, or two answers fit equally well.
    """
    T_base_sensor = connected_by(sightings, base, about, platform_moves)
    if missing := [name for name in needed if name not in T_base_sensor]:
        raise UnobservableError(_unconnected(missing, T_base_sensor, sightings, platform_moves), tuple(missing))
    if platform_moves:
        return _among_targets(sightings, T_base_sensor)
    chosen, alone, strangers = list[Sighting](), list[Sighting](), set[int]()
    T_world_target: dict[str, Floats] = {}
    for (placement, _), group in _groups(sightings, platform_moves).items():
        if len({sighting.sensor for sighting in group}) == 1:
            alone += group
            continue
        T_world_target[placement], reading = read(group, T_base_sensor)
        for sighting, number, agrees in reading:
            if not agrees:
                strangers.add(len(chosen))
            chosen.append(sighting.read_as(number))
    return Start(tuple(chosen), tuple(alone), T_base_sensor, {}, T_world_target, frozenset(strangers))


def connected_by(
    sightings: Sequence[Sighting], base: str, about: Mapping[str, Floats], platform_moves: bool
) -> dict[str, Floats]:
    """Return T_base_sensor (4, 4) of every sensor that sightings of what stands still connect with the base.

    Raises:
        EstimationError: the placements contradict each other.
        UnobservableError: two answers fit equally well.
    """
    groups = list(_groups(sightings, platform_moves).values())
    found = connected(base, groups, about)
    return _by_motion(base, sightings, groups, found) if platform_moves else found


def _groups(sightings: Sequence[Sighting], platform_moves: bool) -> dict[tuple[str, int | None], list[Sighting]]:
    """Sightings of one target in one place, by the placement, and the moment where the platform moves."""
    groups: dict[tuple[str, int | None], list[Sighting]] = {}
    for sighting in sightings:
        groups.setdefault((sighting.placement, sighting.moment if platform_moves else None), []).append(sighting)
    return groups


def _unconnected(
    missing: Sequence[str], found: Mapping[str, Floats], sightings: Sequence[Sighting], platform_moves: bool
) -> str:
    saw = {sighting.sensor for sighting in sightings}
    blind = [name for name in missing if name not in saw]
    names, others = (", ".join(f"'{name}'" for name in which) for which in (missing, found))
    why = f" ({', '.join(blind)} saw no target at all)" if blind else ""
    if platform_moves:
        how = "the motion that both saw static targets during is not enough"
    elif all(sighting.time is None for sighting in sightings):
        how = "no view has a 'stamp': those of one stamp see the same scene"
    else:
        how = (
            "views of one stamp see the same scene: are the stamps of one clock? 'platform: moving' with targets that "
            "are 'static: true' connects sensors that never see a target at once"
        )
    return f"nothing connects {names} with {others}: no target that both saw in one place{why}; {how}"


def _by_motion(
    base: str, sightings: Sequence[Sighting], groups: Sequence[Sequence[Sighting]], T_base_sensor: Mapping[str, Floats]
) -> dict[str, Floats]:
    """Add sensors by how they move among targets that stay, where none of those is in view of both at once."""
    found = dict(T_base_sensor)
    tracks = {s.sensor: motions([t for t in sightings if t.sensor == s.sensor]) for s in sightings}
    while missing := [name for name in tracks if name not in found]:
        of_base: dict[tuple[int, int], Floats] = {}
        for name, T in found.items():
            for motion in tracks.get(name, ()):
                of_base.setdefault(motion.moments, T @ motion.T_m_n @ inverse(T))
        fits = {
            name: fit.T_a_b
            for name in missing
            if (fit := hand_eye([(of_base[m.moments], m.T_m_n) for m in tracks[name] if m.moments in of_base]))
            is not None
        }
        if not fits:
            break
        found |= fits
        found = connected(base, groups, found)
    return found


def motions(sightings: Sequence[Sighting]) -> list[Motion]:
    """Return how one sensor moved between moments at which it saw a target that stays.

    Of a symmetric target the readings nearest to those of the moment before are taken.
    """
    tracks: dict[str, list[Sighting]] = {}
    for sighting in sorted(sightings, key=lambda s: s.moment):
        tracks.setdefault(sighting.placement, []).append(sighting)
    found = []
    for track in tracks.values():
        poses: list[Floats] = []
        for sighting in track:
            options = sighting.poses
            nearest = int(np.einsum("ij,kij->k", poses[-1][:3, :3], options[:, :3, :3]).argmax()) if poses else 0
            poses.append(options[nearest])
        for j in range(len(track)):
            found += [
                Motion((track[i].moment, track[j].moment), poses[i] @ inverse(poses[j]))
                for i in range(j)
                if track[i].moment != track[j].moment
            ]
    return found


def _among_targets(sightings: Sequence[Sighting], T_base_sensor: Mapping[str, Floats]) -> Start:
    """Place the platform at every moment and every target, one by the other; one moment's frame is the world.

    Next comes the moment at which placed targets tell most: by a symmetric one alone it would not be known how the
    platform is turned, and whatever else was seen then would be put in a wrong place.
    """
    T_base_target = [T_base_sensor[s.sensor] @ s.poses for s in sightings]
    moments: dict[int, list[int]] = {}
    for n in sorted(range(len(sightings)), key=lambda n: sightings[n].moment):
        moments.setdefault(sightings[n].moment, []).append(n)
    T_world_base, T_world_target = dict[int, Floats](), dict[str, Floats]()

    def told(moment: int) -> tuple[float, float]:
        ways = {sightings[n].placement: 1 / len(sightings[n].poses) for n in moments[moment]}
        return sum(one for name, one in ways.items() if name in T_world_target), sum(ways.values())

    while waiting := [moment for moment in moments if moment not in T_world_base]:
        moment = max(waiting, key=told)
        seen = [
            (T_world_target[sightings[n].placement], T_base_target[n])
            for n in moments[moment] if sightings[n].placement in T_world_target
        ]  # fmt: skip
        before = T_world_base.get(min(T_world_base, key=lambda m: (m > moment, abs(m - moment)), default=moment))
        # Without any, it is a part of its own: nothing ties it to the rest but the sensors.
        T_world_base[moment] = np.eye(4) if before is None or not seen else _where(seen, before)
        for n in moments[moment]:
            T_world_target.setdefault(sightings[n].placement, T_world_base[moment] @ T_base_target[n][0])
    chosen, strangers = list[Sighting](), set[int]()
    for n, (s, poses) in enumerate(zip(sightings, T_base_target, strict=True)):
        known, seen_at = T_world_target[s.placement], T_world_base[s.moment] @ poses
        if distances(np.eye(4), known[None, None], seen_at[None], *TOLERANCES[0])[0][0] > CUT**2:
            strangers.add(n)
        chosen.append(s.read_as(int(np.einsum("ij,kij->k", known[:3, :3], seen_at[:, :3, :3]).argmax())))
    return Start(tuple(chosen), (), T_base_sensor, T_world_base, T_world_target, frozenset(strangers))


def _where(seen: Sequence[tuple[Floats, Floats]], before: Floats) -> Floats:
    """T_world_base (4, 4) by targets, each known (4, 4) and seen in some ways (k, 4, 4): where most of them agree.

    Of places that agree alike the one is taken that is turned least from where the platform was before.
    """
    options = np.concatenate([known @ inverse(poses) for known, poses in seen])
    cost = np.zeros(len(options))
    for known, poses in seen:
        cost += [
            min(float(distances(X, known[None, None], poses[None], *TOLERANCES[0])[0][0]), CUT**2) for X in options
        ]
    alike = options[cost <= cost.min() + TIE]
    return np.asarray(alike[np.einsum("ij,kij->k", before[:3, :3], alike[:, :3, :3]).argmax()])
