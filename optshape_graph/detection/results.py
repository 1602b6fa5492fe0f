"""What detection finds in a scan, and what it turned down."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, frozen
from optshape_graph.pose import PoseEstimate
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False)
class Evidence:
    """What speaks for a target at a pose: shares of rays, each 1 for a target that hangs free and is seen whole.

    Attributes:
        contained: of the connected returns in its plane, those inside its outline.
        covered: of the rays that should meet it, occluded ones apart, those that return from its plane.
        edged: of the ends of its rings, those on its outline.
        solid: of the returns from inside its outline or from behind it, those that are not from behind.
        free: of the rays that pass beside it, those that see past it: around a window cut out of a wall, none do;
            below a box on the floor, none do.
        stepped: of the ends of its rings, those where the range jumps back, or nothing returns: where a surface
            bends away, or something stands before it, there is no edge to be seen.
        apart: of the rays just beyond the side where it is least, those that do not return from something that begins
            at that side: the next face of a box, the floor.
        seen: of its outline, what is within the field of view.
        distinct: probability that it is not one of as many surfaces of other shapes: the ends of few rings fit any.
    """

    contained: float
    covered: float
    edged: float
    solid: float
    free: float
    stepped: float
    apart: float
    seen: float
    distinct: float

    @property
    def score(self) -> float:
        """Product of the shares."""
        return float(np.prod([getattr(self, field.name) for field in fields(self)]))


@dataclass(frozen=True, eq=False)
class Detection:
    """A target found in a scan.

    Attributes:
        target: which one.
        estimate: its pose, from these returns.
        indices: (K,) rows of the scan that are its returns, those at its rim and of much noise included: the pose's.
        doubtful: (K,) whether each might be taken for something else: outside the outline or within a standard
            deviation of it, or among the 5 % furthest from the plane.
        evidence: for it.
        rival: the next likely of the targets asked for, where one fits as well; else None.
        margin: difference of log likelihoods to the rival; infinite where there is none.
        probabilities: by name, of each of the targets asked for that fits, had all been as likely before; the likeliest
            first. They sum to 1: that it is one of them is what `evidence` is for.
        status: "ok"; "ambiguous" where another of the targets, another pose of this one, or a surface of another shape
            is not ruled out; "failed" where the target is there, but its returns leave its pose undetermined.
        reason: why not "ok", else empty.
    """

    target: Target
    estimate: PoseEstimate
    indices: Ints
    doubtful: Bools
    evidence: Evidence
    rival: Target | None
    margin: float
    probabilities: Mapping[str, float]
    status: str
    reason: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "indices", frozen(self.indices, np.int64))
        object.__setattr__(self, "doubtful", frozen(self.doubtful, np.bool_))

    @property
    def score(self) -> float:
        """How well it fits, 0 to 1: `Evidence.score`."""
        return self.evidence.score


@dataclass(frozen=True, eq=False)
class Rejection:
    """A surface that was looked at and is none of the targets.

    Attributes:
        reason: what speaks against it, with numbers.
        passed: how many of the tests it passed: of its size, its rings, how they end, its pose, and its evidence.
        target: name of the target that it was compared with; empty: with all.
        centre: (3,) metres, LiDAR frame.
        n_returns: its returns.
        n_rings: rings they are on.
        area: square metres it covers.
    """

    reason: str
    passed: int
    target: str
    centre: Floats
    n_returns: int
    n_rings: int
    area: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", frozen(self.centre))


@dataclass(frozen=True)
class Detections:
    """What was found in one scan.

    Attributes:
        found: targets, the best score first; empty: none.
        rejected: surfaces of about a target's size that are none, the one that passed the most tests first.
    """

    found: tuple[Detection, ...]
    rejected: tuple[Rejection, ...]
