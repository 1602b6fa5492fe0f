"""A target's outline laid over ring ends in their plane: a quick fit before the pose is estimated, and after.

The first look tries every turn of the outline, with the centre of its area at that of the rings' area. The best turns
are refined by Gauss-Newton steps with weights that ignore stray ends (Cauchy's, narrowing). Beside turn and place, a
common shift across the edges is fitted, since the beam's width and blooming move all ring ends alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.detection.segments import OrderedScan
from optshape_graph.plane import ReturnsPlane
from optshape_graph.se3 import transform
from optshape_graph.target import Target

_ANGLES = np.linspace(0.0, 2 * np.pi, 36, endpoint=False)
_STARTS = 4  # turns that are refined
_STEPS = 6  # Gauss-Newton steps from each
_MOST_RINGS = 32  # rings that a first look uses at most, evenly over all
_STRAYS = 0.1  # share of ends that lie anywhere: mixed, lost, or on something that touches the target
_PLACE, _SHIFT = 0.2, 0.03  # prior standard deviations of the place and of the common shift, in circumradii
_FITTED = 4  # numbers that are fitted: turn, place, shift


@dataclass(frozen=True, eq=False, repr=False)
class Boundary(Value):
    """The boundary of a surface, from the ends of its rings.

    Attributes:
        plane: of the surface.
        at: (M, 2) expected end of the surface beyond each ring end, metres, along the plane's axes.
        sd: (M,) its standard deviation, metres.
    """

    plane: ReturnsPlane
    at: Floats
    sd: Floats

    @classmethod
    def of(cls, scan: OrderedScan, ends: Ints, plane: ReturnsPlane, hidden: Bools | None = None) -> Boundary:
        """Return the boundary of a surface.

        It ends half a step beyond a ring's last return, with an uncertainty of half a step and of the beam.

        Args:
            scan: the ordered scan.
            ends: (2 R,) rows of it, where the surface's rings begin and end; see `Runs.ends`.
            plane: through its returns.
            hidden: (2 R,) ends that do not count; None, or where these are all of them: all count.
        """
        side = np.repeat([-0.5, 0.5], len(ends) // 2)
        if hidden is not None and not hidden.all():
            side, ends = side[~hidden], ends[~hidden]
        else:
            n_rings = len(ends) // 2
            picked = np.unique(np.linspace(0, n_rings - 1, min(n_rings, _MOST_RINGS)).round().astype(int))
            picked = np.concatenate([picked, n_rings + picked])
            side, ends = side[picked], ends[picked]
        points, normal = scan.points[ends], plane.axes[0]
        outward = np.column_stack([-points[:, 1], points[:, 0], np.zeros(len(points))])
        outward *= (side * scan.resolution.step)[:, None]
        outward -= points * ((outward @ normal) / (points @ normal))[:, None]
        beam = scan.resolution.beam * np.linalg.norm(points, axis=1)
        variance = (outward**2).sum(axis=1) / 3.0 + beam**2 / 3.0 + scan.resolution.range_noise**2
        return cls(plane, (points + outward - plane.centre) @ plane.axes[1:].T, np.sqrt(variance))


@dataclass(frozen=True, eq=False, repr=False)
class OutlineFit(Value):
    """A target's outline laid over a boundary.

    Attributes:
        T_lidar_target: (4, 4).
        shift: of all ends across the edges, metres; outwards if the target blooms.
        edged: share of the ends within two standard deviations of the outline.
        log_odds: of this shape against any other of its size, whose ends lie anywhere within a fifth of its size.
    """

    T_lidar_target: Floats
    shift: float
    edged: float
    log_odds: float


def first_looks(
    boundaries: Sequence[Boundary], centroids: Sequence[Floats], targets: Sequence[Target]
) -> list[OutlineFit]:
    """Return the outlines that fit boundaries best, at any turn.

    Args:
        boundaries: of B surfaces.
        centroids: (2,) of the area of each, along its plane's axes, metres.
        targets: the template that is laid over each.
    """
    if not boundaries:
        return []
    laid = _Laid.of(boundaries, np.array(centroids), targets)
    start = np.array([_centroid(target) for target in targets])[:, None]
    off = laid.beyond(laid.turned(np.tile(_ANGLES, (len(targets), 1))), start).max(axis=2)
    rough = laid.total(np.log1p((off / (0.1 * laid.size[:, None, None])) ** 2))
    lowest = (rough <= np.roll(rough, 1, axis=1)) & (rough <= np.roll(rough, -1, axis=1))
    order = np.argsort(np.where(lowest, rough, np.inf), axis=1)[:, :_STARTS]
    order = np.where(np.take_along_axis(lowest, order, axis=1), order, order[:, :1])
    return _refined(laid, _ANGLES[order], np.repeat(start, _STARTS, axis=1), 0.1)


def look_again(
    boundaries: Sequence[Boundary], targets: Sequence[Target], T_lidar_target: Sequence[Floats]
) -> list[OutlineFit]:
    """Return the outlines that fit boundaries best near poses (4, 4), one for each."""
    if not boundaries:
        return []
    laid = _Laid.of(boundaries, np.array([boundary.at.mean(axis=0) for boundary in boundaries]), targets)
    T = np.array(T_lidar_target)
    y, z = T[:, :3, 1], T[:, :3, 2]
    left, up = laid.axes[:, 1], laid.axes[:, 2]
    place = laid.middle_in_space - T[:, :3, 3]
    angle = np.arctan2((z * left - y * up).sum(axis=1), (y * left + z * up).sum(axis=1))
    start = np.stack([(place * y).sum(axis=1), (place * z).sum(axis=1)], axis=1)
    return _refined(laid, angle[:, None], start[:, None], 0.02)


@dataclass(frozen=True, eq=False, repr=False)
class _Laid(Value):
    """B outlines over as many boundaries, side by side: the shorter ones are filled up with what doesn't count.

    Attributes:
        q: (B, M, 2) ends from the middle of the turn, along the plane's axes, metres.
        sd: (B, M) metres; infinite where a boundary has no more ends.
        normals: (B, n, 2) of the outlines' sides.
        offsets: (B, n) of these, metres.
        size: (B,) circumradius, metres.
        axes: (B, 3, 3) of the surfaces' planes.
        middle_in_space: (B, 3) of the turn, metres.
    """

    q: Floats
    sd: Floats
    normals: Floats
    offsets: Floats
    size: Floats
    axes: Floats
    middle_in_space: Floats

    @classmethod
    def of(cls, boundaries: Sequence[Boundary], middle: Floats, targets: Sequence[Target]) -> _Laid:
        """Lay targets over boundaries, to be turned about middles (B, 2), along the planes' axes, metres."""
        n = max(len(target) for target in targets)
        sides = [np.arange(n) % len(target) for target in targets]  # a side that is there twice changes nothing
        axes = np.array([boundary.plane.axes for boundary in boundaries])
        in_plane = (middle[:, None] @ axes[:, 1:])[:, 0]
        return cls(
            _filled_up([boundary.at - own for boundary, own in zip(boundaries, middle, strict=True)], 0.0),
            _filled_up([boundary.sd for boundary in boundaries], np.inf),
            np.array([target.normals[own] for target, own in zip(targets, sides, strict=True)]),
            np.array([target.offsets[own] for target, own in zip(targets, sides, strict=True)]),
            np.array([target.circumradius for target in targets]),
            axes,
            np.array([boundary.plane.centre for boundary in boundaries]) + in_plane,
        )

    def turned(self, angle: Floats) -> Floats:
        """Return the ends turned by angles (B, K), as (B, K, 2, M)."""
        return _turned(angle, self.q)

    def beyond(self, turned: Floats, t: Floats) -> Floats:
        """Return how far turned ends, moved by t (B, K, 2), are beyond each side (B, K, n, M), metres."""
        return np.asarray(self.normals[:, None] @ (turned + t[..., None]) - self.offsets[:, None, :, None])

    def total(self, values: Floats) -> Floats:
        """Return sums (B, K) over the ends of values (B, K, M)."""
        return _total(values, self.sd)


