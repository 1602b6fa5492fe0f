"""What all scans of one LiDAR have in common: the range bias that each ring keeps.

A match says with which bias of which ring its residuals would vanish, B beta + A z + r. Were the bias marginalised in
every match by itself, it would average away over many scans, and landmarks seen often would seem better known than they
are. So beta is a variable of its own for each track, in standard deviations of the sensor's ring bias, and a match is
linear in it: linearised at H, its rows reduce to

    [R_xi  R_beta  d; 0  S  s; 0  0  c],

of which the first six link landmark, pose and biases, and the others are of the biases alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.factors import BiasedMeasurement, SharedError
from optshape_graph.factors._rows import factored, triangular
from optshape_graph.mapping.track import MappingProblem
from optshape_graph.se3 import vec, vec_derivative

BLOCK = 256
"""Matches that are linearised at a time: more would only take memory."""


@dataclass(frozen=True, eq=False)
class Biases:
    """The part of a problem that has biases as variables.

    Attributes:
        matches: (B,) numbers of the matches that are linear in them.
        track: (B,) of each of those.
        errors: each track's biases, in the order of its variable; empty: none of its matches has any.
        measurements: of each of those matches.
        replaced: (K,) whether a match is among them, instead of its template measurement.
    """

    matches: Ints
    track: Ints
    errors: tuple[tuple[SharedError, ...], ...]
    measurements: tuple[BiasedMeasurement, ...]
    replaced: Bools

    @classmethod
    def of(cls, problem: MappingProblem, wanted: bool, taken: Bools) -> Biases:
        """Collect the matches (K,) whose sightings have their biases, but for those that are taken already, (K,)."""
        matches = [(t, match) for t, track in enumerate(problem.tracks) for match in track.matches]
        biased = {k: match.biased for k, (_, match) in enumerate(matches) if wanted and not taken[k]}
        found = {k: measurement for k, measurement in biased.items() if measurement is not None}
        errors = tuple(
            tuple(sorted({e for k, m in found.items() if matches[k][0] == t for e in m.shared}, key=_by_ring))
            for t in range(len(problem.tracks))
        )
        replaced = np.zeros(len(matches), dtype=bool)
        replaced[list(found)] = True
        track = np.array([matches[k][0] for k in found], int)
        return cls(np.array(list(found), int), track, errors, tuple(found.values()), replaced)

    def insert(self, values: gtsam.Values, keys: Mapping[int, int]) -> None:
        """Add the biases, zero, to initial values."""
        for t, key in keys.items():
            values.insert(key, np.zeros(len(self.errors[t])))

    def at(self, H: Floats, values: gtsam.Values, keys: Mapping[int, int]) -> BiasModel:
        """Linearise the matches at T_target_lidar (B, 4, 4) and the biases in `values`."""
        m = max(map(len, self.errors))
        beta = np.zeros((len(self.errors), m))
        for t, key in keys.items():
            beta[t, : len(self.errors[t])] = values.atVector(key)
        alone = {t: np.column_stack([np.eye(m), beta[t]]) for t in keys}  # the prior
        linked = np.zeros((len(H), 6, m + 7))
        for first in range(0, len(H), BLOCK):
            block = slice(first, first + BLOCK)
            track, rows = self.track[block], self._rows(block, m)
            B, A, r = rows[..., :m], rows[..., m:-1], rows[..., -1:]
            residual = B @ beta[track][..., None] + A @ vec(H[block])[..., None] + r
            R = factored(np.concatenate([A @ vec_derivative(H[block]), B, residual], axis=-1))
            linked[block] = R[:, :6]
            for t in set(track.tolist()):
                alone[t] = triangular(np.vstack([alone[t], R[track == t, 6:, 6:].reshape(-1, m + 1)]))
        return BiasModel(linked[..., :6], linked[..., 6:-1], linked[..., -1], alone)

    def _rows(self, block: slice, m: int) -> Floats:
        """(b, n, m + 13) rows over [beta; z; 1] of some matches, beta as their tracks have it, padded to m."""
        some = self.measurements[block]
        rows = np.zeros((len(some), max(len(one.stack) for one in some), m + 13))
        for row, one, t in zip(rows, some, self.track[block].tolist(), strict=True):
            place = [self.errors[t].index(error) for error in one.shared]
            row[: len(one.stack), [*place, *range(m, m + 13)]] = one.stack
        return rows


@dataclass(frozen=True, eq=False)
class BiasModel:
    """Gauss-Newton models 1/2 ||R xi + E beta + d||^2 of matches, and what is of the biases alone, steps from here.

    Attributes:
        R: (B, 6, 6) by the right perturbation of H, whitened.
        E: (B, 6, m) by the biases, whitened.
        d: (B, 6) whitened.
        alone: by track, (m + 1, m + 1) rows [S s; 0 c] over [beta; 1], the prior among them.
    """

    R: Floats
    E: Floats
    d: Floats
    alone: dict[int, Floats]

    @property
    def error(self) -> float:
        """Half the chi-square of the biases alone, and of what no step takes away."""
        return 0.5 * sum(float(np.square(rows[:, -1]).sum()) for rows in self.alone.values())


def _by_ring(error: SharedError) -> int:
    return -1 if error.ring is None else error.ring
