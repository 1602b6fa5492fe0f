"""Targets as they were built: vertices refined with the map.

The vertices of a landmark are one vector variable (y, z of each). How the polygon as a whole is shifted or turned in
its plane is the pose's business, so the template's prior holds that tightly, and the shape as loosely as it is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.azimuth_grid import level_rings
from optshape_graph.factors import ShapeMeasurement, shape_rows
from optshape_graph.factors._rows import gaussian, marginalised
from optshape_graph.factors.plane_returns import returns_on_plane
from optshape_graph.factors.static import spread
from optshape_graph.graph import Chains, State, add_rows
from optshape_graph.mapping.batch_solution import Keys
from optshape_graph.mapping.track import MappingProblem, Sighting
from optshape_graph.pose import PoseEstimate
from optshape_graph.ring_returns import RingReturns
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse
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
    azimuth_noise = 0.0
    if returns.ring is not None:  # as the estimator does, so that rows of its edge points agree
        level, noise = level_rings(RingReturns.of([returns]))
        (returns,), azimuth_noise = level.sorted_scans(), float(noise[0])
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
    shared = spread(on_plane.moved, on_plane.which, len(on_plane.errors))
    biased = np.vstack([np.zeros((len(boundary), shared.shape[1])), shared])
    return ShapeMeasurement.from_rows(marginalised(biased, rows), estimate.T_target_lidar)


@dataclass(frozen=True, eq=False, repr=False)
class AsBuilt(Value):
    """The matches that say something about the vertices of their landmarks, as a term.

    Attributes:
        sigma: of the template's prior, metres.
        targets: template of each landmark that is refined.
        shapes: key of its vertices, a vector variable (y, z of each).
        numbers: of those matches among all of the problem.
        landmarks: whose vertices each is of.
        measurements: of each, edges in the landmark's own numbering.
        chains: of T_target_lidar.
    """

    sigma: float
    targets: Mapping[str, Target]
    shapes: Mapping[str, int]
    numbers: tuple[int, ...]
    landmarks: tuple[str, ...]
    measurements: tuple[ShapeMeasurement, ...]
    chains: Chains

    @classmethod
    def of(cls, problem: MappingProblem, keys: Keys, sigma: float | None) -> AsBuilt:
        """Collect what there is; with sigma (metres) None, nothing."""
        matches = enumerate(problem.matches) if sigma is not None else ()
        shapes = [(k, t, match, _in_landmark(match.sighting, match.hypothesis)) for k, (t, match) in matches]
        found = [(k, t, match, shape) for k, t, match, shape in shapes if shape is not None]
        landmarks = tuple(match.landmark for _, _, match, _ in found)
        names = dict.fromkeys(landmarks)
        return cls(
            sigma or 0.0,
            {name: problem.targets[name] for name in names},
            {name: keys.shapes[name] for name in names},
            tuple(k for k, *_ in found),
            landmarks,
            tuple(shape for *_, shape in found),
            Chains([keys.chain(t, match) for _, t, match, _ in found]),
        )

    def insert(self, values: gtsam.Values) -> None:
        """Add the vertices to initial values, as the templates have them."""
        for name, target in self.targets.items():
            values.insert(self.shapes[name], target.polygon.ravel())

    def priors(self) -> Iterator[gtsam.NonlinearFactor]:
        """Yield the templates as priors of the vertices."""
        for name, target in self.targets.items():
            gauge = _gauge(target)
            moves = gauge @ gauge.T  # a projection, and so is what it leaves: the square root is theirs, exactly
            noise = gaussian((np.eye(len(gauge)) - moves) / self.sigma + moves / GAUGE_SIGMA_M)
            yield gtsam.PriorFactorVector(self.shapes[name], target.polygon.ravel(), noise)

    def at(self, state: State) -> AsBuiltModel:
        """Return the residuals and derivatives of every match at a state."""
        residuals, by_pose, by_shape = [], [], []
        for landmark, measurement, H in zip(self.landmarks, self.measurements, self.chains.at(state), strict=True):
            yz = state.values.atVector(self.shapes[landmark]).reshape(-1, 2)
            vertices = np.column_stack([np.zeros(len(yz)), yz])
            by_H, by_vertex = measurement.jacobians(H, vertices)
            residuals.append(measurement.residual(H, vertices))
            by_pose.append(by_H)
            by_shape.append(np.concatenate(by_vertex[:, :, 1:], axis=1))
        return AsBuiltModel(self, state, residuals, by_pose, by_shape)

    def refined(self, problem: MappingProblem, values: gtsam.Values) -> dict[str, Target]:
        """Return the template of every landmark, refined where it was."""
        return {
            name: _target(target, values.atVector(self.shapes[name])) if name in self.shapes else target
            for name, target in problem.targets.items()
        }


@dataclass(frozen=True, eq=False, repr=False)
class AsBuiltModel(Value):
    """Residuals r and their derivatives, whitened, of the matches of a term at a state.

    Attributes:
        term: that this is the model of.
        state: where it is linearised.
        residuals: (n,) of each match, whitened.
        by_pose: (n, 6) rows of each, by the right perturbation of T_target_lidar.
        by_shape: (n, 2 v) rows of each, by the vertices.
    """

    term: AsBuilt
    state: State
    residuals: Sequence[Floats]
    by_pose: Sequence[Floats]
    by_shape: Sequence[Floats]

    @property
    def error(self) -> float:
        """Half the chi-square."""
        return 0.5 * sum(float(r @ r) for r in self.residuals)

    @property
    def chi2(self) -> Floats:
        """(m,) chi-square of each match that its own best pose would take away: 6 degrees of freedom."""
        explained = [J @ np.linalg.lstsq(J, r)[0] for J, r in zip(self.by_pose, self.residuals, strict=True)]
        return np.array([float(part @ part) for part in explained])

    @property
    def weight(self) -> Floats:
        """(m,) weight of each match: no loss is applied."""
        return np.ones(len(self.residuals))

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        term = self.term
        moves = term.chains.derivatives(np.broadcast_to(np.eye(6), (len(term.landmarks), 6, 6)), self.state)
        for n, landmark in enumerate(term.landmarks):
            keys = [*term.chains.keys[n], term.shapes[landmark]]
            add_rows(linear, keys, [*(self.by_pose[n] @ D for D in moves[n]), self.by_shape[n]], -self.residuals[n])


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
