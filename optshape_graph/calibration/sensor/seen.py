"""A board in one revolution: its returns' plane, once and for all, and its ring ends as the solution has them.

A ring's end says that the boundary lies in an interval along the ring. In the company of everything else, which is the
pose and the errors that all revolutions share, it stands for a Gaussian (expectation propagation, see
`pose.ends.propagation`): a row that is linear in both, and made again as the company gets to know better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Self

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.calibration.sensor.unknowns import (
    DRIFT,
    EDGES_AT_RANGE,
    RANGE_BY_EDGES_SD,
    SIZE_SD,
    board_errors,
    bow,
)
from optshape_graph.errors import EstimationError
from optshape_graph.factors import (
    EDGE_OFFSET,
    RANGE_BIAS,
    BiasedMeasurement,
    SharedError,
    TemplateMeasurement,
    refine,
    template_rows,
)
from optshape_graph.factors.plane_returns import PlaneReturns, plane_measurement
from optshape_graph.factors.static import angle_errors
from optshape_graph.pose.ends import (
    EdgeGeometry,
    Problem,
    residual_intervals,
    update_sites,
)
from optshape_graph.pose.evidence import measure
from optshape_graph.pose.options import PoseOptions
from optshape_graph.scan import Scan
from optshape_graph.se3 import vec, vec_derivative
from optshape_graph.target import Target

BENDS = 3
"""Polynomials along a ring, from its slope on, in which smooth errors are looked for."""

LONG = 8
"""Returns of a ring from which on they are."""

ODD = 3.5
"""Standard deviations from where ring ends may be, lost returns included, beyond which an end counts for nothing."""


@dataclass(frozen=True, eq=False, repr=False)
class Seen(Value):
    """A board in one revolution, and the Gaussians that its ring ends stand for.

    Attributes:
        scan: its returns.
        target: the board.
        placement: number of the placement that it belongs to.
        problem: its ring ends, whatever the pose.
        plane: its returns against its plane, with the errors of rings and of the board.
        returns: the same, each for itself.
        ring: (N,) of these returns.
        noise: standard deviation of ranges within rings, metres.
        smooth: noise of ranges, metres, that would bend rings along themselves as much as they are bent; NaN: they are
            too short to tell. With white noise it is the same.
        labels: (M,) edge of each ring end.
        odd: (M,) whether it counts for nothing: far from any place that a last return may be at, it is a stray, or of
            something else.
        precision: (M,) of each Gaussian across its edge, 1/m2.
        information: (M,) its mean times its precision, 1/m.
    """

    scan: Scan
    target: Target
    placement: int
    problem: Problem
    plane: BiasedMeasurement
    returns: PlaneReturns
    ring: Ints
    noise: float
    smooth: float
    labels: Ints
    odd: Bools
    precision: Floats
    information: Floats

    @classmethod
    def of(
        cls, scan: Scan, target: Target, placement: int, T_target_lidar: Floats, options: PoseOptions = PoseOptions()
    ) -> Self:
        """Measure a board in one revolution.

        Args:
            scan: its returns, with rings, the sensor known.
            target: the board.
            placement: number of the placement.
            T_target_lidar: (4, 4) about where it is.
            options: of the estimate of poses.

        Raises:
            EstimationError: the returns span no plane.
        """
        (found,) = measure([scan], [target], options)
        if isinstance(found, EstimationError):
            raise found
        usual, factor = found.residuals.usual, float((found.residuals.noise / found.residuals.file_noise)[0])
        assert found.scan.ring is not None
        returns = found.returns.widened(factor, 1.0).select(usual)
        returns = returns.with_angles(found.plane.axes[0], found.scan.ring[usual], found.scan.sensor)
        yz = (returns.points @ T_target_lidar[:3, :3].T + T_target_lidar[:3, 3])[:, 1:]
        bent = -bow(target, yz) / returns.sigma[:, None]
        returns = returns.sharing(board_errors(target)[1:], bent)
        problem = found.problem
        rest, counts = found.residuals.rest[usual], len(np.unique(found.scan.ring[usual]))
        noise = 1.4826 * float(np.median(np.abs(rest))) * np.sqrt(len(rest) / max(len(rest) - counts - 5, 1))
        cosine = float(
            np.abs(found.plane.axes[0] @ scan.points.mean(axis=0)) / np.linalg.norm(scan.points.mean(axis=0))
        )
        g = problem.geometry(T_target_lidar[None])
        precision = 1.0 / (_own(g) + g.along[0] ** 2 * problem.edges.width**2 / 12)
        information = -precision * problem.edges.middle * g.along[0]
        smooth = _smooth(rest, found.scan.ring[usual])
        return cls(
            found.scan, target, placement, problem, plane_measurement(returns), returns, found.scan.ring[usual],
            noise / cosine, smooth / cosine, g.labels[0], np.zeros(len(precision), dtype=bool), precision, information,
        )  # fmt: skip

    @property
    def distance(self) -> float:
        """From the sensor, metres."""
        return float(np.linalg.norm(self.scan.points.mean(axis=0)))

    def drifting(self, drift: float) -> Self:
        """Return it with a range bias of each ring that is the placement's own.

        Args:
            drift: its standard deviation, metres.
        """
        if drift == 0:
            return self
        assert self.scan.sensor is not None
        errors = [SharedError(DRIFT, ring=error.ring) for error in self.returns.errors if error.kind == RANGE_BIAS]
        moved = drift / self.scan.sensor.range_bias_sds[self.ring] * self.returns.moved[:, 0]
        wider = self.returns.sharing(errors, moved[:, None], self.returns.which[:, :1])
        return replace(self, plane=plane_measurement(wider))

    def measurement(self, T_target_lidar: Floats) -> BiasedMeasurement:
        """Return plane and ring ends, linear in the errors, at a pose (4, 4)."""
        rows = self.rows(T_target_lidar)
        root = np.sqrt(self.precision)
        constant = rows.constant - self.information / self.precision
        on_edges = BiasedMeasurement.from_rows(
            root[:, None] * rows.A, root[:, None] * rows.B, root * constant, T_target_lidar, rows.errors
        )
        return on_edges + self.plane

    def rows(self, T_target_lidar: Floats) -> EdgeRows:
        """Return the residuals of the ring ends across their edges at a pose (4, 4), unweighted."""
        problem, target = self.problem, self.target
        edges, g = problem.edges, problem.geometry(T_target_lidar[None], self.labels[None])
        R, m = T_target_lidar[:3, :3], g.direction[0]
        A, constant = template_rows(edges.points, m, target.offsets[self.labels] + g.shift[0])
        middle = edges.points.mean(axis=0)
        ray = R @ (middle / np.linalg.norm(middle))
        yz = (edges.points @ R.T + T_target_lidar[:3, 3])[:, 1:]
        by_angle, angles = angle_errors(g.lifted[0], g.turned[0], edges.ring, problem.sensor)
        B = np.column_stack(
            [
                by_angle,
                g.across[0] * problem.beam.common,
                RANGE_BY_EDGES_SD * (m @ ray),
                -SIZE_SD * target.offsets[self.labels] / target.circumradius,
                -m[:, :1] * bow(target, yz),
            ]
        )
        errors = (*angles, SharedError(EDGE_OFFSET), SharedError(EDGES_AT_RANGE), *board_errors(target))
        return EdgeRows(A, B, constant, errors, g)

    def ring_residuals(self, T_target_lidar: Floats, beta: Mapping[SharedError, float]) -> tuple[Ints, Floats]:
        """Return its rings (R,), and how far the returns of each are behind the board along their rays, metres (R,).

        The pose is the one in the company of which they are least, the errors given.

        Args:
            T_target_lidar: (4, 4) about the pose.
            beta: the errors, in prior standard deviations.
        """
        whole = self.measurement(T_target_lidar)
        k = len(whole.shared)
        values = np.array([beta.get(error, 0.0) for error in whole.shared])
        given = TemplateMeasurement.from_stack(
            np.column_stack([whole.stack[:, k:-1], whole.stack[:, -1] + whole.stack[:, :k] @ values]),
            whole.n_rows,
            T_target_lidar,
        )
        T = refine(given)
        off = self.returns
        size = np.array([beta.get(error, 0.0) for error in off.errors])
        moved = (off.moved * size[off.which]).sum(axis=1) * off.sigma
        residual = off.points @ T[0, :3] + T[0, 3] - off.offset + moved
        cosine = np.abs(off.points @ T[0, :3]) / np.linalg.norm(off.points, axis=1)
        rings, column = np.unique(self.ring, return_inverse=True)
        return rings, np.bincount(column, residual / cosine) / np.bincount(column)

    def updated(
        self, T_target_lidar: Floats, place: Ints, beta: Floats, covariance: Floats, undecided: bool, step: float
    ) -> Seen:
        """Return it with its Gaussians made again.

        Args:
            T_target_lidar: (4, 4) of the solution.
            place: (j,) numbers, among the errors of the solution, of those of `rows`.
            beta: (k,) all errors of the solution, in prior standard deviations.
            covariance: (6 + k, 6 + k) of the right perturbation of the pose, rad and metres, and of the errors.
            undecided: whether rings may leave by another edge now, and ends become odd or cease to be: of two that
                each make the other odd, one by one would go on for ever.
            step: how far each Gaussian goes to where it belongs, 0 to 1.
        """
        rows = self.rows(T_target_lidar)
        g = rows.geometry
        J = np.zeros((len(rows.A), len(covariance)))
        J[:, :6] = rows.A @ vec_derivative(T_target_lidar)
        J[:, 6 + place] = rows.B
        prediction = rows.A @ vec(T_target_lidar) + rows.constant + rows.B @ beta[place]
        variance = ((J @ covariance) * J).sum(axis=1)
        intervals = residual_intervals(g, self.problem.ends)
        lower, upper, log_density = (part[:, 0] for part in intervals)
        site = update_sites(
            prediction, variance, _own(g), (lower, upper, log_density), self.precision, self.information
        )
        precision = self.precision + step * (site.precision - self.precision)
        information = self.information + step * (site.information - self.information)
        seen, odd = site.cavity_variance + _own(g), self.odd
        if undecided:
            beyond = np.maximum(lower.min(axis=0) - site.cavity_mean, site.cavity_mean - upper.max(axis=0))
            odd = beyond > ODD * np.sqrt(seen)
        precision, information = np.where(odd, 1e-6 / seen, precision), np.where(odd, 0.0, information)
        if not undecided:
            return replace(self, precision=precision, information=information)
        # Where a ring leaves by another edge now, its Gaussian begins anew.
        labels = self.problem.geometry(T_target_lidar[None]).labels[0]
        moved = labels != self.labels
        if moved.any():
            g = self.problem.geometry(T_target_lidar[None], labels[None])
            fresh = 1.0 / (_own(g) + g.along[0] ** 2 * self.problem.edges.width**2 / 12)
            precision = np.where(moved, fresh, precision)
            information = np.where(moved, -fresh * self.problem.edges.middle * g.along[0], information)
        return replace(self, labels=labels, odd=odd, precision=precision, information=information)


@dataclass(frozen=True, eq=False, repr=False)
class EdgeRows(Value):
    """Residuals A z + B beta + constant of ring ends across their edges, metres.

    Attributes:
        A: (M, 12) by the entries of z, metres for each.
        B: (M, k) metres for a prior standard deviation of each error.
        constant: (M,) metres.
        errors: (k,) what beta is.
        geometry: of the ring ends.
    """

    A: Floats
    B: Floats
    constant: Floats
    errors: tuple[SharedError, ...]
    geometry: EdgeGeometry


def _smooth(rest: Floats, ring: Ints) -> float:
    """Root mean square of what rings are bent by along themselves, metres, each bend as long as one return's noise.

    Args:
        rest: (N,) distances off the board and the rings' middles, metres, ring by ring, each from the left.
        ring: (N,) of each.
    """
    squares = []
    for part in np.split(rest, np.flatnonzero(np.diff(ring)) + 1):
        if len(part) >= LONG:
            bends = np.linalg.qr(np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, len(part)), BENDS))[0][:, 1:]
            squares.append((bends.T @ part) ** 2)
    return float(np.sqrt(np.mean(squares))) if squares else float("nan")


def _own(g: EdgeGeometry) -> Floats:
    """(M,) variance of each ring end about its residual, what its ring's angles add left out, m2."""
    return np.asarray(g.own[0] - g.of_ring[0])


def of_placement(seen: Sequence[Seen], T_target_lidar: Floats) -> BiasedMeasurement:
    """Return what all revolutions of a placement say of its pose and the errors, its own marginalised.

    Args:
        seen: its revolutions.
        T_target_lidar: (4, 4) its pose.
    """
    total = reduce(add, [one.measurement(T_target_lidar) for one in seen])
    return total.without([error for error in total.shared if error.kind == DRIFT])
