"""Points of a target that a sensor sees, as a term of the engine: corners in images, markers of motion capture.

A sighting is of T_sensor_target, a chain, and of vectors that sightings of one target or camera share: where a pattern
or markers lie, a lens. beta are these, one after the other. Linearised, its rows reduce to [R_xi R_beta d; 0 S s], as
those of scans with a LiDAR's errors do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import gtsam
import numpy as np

from optshape_graph._arrays import Floats, Ints, Value
from optshape_graph.calibration.camera.factors import INTRINSICS_SIGMA, LENS, PRINT_SIGMA_M, CompiledCamera
from optshape_graph.calibration.camera.lens import lens_derivative
from optshape_graph.calibration.images.image_points import ImagePoints
from optshape_graph.calibration.images.planar_pose import whitened_errors
from optshape_graph.camera import CameraIntrinsics
from optshape_graph.factors._rows import triangular
from optshape_graph.graph import Chain, Chains, State, add_rows
from optshape_graph.graph.terms import huber, huber_weight
from optshape_graph.se3 import skew


class Seen(Protocol):
    """Points of a target, as one sensor sees them."""

    def whitened(self, T_sensor_target: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return residuals (n,), and their derivatives by the pose's right perturbation (n, 6) and by beta (n, k)."""


@dataclass(frozen=True, eq=False, repr=False)
class Corners(Value):
    """Points of a target in an image.

    beta is (y, z) of a printed pattern on its board, metres, where the points are a pattern's; then, where the lens is
    free, how far every point of the target is from where it should be, in PRINT_SIGMA_M, and the lens, in standard
    deviations from the one given. A lens is told by what points leave, to which their own places matter.

    Attributes:
        points: as the sighting is read.
        camera: the lens as given.
        places: (m,) number of each point among all of its target that images show; None: the lens is as given.
    """

    points: ImagePoints
    camera: CameraIntrinsics
    places: Ints | None = None

    def whitened(self, T_sensor_target: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """See `Seen.whitened`."""
        points, camera, T = self.points, self.camera, np.array(T_sensor_target)
        printed = 2 * points.printed
        moved = np.append(0.0, beta[:2]) if printed else np.zeros(3)
        T[:3, 3] += T[:3, :3] @ moved  # a pattern that is moved on its board is a board that is moved
        if self.places is not None:
            off, lens = beta[printed : -len(LENS)].reshape(-1, 3), beta[-len(LENS) :]
            points = replace(points, points=points.points + PRINT_SIGMA_M * off[self.places])
            camera = with_lens(camera, lens)
        r, by_pattern = whitened_errors(points, camera, T)
        # T Exp(xi) Trans(m) = T Trans(m) Exp(xi') with xi' = (w, v - m x w)
        by_pose = by_pattern.copy()
        by_pose[:, :3] -= by_pattern[:, 3:] @ skew(moved)
        columns = [by_pattern[:, 4 : 4 + printed]]
        if self.places is not None:
            by_place = np.zeros((len(points), 2, len(off), 3))
            by_place[np.arange(len(points)), :, self.places] = by_pattern[:, 3:].reshape(-1, 2, 3)
            columns.append(PRINT_SIGMA_M * by_place.reshape(len(r), -1))
            columns.append(lens_derivative(points, CompiledCamera.of(camera), T) * INTRINSICS_SIGMA[LENS])
        return r, by_pose, np.hstack(columns)


def with_lens(camera: CameraIntrinsics, beta: Floats) -> CameraIntrinsics:
    """Return intrinsics with a lens (8,), in standard deviations of its prior from the given one."""
    compiled = CompiledCamera.of(camera)
    vector = compiled.vector
    vector[LENS] += INTRINSICS_SIGMA[LENS] * beta
    return compiled.refined(vector)


@dataclass(frozen=True, eq=False, repr=False)
class Marked(Value):
    """Markers of a target; beta is (3 n,), where all its markers are, less its vertices, metres, target frame.

    Attributes:
        points: (k, 3) metres, the sensor's frame.
        near: (k, 3) the vertices that they are near, metres, target frame.
        vertices: (k,) numbers of these.
        whiten: (3 k, 3 k) square root information of the points, the error of the sensor's own pose among it.
    """

    points: Floats
    near: Floats
    vertices: Ints
    whiten: Floats

    @classmethod
    def of(cls, points: Floats, near: Floats, vertices: Ints, sigma: float, of_body: Floats) -> Marked:
        """Return markers with noise `sigma` of a coordinate, and a covariance (6, 6) of the sensor's own pose."""
        # q = (T Exp(x))^-1 p moves by -x_v + [q]x x_w
        moved = np.concatenate([np.concatenate([skew(q), -np.eye(3)], axis=1) for q in points])
        covariance = sigma**2 * np.eye(3 * len(points)) + moved @ of_body @ moved.T
        return cls(points, near, vertices, np.linalg.inv(np.linalg.cholesky(covariance)))

    def whitened(self, T_sensor_target: Floats, beta: Floats) -> tuple[Floats, Floats, Floats]:
        """See `Seen.whitened`."""
        R, t = T_sensor_target[:3, :3], T_sensor_target[:3, 3]
        places = self.near + beta.reshape(-1, 3)[self.vertices]
        r = (places @ R.T + t - self.points).ravel()
        by_pose = np.concatenate([np.concatenate([-R @ skew(p), R], axis=1) for p in places])
        by_beta = np.zeros((len(r), len(beta)))
        for k, vertex in enumerate(self.vertices):
            by_beta[3 * k : 3 * k + 3, 3 * vertex : 3 * vertex + 3] = R
        return self.whiten @ r, self.whiten @ by_pose, self.whiten @ by_beta


@dataclass(frozen=True, eq=False, repr=False)
class Points(Value):
    """Sightings of points, each of T_sensor_target and of a vector variable.

    Attributes:
        chains: of T_sensor_target.
        seen: (m,) sightings.
        keys: (m,) of the vectors that each shares with others, in the order of beta.
        loss: of Huber, as in `Templates`.
    """

    chains: Chains
    seen: tuple[Seen, ...]
    keys: tuple[tuple[int, ...], ...]
    loss: float = np.inf

    @classmethod
    def of(
        cls, seen: Sequence[Seen], chains: Sequence[Chain], keys: Sequence[Sequence[int]], loss: float = np.inf
    ) -> Points:
        """Return the term of sightings (m,), what T_sensor_target is made of (m,), and the keys of what they share."""
        return cls(Chains(chains), tuple(seen), tuple(tuple(own) for own in keys), loss)

    def at(self, state: State) -> PointsModel:
        """Return the Gauss-Newton model of every sighting at a state."""
        rows, floors = [], np.zeros(len(self.seen))
        for n, (seen, keys, T) in enumerate(zip(self.seen, self.keys, self.chains.at(state), strict=True)):
            beta = np.concatenate([np.zeros(0), *(state.values.atVector(key) for key in keys)])
            r, by_pose, by_beta = seen.whitened(T, beta)
            R = triangular(np.column_stack([by_pose, by_beta, r]))
            k = 6 + len(beta)
            floors[n] = float(np.square(R[k:, -1]).sum())
            rows.append(R[:k])
        return PointsModel(self, state, rows, floors)


@dataclass(frozen=True, eq=False, repr=False)
class PointsModel(Value):
    """Gauss-Newton models of sightings of points.

    Attributes:
        term: that this is the model of.
        state: where it is linearised.
        rows: (r, n) of each, whitened, r up to 6 + k and n = 7 + k: [by pose, by beta, residual], the pose's first.
        floor: (m,) chi-square that neither pose nor beta takes away.
    """

    term: Points
    state: State
    rows: list[Floats]
    floor: Floats

    @property
    def chi2(self) -> Floats:
        """(m,) chi-square of each that its own best pose would take away: 6 degrees of freedom."""
        return np.array([np.square(rows[:6, -1]).sum() for rows in self.rows])

    @property
    def weight(self) -> Floats:
        """(m,) weight that the loss gives each, 0 to 1."""
        return huber_weight(self.chi2, self.term.loss)

    @property
    def error(self) -> float:
        """Half the chi-square, the loss applied to what a pose can take away."""
        alone = sum(float(np.square(rows[6:, -1]).sum()) for rows in self.rows) + float(self.floor.sum())
        return 0.5 * float(huber(self.chi2, self.term.loss).sum()) + 0.5 * alone

    def add_to(self, linear: gtsam.GaussianFactorGraph) -> None:
        """Add the linearisation to a graph."""
        root = np.sqrt(self.weight)
        by_pose = np.zeros((len(self.rows), 6 + max((r.shape[1] - 7 for r in self.rows), default=0), 6))
        weighted = []
        for n, rows in enumerate(self.rows):
            rows = rows.copy()
            rows[:6] *= root[n]
            by_pose[n, : len(rows)] = rows[:, :6]
            weighted.append(rows)
        blocks = self.term.chains.derivatives(by_pose, self.state)
        for keys, by, rows, shared in zip(self.term.chains.keys, blocks, weighted, self.term.keys, strict=True):
            m = len(rows)
            columns = split(rows[:, 6:-1], shared, self.state)
            add_rows(linear, [*keys, *shared], [*(b[:m] for b in by), *columns], -rows[:, -1])


def split(by_beta: Floats, keys: Sequence[int], state: State) -> list[Floats]:
    """Split columns by beta (r, k), whitened, into those of each vector, (r, k_i)."""
    ends = np.cumsum([len(state.values.atVector(key)) for key in keys])
    return np.split(by_beta, ends[:-1], axis=1) if keys else []