def _filled_up(arrays: Sequence[Floats], with_value: float) -> Floats:
    """Return arrays (M_b, ...) of different lengths side by side (B, M, ...), filled up with a value."""
    side_by_side = np.full((len(arrays), max(len(one) for one in arrays), *arrays[0].shape[1:]), with_value)
    for row, one in zip(side_by_side, arrays, strict=True):
        row[: len(one)] = one
    return side_by_side


def _refined(laid: _Laid, angle: Floats, start: Floats, width: float) -> list[OutlineFit]:
    """Refine starts, and return the best of each outline.

    Args:
        laid: outlines over boundaries.
        angle: (B, K) turns, rad.
        start: (B, K, 2) the middle in the target's frame, metres.
        width: initial width of the weights, in circumradii.
    """
    size, sd = laid.size[:, None], laid.sd[:, None]
    t, shift, which = start, np.zeros(angle.shape), np.arange(len(angle))[:, None, None]
    prior = np.column_stack([0.0 * size, (_PLACE * size) ** -2, (_PLACE * size) ** -2, (_SHIFT * size) ** -2])
    kept = prior[:, None, :, None] * np.eye(_FITTED) + 1e-9 * np.eye(_FITTED)
    for step in range(_STEPS):
        turned = laid.turned(angle)
        beyond = laid.beyond(turned, t)
        off, side = beyond.max(axis=2) - shift[..., None], beyond.argmax(axis=2)
        ny, nz = laid.normals[which, side, 0], laid.normals[which, side, 1]
        J = np.stack([nz * turned[:, :, 0] - ny * turned[:, :, 1], ny, nz, -np.ones_like(off)], axis=2)
        weighted = J / (np.maximum(sd, width * 0.4**step * size[..., None]) ** 2 + off**2)[:, :, None]
        drift = np.concatenate([np.zeros((*angle.shape, 1)), t - start, shift[..., None]], axis=2)
        gradient = (weighted @ off[..., None])[..., 0] + drift * prior[:, None]
        information = weighted @ np.swapaxes(J, 2, 3) + kept
        change = np.linalg.solve(information, -gradient[..., None])[..., 0]
        angle, t, shift = angle + change[..., 0], t + change[..., 1:3], shift + change[..., 3]
    off = laid.beyond(laid.turned(angle), t).max(axis=2) - shift[..., None]
    log_odds = _log_odds(off, laid.sd, laid.size, _FITTED) - 0.5 * (shift / (_SHIFT * size)) ** 2
    edged = laid.total(np.abs(off) < 2.0 * sd) / np.isfinite(laid.sd).sum(axis=1)[:, None]
    rows, best = np.arange(len(angle)), log_odds.argmax(axis=1)
    axes = np.zeros((len(angle), 3, 3))
    c, s = np.cos(angle[rows, best]), np.sin(angle[rows, best])
    axes[:, 0, 0], axes[:, 1, 1], axes[:, 1, 2], axes[:, 2, 1], axes[:, 2, 2] = 1.0, c, -s, s, c
    R = np.swapaxes(axes @ laid.axes, 1, 2)
    T = transform(R, laid.middle_in_space - (R[:, :, 1:] @ t[rows, best][..., None])[..., 0])
    values = zip(T, *(array[rows, best].tolist() for array in (shift, edged, log_odds)), strict=True)
    return [OutlineFit(*of_one) for of_one in values]


