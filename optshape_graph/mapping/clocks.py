"""The clocks of a recording: what they span, how they were set, and the offset between those of scans and odometry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.io.recordings import ClockOffset, Stamped, estimate_clock_offset
from optshape_graph.io.recordings.stream import Jump
from optshape_graph.mapping.registration import scan_odometry
from optshape_graph.scan import Scan


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

    Args:
        scans: of one LiDAR, with the times of their returns; its motion is taken from them, by KISS-ICP.
        poses: T_odometry_body (4, 4), in order of time.

    Raises:
        InputError: scans without times, or too little of either.
        MissingExtraError: kiss-icp is absent.
        UnobservableError: it hardly turned, or so regularly that several offsets fit.
    """
    registered, odometry = list(scan_odometry(scans)), list(poses)
    for found, what in ((registered, "scans with the times of their returns"), (odometry, "poses of odometry")):
        if len(found) < 3:
            raise InputError(f"clock offset: {len(found)} {what}; the offset cannot be estimated, give it")
    (a, R_a), (b, R_b) = ((_stamps(found), _rotations(found)) for found in (registered, odometry))
    return estimate_clock_offset(a, R_a, b, R_b)


def _stamps(poses: list[Stamped[Floats]]) -> Floats:
    return np.array([pose.stamp for pose in poses])


def _rotations(poses: list[Stamped[Floats]]) -> Rotation:
    return Rotation.from_matrix(np.array([pose.value[:3, :3] for pose in poses]))


def _span(span: tuple[float, float] | None) -> str:
    return "empty" if span is None else f"from {span[0]:.3f} to {span[1]:.3f} s"
