"""Results of detection: targets found in a scan, the evidence for them, and rejected surfaces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value, frozen, shortened
from optshape_graph.factors import TemplateMeasurement
from optshape_graph.io.records import to_record
from optshape_graph.io.results import RECORD, Result, Row, one_scan
from optshape_graph.pose import PoseEstimate
from optshape_graph.target import Target


@dataclass(frozen=True, eq=False, repr=False)
class Evidence(Value):
    """The evidence for a target at a pose: shares of rays, each 1 for a target that hangs free and is seen whole.

    Attributes:
        contained: of the connected returns in its plane, the share inside its outline.
        bounded: of the ends of the connected rings, the share beyond which the surface does not go on outside its
            outline; 1 where the ends on the outline fit it up to chance, as they do not if another shape is cut to it.
        covered: of the rays that should meet it, except occluded ones, the share that returns from its plane.
        edged: of the ends of its rings, the share on its outline.
        solid: of the returns from inside its outline, in its plane or behind, the share that is not behind.
        free: of the rays that pass beside it, the share that sees past it; 0 around a window cut out of a wall.
        stepped: of the ends of its rings, the share where the range jumps back, or nothing returns. Where a surface
            bends away, or something stands before it, there is no edge.
        apart: of the rays just beyond a side, the share that does not return from something that begins at that side,
            such as the next face of a box, or the floor; at the worst side.
        seen: the share of its outline just beyond which rays pass. None pass outside the field of view, behind
            something, or between two rings far apart.
        distinct: probability that it is not a surface of another shape, such as a rectangle; few ring ends fit any
            shape.
    """

    contained: float
    bounded: float
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


@dataclass(frozen=True, eq=False, repr=False)
class Detection(Value):
    """A target found in a scan.

    Attributes:
        target: the target.
        estimate: its pose, from these returns; in the frame of `Search.fired`, where that was given.
        indices: (K,) rows of the scan of all returns that the pose uses, including those at the rim and with much
            noise.
        doubtful: (K,) whether each may be of something else: outside the outline or within a standard deviation of it,
            or among the 5 % furthest from the plane.
        evidence: for the target.
        rival: the next likely of the targets that fit, or None.
        margin: difference of log likelihoods to the rival; infinite without a rival.
        probabilities: by name, of each target that fits, for equal prior probabilities; the likeliest first. They sum
            to 1; whether it is one of them at all is told by `evidence`.
        status: "ok"; "doubtful" if the returns do not fit the model; "ambiguous" if another target, another pose of
            this one, or a surface of another shape is not ruled out; "failed" if the target is there, but its returns
            leave its pose undetermined.
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
        """Product of the shares of the evidence, 0 to 1 (`Evidence.score`)."""
        return self.evidence.score

    @property
    def measurement(self) -> TemplateMeasurement:
        """The estimate's measurement of T_target_lidar, from which factors are made."""
        return self.estimate.measurement

    def __repr__(self) -> str:
        x, y, z = self.estimate.T_lidar_target[:3, 3]
        said = f"at ({x:.3f}, {y:.3f}, {z:.3f}) m, score {self.score:.2f}, {len(self.indices)} returns"
        return shortened(f"Detection({self.target.name!r} {self.status}: {said})")

    def to_dict(self) -> dict[str, Any]:
        """Return the target's entry in the JSON form, as plain data."""
        estimate = self.estimate
        return {
            "target": self.target.name,
            "T_lidar_target": estimate.T_lidar_target.tolist(),
            "covariance": estimate.covariance.tolist(),
            "equivalent_poses": estimate.equivalent_poses.tolist(),
            "return_indices": self.indices[~self.doubtful].tolist(),
            "doubtful_indices": self.indices[self.doubtful].tolist(),
            "score": self.score,
            "status": self.status,
            "reason": self.reason,
            "rival": self.rival.name if self.rival else None,
            "margin": self.margin if self.rival else None,
            "probabilities": dict(self.probabilities),
            "evidence": asdict(self.evidence),
            "fit": estimate.fit.to_dict(),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Rejection(Value):
    """A surface that was tested and is not one of the targets.

    Attributes:
        reason: the reason against it, with numbers.
        passed: number of tests that it passed: of size, rings, their ends, pose, and evidence.
        target: name of the target that it was compared with; empty: all targets.
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

    def to_dict(self) -> dict[str, Any]:
        """Return the surface's entry in the JSON form, as plain data."""
        return {
            "reason": self.reason,
            "passed": self.passed,
            "target": self.target or None,
            "centre": self.centre.tolist(),
            "returns": self.n_returns,
            "rings": self.n_rings,
            "area_m2": self.area,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Detections(Result):
    """The detections in one scan.

    Attributes:
        found: targets, the best score first.
        rejected: other surfaces of about a target's size, the one that passed the most tests first.
        scan: name of the scan.
    """

    FORM: ClassVar[str] = "detect"

    found: tuple[Detection, ...]
    rejected: tuple[Rejection, ...]
    scan: str = ""

    def __repr__(self) -> str:
        named = ", ".join(f"{one.target.name} {one.status}" for one in self.found) or "none"
        return shortened(f"Detections({len(self.found)} found: {named}; {len(self.rejected)} rejected)")

    def to_dict(self) -> dict[str, Any]:
        """Return the scan's entry in the JSON form, as plain data."""
        return {
            "scan": self.scan or "scan",
            "targets": [one.to_dict() for one in self.found],
            "rejected": [one.to_dict() for one in self.rejected],
        }

    def rows(self) -> list[Row]:
        """Return a row for each target found."""
        return [
            {**one.estimate.rows()[0], "scan": self.scan, "status": one.status, "margin": one.margin,
             "returns": len(one.indices), "score": one.score}
            for one in self.found
        ]  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read detections that `save` wrote: equal to what was saved.

        Args:
            path: of the file.

        Raises:
            InputError: another file, one of several scans, or one without a record.
        """
        loaded: Self = one_scan(path, cls.FORM, cls)
        return loaded

    def _document(self) -> dict[str, Any]:
        return {"schema": f"optshape/{self.FORM}/1", "scans": [{**self.to_dict(), RECORD: to_record(self)}]}
