"""How likely a scan is, given the pose: what the posterior of the edge points leaves out, and the whole for thin beams.

Evidence that the posterior leaves out is free: where the rings that returned nothing would have met the target
(`missed_rings`), and that each ring leaves it within an edge, not on its extension (`exit_probability`).

`Firings` has the likelihood by beams without width as it is: no edge assigned, nothing linearised.

A ring of a convex polygon is a chord. In units of the azimuth step, it holds the firings of a grid from the first
beyond its right end to the last before its left end. The returns' mean azimuth says where those firings are, up to one
Gaussian error for the ring; where the grid lies is unknown, and uniform beforehand. So a ring with n returns has, at
a grid's place g, the density N(mean; g, sigma^2 / n) if the chord ends within one step beyond the outermost firings
(or, with a small probability, elsewhere: a return lost or too many), and a ring without returns has a chord that
fits between two firings, or was lost.

If the lasers fire on one grid, its place is common: rings are independent given it, and it is averaged over. If
they do not, each ring has its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.edges import EdgePoints
from optshape_graph.gaussian import log_ndtr, logsumexp, ndtr
from optshape_graph.pose.mixture import LogDensity
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.propagation import Posterior, Problem
from optshape_graph.pose.rays import Rays, chords, sight_planes
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse, vec
from optshape_graph.sensor import SensorModel

KNOWN_LOST = (10.0, 0.4)
"""Rings that count as tried before a scan, and as lost: one in 25, as on recordings."""

_PLACES = 24  # of the grid within a step that are averaged over
_SEEN = 0.05  # a ring's place counts as known below this, in steps
_REACH = 3.5  # standard deviations of a ring's place that count


def share_lost(edges: EdgePoints) -> float:
    """Share of rings that return nothing though they meet the target, from those between the lowest and highest."""
    between = edges.ring[-1] - edges.ring[0] + 1
    tried, lost = KNOWN_LOST
    return float((between - edges.n_rings + lost) / (between + tried))


def missed_rings(problem: Problem, posterior: Posterior, ends: EdgePoints, sensor: SensorModel) -> Floats:
    """Logarithm of the probability (C,) that the rings without returns return nothing.

    A ring that crosses the target by less than a step may fall between two firings. Beyond that it must have been
    lost: occluded, outside the field of view, dropped. How often that happens, the rings between the lowest and the
    highest that did return tell.

    Args:
        problem: one target in one scan.
        posterior: of C poses.
        ends: of the rings that returned.
        sensor: whose table says which rings there are.
    """
    T, noise = posterior.T_target_lidar, problem.noise
    vertices = (problem.target.vertices - T[:, None, :3, 3]) @ T[:, :3, :3]
    ranges = np.linalg.norm(problem.edges.points, axis=1)
    narrower = 2 * posterior.offset * float(np.mean(noise.width(ranges) / ranges))  # as the target seems to the rings
    lost = share_lost(ends)
    outer = np.delete(sensor.elevations, slice(ends.ring[0], ends.ring[-1] + 1))
    right, left = chords(sight_planes(vertices), outer, ends.reference_azimuth)
    with np.errstate(invalid="ignore"):
        steps = np.nan_to_num((left - right - narrower[:, None]) / ends.azimuth_step, neginf=0.0)
    unseen = np.clip(1.0 - steps, 0.0, 1.0)
    return np.asarray(np.log(unseen * (1 - lost) + lost).sum(axis=1))


def other_edges(problem: Problem, posterior: Posterior) -> Floats:
    """Distance (C, M, n), metres, of boundary points beyond each edge line; -inf for the edge each is assigned to."""
    geometry, target = posterior.geometry, problem.target
    T = posterior.T_target_lidar
    boundary = _boundary(problem, posterior)
    y = (boundary @ np.swapaxes(T[:, :3, :3], 1, 2)) + T[:, None, :3, 3]
    beyond = y[..., 1:] @ target.normals.T - target.offsets
    np.put_along_axis(beyond, geometry.labels[..., None], -np.inf, axis=-1)
    return np.asarray(beyond)


def _boundary(problem: Problem, posterior: Posterior) -> Floats:
    """(C, M, 3) where the posterior puts the boundary that each edge point stands for, LiDAR frame, on the plane."""
    T, edges = posterior.T_target_lidar, problem.edges
    normal = T[:, 0, :3]
    ray = edges.points + (posterior.inset + posterior.shift)[..., None] * edges.sweep
    return np.asarray(ray * (-T[:, 0, 3, None] / np.einsum("ci,cmi->cm", normal, ray))[..., None])


def exit_probability(problem: Problem, posterior: Posterior) -> Floats:
    """Logarithm of the probability (C,) that each ring leaves the target by the edge it is assigned to.

    Edge lines are infinite; the target is not: a boundary point must be inside all other edges, as far as the
    pose and the point's own scatter tell, down to the probability of a lost return.
    """
    beyond = other_edges(problem, posterior)
    worst = beyond.argmax(axis=-1)
    R = posterior.T_target_lidar[:, :3, :3]
    normal = np.concatenate([np.zeros((*worst.shape, 1)), problem.target.normals[worst]], axis=-1) @ R
    J = np.concatenate([np.cross(_boundary(problem, posterior), normal), normal], axis=-1)
    variance = ((J @ posterior.covariance) * J).sum(axis=-1)
    variance += posterior.geometry.own
    inside = log_ndtr(-np.take_along_axis(beyond, worst[..., None], axis=-1)[..., 0] / np.sqrt(variance))
    return np.asarray(np.maximum(inside, np.log(0.1 * problem.noise.options.lost_ends)).sum(axis=1))


def alternative_labels(problem: Problem, posterior: Posterior, limit: int) -> Ints:
    """Labels (V, M) of the associations that differ from a posterior's in one edge point near a vertex.

    Args:
        problem: one target in one scan.
        posterior: of one pose.
        limit: at most so many, those nearest to a vertex.
    """
    beyond = other_edges(problem, posterior)[0]
    nearest = beyond.argmax(axis=-1)
    reach = 0.5 * np.abs(posterior.geometry.along[0]) * problem.edges.width
    closeness = -beyond.max(axis=-1) / (posterior.sigma[0] + reach)
    order = np.argsort(closeness)[:limit]
    order = order[closeness[order] < 1.0]
    labels = np.repeat(posterior.geometry.labels, len(order), axis=0)
    labels[np.arange(len(order)), order] = nearest[order]
    return labels


@dataclass(frozen=True, eq=False, repr=False)
class Firings(Value):
    """What a scan says of chords, in azimuth steps.

    Attributes:
        left: (R,) last firing to the left of each ring that returned, number from the reference azimuth.
        right: (R,) last to the right, number likewise.
        shift: (R,) standard deviation of where they are, in units of steps.
        offset: (R,) azimuth of each ring's laser relative to the sensor's, in units of steps.
        elevations: (R,) of those rings, rad.
        empty: (O,) elevations of rings above and below them, that returned nothing, rad.
        empty_offset: (O,) azimuth of their lasers, in units of steps.
        options: how probable it is that a ring's end is not where its last return says, and where it is then.
        lost_ring: probability that a ring returns nothing whatever its chord.
        step: rad.
        reference_azimuth: rad.
    """

    left: Floats
    right: Floats
    shift: Floats
    offset: Floats
    elevations: Floats
    empty: Floats
    empty_offset: Floats
    options: PoseOptions
    lost_ring: float
    step: float
    reference_azimuth: float

    @classmethod
    def of(cls, ends: EdgePoints, scan: Scan, options: PoseOptions = PoseOptions()) -> Firings:
        """Collect it from both ends of each ring, on the firing grid, and from the sensor's table."""
        step, rings = ends.azimuth_step, ends.ring[::2]
        x, y, z = ends.points[::2].T
        table = np.zeros(0) if scan.sensor is None else scan.sensor.elevations
        offsets = None if scan.sensor is None else scan.sensor.azimuth_offsets
        offsets = np.zeros(max(len(table), rings[-1] + 1)) if offsets is None else offsets / step
        outer = np.r_[: rings[0], rings[-1] + 1 : len(table)]
        return cls(
            left=ends.azimuth[::2] / step,
            right=ends.azimuth[1::2] / step,
            shift=np.maximum(ends.shift[::2], options.flatness / np.linalg.norm(ends.points[::2], axis=1)) / step,
            offset=offsets[rings],
            elevations=np.arctan2(z, np.hypot(x, y)),
            empty=table[outer],
            empty_offset=offsets[outer],
            options=options,
            lost_ring=share_lost(ends),
            step=step,
            reference_azimuth=ends.reference_azimuth,
        )

    def log_likelihood(self, corners: Floats, offset: Floats | float = 0.0) -> Floats:
        """Logarithm (S,) of the likelihood of polygons (S, n, 3), LiDAR frame, metres; no width, so no offset."""
        right, left = self._chords(corners, self.elevations)
        beyond_left, beyond_right = left - self.left, self.right - right
        # A ring far above or below no polygon meets has nothing to say: most of the sensor's.
        met = self._may_be_met(corners)
        empty_right, empty_left = self._chords(corners, self.empty[met])
        rings = self._own_grids(beyond_left, beyond_right)
        own = rings + self._missed(np.clip(1.0 - (empty_left - empty_right), 0.0, 1.0)).sum(axis=-1)
        offset = self.empty_offset[met]
        if self.shift.min() > _SEEN:
            common = self._common_grid(beyond_left, beyond_right, empty_left, empty_right, offset)
            return np.asarray(np.logaddexp(own, common))
        place = self._seen_place()
        if place is None:
            return np.asarray(own)
        return np.asarray(rings + self._missed(~_fired(empty_left, empty_right, place + offset)).sum(axis=-1))

    def _seen_place(self) -> float | None:
        """Place of the common grid where each ring's is all but known; None where they differ."""
        place = self.left - self.offset
        off = (place - place[0] + 0.5) % 1.0 - 0.5
        mean = float(np.average(off, weights=self.shift**-2))
        return None if (np.abs(off - mean) > 4 * self.shift).any() else float(place[0]) + mean

    def _missed(self, unseen: Floats | Bools) -> Floats:
        """Logarithm of the probability of a ring without returns, from that of firing past its chord."""
        return np.log(unseen * (1 - self.lost_ring) + self.lost_ring)

    def _chords(self, corners: Floats, elevations: Floats) -> tuple[Floats, Floats]:
        """Right and left ends (S, R) in steps; a ring that misses has its left end right of its right end."""
        right, left = chords(sight_planes(corners), elevations, self.reference_azimuth)
        right, left = np.minimum(right, 4.0) / self.step, np.maximum(left, -4.0) / self.step
        return right, left

    def _may_be_met(self, corners: Floats) -> Ints:
        elevation = np.arctan2(corners[..., 2], np.hypot(corners[..., 0], corners[..., 1]))
        # Lines between corners rise above them in elevation, but by less than a tenth of their extent.
        low, high = elevation.min(), elevation.max()
        slack = 0.1 * (high - low)
        return np.flatnonzero((self.empty > low - slack) & (self.empty < high + slack))

    def _own_grids(self, beyond_left: Floats, beyond_right: Floats) -> Floats:
        """Logarithm (S,) of the likelihood of the rings that returned, each on a grid of its own."""
        total = np.zeros(beyond_left.shape)
        for low_left, high_left, density_left in self._intervals:
            for low_right, high_right, density_right in self._intervals:
                # With firings farther left by e, the chord ends less far beyond the left one, farther beyond the right.
                first = np.maximum(beyond_left - high_left, low_right - beyond_right) / self.shift
                last = np.minimum(beyond_left - low_left, high_right - beyond_right) / self.shift
                mass = np.where(first > 0, ndtr(-first) - ndtr(-last), ndtr(last) - ndtr(first))
                total += density_left * density_right * np.where(last > first, mass, 0.0)
        return np.asarray(np.log(total + self._floor).sum(axis=-1))

    def _common_grid(
        self, beyond_left: Floats, beyond_right: Floats, empty_left: Floats, empty_right: Floats, offset: Floats
    ) -> Floats:
        """Logarithm (S,) of the likelihood of all rings, averaged over the place of one grid."""
        place = (np.arange(_PLACES) + 0.5) / _PLACES
        log = np.zeros((len(beyond_left), _PLACES))
        for k, (left, shift) in enumerate(zip(self.left, self.shift, strict=True)):
            whole = np.arange(-np.ceil(_REACH * shift), np.ceil(_REACH * shift) + 1)
            # How far left of its likeliest place the ring's last firing is, if the grid is at a place.
            e = (place + self.offset[k] - left + 0.5) % 1.0 - 0.5 + whole[:, None]
            density = np.exp(-0.5 * (e / shift) ** 2) / (shift * np.sqrt(2 * np.pi))
            at_left = self._end_density(beyond_left[:, k, None, None] - e)
            at_right = self._end_density(beyond_right[:, k, None, None] + e)
            log += np.log((at_left * at_right * density).sum(axis=1) + self._floor)
        fired = _fired(empty_left[..., None], empty_right[..., None], place + offset[:, None])
        log += self._missed(~fired).sum(axis=1)
        return np.asarray(logsumexp(log, axis=1) - np.log(_PLACES))

    def _end_density(self, beyond: Floats) -> Floats:
        """Probability density, per step, of how far beyond a ring's last firing its chord ends."""
        (low, high, density), (low_lost, high_lost, density_lost) = self._intervals
        proper, lost = (beyond >= low) & (beyond < high), (beyond >= low_lost) & (beyond < high_lost)
        return np.asarray(density * proper + density_lost * lost)

    @property
    def _intervals(self) -> tuple[tuple[float, float, float], ...]:
        """Ends, in steps, and densities of where a chord may end beyond a ring's last firing."""
        low, high = self.options.lost_span
        share = self.options.lost_ends_of_rays
        return (0.0, 1.0, 1 - share), (low, high, share / (high - low))

    @property
    def _floor(self) -> float:
        """Density of a ring neither of whose ends is near where it should be."""
        return (0.1 * self.options.lost_ends_of_rays) ** 2


