"""Candidate poses of a target in the plane of its returns, from every consistent association of ring ends to edges.

Rings cut a convex polygon in chords. From the top ring down, the left ends of the chords walk along consecutive edges
one way round, the right ends the other way, and no edge is met from both sides. So a labelling is an edge at the top
left, and how many edges each end passes between one ring and the next: n - 2 passes at most, those skipped at the top
included. All labellings are solved at once.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations_with_replacement
from math import comb

import numpy as np

from optshape_graph._arrays import Floats, Ints
from optshape_graph.edges import EdgePoints
from optshape_graph.plane import ReturnsPlane
from optshape_graph.target import Target

_ANGLES = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
_PAIRS = np.triu_indices(5)
_REFINED = 400  # labellings whose angle is refined from the grid's
_SECTOR = 2  # grid steps between the directions in which a rival is looked for


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


def enumerate_poses(edges: EdgePoints, plane: ReturnsPlane, target: Target) -> Floats:
    """Solve the in-plane pose of every labelling, and keep the best that differ.

    With edge points moved to where the boundary is expected, the residual of point q on edge k is
    n_k . (C q + t) - c_k, linear in (cos, sin, t_y, t_z): the normal matrix of a labelling is a sum over its points,
    t is eliminated, and the angle minimises a quadratic form on the circle.

    Args:
        edges: both ends of each ring.
        plane: of all returns.
        target: the template.

    Returns:
        T_target_lidar (C, 4, 4), best first.
    """
    count = max(2, _rings_that_fit(len(target), edges.n_rings))
    picked = np.unique(np.linspace(0, edges.n_rings - 1, min(count, edges.n_rings)).round().astype(int))
    rows = np.column_stack([2 * picked, 2 * picked + 1]).ravel()
    outward = edges.outward(plane.axes[0])[rows]
    q = ((edges.points[rows] + edges.middle[rows, None] * outward - plane.centre) @ plane.axes.T)[:, 1:]

    n = target.normals
    columns = np.stack(np.broadcast_arrays(
        q @ n.T,  # multiplies the cosine
        np.outer(q[:, 0], n[:, 1]) - np.outer(q[:, 1], n[:, 0]),  # the sine
        n[:, 0], n[:, 1], target.offsets,
    ))  # fmt: skip
    products = (columns[_PAIRS[0]] * columns[_PAIRS[1]]).reshape(15, -1).T
    _, indicators = enumerate_labellings(len(target), len(picked))
    sums = indicators @ products
    G = np.empty((len(sums), 5, 5))
    G[:, _PAIRS[0], _PAIRS[1]] = G[:, _PAIRS[1], _PAIRS[0]] = sums

    by_t, rest = G[:, 2:4, 2:4] + 1e-9 * len(q) * np.eye(2), G[:, [0, 1, 4]][:, :, [0, 1, 4]]
    cross = G[:, 2:4][:, :, [0, 1, 4]]
    K = _solve_2x2(by_t, cross)
    form = rest - np.swapaxes(cross, 1, 2) @ K
    which, angle = _minimise_on_circle(form)
    K = K[which]

    x = np.stack([np.cos(angle), np.sin(angle), -np.ones_like(angle)], axis=-1)
    t = -np.einsum("kij,kj->ki", K, x)
    near = _first_different(angle, t / target.circumradius, np.radians(1.5), 0.01, NEAR)
    far = _first_different(angle, t / target.circumradius, np.radians(15.0), 0.3, FAR)
    chosen = np.union1d(near, far)
    return plane.poses(angle[chosen], t[chosen])


def _solve_2x2(A: Floats, B: Floats) -> Floats:
    """Solve systems (K, 2, 2) with right-hand sides (K, 2, n) in closed form."""
    adjugate = np.empty_like(A)
    adjugate[:, 0, 0], adjugate[:, 1, 1] = A[:, 1, 1], A[:, 0, 0]
    adjugate[:, 0, 1], adjugate[:, 1, 0] = -A[:, 0, 1], -A[:, 1, 0]
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    return np.asarray(adjugate @ B / determinant[:, None, None])


def _rings_that_fit(n_edges: int, n_rings: int) -> int:
    """Largest number of rings, up to `n_rings`, whose labellings are few enough."""
    while n_rings > 2 and count_labellings(n_edges, n_rings) > MAX_LABELLINGS:
        n_rings -= 1
    return n_rings


def _minimise_on_circle(form: Floats) -> tuple[Ints, Floats]:
    """Minimise v^T F v, v = (cos, sin, -1), for forms (K, 3, 3).

    All on a grid of angles; then by Newton steps those that are best of all, and those that are best in each
    direction, however much worse: rivals.

    Returns:
        Which form (T,) and its angle (T,), best first.
    """
    grid = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), -np.ones_like(_ANGLES)], axis=-1)
    outer = np.einsum("ai,aj->aij", grid, grid).reshape(len(grid), 9)
    values = form.reshape(-1, 9) @ outer.T
    best = values.argmin(axis=1)
    top = np.argsort(values[np.arange(len(best)), best])[:_REFINED]
    sectors = np.arange(0, len(_ANGLES), _SECTOR)
    which = np.concatenate([top, values[:, sectors].argmin(axis=0)])
    phi, F = np.concatenate([_ANGLES[best[top]], _ANGLES[sectors]]), form[which]
    for _ in range(4):
        c, s, zero = np.cos(phi), np.sin(phi), np.zeros_like(phi)
        v = np.stack([c, s, zero - 1], axis=-1)
        d = np.stack([-s, c, zero], axis=-1)
        Fv, Fd = (F @ v[..., None])[..., 0], (F @ d[..., None])[..., 0]
        slope = (d * Fv).sum(axis=-1)
        curvature = (d * Fd).sum(axis=-1) - ((v + np.array([0.0, 0.0, 1.0])) * Fv).sum(axis=-1)
        phi = phi - np.clip(slope / np.where(curvature > 0, curvature, np.inf), -0.1, 0.1)
    v = np.stack([np.cos(phi), np.sin(phi), -np.ones_like(phi)], axis=-1)
    cost = np.einsum("ki,kij,kj->k", v, F, v)
    order = np.argsort(cost, kind="stable")
    return which[order], phi[order]


def _first_different(angle: Floats, t: Floats, turn: float, move: float, count: int) -> Ints:
    """Indices of the first `count` of poses (K,), (K, 2) that differ by `turn`, rad, or `move` from each before."""
    free = np.ones(len(angle), dtype=bool)
    kept: list[int] = []
    while free.any() and len(kept) < count:
        first = int(free.argmax())
        kept.append(first)
        turned = np.abs((angle - angle[first] + np.pi) % (2 * np.pi) - np.pi)
        free &= (turned >= turn) | (np.hypot(*(t - t[first]).T) >= move)
        free[first] = False
    return np.array(kept, dtype=np.int64)
