"""Candidate poses of a target in the plane of its returns, from every consistent association of ring ends to edges.

Rings cut a convex polygon in chords. From the top ring down, the left ends of the chords walk along consecutive edges
one way round, the right ends the other way, and no edge is met from both sides. So a labelling is an edge at the top
left, and how many edges each end passes between one ring and the next: n - 2 passes at most, those skipped at the top
included. All labellings are solved at once, those of several scans too.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from numpy.typing import NDArray

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.compiled import address, library, structure
from optshape_graph.edges import EdgePoints
from optshape_graph.plane import ReturnsPlane
from optshape_graph.target import Target

_ANGLES = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
_PAIRS = np.triu_indices(5)
_AT = np.zeros((5, 5), dtype=int)  # where in a row of such pairs each entry of a symmetric (5, 5) matrix is
_AT[_PAIRS] = _AT.T[_PAIRS] = np.arange(15)
_REST = [0, 1, 4]  # what multiplies cosine, sine and -1
_REFINED = 400  # labellings whose angle is refined from the grid's
_SECTOR = 2  # grid steps between the directions in which a rival is looked for
_NEAR, _FAR = (
    (float(np.radians(1.5)), 0.01),
    (float(np.radians(15.0)), 0.3),
)  # turns, rad, and moves, radii, that differ
_AT_ONCE = 8  # scans whose labellings are worked on at once: arrays stay in cache

Complexes = NDArray[np.complex128]


MAX_LABELLINGS = 800
"""Beyond this many, the enumeration works on fewer rings, evenly picked."""


def count_labellings(n_edges: int, n_rings: int) -> int:
    """Number of consistent labellings of `n_rings` rings over a polygon with `n_edges` edges."""
    # n - 2 passes or fewer, each at one of 2 (M - 1) gaps between rings or at the top: multisets.
    places = 2 * (n_rings - 1) + 1
    return n_edges * comb(places + n_edges - 2, n_edges - 2)


@lru_cache(maxsize=16)
def enumerate_labellings(n_edges: int, n_rings: int) -> tuple[Ints, Floats]:
    """List every consistent labelling.

    Args:
        n_edges: edges of the polygon, counted counter-clockwise seen from +x (so that the left ends, seen from
            the sensor, walk towards smaller indices from the top down).
        n_rings: rings, counted from the lowest up.

    Returns:
        Labels (K, 2 M), left end before right end, rings from the lowest up; and the same as indicators
        (K, 2 M n), so that summing any quantity over a labelling's points is a matrix product.
    """
    left, right = {}, {}
    for passes in range(n_edges - 1):
        positions = list(combinations_with_replacement(range(1, n_rings), passes))
        passed = np.zeros((len(positions), n_rings), dtype=np.int64)
        for row, where in zip(passed, positions, strict=True):
            for place in where:
                row[place:] += 1
        left[passes] = -passed[:, ::-1]  # from the lowest ring up
        right[passes] = passed[:, ::-1]
    blocks = []
    for skipped in range(n_edges - 1):
        for on_left in range(n_edges - 1 - skipped):
            for on_right in range(n_edges - 1 - skipped - on_left):
                a, b = left[on_left], right[on_right] + 1 + skipped
                if not (len(a) and len(b)):
                    continue
                block = np.empty((len(a), len(b), n_rings, 2), dtype=np.int64)
                block[..., 0], block[..., 1] = a[:, None], b[None]
                blocks.append(block.reshape(-1, 2 * n_rings))
    shapes = np.concatenate(blocks)
    labels = (shapes[None] + np.arange(n_edges)[:, None, None]).reshape(-1, 2 * n_rings) % n_edges
    indicators = np.eye(n_edges)[labels].reshape(len(labels), -1)
    labels.setflags(write=False)
    indicators.setflags(write=False)
    return labels, indicators


NEAR, FAR = 10, 40
"""How many of the best poses are kept that differ a little, and how many beside them that differ much."""


def enumerate_poses(
    edges: Sequence[EdgePoints], planes: Sequence[ReturnsPlane], targets: Sequence[Target]
) -> list[Floats]:
    """Solve the in-plane pose of every labelling, and keep the best that differ, in each of B scans.

    With edge points moved to where the boundary is expected, the residual of point q on edge k is
    n_k . (C q + t) - c_k, linear in (cos, sin, t_y, t_z): the normal matrix of a labelling is a sum over its points,
    t is eliminated, and the angle minimises a quadratic form on the circle.

    Args:
        edges: both ends of each ring.
        planes: of all returns.
        targets: the templates.

    Returns:
        T_target_lidar (C, 4, 4) in each scan, best first.
    """
    picked = [_picked(one, target) for one, target in zip(edges, targets, strict=True)]
    alike: dict[tuple[int, int], list[int]] = {}  # scans whose labellings are the same
    for k, (rings, target) in enumerate(zip(picked, targets, strict=True)):
        alike.setdefault((len(target), len(rings)), []).append(k)
    found: dict[int, Floats] = {}
    for (n_edges, n_rings), scans in alike.items():
        for first in range(0, len(scans), _AT_ONCE):
            some = scans[first : first + _AT_ONCE]
            products = np.stack([_products(edges[k], planes[k], targets[k], picked[k]) for k in some])
            size = np.array([targets[k].circumradius for k in some])
            for k, (angle, t) in zip(some, _best_poses(products, n_edges, n_rings, size), strict=True):
                found[k] = planes[k].poses(angle, t)
    return [found[k] for k in range(len(edges))]


def _picked(edges: EdgePoints, target: Target) -> Ints:
    """Rings (P,), evenly picked, whose labellings are few enough."""
    count = max(2, _rings_that_fit(len(target), edges.n_rings))
    return np.unique(np.linspace(0, edges.n_rings - 1, min(count, edges.n_rings)).round().astype(int))


def _products(edges: EdgePoints, plane: ReturnsPlane, target: Target, picked: Ints) -> Floats:
    """(2 P n, 15) normal matrix of each end of the rings picked (P,), were it on each of n edges."""
    rows = np.column_stack([2 * picked, 2 * picked + 1]).ravel()
    outward = edges.outward(plane.axes[0])[rows]
    q = ((edges.points[rows] + edges.middle[rows, None] * outward - plane.centre) @ plane.axes.T)[:, 1:]
    n = target.normals
    columns = np.stack(np.broadcast_arrays(
        q @ n.T,  # multiplies the cosine
        np.outer(q[:, 0], n[:, 1]) - np.outer(q[:, 1], n[:, 0]),  # the sine
        n[:, 0], n[:, 1], target.offsets,
    ))  # fmt: skip
    return np.asarray((columns[_PAIRS[0]] * columns[_PAIRS[1]]).reshape(15, -1).T)


def _best_poses(products: Floats, n_edges: int, n_rings: int, size: Floats) -> list[tuple[Floats, Floats]]:
    """Angles and shifts in the plane of the best labellings that differ, in each of B scans.

    Args:
        products: (B, 2 P n, 15) see `_products`.
        n_edges: n.
        n_rings: P.
        size: (B,) radius of each target, metres.
    """
    labels, indicators = enumerate_labellings(n_edges, n_rings)
    compiled = library()
    if compiled is None:
        return _best_different(indicators @ products, 2 * n_rings, size)
    search = structure(_REFINED, _SECTOR, *_NEAR, NEAR, *_FAR, FAR)
    best = []
    for of_scan, radius in zip(np.ascontiguousarray(products), size.tolist(), strict=True):
        angle, t = np.empty(NEAR + FAR), np.empty((NEAR + FAR, 2))
        arrays = (address(labels), address(of_scan), radius, address(angle), address(t))
        count = compiled.best_poses(address(search), *labels.shape, n_edges, *arrays)
        best.append((angle[:count], t[:count]))
    return best


def _best_different(sums: Floats, count: int, size: Floats) -> list[tuple[Floats, Floats]]:
    """Angles and shifts in the plane of the best labellings that differ, in each of B scans.

    Args:
        sums: (B, K, 15) normal matrices of K labellings.
        count: number of ring ends in each.
        size: (B,) radius of each target, metres.
    """
    by_y, by_z, across = sums[..., _AT[2, 2]] + 1e-9 * count, sums[..., _AT[3, 3]] + 1e-9 * count, sums[..., _AT[2, 3]]
    of_y, of_z = sums[..., _AT[2, _REST]], sums[..., _AT[3, _REST]]
    determinant = (by_y * by_z - across**2)[..., None]
    # The best t is -K (cos, sin, -1).
    K = (
        (by_z[..., None] * of_y - across[..., None] * of_z) / determinant,
        (by_y[..., None] * of_z - across[..., None] * of_y) / determinant,
    )
    form = (
        sums[..., _AT[np.ix_(_REST, _REST)]]
        - of_y[..., None] * K[0][..., None, :]
        - of_z[..., None] * K[1][..., None, :]
    )
    which, angle = _minimise_on_circle(form)
    x = np.stack([np.cos(angle), np.sin(angle), -np.ones_like(angle)], axis=-1)
    scan = np.arange(len(sums))[:, None]
    t = np.stack([-np.vecdot(part[scan, which], x) for part in K], axis=-1)
    place = (t[..., 0] + 1j * t[..., 1]) / size[:, None]
    near, far = _first_different(angle, place, *_NEAR, NEAR), _first_different(angle, place, *_FAR, FAR)
    return [(a[chosen], b[chosen]) for a, b, chosen in zip(angle, t, near | far, strict=True)]


def _rings_that_fit(n_edges: int, n_rings: int) -> int:
    """Largest number of rings, up to `n_rings`, whose labellings are few enough."""
    while n_rings > 2 and count_labellings(n_edges, n_rings) > MAX_LABELLINGS:
        n_rings -= 1
    return n_rings


def _minimise_on_circle(form: Floats) -> tuple[Ints, Floats]:
    """Minimise v^T F v, v = (cos, sin, -1), for forms (B, K, 3, 3) of B scans.

    All on a grid of angles; then by Newton steps those that are best of all, and those that are best in each
    direction, however much worse: rivals.

    Returns:
        Which form (B, T) and its angle (B, T), best first.
    """
    grid = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), -np.ones_like(_ANGLES)], axis=-1)
    outer = np.einsum("ai,aj->aij", grid, grid).reshape(len(grid), 9)
    values = form.reshape(*form.shape[:2], 9) @ outer.T
    scan, best = np.arange(len(form))[:, None], values.argmin(axis=2)
    least = np.take_along_axis(values, best[..., None], axis=2)[..., 0]
    top = np.argsort(least, axis=1)[:, :_REFINED]
    sectors = np.arange(0, len(_ANGLES), _SECTOR)
    which = np.concatenate([top, values[:, :, sectors].argmin(axis=1)], axis=1)
    directions = np.broadcast_to(_ANGLES[sectors], (len(form), len(sectors)))
    phi = np.concatenate([_ANGLES[best[scan, top]], directions], axis=1)
    cc, cs, c1, _, ss, s1, _, _, one = np.moveaxis(form.reshape(*form.shape[:2], 9)[scan, which], 2, 0)
    for _ in range(4):
        c, s = np.cos(phi), np.sin(phi)
        double, square = c * s, c * c - s * s
        slope = (ss - cc) * double + cs * square + c1 * s - s1 * c
        curvature = (ss - cc) * square - 4 * cs * double + c1 * c + s1 * s
        phi = phi - np.clip(slope / np.where(curvature > 0, curvature, np.inf), -0.1, 0.1)
    c, s = np.cos(phi), np.sin(phi)
    cost = cc * c * c + 2 * cs * c * s + ss * s * s - 2 * (c1 * c + s1 * s) + one
    order = np.argsort(cost, axis=1, kind="stable")
    return which[scan, order], phi[scan, order]


def _first_different(angle: Floats, place: Complexes, turn: float, move: float, count: int) -> Bools:
    """(B, K) which are the first `count` of poses of B scans that differ from each before by `turn` or `move`.

    Args:
        angle: (B, K) rad.
        place: (B, K) y + i z.
        turn: rad.
        move: in the unit of places.
        count: at most so many.
    """
    scan, direction, least = np.arange(len(angle)), np.exp(1j * angle), np.cos(turn)
    free, kept = np.ones(angle.shape, dtype=bool), np.zeros(angle.shape, dtype=bool)
    for _ in range(count):
        first = free.argmax(axis=1)
        kept[scan, first] |= free[scan, first]
        alike = (direction * direction[scan, first, None].conj()).real > least
        alike &= np.abs(place - place[scan, first, None]) < move
        free &= ~alike
        if not free.any():
            break
    return kept