def rectangle_log_odds(boundaries: Sequence[Boundary], sizes: Floats) -> Floats:
    """Return the log odds (B,), numbers, of rectangles of any size, as `OutlineFit.log_odds` of a target.

    Most flat surfaces are rectangles: faces of boxes, doors, signs, screens.

    Args:
        boundaries: of B surfaces.
        sizes: (B,) of the targets that they are compared with: their circumradii, metres.
    """
    if not boundaries:
        return np.zeros(0)
    ends = [boundary.at - np.median(boundary.at, axis=0) for boundary in boundaries]
    q, sd = _filled_up(ends, 0.0), _filled_up([boundary.sd for boundary in boundaries], np.inf)
    extent = np.linalg.norm(q, axis=2).max(axis=1)
    # At any turn the sides are where most ends lie; the best turns are refined, with turn and sides free.
    angle = np.tile(np.linspace(0.0, np.pi / 2, 18, endpoint=False), (len(ends), 1))
    turned = _turned(angle, q)
    sides = [np.percentile(own[..., : len(one)], [6.0, 94.0], axis=2) for own, one in zip(turned, ends, strict=True)]
    inner, outer = np.swapaxes(np.array(sides), 0, 1)
    off = np.minimum(np.abs(turned - inner[..., None]), np.abs(outer[..., None] - turned)).min(axis=2)
    rough = _total(np.log1p((off / (0.1 * extent[:, None, None])) ** 2), sd)
    fitted = np.concatenate([angle[..., None], outer, -inner], axis=2)
    fitted = np.take_along_axis(fitted, np.argsort(rough, axis=1)[:, :_STARTS, None], axis=1)
    size = sizes[:, None, None]
    for step in range(_STEPS):
        off, side, turned = _outside_rectangle(fitted, q)
        ny, nz = _RIGHT_ANGLES.T[:, side]
        about = nz * turned[:, :, 0] - ny * turned[:, :, 1]
        J = np.concatenate([about[:, :, None], -1.0 * (side[:, :, None] == np.arange(4)[:, None])], axis=2)
        weighted = J / (np.maximum(sd[:, None], 0.1 * 0.4**step * size) ** 2 + off**2)[:, :, None]
        information = weighted @ np.swapaxes(J, 2, 3) + np.eye(5) * (0.5 * size[..., None]) ** -2
        fitted = fitted - np.linalg.solve(information, weighted @ off[..., None])[..., 0]
    return np.asarray(_log_odds(_outside_rectangle(fitted, q)[0], sd, sizes, 5).max(axis=1))


