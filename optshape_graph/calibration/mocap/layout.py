"""Markers among themselves and against the target's vertices: what can be told without any scan.

The markers are rigid to the target, so the distances between them are the same in all frames: a frame in which they
are not has a marker out of place, or names that were mixed up. And they are near the vertices, so their layout has
nearly the target's shape and size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.calibration.mocap.comparison import MIN_MARKERS, align
from optshape_graph.calibration.verdict import Finding
from optshape_graph.errors import InputError
from optshape_graph.se3 import apply
from optshape_graph.target import Target

TOLERANCE_M = 0.01
"""By how much a distance between two markers may differ between frames: ten standard deviations of a coordinate."""

FEW_ENOUGH = 5
"""Vertices up to which all renamings are tried; of more, rotations, reversals and swaps of two."""

SIZES = (0.7, 1.4)
"""Sizes of a layout, in sizes of the target, beyond which the unit of length is not the one that was read."""

UNITS = {"millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "feet": 0.3048}
"""Metres per unit of length."""

LARGER = 2 / 3
"""Difference in size between layout and target, at the target's corners, that is too much; in the layout's prior."""


@dataclass(frozen=True, eq=False, repr=False)
class CheckedMarkers(Value):
    """The markers of a session, mended.

    Attributes:
        frames: (n, 3) position of the marker of each vertex by frame, metres, motion-capture frame; NaN: not seen, or
            left out.
        left_out: reasons by frame of which too little is left.
        doubted: indices of the vertices whose marker alone may be out of place in all frames; the scans tell which.
        findings: what was mended, left out or looks wrong.
    """

    frames: dict[int, Floats]
    left_out: dict[int, str]
    doubted: tuple[int, ...]
    findings: tuple[Finding, ...]


def check_markers(
    target: Target, frames: Mapping[int, Floats], names: Sequence[str], layout_prior: float, where: str
) -> CheckedMarkers:
    """Check and mend the markers of all frames of a session.

    Args:
        target: with n vertices.
        frames: (n, 3) position of the marker of each vertex by frame, metres; NaN: not seen.
        names: the markers' names, vertex by vertex.
        layout_prior: standard deviation of a marker's place about its vertex along each axis, metres.
        where: the session's file, for messages.

    Raises:
        InputError: the layout is so large or small that the unit of length must be another.
    """
    _check_unit(target, frames, where)
    mended, left_out, findings = _mend_frames(target, frames, names)
    places = _layout(mended)
    if np.isfinite(places).all(axis=1).sum() < MIN_MARKERS:
        return CheckedMarkers(mended, left_out, (), tuple(findings))
    order, more = _renamed(target, places, names)
    mended, places = {number: frame[order] for number, frame in mended.items()}, places[order]
    findings += more
    errors, rms = fit_error(target, places)
    of_size = _of_size(target, places, layout_prior)
    if rms < layout_prior or (of_size and fit_error(target, places / _size(target, places))[1] < layout_prior):
        return CheckedMarkers(mended, left_out, (), (*findings, *of_size))
    worst = int(np.nanargmax(errors))
    text = (
        f"the markers are {rms:.3f} m (rms) from the vertices of target '{target.name}', that of vertex {worst} "
        f"{errors[worst]:.3f} m; expected less than {layout_prior:.3f}"
    )
    doubted = _doubted(target, places, layout_prior)
    findings += [Finding(text, True), *([] if doubted else of_size)]
    return CheckedMarkers(mended, left_out, doubted, tuple(findings))


def marker_out_of_place(target: Target, frames: Sequence[Floats], k: int) -> float:
    """Return how far the marker of vertex k is from it, metres, by the other markers; the median over frames (n, 3)."""
    return float(np.median([_distance_from(frame, target.vertices, k) for frame in frames]))


def fit_error(target: Target, places: Floats) -> tuple[Floats, float]:
    """Return the distances (n,), metres, of markers from their vertices after a rigid fit, and their rms; NaN: none."""
    seen = np.isfinite(places).all(axis=1)
    T = align(target.vertices[seen], places[seen])
    errors = np.linalg.norm(apply(T, places) - target.vertices, axis=1)
    return errors, float(np.sqrt(np.mean(errors[seen] ** 2)))


def _check_unit(target: Target, frames: Mapping[int, Floats], where: str) -> None:
    """Refuse a layout of another size than the target's; names don't matter for it."""
    found = np.concatenate([_distances(frame)[np.triu_indices(len(target), 1)] for frame in frames.values()])
    found = found[np.isfinite(found)]
    if not len(found):
        return
    expected = _distances(target.vertices)[np.triu_indices(len(target), 1)]
    ratio = float(np.median(found) / np.median(expected))
    if SIZES[0] < ratio < SIZES[1]:
        return
    unit = next((name for name, metres in UNITS.items() if SIZES[0] < ratio * metres < SIZES[1]), "")
    other = next((name for name, metres in UNITS.items() if SIZES[0] < ratio / metres < SIZES[1]), "")
    hint = ": is the unit right ('units'), and the target?"
    if unit or other:
        hint = f": are they in {unit}, read as metres?" if unit else f": are they in metres, read as {other}?"
    raise InputError(
        f"{where}: the markers are {ratio:.3g} times as far apart as the vertices of target '{target.name}' "
        f"({np.median(found):.3g} m, expected about {np.median(expected):.3g} m){hint}"
    )


def _mend_frames(
    target: Target, frames: Mapping[int, Floats], names: Sequence[str]
) -> tuple[dict[int, Floats], dict[int, str], list[Finding]]:
    """Compare each frame's distances with those of most frames: rename or leave out what is out of place."""
    stack = np.array([_distances(frame) for frame in frames.values()])
    if len(stack) < 3:  # with two, the target's own distances say which is right
        stack = np.concatenate([stack, _distances(target.vertices)[None]])
    usual = _median(stack)
    mended = {number: np.array(frame, dtype=float) for number, frame in frames.items()}
    left_out: dict[int, str] = {}
    findings: list[Finding] = []
    for number, frame in mended.items():
        tolerance = TOLERANCE_M if len(frames) > 2 else 5 * TOLERANCE_M
        if np.isfinite(frame).all(axis=1).sum() < MIN_MARKERS or _fits(frame, usual, tolerance):
            continue
        renaming = min(
            (order for order in _renamings(len(frame)) if _fits(frame[list(order)], usual, tolerance)),
            key=lambda order: float(np.nanmax(np.abs(_distances(frame[list(order)]) - usual))), default=None,
        )  # fmt: skip
        if renaming is not None:
            mended[number] = frame[list(renaming)]
            findings.append(Finding(f"{_in_words(renaming, names)} in frame {number}; they were put right", False))
            continue
        without = [k for k in range(len(frame)) if _fits(np.delete(frame, k, 0), _without(usual, k), tolerance)]
        without = [k for k in without if np.isfinite(frame[k]).all()]
        if not without:
            left_out[number] = f"the markers of frame {number} are not as far apart as in the other frames"
            mended[number] = np.full_like(frame, np.nan)
            continue
        k = min(
            without, key=lambda k: float(np.nanmax(np.abs(_distances(np.delete(frame, k, 0)) - _without(usual, k))))
        )
        others = [other for name, other in frames.items() if name != number] or [target.vertices]
        off = min(_distance_from(frame, other, k) for other in others)
        mended[number][k] = np.nan
        findings.append(Finding(
            f"{names[k]} is {off:.3f} m from where the other markers of frame {number} put it; it was left out", False
        ))  # fmt: skip
    return mended, left_out, findings


