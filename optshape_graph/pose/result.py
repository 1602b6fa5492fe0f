"""The estimate of the pose of one target in one scan: what it says, and how it is saved."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from optshape_graph._arrays import Floats, Ints, Value, frozen, shortened
from optshape_graph.edges import EdgePoints
from optshape_graph.factors.measurement import TemplateMeasurement
from optshape_graph.factors.static import OF_RINGS, OF_SENSOR, OF_TARGET, OUTER_EDGE, RANGE_BIAS, BiasedMeasurement
from optshape_graph.io.records import to_record
from optshape_graph.io.results import RECORD, Result, Row, one_scan
from optshape_graph.pose.certificate import Certificate
from optshape_graph.pose.fit import Fit
from optshape_graph.se3 import adjoint, apply, inverse, inverse_covariance, skew
from optshape_graph.target import Target

Status = Literal["ok", "doubtful", "ambiguous", "failed"]


@dataclass(frozen=True, eq=False, repr=False)
class Ambiguity(Value):
    """How much better the pose is than the best different one.

    Attributes:
        margin: difference of log likelihoods, infinite where no different pose was found.
        T_lidar_target: (4, 4) that pose, or None.
    """

    margin: float
    T_lidar_target: Floats | None


@dataclass(frozen=True, eq=False, repr=False)
class PoseEstimate(Result):
    """The pose of a target in a scan, and how far to believe it.

    Attributes:
        target: the template.
        T_lidar_target: (4, 4).
        covariance: (6, 6) of the right perturbation of T_lidar_target: rotation first, in the target's frame.
        status: "ok"; "doubtful" where the returns do not fit the model; "ambiguous" where a different pose is not ruled
            out; "failed" where it is not to be used.
        reason: why not "ok"; of an estimate that is, why its certificate is not one, else empty.
        measurement: all whitened residuals, compressed: what factors are made of.
        shared: the same before the errors that scans of one static scene share (ring biases, edge offset) are
            marginalised, for `fuse_static`; each in units of its standard deviation. None for `method="paper"`.
        certificate: of global optimality, for the association and the weights used.
        ambiguity: margin to the best different pose.
        log_likelihood: logarithm of the evidence for the target at this pose, up to a constant of the scan: what tells
            targets of different shapes apart. Not a number for `method="paper"`.
        edge_points: the ring ends used.
        labels: (M,) edge of each edge point.
        inset: (M,) azimuth by which the boundary is taken to lie beyond each edge point, rad.
        edge_sigma: (M,) standard deviation of each edge residual, metres.
        edge_residuals: (M,) distance of each boundary point from its edge, metres, positive outside.
        plane_rms: root mean square distance of the returns from the target's plane, metres.
        n_returns: number of returns.
        unobservable: directions, in the target's frame, that the scan does not determine.
        fit: how well the returns fit the model, and what was widened for it.
        scan: name of the scan.
    """

    FORM: ClassVar[str] = "estimate"

    target: Target
    T_lidar_target: Floats
    covariance: Floats
    status: Status
    reason: str
    measurement: TemplateMeasurement
    shared: BiasedMeasurement | None
    certificate: Certificate
    ambiguity: Ambiguity
    log_likelihood: float
    edge_points: EdgePoints
    labels: Ints
    inset: Floats
    edge_sigma: Floats
    edge_residuals: Floats
    plane_rms: float
    n_returns: int
    unobservable: tuple[str, ...]
    fit: Fit
    scan: str

    def __post_init__(self) -> None:
        for field in ("T_lidar_target", "covariance", "inset", "edge_sigma", "edge_residuals"):
            object.__setattr__(self, field, frozen(getattr(self, field)))
        object.__setattr__(self, "labels", frozen(self.labels, np.int64))

    @property
    def usable(self) -> bool:
        """Whether factors may be made of it: neither failed nor doubtful. An ambiguous one has a rival beside it."""
        return self.status not in ("failed", "doubtful")

    @property
    def T_target_lidar(self) -> Floats:
        """(4, 4) inverse of T_lidar_target."""
        return inverse(self.T_lidar_target)

    @property
    def covariance_target_lidar(self) -> Floats:
        """(6, 6) of the right perturbation of T_target_lidar: rotation first, in the LiDAR's frame."""
        return inverse_covariance(self.T_lidar_target, self.covariance)

    @property
    def vertices(self) -> Floats:
        """(n, 3) vertices, LiDAR frame, metres."""
        return apply(self.T_lidar_target, self.target.vertices)

    @property
    def vertex_covariances(self) -> Floats:
        """(n, 3, 3) covariance of each vertex, LiDAR frame, square metres."""
        R = self.T_lidar_target[:3, :3]
        J = np.concatenate([-R @ skew(self.target.vertices), np.tile(R, (len(self.target), 1, 1))], axis=-1)
        return np.asarray(J @ self.covariance @ np.swapaxes(J, 1, 2))

    @property
    def edge_lines(self) -> tuple[Floats, Floats]:
        """A point (n, 3), metres, and the unit direction (n, 3) of each edge, LiDAR frame."""
        start = self.vertices
        along = np.roll(start, -1, axis=0) - start
        return start, along / np.linalg.norm(along, axis=1, keepdims=True)

    @property
    def plane(self) -> Floats:
        """(4,) plane of the target, LiDAR frame: n . p + d = 0, n the target's +x, away from the sensor."""
        normal = self.T_lidar_target[:3, 0]
        return np.append(normal, -normal @ self.T_lidar_target[:3, 3])

    @property
    def equivalent_poses(self) -> Floats:
        """(S, 4, 4) T_lidar_target of every pose that a symmetric target cannot tell apart, this one first."""
        return np.asarray(self.T_lidar_target @ self.target.symmetry_transforms)

    def equivalent(self, k: int) -> PoseEstimate:
        """Return this estimate with the vertices named otherwise: `equivalent_poses[k]`, and all that goes with it."""
        turn = self.target.symmetry_transforms[k]
        Ad = adjoint(inverse(turn))
        normals = self.target.normals @ turn[1:3, 1:3]  # of each edge, in the turned target's frame
        renamed = (normals @ self.target.normals.T).argmax(axis=1)
        return replace(
            self,
            T_lidar_target=self.T_lidar_target @ turn,
            covariance=Ad @ self.covariance @ Ad.T,
            measurement=self.measurement.substituted(turn),
            shared=None if self.shared is None else self.shared.substituted(turn),
            labels=renamed[self.labels],
        )

    @property
    def of_sensor(self) -> BiasedMeasurement | None:
        """What the returns say before the errors that the LiDAR keeps are marginalised; None for `method="paper"`.

        Others are of one scan: where the target ends between two rings, and what isn't known of the board itself. Scans
        share biases of ranges in metres: their unit is the sensor file's deviation, however large a scan shows them.
        """
        return self._keeping(OF_SENSOR)

    @property
    def of_sensor_and_target(self) -> BiasedMeasurement | None:
        """The same before those that the target keeps are marginalised too: of its surface, and of its outline."""
        return self._keeping((*OF_SENSOR, *OF_TARGET))

    @property
    def of_scene(self) -> BiasedMeasurement | None:
        """What the returns say before all that scans of one still scene have in common is marginalised; or None.

        For `factors.fuse_static`: beside what LiDAR and target keep, where the target ends between two rings. In each
        revolution it is the same rings that miss it.
        """
        return self._keeping((*OF_SENSOR, *OF_TARGET, OUTER_EDGE))

    def _keeping(self, kinds: Collection[str]) -> BiasedMeasurement | None:
        """What the returns say before errors of some kinds, and those of single rings, are marginalised."""
        if self.shared is None:
            return None
        own = [
            error
            for error in self.shared.shared
            if not (error.kind in kinds or (error.kind in OF_RINGS and error.ring is not None))
        ]
        return self.shared.without(own).rescaled(RANGE_BIAS, 1.0 / self.fit.bias_factor)

    @property
    def inset_rad(self) -> float:
        """Median azimuth from an edge point to the target's edge, along its ring, rad; without rings not a number."""
        if not len(self.labels):
            return float("nan")
        outward = self.edge_points.outward(self.T_lidar_target[:3, 0])
        normal = np.column_stack([np.zeros(len(self.labels)), self.target.normals[self.labels]])
        R = self.T_target_lidar[:3, :3]
        speed = ((outward @ R.T) * normal).sum(axis=1)
        usable = np.abs(speed) > 0.1 * np.linalg.norm(outward, axis=1)
        to_edge = self.inset - self.edge_residuals / np.where(usable, speed, np.inf)
        return float(np.median(to_edge[usable])) if usable.any() else float(np.median(self.inset))

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of the position, metres."""
        return float(np.sqrt(np.diag(self.covariance)[3:].max()))

    @property
    def sigma_rad(self) -> float:
        """Largest standard deviation of the rotation, rad."""
        return float(np.sqrt(np.diag(self.covariance)[:3].max()))

    def __repr__(self) -> str:
        x, y, z = self.T_lidar_target[:3, 3]
        pose = f"({x:.3f}, {y:.3f}, {z:.3f}) m ± {1e3 * self.sigma_m:.1f} mm, ± {np.degrees(self.sigma_rad):.2f} deg"
        certified = "certified" if self.certificate.certified else "not certified"
        margin = "" if self.ambiguity.T_lidar_target is None else f", margin {self.ambiguity.margin:.0f}"
        said = f"{pose}, {certified}{margin}" if self.status != "failed" else self.reason
        return shortened(f"PoseEstimate({self.target.name!r} {self.status}: {said}, {self.n_returns} returns)")

    def to_dict(self) -> dict[str, Any]:
        """Return what the JSON form says of this scan, as plain data."""
        usable = self.status != "failed"
        rival = self.ambiguity.T_lidar_target
        return {
            "scan": self.scan or "scan",
            "target": self.target.name,
            "status": self.status,
            "reason": self.reason,
            "T_lidar_target": self.T_lidar_target.tolist() if usable else None,
            "covariance": self.covariance.tolist() if usable else None,
            "vertices": self.vertices.tolist() if usable else None,
            "certificate": {
                "certified": self.certificate.certified,
                "gap_m2": self.certificate.gap_m2,
                "second_eigenvalue": self.certificate.second_eigenvalue,
            },
            "ambiguity": {
                "margin": self.ambiguity.margin if rival is not None else None,
                "T_lidar_target": rival.tolist() if rival is not None else None,
            },
            "equivalent_poses": self.equivalent_poses.tolist() if usable else None,
            "inset_rad": self.inset_rad if len(self.labels) else None,
            "labels": self.labels.tolist(),
            "edge_points": self.edge_points.points.tolist(),
            "n_returns": self.n_returns,
            "fit": self.fit.to_dict(),
        }

    def rows(self) -> list[Row]:
        """Return the estimate as a table of one row."""
        x, y, z = self.T_lidar_target[:3, 3].tolist()
        return [
            {
                "scan": self.scan, "target": self.target.name, "status": self.status, "x_m": x, "y_m": y, "z_m": z,
                "sd_mm": 1e3 * self.sigma_m, "sd_deg": float(np.degrees(self.sigma_rad)),
                "certified": self.certificate.certified, "margin": self.ambiguity.margin, "fit": self.fit.summary,
                "returns": self.n_returns,
            }
        ]  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read an estimate that `save` wrote: equal to what was saved.

        Args:
            path: of the file.

        Raises:
            InputError: another file, one of several scans, or one without a record.
        """
        loaded: Self = one_scan(path, cls.FORM, cls)
        return loaded

    def _document(self) -> dict[str, Any]:
        return {"schema": f"optshape/{self.FORM}/1", "scans": [{**self.to_dict(), RECORD: to_record(self)}]}

    @staticmethod
    def failed_entry(scan: str, target: str, reason: str) -> dict[str, Any]:
        """Return what the JSON form says of a scan that gave no estimate, as plain data.

        Args:
            scan: its name.
            target: name of the target.
            reason: why there is none.
        """
        empty = dict.fromkeys(
            ["T_lidar_target", "covariance", "vertices", "certificate", "ambiguity", "equivalent_poses", "inset_rad",
             "labels", "edge_points", "n_returns", "fit"]
        )  # fmt: skip
        return {"scan": scan, "target": target, "status": "failed", "reason": reason, **empty}