def _fired(left: Floats, right: Floats, place: Floats) -> Bools:
    """Whether a grid at a place has a firing between the ends of chords, all in steps."""
    return np.asarray(np.floor(left - place) >= np.ceil(right - place))


def scan_log_likelihood(problem: Problem, scan: Scan, ends: EdgePoints) -> LogDensity:
    """Return the logarithm of the likelihood of a scan, up to a constant, as a function of pose and common offset.

    Args:
        problem: one target in one scan.
        scan: the returns.
        ends: both ends of each ring, on the grid of firings.

    Returns:
        A function of T_lidar_target (S, 4, 4) and of the offset across the edges (S,), in beam widths.
    """
    noise, form = problem.noise, problem.plane
    rays: Firings | Rays
    if noise.ideal and not ends.scatter.any():
        rays = Firings.of(ends, scan, noise.options)
    else:
        ranges = np.linalg.norm(ends.points[::2], axis=1)
        beam, extent = noise.width(ranges) / ranges, 2 * problem.target.circumradius
        rays = Rays.of(scan, ends, beam, extent, noise.options.odd_ends, share_lost(ends))

    def log_likelihood(T_lidar_target: Floats, offset: Floats) -> Floats:
        z = vec(inverse(T_lidar_target))
        on_plane = -0.5 * (((z @ form[:12, :12] + 2 * form[12, :12]) * z).sum(axis=-1) + form[12, 12])
        corners = apply(T_lidar_target, problem.target.vertices)
        on_edges = rays.log_likelihood(corners, offset + noise.offset)
        return np.asarray(on_plane - 0.5 * (offset / noise.common) ** 2 + on_edges)

    return log_likelihood