_RIGHT_ANGLES = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def _outside_rectangle(fitted: Floats, q: Floats) -> tuple[Floats, Ints, Floats]:
    """Return how far points (B, M, 2) are outside rectangles (B, K, 5) of a turn and four sides; side, and points."""
    turned = _turned(fitted[..., 0], q)
    beyond = np.concatenate([turned, -turned], axis=2) - fitted[..., 1:, None]
    return beyond.max(axis=2), beyond.argmax(axis=2), turned


def _turned(angle: Floats, q: Floats) -> Floats:
    """Return points (B, M, 2) turned by angles (B, K), as (B, K, 2, M)."""
    c, s, y, z = np.cos(angle)[..., None], np.sin(angle)[..., None], q[:, None, :, 0], q[:, None, :, 1]
    return np.stack([c * y - s * z, s * y + c * z], axis=2)


def _log_odds(off: Floats, sd: Floats, size: Floats, n_fitted: int) -> Floats:
    """Return log odds (B, K) of shapes with ends off by (B, K, M) metres, against one whose ends lie anywhere in reach.

    Each fitted number lowers the odds.

    Args:
        off: (B, K, M) metres.
        sd: (B, M) of each end, metres; infinite where there is none.
        size: (B,) metres.
        n_fitted: numbers that were fitted.
    """
    there, reach = np.isfinite(sd), 0.4 * size
    count, square = there.sum(axis=1), np.where(there, sd, 0.0) ** 2
    fits = np.exp(-0.5 * (off / sd[:, None]) ** 2) * reach[:, None, None] / (np.sqrt(2 * np.pi) * sd[:, None])
    mean = square.sum(axis=1) / count
    cost = 0.5 * n_fitted * np.log(np.maximum(count / n_fitted, 1.0) * reach**2 / (12.0 * mean))
    return np.asarray(_total(np.log((1.0 - _STRAYS) * fits + _STRAYS), sd) - cost[:, None])


def _total(values: Floats | Bools, sd: Floats) -> Floats:
    """Return sums (B, K) of values (B, K, M) over the ends that there are."""
    return np.asarray((values @ np.isfinite(sd)[..., None].astype(float))[..., 0])


def _centroid(target: Target) -> Floats:
    """Return the centroid (2,) of a target's area, metres."""
    polygon = target.polygon
    following = np.roll(polygon, -1, axis=0)
    cross = polygon[:, 0] * following[:, 1] - following[:, 0] * polygon[:, 1]
    return np.asarray(cross @ (polygon + following) / (6.0 * target.area))
