"""Targets as they were built: vertices refined with the map.

The vertices of a landmark are one vector variable (y, z of each). How the polygon as a whole is shifted or turned in
its plane is the pose's business, so the template's prior holds that tightly, and the shape as loosely as it is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.factors import ShapeMeasurement, shape_rows
from optshape_graph.factors._rows import gaussian
from optshape_graph.mapping.priors import sqrt_information
from optshape_graph.mapping.sighting import Sighting
from optshape_graph.mapping.track import Keys, MappingProblem
from optshape_graph.pose import PoseEstimate
from optshape_graph.pose.azimuth_grid import level_rings
from optshape_graph.pose.noise import returns_on_plane
from optshape_graph.scan import Scan
from optshape_graph.se3 import adjoint, apply, inverse
from optshape_graph.target import Target

GAUGE_SIGMA_M = 1e-6
"""Standard deviation to which the polygon's own shift and turn are held, metres."""


def shape_measurement(estimate: PoseEstimate, returns: Scan) -> ShapeMeasurement:
    """Return what an estimate's returns say about the pose and the shape, with the noise that the estimate found.

    Args:
        estimate: not failed.
        returns: the returns on the target that it was made of.
    """
    n = len(estimate.target)
    returns, azimuth_noise = level_rings(returns)  # as the estimator does, so that rows of its edge points agree
    edges, plane = estimate.edge_points, estimate.plane
    normal, distance = plane[:3], -float(plane[3])
    boundary = edges.points + estimate.inset[:, None] * edges.outward(normal)
    boundary = boundary * (distance / (boundary @ normal))[:, None]
    on_plane = returns_on_plane(returns, normal, distance, azimuth_noise)
    # The distance from the plane goes along its normal, where it does not touch the row's other coefficients.
    off_plane = on_plane.points - on_plane.offset[:, None] * normal
    rows = np.vstack([
        shape_rows(boundary, estimate.labels, n) / estimate.edge_sigma[:, None],
        shape_rows(off_plane, np.full(len(returns), n), n) / on_plane.sigma[:, None],
    ])  # fmt: skip
    biased = np.vstack([np.zeros((len(boundary), on_plane.bias.shape[1])), on_plane.bias])
    return ShapeMeasurement.from_rows(_marginal(biased, rows), estimate.T_target_lidar)


def _marginal(B: Floats, rows: Floats) -> Floats:
    """Rows with shared errors, columns B in units of their standard deviations, marginalised."""
    k = B.shape[1]
    stack = np.block([[np.eye(k), np.zeros((k, rows.shape[1]))], [B, rows]])
    R = np.asarray(np.linalg.qr(stack, mode="r"))
    return R[k:, k:]


