"""Markers over time, as a motion-capture system recorded them."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError

LARGEST_BAD_SHARE = 0.1
"""Share of frames that may be out of order; they are left out and counted."""


OUTPUTS = "output of a model, no marker"
UNLABELLED = "marker without a label"
REPEATED = "marker of a name that is there already"
LATE = "frame no later than the one before"
"""Reasons why a part of a file is not read."""


log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, repr=False)
class MocapRecording(Value):
    """Positions of markers over time.

    Attributes:
        times: (F,) seconds since the capture began, increasing; of the capture system's own clock.
        markers: M names, all different.
        positions: (F, M, 3) metres, motion-capture frame; NaN where a marker was not seen.
        rate: frames per second.
        name: where it came from, for messages.
        passed_over: number of markers and frames in the file that were not read, by reason.

    Raises:
        InputError: shapes that do not fit, names that repeat, times that do not increase, infinite positions.
    """

    times: Floats
    markers: tuple[str, ...]
    positions: Floats
    rate: float
    name: str = "motion capture"
    passed_over: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        times, positions = frozen(self.times), frozen(self.positions)
        if positions.shape != (len(times), len(self.markers), 3):
            raise InputError(
                f"{self.name}: {len(times)} frames and {len(self.markers)} markers, "
                f"but positions of shape {positions.shape}"
            )
        if not len(times) or not self.markers:
            raise InputError(f"{self.name}: {len(times)} frames of {len(self.markers)} markers: nothing was captured")
        if repeated := [marker for marker, times in Counter(self.markers).items() if times > 1]:
            raise InputError(f"{self.name}: several markers are called {min(repeated)!r}")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InputError(f"{self.name}: rate {self.rate} Hz is not a positive number")
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(f"{self.name}: times of frames do not increase")
        gaps = np.isnan(positions).any(axis=2)
        if np.isinf(positions).any():
            raise InputError(f"{self.name}: a position is infinite")
        positions = np.where(gaps[:, :, None], np.nan, positions)
        positions.setflags(write=False)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)

    @property
    def seen(self) -> np.ndarray:
        """(F, M) whether a marker was seen in a frame."""
        return np.isfinite(self.positions[:, :, 0])

    def select(self, markers: Sequence[str]) -> MocapRecording:
        """Return the recording of some markers.

        Raises:
            InputError: one of them is not there.
        """
        column = {marker: k for k, marker in enumerate(self.markers)}
        if missing := [marker for marker in markers if marker not in column]:
            raise InputError(f"{self.name}: no marker {missing[0]!r}; it has {', '.join(self.markers)}")
        columns = [column[marker] for marker in markers]
        return replace(self, markers=tuple(markers), positions=self.positions[:, columns])

    def at(self, times: Floats) -> Floats:
        """(N, M, 3) positions, metres, at other times (N,), seconds, between the frames on either side; NaN at gaps.

        Two frames further apart than two and a half periods are a gap of all markers.
        """
        wanted = np.asarray(times, dtype=float)
        if len(self.times) == 1:
            exact = wanted == self.times[0]
            return np.where(exact[:, None, None], self.positions[0], np.nan)
        after = np.searchsorted(self.times, wanted).clip(1, len(self.times) - 1)
        t0, t1 = self.times[after - 1], self.times[after]
        inside = (wanted >= t0) & (wanted <= t1) & (t1 - t0 <= 2.5 / self.rate)
        w = ((wanted - t0) / (t1 - t0))[:, None, None]
        # On a frame itself the other one does not count, so that a gap beside it does no harm.
        blend = np.where(w == 0, self.positions[after - 1], np.where(w == 1, self.positions[after],
                         (1 - w) * self.positions[after - 1] + w * self.positions[after]))  # fmt: skip
        return np.where(inside[:, None, None], blend, np.nan)


def make_recording(
    path: Path,
    times: Floats,
    markers: Sequence[str],
    positions: Floats,
    rate: float,
    passed_over: Mapping[str, int] | None = None,
) -> MocapRecording:
    """Return a recording without repetitions: the first marker of each name, and frames later than all before them.

    Args:
        path: the file, for messages.
        times: (F,) seconds.
        markers: M names.
        positions: (F, M, 3) metres; NaN where a marker was not seen.
        rate: frames per second.
        passed_over: number of parts of the file that were not read, by reason.

    Raises:
        InputError: as `MocapRecording`, and more than `LARGEST_BAD_SHARE` of the frames out of order.
    """
    counts = Counter(passed_over or {})
    first = {name: k for k, name in reversed(list(enumerate(markers)))}
    if len(first) < len(markers):
        counts[REPEATED] += len(markers) - len(first)
        repeated = sorted({name for k, name in enumerate(markers) if first[name] != k})
        log.warning("%s: several markers are called %s; the first of each is read", path, ", ".join(repeated))
    latest = np.maximum.accumulate(times) if len(times) else times
    later = np.ones(len(times), dtype=bool)
    later[1:] = times[1:] > latest[:-1]
    if not later.all() and later.mean() > 1 - LARGEST_BAD_SHARE:
        log.warning(
            "%s: %d of %d frames are no later than the one before and left out", path, (~later).sum(), len(later)
        )
        counts[LATE] += int((~later).sum())
        times, positions = times[later], positions[later]
    kept = sorted(first.values())
    names = tuple(markers[k] for k in kept)
    return MocapRecording(times, names, positions[:, kept], rate, str(path), +counts)
