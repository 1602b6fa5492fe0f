"""Planar patches: ring segments in one plane, one above the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.detection.options import DetectionOptions
from optshape_graph.detection.segments import OrderedScan


@dataclass(frozen=True, eq=False, repr=False)
class Patch(Value):
    """Ring segments in one plane, connected.

    Attributes:
        segments: (S,) numbers of the ordered scan's segments.
        centre: (3,) mean of their returns, LiDAR frame, metres.
        normal: (3,) unit normal, away from the sensor.
        area: square metres that their beams cover in the plane.
        n_rings: rings that they are on.
    """

    segments: Ints
    centre: Floats
    normal: Floats
    area: float
    n_rings: int


def find_patches(scan: OrderedScan, shortest: float, longest: float) -> list[Patch]:
    """Find the planar patches that segments of a target's size form.

    For every segment, the plane through it with the most support nearby is found: a plane through a line has one free
    angle, and each segment nearby votes for one. Neighbouring segments that lie in each other's planes form a patch.
    Segments longer than `longest` are left out, so that walls and floors cost no time.

    Args:
        scan: the ordered scan.
        shortest: smallest length of a segment, metres.
        longest: largest length of a segment, and largest distance of its neighbours, metres.
    """
    options = scan.options
    chord = np.linalg.norm(scan.points[scan.last] - scan.points[scan.first], axis=1)
    count = scan.last - scan.first + 1
    taken = np.flatnonzero((count >= options.fewest_returns) & (chord >= shortest) & (chord <= longest))
    if len(taken) < 2:
        return []
    first, last = scan.first[taken], scan.last[taken]
    moments = _moments(scan, taken)
    ring, chord = scan.ring[first], chord[taken]
    centre, covariance = _mean_and_covariance(moments)
    along = (scan.points[last] - scan.points[first]) / chord[:, None]

    pairs = KDTree(centre).query_pairs(longest, output_type="ndarray")
    pairs = pairs[ring[pairs[:, 0]] != ring[pairs[:, 1]]]
    s, t = np.concatenate([pairs, pairs[:, ::-1]]).T
    order = np.argsort(s, kind="stable")
    s, t = s[order], t[order]

    off_plane = scan.resolution.off_plane
    normal = _supported_planes(
        s, t, centre, along, chord, moments, off_plane / np.tan(0.5 * options.tilt_window), options
    )
    limit = (options.patch_sigmas * off_plane) ** 2
    for _ in range(2):
        member = _mean_square(normal[s], centre[s], centre[t], covariance[t]) < limit
        normal = _fit(s[member], t[member], moments, len(taken), normal)
    member = _mean_square(normal[s], centre[s], centre[t], covariance[t]) < limit
    beside = (np.abs(ring[s] - ring[t]) <= options.rings_apart) & _overlap(scan, first, last, s, t)
    back = _mean_square(normal[t], centre[t], centre[s], covariance[s]) < limit
    linked = member & back & beside
    graph = coo_array((np.ones(linked.sum()), (s[linked], t[linked])), shape=(len(taken), len(taken)))
    n_patches, label = connected_components(graph, directed=False)

    total = np.array([np.bincount(label, column, n_patches) for column in moments.T]).T
    middle, covariance = _mean_and_covariance(total)
    normal = np.linalg.eigh(covariance)[1][:, :, 0]
    normal = normal * np.where((normal * middle).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    # A beam's solid angle cos(e) da de covers r^2 cos(e) da de / cos(incidence).
    across = np.maximum(np.abs((normal[label] * centre).sum(axis=1)), 1e-3)
    solid = (scan.azimuth[last] - scan.azimuth[first]) * scan.ring_heights[ring] * np.hypot(*centre[:, :2].T)
    area = np.bincount(label, (centre**2).sum(axis=1) * solid / across)
    order = np.lexsort((ring, label))
    groups = np.split(order, np.cumsum(np.bincount(label))[:-1])
    return [
        Patch(np.sort(taken[group]), middle[k], normal[k], float(area[k]), len(np.unique(ring[group])))
        for k, group in enumerate(groups)
        if len(group) >= 2
    ]


def _moments(scan: OrderedScan, segments: Ints) -> Floats:
    """Return number, sum and second moments (S, 10) of the returns of some segments."""
    count = scan.last[segments] - scan.first[segments] + 1
    begin = np.cumsum(count) - count
    rows = np.arange(count.sum()) + np.repeat(scan.first[segments] - begin, count)
    x, y, z = scan.points[rows].T
    columns = np.column_stack([np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    return np.asarray(np.add.reduceat(columns, begin, axis=0))


def _mean_and_covariance(moments: Floats) -> tuple[Floats, Floats]:
    """Return mean (S, 3) and covariance (S, 3, 3) of sums (S, 10)."""
    scaled = moments[:, 1:] / np.maximum(moments[:, :1], 1.0)
    centre = scaled[:, :3]
    square = scaled[:, [3, 4, 5, 4, 6, 7, 5, 7, 8]].reshape(-1, 3, 3)
    return centre, square - centre[:, :, None] * centre[:, None, :]


def _mean_square(normal: Floats, through: Floats, centre: Floats, covariance: Floats) -> Floats:
    """Return the mean square distance (P,) of segments from planes, square metres."""
    offset = np.vecdot(normal, centre - through)
    return np.asarray(offset**2 + np.vecdot(normal, np.vecdot(covariance, normal[:, None])))


def _supported_planes(
    s: Ints,
    t: Ints,
    centre: Floats,
    along: Floats,
    chord: Floats,
    moments: Floats,
    baseline: float,
    options: DetectionOptions,
) -> Floats:
    """Return the normal (S, 3) of the plane through each segment s that its neighbours t support most, by total chord.

    Args:
        s: (P,) segments, ascending.
        t: (P,) the neighbour of each.
        centre: (S, 3) of each segment.
        along: (S, 3) direction of each segment.
        chord: (S,) metres.
        moments: (S, 10).
        baseline: smallest distance, metres, of a neighbour that votes from the segment.
        options: the settings.
    """
    ray = centre / np.linalg.norm(centre, axis=1, keepdims=True)
    depth = ray - along * (ray * along).sum(axis=1, keepdims=True)
    depth /= np.maximum(np.linalg.norm(depth, axis=1, keepdims=True), 1e-9)
    up = np.cross(along, depth)
    to = centre[t] - centre[s]
    a, b = np.vecdot(to, depth[s]), np.vecdot(to, up[s])
    tilt = np.arctan2(a, b)  # of the plane from upright, modulo pi
    tilt = (tilt + np.pi / 2) % np.pi - np.pi / 2
    votes = np.flatnonzero((np.hypot(a, b) > baseline) & (np.abs(tilt) < options.steepest))
    order = votes[np.lexsort((tilt[votes], s[votes]))]
    key = 2 * np.pi * s[order] + tilt[order]
    weight = np.concatenate([[0.0], np.cumsum(chord[t[order]])])
    end = np.searchsorted(key, key + options.tilt_window, side="right")
    support = weight[end] - weight[:-1]
    best = np.full(len(centre), -1)
    ranked = np.lexsort((support, s[order]))
    best[s[order][ranked]] = ranked  # the last of each, which is the best, stays
    has = np.flatnonzero(best >= 0)
    middle = np.zeros(len(centre))
    sums = np.concatenate([[0.0], np.cumsum(chord[t[order]] * tilt[order])])
    window = best[has]
    middle[has] = (sums[end[window]] - sums[window]) / support[window]
    c, d = np.cos(middle)[:, None], np.sin(middle)[:, None]
    return np.asarray(c * depth - d * up)


def _fit(s: Ints, t: Ints, moments: Floats, n: int, fallback: Floats) -> Floats:
    """Return normals (S, 3) of least-squares planes of each segment and its members t; without any, the fallback."""
    total = moments + np.array([np.bincount(s, column, n) for column in moments[t].T]).T
    _, vectors = np.linalg.eigh(_mean_and_covariance(total)[1])
    alone = np.bincount(s, minlength=n) == 0
    return np.where(alone[:, None], fallback, vectors[:, :, 0])


def _overlap(scan: OrderedScan, first: Ints, last: Ints, s: Ints, t: Ints) -> Bools:
    """Return (P,) whether segments overlap in azimuth to within a step, also across the seam."""
    middle = 0.5 * (scan.azimuth[first] + scan.azimuth[last])
    half = 0.5 * (scan.azimuth[last] - scan.azimuth[first])
    apart = np.abs((middle[s] - middle[t] + np.pi) % (2 * np.pi) - np.pi)
    return np.asarray(apart <= half[s] + half[t] + scan.resolution.step)
