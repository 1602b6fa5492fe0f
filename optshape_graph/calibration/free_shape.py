"""The shape of a target as LiDARs see it: all vertices free, its drawing no more than where the search starts.

Each scan gives a posterior of the vertices, by expectation propagation over its edge points as in `pose.ends`,
with the vertices among the unknowns: the line of an edge through v and v' moves, at share s of its length, by
n . ((1 - s) dv + s dv'). What scans share adds up: the vertices, and how far across the edges the beam's width lets
them seem to lie, which no scan can tell from the size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from scipy.stats import chi2

from optshape_graph._arrays import Floats, Ints, Value, frozen
from optshape_graph.azimuth_grid import level_rings
from optshape_graph.beam import Beam
from optshape_graph.edges import extract_edge_points, with_top_and_bottom
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.factors.plane_returns import plane_measurement, returns_on_plane
from optshape_graph.plane import fit_plane
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.pose.ends import Problem, posterior_step
from optshape_graph.pose.options import PoseOptions
from optshape_graph.ring_returns import RingReturns
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, vec, vec_derivative
from optshape_graph.target import Target

FREE_SIGMA_M = 0.05
"""How far a vertex may be from its drawing before the drawing matters: a hundred times what the scans tell."""

BUILT_SIGMA_M = 1e-3
"""How true to a right drawing a target is built."""

RELINEARISATIONS, SWEEPS = 6, 6
"""Rounds, and updates of all edge points in each."""

DISAGREEMENT = 1e-3
"""Probability of sides so far from a right drawing, below which it is called wrong."""

SIZE_OFF = 0.025
"""Share by which the sum of the sides is off where the file is called wrong; ring biases of real sensors make 1 %."""


@dataclass(frozen=True, eq=False, repr=False)
class SeenShape(Value):
    """A polygon with its uncertainty.

    Attributes:
        name: the scan's; empty: of all scans together.
        polygon: (n, 2) vertices in the target's plane, (y, z), metres, laid over the drawing.
        covariance: (2 n, 2 n) of the vertices, square metres; wide where the polygon moves as a whole.
    """

    name: str
    polygon: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        for field in ("polygon", "covariance"):
            object.__setattr__(self, field, frozen(getattr(self, field)))

    @property
    def sides(self) -> Floats:
        """(n,) lengths of the edges, metres."""
        return np.asarray(np.linalg.norm(np.roll(self.polygon, -1, axis=0) - self.polygon, axis=1))

    @property
    def sides_covariance(self) -> Floats:
        """(n, n) of the lengths, square metres."""
        n = len(self.polygon)
        along = (np.roll(self.polygon, -1, axis=0) - self.polygon) / self.sides[:, None]
        J, k = np.zeros((n, n, 2)), np.arange(n)
        J[k, k], J[k, (k + 1) % n] = -along, along
        rows = J.reshape(n, -1)
        return np.asarray(rows @ self.covariance @ rows.T)


@dataclass(frozen=True, eq=False, repr=False)
class MeasuredShape(Value):
    """The shape of a target by all scans, and by each.

    Attributes:
        target: the drawing.
        joint: the shape by all scans.
        scans: the shape by each scan alone.
        beam_crossing: whether the scans' heights were corrected for where the sensor's beams cross.
    """

    target: Target
    joint: SeenShape
    scans: tuple[SeenShape, ...]
    beam_crossing: bool

    @property
    def mean_absolute_error(self) -> float:
        """Mean over scans and sides of the difference from the drawing, metres."""
        return float(np.mean([np.abs(scan.sides - self.target.edge_lengths) for scan in self.scans]))

    @property
    def agrees(self) -> bool:
        """Whether the drawing is within what the scans cannot tell."""
        off = self.joint.sides - self.target.edge_lengths
        total = self.joint.sides_covariance + BUILT_SIGMA_M**2 * np.eye(len(off))
        return bool(chi2.sf(off @ np.linalg.solve(total, off), len(off)) > DISAGREEMENT)


def measure_shape(returns: Sequence[Scan], target: Target) -> MeasuredShape:
    """Measure a target's shape from its returns in one or several scans of one sensor: is its file right?

    Ranges are taken as they are: a bias of 1 % makes the target 1 % larger or smaller. So does the width of the beam,
    which is why the sizes of all sides are uncertain together, by up to half of it, and their ratios are not.

    Beams of some sensors cross beside the axis (`SensorModel.beam_crossing`), and drivers report heights as if they
    met on it; simulated scans and some drivers do not err so. Which it is, the target's own likelihoods tell.

    Args:
        returns: the returns on the target and no others, with rings; each scan is a placement of its own. Scans with
            angular noise are left out.
        target: its drawing: number of vertices, and a rough idea of where they are.

    Raises:
        EstimationError: no scans, or one that determines no pose, or no shape, at all.
    """
    scans = [scan for scan in returns if len(scan) and scan.ring is not None and not _noisy(scan)]
    if not scans:
        raise EstimationError(
            f"no scan to measure target '{target.name}' in; expected at least one, with rings of exact angles"
        )
    crossed, corrected = _with_crossing(scans, target)
    n = len(target)
    seen, information, weighted, by_offset = [], np.eye(2 * n) / FREE_SIGMA_M**2, np.zeros(2 * n), np.zeros(2 * n)
    for scan, T_target_lidar in corrected:
        mean, covariance = _free(scan, target, T_target_lidar)
        alone = np.linalg.inv(covariance) - _prior(target)
        information = information + alone[1:, 1:]
        by_offset = by_offset + alone[1:, 0]
        weighted = weighted + alone[1:] @ (mean - _start(target))
        seen.append(SeenShape(scan.name, mean[1:].reshape(-1, 2), covariance[1:, 1:]))
    # That the offset's effect changes with range would tell it, by less than what is left out here changes with range.
    # So it is not estimated, but it counts.
    total = np.asarray(np.linalg.inv(information))
    ranges = np.concatenate([np.linalg.norm(scan.points, axis=1) for scan, _ in corrected])
    common = Beam.of(corrected[0][0].sensor).offset_of_rays(ranges) * total @ by_offset
    polygon = target.polygon + (total @ weighted).reshape(n, 2)
    return MeasuredShape(target, SeenShape("", polygon, total + np.outer(common, common)), tuple(seen), crossed)


def wrong_size(returns: Sequence[Scan], target: Target) -> str:
    """Say by how much a target's sides are longer or shorter than its file has them; "" where they are not.

    Args:
        returns: the returns on it of one scan or more.
        target: as its file has it.
    """
    try:
        shape = measure_shape(returns, target)
    except EstimationError:  # no rings, or angles with noise: no shape to be told
        return ""
    ratio = float(shape.joint.sides.sum() / target.edge_lengths.sum())
    if shape.agrees or abs(ratio - 1) < SIZE_OFF:
        return ""
    size = f"{100 * abs(ratio - 1):.1f} % {'longer' if ratio > 1 else 'shorter'}"
    sides = " ".join(f"{1e3 * side:.0f}" for side in shape.joint.sides)
    expected = " ".join(f"{1e3 * side:.0f}" for side in target.edge_lengths)
    return (
        f"the sides of target '{target.name}' are {size} than its file says ({sides} mm by the LiDAR, {expected} by "
        f"the file): is the file right?"
    )


def _start(target: Target) -> Floats:
    """(1 + 2 n,) offset across the edges, and vertices, before any scan."""
    return np.concatenate([[0.0], target.polygon.ravel()])


def _prior(target: Target) -> Floats:
    """(1 + 2 n, 1 + 2 n) information of them."""
    return np.diag([1.0 / Beam.common**2, *np.full(2 * len(target), 1.0 / FREE_SIGMA_M**2)])


def _with_crossing(scans: Sequence[Scan], target: Target) -> tuple[bool, list[tuple[Scan, Floats]]]:
    """Say whether the likelihoods speak for a correction of heights; the scans as they prefer, with T_target_lidar."""
    plain = _posed(scans, target)
    if all(scan.sensor is None or scan.sensor.beam_crossing == 0 for scan in scans):
        return False, [(scan, estimate.T_target_lidar) for scan, estimate in zip(scans, plain, strict=True)]
    corrected = [_lowered(scan) for scan in scans]
    lowered = _posed(corrected, target)
    gain = sum(b.log_likelihood - a.log_likelihood for a, b in zip(plain, lowered, strict=True))
    chosen, estimates = (corrected, lowered) if gain > 0 else (scans, plain)
    return gain > 0, [(scan, estimate.T_target_lidar) for scan, estimate in zip(chosen, estimates, strict=True)]


def _posed(scans: Sequence[Scan], target: Target) -> list[PoseEstimate]:
    """Estimate the pose in each scan; the first that has none raises its error."""
    estimates = estimate_poses(scans, target)
    failed = [one for one in estimates if isinstance(one, EstimationError)]
    if failed:
        raise failed[0]
    return [one for one in estimates if isinstance(one, PoseEstimate)]


def _lowered(scan: Scan) -> Scan:
    """Scale the heights of a target's returns to what they are if the beams cross beside the axis.

    A ray through (crossing, 0) at elevation e reaches the height (h - crossing) tan e at horizontal distance h, where
    the driver says h tan e. The target's mean distance serves for all its returns, which leaves rings cones.
    """
    sensor = scan.sensor
    if sensor is None or sensor.beam_crossing == 0:
        return scan
    share = 1.0 - sensor.beam_crossing / float(np.median(np.hypot(scan.points[:, 0], scan.points[:, 1])))
    elevations = np.arctan(share * np.tan(sensor.elevations))
    return replace(scan, points=scan.points * [1.0, 1.0, share], sensor=replace(sensor, elevations=elevations))


def _free(scan: Scan, target: Target, T: Floats) -> tuple[Floats, Floats]:
    """Mean (1 + 2 n,) and covariance of the offset across the edges and the vertices, by one scan.

    Args:
        scan: the returns.
        target: its drawing.
        T: (4, 4) about T_target_lidar.
    """
    n = len(target)
    problem = _problem(scan, target)
    prior, start = _prior(target), _start(target)
    x = start
    for _ in range(RELINEARISATIONS):
        geometry = problem.geometry(T[None])
        across, m = geometry.across[0], geometry.direction[0] @ T[:3, :3]
        by_vertex = _by_vertex(problem, T, geometry.labels[0])
        J = np.hstack([np.cross(problem.edges.points, m), m, across[:, None], by_vertex])
        D, z = vec_derivative(T), vec(T)
        precision, shift = np.zeros((7 + 2 * n, 7 + 2 * n)), np.zeros(7 + 2 * n)
        precision[:6, :6] = D.T @ problem.plane[:12, :12] @ D + 1e-6 * np.eye(6)
        shift[:6] = -(z @ problem.plane[:12, :12] + problem.plane[12, :12]) @ D
        precision[6:, 6:], shift[6:] = prior, prior @ (start - x)
        residual = geometry.residual[0] + x[0] * across
        inset, spread = problem.edges.middle, problem.edges.width**2 / 12
        step = posterior_step(
            problem.ends, geometry, precision[None], shift[None], J[None], residual[None], inset, spread, SWEEPS
        )
        mean, covariance = step.mean[0], step.covariance[0]
        x = x + mean[6:]
        # A target's origin is the mean of its vertices: the pose takes up what the vertices move together.
        polygon = x[1:].reshape(n, 2)
        T = np.array(T @ gtsam.Pose3.Expmap(mean[:6]).matrix())
        T[1:3, 3] -= polygon.mean(axis=0)
        x[1:] = (polygon - polygon.mean(axis=0)).ravel()
        try:
            problem = replace(problem, target=Target.from_polygon(polygon, target.name))
        except InputError as error:
            raise EstimationError(f"scan '{scan.name}' leaves the target's shape open: {error}") from error
    return x, covariance[6:, 6:]


def _noisy(scan: Scan) -> bool:
    """Whether its angles are."""
    return bool(level_rings(RingReturns.of([scan]))[1].any())


def _problem(scan: Scan, target: Target) -> Problem:
    edges, plane = extract_edge_points(scan), fit_plane(scan.points, scan.ring)
    if edges.n_rings == edges.ring[-1] - edges.ring[0] + 1:
        edges = with_top_and_bottom(edges, RingReturns.of([scan]))
    on_plane = plane_measurement(returns_on_plane(scan, plane.axes[0], plane.distance)).marginal(1.0)
    return Problem(edges, target, on_plane.quadratic(), Beam.of(scan.sensor), PoseOptions())


def _by_vertex(problem: Problem, T: Floats, labels: Ints) -> Floats:
    """(M, 2 n) derivative of each edge point's residual by the vertices."""
    polygon, edges = problem.target.polygon, problem.edges
    n, rows = len(polygon), np.arange(len(edges))
    boundary = edges.points + edges.middle[:, None] * edges.outward(T[0, :3])
    yz = apply(T, boundary)[:, 1:]
    first, side = polygon[labels], polygon[(labels + 1) % n] - polygon[labels]
    share = (((yz - first) * side).sum(axis=1) / (side**2).sum(axis=1)).clip(0.0, 1.0)[:, None]
    J = np.zeros((len(edges), n, 2))
    J[rows, labels] = -(1 - share) * problem.target.normals[labels]
    J[rows, (labels + 1) % n] = -share * problem.target.normals[labels]
    return J.reshape(len(edges), -1)