def _renamed(target: Target, places: Floats, names: Sequence[str]) -> tuple[list[int], list[Finding]]:
    """Return, for each vertex, which place is near it, where the names of all frames were mixed up."""
    same = list(range(len(places)))
    error = fit_error(target, places)[1]
    found = [(fit_error(target, places[list(order)])[1], order) for order in _renamings(len(places))]
    best, order = min(found, default=(np.inf, ()))
    if best > error / 2 or error - best < TOLERANCE_M:
        return same, []
    text = (
        f"{_in_words(order, names)} in all frames: as named, the markers are {error:.3f} m (rms) from their vertices, "
        f"so {best:.3f} m; they were put right"
    )
    return list(order), [Finding(text, False)]


def _doubted(target: Target, places: Floats, layout_prior: float) -> tuple[int, ...]:
    """Return the markers without which the others lie as near to their vertices as they should."""
    seen = np.flatnonzero(np.isfinite(places).all(axis=1))
    if len(seen) <= MIN_MARKERS:
        return ()
    without = [np.where(np.arange(len(places))[:, None] == k, np.nan, places) for k in seen]
    return tuple(int(k) for k, rest in zip(seen, without, strict=True) if fit_error(target, rest)[1] < layout_prior)


def _of_size(target: Target, places: Floats, layout_prior: float) -> list[Finding]:
    expected = float(np.sqrt((target.polygon**2).sum(axis=1).mean()))
    found = expected * _size(target, places)
    if abs(found - expected) < LARGER * layout_prior:
        return []
    size = "larger" if found > expected else "smaller"
    text = (
        f"the markers are {100 * abs(found / expected - 1):.1f} % {size} than target '{target.name}' "
        f"({1e3 * abs(found - expected):.0f} mm at its corners): is the motion capture's scale right, and the "
        f"target's file?"
    )
    return [Finding(text, True)]


