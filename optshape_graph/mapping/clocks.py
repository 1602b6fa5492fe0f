"""The clocks of a recording: what they span, how they were set, and the offset between those of scans and odometry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, UnobservableError
from optshape_graph.io.recordings import ClockOffset, Stamped, estimate_clock_offset
from optshape_graph.io.recordings.stream import Jump
from optshape_graph.mapping.registration import scan_odometry
from optshape_graph.scan import Scan

LONGEST = 60.0
"""Seconds of scans that are held in memory, to be registered backward in time: those in which the robot turned most."""

REGISTERED = 15_000
"""Returns of a scan that are enough to register it."""

LOOSEST = 0.02
"""Standard deviation of an offset, seconds, beyond which it is not told: at half a radian a second, half a degree."""


@dataclass(frozen=True)
class Clocks:
    """The clocks of scans and of odometry.

    Attributes:
        scans: seconds of the first and the last scan, or None.
        odometry: of the first and the last pose read, on their own clock, or None.
        offset: seconds that were added to the stamps of the odometry.
        offset_sd: standard deviation of the offset, seconds; None: it was given.
        jumps: how clocks were set, by the name of the stream.
    """

    scans: tuple[float, float] | None = None
    odometry: tuple[float, float] | None = None
    offset: float = 0.0
    offset_sd: float | None = None
    jumps: Mapping[str, tuple[Jump, ...]] | None = None

    @property
    def spans(self) -> str:
        """Both spans in words."""
        return f"scans are {_span(self.scans)}, odometry is {_span(self.odometry)}"

    def lines(self) -> list[str]:
        """Return what there is to say."""
        said = [self.spans] if self.odometry is not None else []
        if self.offset or self.offset_sd is not None:
            how = "given" if self.offset_sd is None else f"estimated, +- {self.offset_sd:.4f} s"
            said.append(f"clock offset, added to the stamps of the odometry: {self.offset:.4f} s ({how})")
        for name, jumps in (self.jumps or {}).items():
            said += [
                f"{name}: its clock was set {'back' if jump.seconds > 0 else 'forward'} by {abs(jump.seconds):.3f} s "
                f"at {jump.stamp:.3f} s; taken to have gone on"
                for jump in jumps
            ]
        return said

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "scans_s": None if self.scans is None else list(self.scans),
            "odometry_s": None if self.odometry is None else list(self.odometry),
            "offset_s": self.offset,
            "offset_sd_s": self.offset_sd,
            "set_back": [
                {"topic": name, "stamp": jump.stamp, "seconds": jump.seconds}
                for name, jumps in (self.jumps or {}).items()
                for jump in jumps
            ],
        }


def offset_of(scans: Iterable[Stamped[Scan]], poses: Iterable[Stamped[Floats]]) -> ClockOffset:
    """Estimate what to add to the stamps of odometry to have those of the scans, by how fast both say it turned.

    Registration lags: it expects a scan to go on as the one before did, the more so the fewer returns it has. So scans
    are registered forward and backward in time, which lags the other way: the mean is the offset, and half of the lag,
    which need not be the same both ways, is part of its standard deviation.

    Args:
        scans: of one LiDAR, with the times of their returns, to be read twice; its motion is taken from them, by
            KISS-ICP.
        poses: T_odometry_body (4, 4), in order of time.

    Raises:
        InputError: scans without times, or too little of either.
        MissingExtraError: kiss-icp is absent.
        UnobservableError: it hardly turned, or so regularly that several offsets fit, or scans don't say how it turned.
    """
    registered, odometry = list(scan_odometry(scans)), list(poses)
    for found, what in ((registered, "scans with the times of their returns"), (odometry, "poses of odometry")):
        if len(found) < 3:
            raise InputError(f"clock offset: {len(found)} {what}; the offset cannot be estimated, give it")
    first, last = _most_turning(registered)
    forward = [pose for pose in registered if first <= pose.stamp <= last]
    mirrored = [_mirrored(scan) for scan in scans if first <= scan.stamp <= last][::-1]
    backward = [Stamped(-pose.stamp, pose.value) for pose in scan_odometry(mirrored)][::-1]
    one, other = (
        estimate_clock_offset(_stamps(found), _rotations(found), _stamps(odometry), _rotations(odometry))
        for found in (forward, backward)
    )
    lag = 0.5 * (one.seconds - other.seconds)
    sd = float(np.hypot(0.5 * lag, max(one.standard_deviation, other.standard_deviation)))
    if sd > LOOSEST:
        raise UnobservableError(
            f"clock offset: scans say {one.seconds:.3f} s registered forward in time, {other.seconds:.3f} s backward: "
            f"+- {sd:.3f} s, at most {LOOSEST:g} s is of use",
            ("offset between the clocks",),
        )
    return replace(one, seconds=one.seconds - lag, standard_deviation=sd)


def _most_turning(poses: list[Stamped[Floats]]) -> tuple[float, float]:
    """The first and the last stamp of a stretch of LONGEST seconds in which the rate of turning varies most."""
    stamps, R = _stamps(poses), _rotations(poses)
    speed = (R[:-1].inv() * R[1:]).magnitude() / np.maximum(np.diff(stamps), 1e-6)
    ends = np.searchsorted(stamps, stamps[:-1] + LONGEST)
    sums = np.array([np.concatenate([[0.0], np.cumsum(speed**power)]) for power in (0, 1, 2)])
    starts = np.arange(len(speed))
    count, total, squares = sums[:, np.minimum(ends, len(speed))] - sums[:, starts]
    k = int((squares - total**2 / count).argmax())
    return float(stamps[k]), float(stamps[min(ends[k], len(stamps) - 1)])


def _mirrored(scan: Stamped[Scan]) -> Stamped[Scan]:
    """A scan as it would be if time ran backward; of its returns as many as registration needs."""
    thinned = scan.value.select(np.arange(0, len(scan.value), max(len(scan.value) // REGISTERED, 1)))
    return Stamped(-scan.stamp, replace(thinned, time=None if thinned.time is None else -thinned.time))


def _stamps(poses: list[Stamped[Floats]]) -> Floats:
    return np.array([pose.stamp for pose in poses])


def _rotations(poses: list[Stamped[Floats]]) -> Rotation:
    return Rotation.from_matrix(np.array([pose.value[:3, :3] for pose in poses]))


def _span(span: tuple[float, float] | None) -> str:
    return "empty" if span is None else f"from {span[0]:.3f} to {span[1]:.3f} s"