@dataclass(frozen=True, eq=False)
class Shapes:
    """The shape part of a problem: which matches say something about the vertices of which landmark.

    Attributes:
        sigma: of the template's prior, metres.
        targets: template of each landmark that is refined.
        measurements: by number of the match; edges in the landmark's own numbering.
        landmark_of: name of each of those matches' landmark.
        pose_of: track and pose of each of those matches.
        replaced: (K,) whether a match is in `measurements`, instead of its template measurement.
    """

    sigma: float
    targets: Mapping[str, Target]
    measurements: Mapping[int, ShapeMeasurement]
    landmark_of: Mapping[int, str]
    pose_of: Mapping[int, tuple[int, int]]
    replaced: Bools

    @classmethod
    def of(cls, problem: MappingProblem, sigma: float | None) -> Shapes:
        """Collect what there is; with sigma None, nothing."""
        matches = [(t, match) for t, track in enumerate(problem.tracks) for match in track.matches]
        measurements, landmark_of, pose_of = {}, {}, {}
        for k, (t, match) in enumerate(matches):
            shape = _in_landmark(match.sighting, match.hypothesis) if sigma is not None else None
            if shape is not None:
                measurements[k], landmark_of[k], pose_of[k] = shape, match.landmark, (t, match.pose)
        targets = {name: problem.targets[name] for name in dict.fromkeys(landmark_of.values())}
        replaced = np.zeros(len(matches), dtype=bool)
        replaced[list(measurements)] = True
        return cls(sigma or 0.0, targets, measurements, landmark_of, pose_of, replaced)

    def insert(self, values: gtsam.Values, keys: Mapping[str, int]) -> None:
        """Add the vertices to initial values, as the templates have them."""
        for name, target in self.targets.items():
            values.insert(keys[name], target.polygon.ravel())

    def add_priors(self, graph: gtsam.NonlinearFactorGraph, keys: Mapping[str, int]) -> None:
        """Add the templates as priors of the vertices."""
        for name, target in self.targets.items():
            gauge = _gauge(target)
            covariance = self.sigma**2 * (np.eye(len(gauge)) - gauge @ gauge.T) + GAUGE_SIGMA_M**2 * gauge @ gauge.T
            noise = gaussian(sqrt_information(covariance))
            graph.push_back(gtsam.PriorFactorVector(keys[name], target.polygon.ravel(), noise))

    def error(self, values: gtsam.Values, keys: Keys) -> float:
        """Return half the chi-square of the shape measurements."""
        return sum(m.error(*self._at(k, values, keys)) for k, m in self.measurements.items())

    def linearise(self, linear: gtsam.GaussianFactorGraph, values: gtsam.Values, keys: Keys) -> None:
        """Add the shape measurements, linearised."""
        for k, measurement in self.measurements.items():
            H, vertices = self._at(k, values, keys)
            by_H, by_vertex = measurement.jacobians(H, vertices)
            by_shape = np.concatenate(by_vertex[:, :, 1:], axis=1)
            t, pose = self.pose_of[k]
            name = self.landmark_of[k]
            linear.push_back(
                gtsam.JacobianFactor(
                    keys.landmarks[name], -by_H @ adjoint(inverse(H)),
                    keys.poses[t][pose], by_H,
                    keys.shapes[name], by_shape,
                    -measurement.residual(H, vertices), gtsam.noiseModel.Unit.Create(len(by_H)),
                )
            )  # fmt: skip

    def refined(self, problem: MappingProblem, values: gtsam.Values, keys: Mapping[str, int]) -> dict[str, Target]:
        """Return the template of every landmark, refined where it was."""
        return {
            name: _target(target, values.atVector(keys[name])) if name in keys else target
            for name, target in problem.targets.items()
        }

    def _at(self, k: int, values: gtsam.Values, keys: Keys) -> tuple[Floats, Floats]:
        t, pose = self.pose_of[k]
        name = self.landmark_of[k]
        H = values.atPose3(keys.landmarks[name]).between(values.atPose3(keys.poses[t][pose])).matrix()
        yz = values.atVector(keys.shapes[name]).reshape(-1, 2)
        return H, np.column_stack([np.zeros(len(yz)), yz])


def _in_landmark(sighting: Sighting, hypothesis: int) -> ShapeMeasurement | None:
    """Return a sighting's shape measurement with the edges numbered as the landmark's, or None.

    A symmetric target's vertex k may be the landmark's vertex k + shift. What is known of the other pose of an
    ambiguous sighting is no shape.
    """
    shape, turns = sighting.shape, len(sighting.target.symmetries)
    if shape is None or hypothesis >= turns:
        return None
    S = sighting.target.symmetry_transforms[hypothesis]
    # T_target_lidar = S T', so a vertex v of the sighting's template is at S^-1 v in the landmark's frame.
    turned = apply(inverse(S), sighting.target.vertices)
    shift = int(np.linalg.norm(turned[0] - sighting.target.vertices, axis=1).argmin())
    n = shape.n_edges
    block = np.append((np.arange(n) - shift) % n, n)  # the landmark's edge j is the sighting's edge j - shift
    U = shape.U.reshape(len(shape.U), n + 1, 4)[:, block].reshape(len(shape.U), -1)
    # The target's frame is turned as well; only the pose that the measurement was taken at notices.
    return ShapeMeasurement(np.asarray(np.linalg.qr(U, mode="r")), shape.n_rows, inverse(S) @ shape.T_target_lidar)


def _gauge(target: Target) -> Floats:
    """Orthonormal basis (2 n, 3) of the motions of the polygon in its plane: both shifts, and the turn."""
    n = len(target)
    y, z = target.polygon.T
    motions = np.zeros((n, 2, 3))
    motions[:, 0, 0] = motions[:, 1, 1] = 1.0
    motions[:, 0, 2], motions[:, 1, 2] = -z, y
    Q, _ = np.linalg.qr(motions.reshape(2 * n, 3))
    return np.asarray(Q)


def _target(template: Target, yz: Floats) -> Target:
    vertices = np.column_stack([np.zeros(len(template)), yz.reshape(-1, 2)])
    return Target(vertices, template.name, template.chessboard, template.tags)
