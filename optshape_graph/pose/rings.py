"""The door of scans with rings: which edge does each ring end on, and where is the target then?

Every consistent association of ring ends to edges gives a start (`association`); expectation propagation finds the
posterior of the pose about each (`propagation`); the starts are ranked and gathered in modes, and the best is compared
with the next (`modes`). What the best mode's associations say of the edges, and all returns of the plane, is compressed
into one measurement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints, Value
from optshape_graph.errors import EstimationError
from optshape_graph.factors.measurement import TemplateMeasurement, refine_all
from optshape_graph.factors.static import BiasedMeasurement
from optshape_graph.pose.ends import EdgeGeometry, EdgeRows, EndsFit, Posterior, RingEnds, concatenate, fit_ends
from optshape_graph.pose.evidence import Evidence, Finding, ends_of
from optshape_graph.pose.modes import Modes, compare_modes, find_candidates
from optshape_graph.pose.sampling import sampled_measurement
from optshape_graph.se3 import difference


def find_by_rings(evidences: Sequence[Evidence]) -> list[Finding | EstimationError]:
    """Find targets' poses by the edges on which their rings end; see `estimate_poses`.

    Args:
        evidences: of B scans with rings, which are worked out at once.

    Returns:
        For each scan what was found; or the error, where no pose explains the returns.
    """
    found: dict[int, Finding | EstimationError] = {}
    alike: dict[int, list[tuple[int, Modes]]] = {}  # scans that lie side by side: their targets have as many edges
    for k, (evidence, candidates) in enumerate(zip(evidences, find_candidates(evidences), strict=True)):
        try:
            modes = compare_modes(candidates, evidence)
            alike.setdefault(len(evidence.problem.target), []).append((k, modes))
        except EstimationError as error:
            found[k] = error
    for some in alike.values():
        places, modes_of = zip(*some, strict=True)
        found.update(zip(places, _in_one_measurement([evidences[k] for k in places], modes_of), strict=True))
    return [found[k] for k in range(len(evidences))]


def _in_one_measurement(evidences: Sequence[Evidence], modes: Sequence[Modes]) -> list[Finding]:
    """Compress the best mode of each scan into one measurement, taken at its minimum."""
    ends, associations = ends_of(evidences), Associations.of(modes)
    T, labels = _at_best(ends, modes)
    fits = fit_ends(ends, T, labels)
    edges = _on_edges(evidences, modes, ends, associations, fits)
    shared = [one for one, _ in edges]
    minima = refine_all([one.of_one_scan() for one in shared], T)

    # What is uncertain beside: the surface, and associations that disagree or ends that scatter more than they should.
    with_surface = [one.displaced(*pair) for one, *pair in zip(evidences, shared, minima, strict=True)]
    disagreement = associations.disagreement(minima, [one.of_one_scan() for one in with_surface])
    for k, (one, fit) in enumerate(zip(modes, fits, strict=True)):
        factor = disagreement[k] if one.sampled is None else fit.factor
        if factor > 1.0:
            shared[k] = replace(shared[k], stack=shared[k].stack / factor)
    minima = refine_all([one.of_one_scan() for one in shared], minima)  # shared errors weigh otherwise now
    exact = [one.of_one_scan().at(pose) for one, pose in zip(shared, minima, strict=True)]
    shared = [one.displaced(*pair) for one, *pair in zip(evidences, shared, minima, strict=True)]

    # How the ring ends lie about the edges there.
    final = ends.geometry(minima, labels)
    best = associations.posterior.select(np.searchsorted(associations.scan, np.arange(len(modes))))
    residuals = final.residual + best.inset * final.along
    offset = np.array([one.sampled.offset if one.sampled else one.candidates.offset[0] for one in modes])
    explained = _explained(ends, final, offset)
    return [
        Finding(
            evidence=evidence,
            measurement=shared[k].of_one_scan().at(minima[k]),
            exact=exact[k],
            shared=shared[k],
            total_weight=edges[k][1] + float((1 / evidence.returns.sigma**2).sum()),
            margin=modes[k].margin,
            rival=modes[k].rival,
            log_likelihood=modes[k].log_likelihood,
            labels=final.labels[k, :n],
            inset=best.inset[k, :n],
            edge_sigma=best.sigma[k, :n],
            edge_residuals=residuals[k, :n],
            ends=fits[k],
            objection=_objection(explained[k, ends.there[k]], evidence.problem.options.min_explained),
        )
        for k, (evidence, n) in enumerate((one, len(one.problem.edges)) for one in evidences)
    ]


def _at_best(ends: RingEnds, modes: Sequence[Modes]) -> tuple[Floats, Ints]:
    """Poses (B, 4, 4) to start from, the samples' or the best candidates', and the edges (B, M) of ring ends there."""
    T, labels = np.empty((len(modes), 4, 4)), np.zeros(ends.there.shape, dtype=int)
    for k, one in enumerate(modes):
        if one.sampled is None:
            found = one.candidates.geometry.labels[0]
            T[k], labels[k, : len(found)] = one.candidates.T_target_lidar[0], found
        else:
            T[k], labels[k] = one.sampled.T_target_lidar, -1
    return T, ends.geometry(T, labels).labels if (labels < 0).any() else labels


@dataclass(frozen=True, eq=False, repr=False)
class Associations(Value):
    """The associations of best modes that count, A of B scans.

    Attributes:
        scan: (A,) that each is of, ascending.
        weight: (A,) probability of each; those of a scan sum to 1.
        posterior: of each.
    """

    scan: Ints
    weight: Floats
    posterior: Posterior

    @classmethod
    def of(cls, modes: Sequence[Modes]) -> Associations:
        """Collect them."""
        weights = [one.weights for one in modes]
        chosen = [np.flatnonzero(weight) for weight in weights]
        return cls(
            np.repeat(np.arange(len(modes)), [len(rows) for rows in chosen]),
            np.concatenate([weight[rows] for weight, rows in zip(weights, chosen, strict=True)]),
            concatenate([one.candidates.select(rows) for one, rows in zip(modes, chosen, strict=True)]),
        )

    def mean(self, values: Floats) -> Floats:
        """(B, ...) weighted means by scan of values (A, ...)."""
        first = np.searchsorted(self.scan, np.arange(self.scan[-1] + 1))
        return np.asarray(np.add.reduceat(self.weight.reshape(-1, *[1] * (values.ndim - 1)) * values, first))

    def shares(self) -> Floats:
        """(A,) shares in the cost that stands for all of a scan.

        A weighted mean of costs is a cost of the same form. Its minimum is near the mixture's mean where a weight is
        the association's probability over how sure that association is of its pose, against the others.
        """
        covariance = self.posterior.covariance
        mean = self.mean(covariance)[self.scan]
        share = self.weight / np.trace(np.linalg.solve(covariance, mean), axis1=1, axis2=2)
        return np.asarray(share / np.bincount(self.scan, share)[self.scan])

    def disagreement(self, T_target_lidar: Floats, measurements: Sequence[TemplateMeasurement]) -> Floats:
        """(B,) factors on standard deviations by which associations disagree about poses (B, 4, 4).

        The covariance of the mixture about the estimate, averaged over directions, is the measurement's own times
        the square of a factor of at least 1.
        """
        information = np.stack([one.information(pose) for one, pose in zip(measurements, T_target_lidar, strict=True)])
        xi = difference(T_target_lidar[self.scan], self.posterior.T_target_lidar)
        moment = self.mean(self.posterior.covariance + xi[:, :, None] * xi[:, None, :])
        ratio = (information * moment).sum(axis=(1, 2)) / 6.0
        return np.where(np.bincount(self.scan) > 1, np.sqrt(np.maximum(1.0, ratio)), 1.0)


def _on_edges(
    evidences: Sequence[Evidence],
    modes: Sequence[Modes],
    ends: RingEnds,
    associations: Associations,
    fits: Sequence[EndsFit],
) -> list[tuple[BiasedMeasurement, float]]:
    """Say what edges and plane say together in each scan; with the sum of 1 / sigma^2 of the edges, 1/m2.

    Near a vertex a ring end may belong to either edge, so associations of the best mode that are nearly as likely
    take part. Ring ends that scatter more than they should count less.
    """
    rows = EdgeRows.of(ends.take(associations.scan), associations.posterior)
    share, bounds = associations.shares(), np.searchsorted(associations.scan, np.arange(len(modes) + 1)).tolist()
    found = []
    for k, (evidence, one, fit) in enumerate(zip(evidences, modes, fits, strict=True)):
        problem = evidence.bounded
        if one.sampled is None:
            mine = slice(bounds[k], bounds[k + 1])
            on_edges, weight = rows.measurement(mine, share[mine], problem, fit.seen_strain, fit.factor)
            found.append((on_edges + evidence.on_plane, weight))
        else:
            offset_sd = problem.beam.offset_of_rays(np.linalg.norm(problem.edges.points, axis=1))
            found.append(sampled_measurement(one.sampled, evidence.on_plane, offset_sd))
    return found


def _explained(ends: RingEnds, geometry: EdgeGeometry, offset: Floats) -> Bools:
    """(B, M) whether ring ends lie where a last return may, give or take 3 sigma; offsets (B,) in beam widths."""
    along = geometry.along
    boundary = geometry.residual + offset[:, None] * geometry.across + along * ends.middle
    scatter = np.sqrt(geometry.own + (ends.ring_shift * along) ** 2)
    return np.asarray(np.abs(boundary) < np.abs(along) * 0.5 * ends.width + 3 * scatter)


def _objection(explained: Bools, least: float) -> str:
    """Say how many of a scan's ring ends (M,) lie elsewhere than they may, where those are too many."""
    if explained.mean() >= least:
        return ""
    count = f"{(~explained).sum()} of {len(explained)}"
    return f"{count} ring ends do not end on an edge: not this target, or its returns are mixed"