def _size(target: Target, places: Floats) -> float:
    """Return the size of the layout in sizes of the target, by the markers that are seen."""
    seen = np.isfinite(places).all(axis=1)
    spreads = [points[seen] - points[seen].mean(axis=0) for points in (places, target.vertices)]
    return float(np.sqrt((spreads[0] ** 2).sum() / (spreads[1] ** 2).sum()))


def _layout(frames: Mapping[int, Floats]) -> Floats:
    """Return the markers' mean places (n, 3), metres, in the frame in which most are seen; NaN: never seen."""
    ordered = sorted(frames.values(), key=lambda frame: -int(np.isfinite(frame).all(axis=1).sum()))
    places = np.array(ordered[0])
    moved = [places]
    for frame in ordered[1:]:
        common = np.isfinite(frame).all(axis=1) & np.isfinite(places).all(axis=1)
        if common.sum() >= MIN_MARKERS:
            T = align(places[common], frame[common])
            moved.append(apply(T, frame))
    return _median(np.array(moved))


def _distance_from(frame: Floats, other: Floats, k: int) -> float:
    """Return how far marker k of a frame is from where another frame has it, laid over it by the other markers."""
    common = np.asarray(np.isfinite(np.hstack([frame, other])).all(axis=1))
    if not common[k] or common.sum() <= MIN_MARKERS:
        return np.inf
    common = common & (np.arange(len(frame)) != k)
    T = align(frame[common], other[common])
    return float(np.linalg.norm(frame[k] - apply(T, other)[k]))


def _distances(points: Floats) -> Floats:
    """(n, n) between points (n, 3)."""
    return np.asarray(np.linalg.norm(points[:, None] - points[None], axis=2))


def _median(stack: Floats) -> Floats:
    """Median over the first axis of what is not NaN; NaN where all is."""
    known = np.isfinite(stack).any(axis=0)
    return np.where(known, np.nanmedian(np.where(known, stack, 0.0), axis=0), np.nan)


def _worst(points: Floats, usual: Floats) -> float:
    """Return by how much the distances between points (n, 3) differ from the usual ones (n, n) at most, metres."""
    return float(np.nanmax(np.abs(_distances(points) - usual)))


def _fits(points: Floats, usual: Floats, tolerance: float) -> bool:
    seen = np.isfinite(points).all(axis=1)
    return bool(seen.sum() >= MIN_MARKERS and _worst(points, usual) <= tolerance)


def _without(matrix: Floats, k: int) -> Floats:
    return np.delete(np.delete(matrix, k, 0), k, 1)


def _renamings(n: int) -> Iterator[tuple[int, ...]]:
    """Yield the orders of n things but their own: swaps of two first, then rotations and reversals, then the rest."""
    own = tuple(range(n))
    swaps = []
    for a, b in combinations(own, 2):
        order = list(own)
        order[a], order[b] = b, a
        swaps.append(tuple(order))
    turns = [own[k:] + own[:k] for k in range(n)]
    likely = dict.fromkeys([*swaps, *turns, *(turn[::-1] for turn in turns)])
    yield from (order for order in likely if order != own)
    if n <= FEW_ENOUGH:
        yield from (order for order in permutations(own) if order not in likely)


def _in_words(order: Sequence[int], names: Sequence[str]) -> str:
    """Say what an order, (for each vertex the name at it), makes of the names."""
    moved = [k for k, other in enumerate(order) if k != other]
    if len(moved) == 2:
        return f"{names[moved[0]]} and {names[moved[1]]} look swapped"
    n = len(order)
    shift = order[0]
    if all(order[k] == (k + shift) % n for k in range(n)):
        places = min(shift, n - shift)
        return f"the markers' names look shifted by {places} corner{'s' if places > 1 else ''}"
    if all(order[k] == (order[0] - k) % n for k in range(n)):
        return "the markers' names look reversed, clockwise for counter-clockwise,"
    return "the markers' names look mixed up (" + ", ".join(f"{names[order[k]]} is at vertex {k}" for k in moved) + ")"
