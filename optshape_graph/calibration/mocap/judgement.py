"""Whether a calibration to motion capture is to be trusted: scatter, layout, size, and what the scans can't tell."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from optshape_graph.calibration.free_shape import wrong_size
from optshape_graph.calibration.mocap.agreement import placements
from optshape_graph.calibration.mocap.comparison import MocapScan
from optshape_graph.calibration.mocap.graph import Innovation, MarkerModel, Solution
from optshape_graph.calibration.verdict import Finding, of_doubts
from optshape_graph.se3 import skew

FEWEST = 3
"""Placements from which the others can show that one is wrong."""

FALSE_REJECTION = 1e-4
"""Probability that a good scan is left out, were its errors Gaussian."""

OFF = 2.0
"""Distance of the vertices from where they should be, in the layout's prior, below which a scan is not left out."""

MOST_SCATTER = 16.0
"""Scatter that is taken for a sensor whose file is too sure of itself; beyond it, something is wrong."""

LOOSEST = (3.0, 0.1)
"""Standard deviations of T_lidar_mocap at the targets, deg and metres, beyond which it is called open."""


def contradicting(compared: Mapping[int, Innovation], used: Collection[int], model: MarkerModel) -> list[int]:
    """Return the numbers of the scans that contradict the used ones, the worst first.

    One that does is beyond chance, where typical scans scatter as they do, and moves the vertices by more than the
    markers may be away from them: what is less widens the covariance.
    """
    typical = max(1.0, float(np.median([compared[i].chi_square for i in used])) / float(chi2.median(6)))
    limit = float(chi2.isf(FALSE_REJECTION, 6)) * typical
    bad = [i for i, one in compared.items() if one.chi_square > limit and one.rms > OFF * model.layout_prior]
    return sorted(bad, key=lambda i: -compared[i].chi_square)


def judge(
    scans: Sequence[MocapScan],
    solution: Solution,
    model: MarkerModel,
    scatter: float,
    compared: Mapping[int, Innovation],
    used: Sequence[int],
) -> tuple[Finding, ...]:
    """Judge a solution by the scans that it is made of.

    Args:
        scans: those used.
        solution: of their graph.
        model: of the markers.
        scatter: of the scans about the solution, 1 where their covariances are right.
        compared: every scan against the used ones, by its number.
        used: numbers of the scans used.
    """
    chi_square = float(np.mean([compared[i].chi_square for i in used]))
    too_few = [scans[used.index(i)].name for i in contradicting(compared, used, model) if i in used]
    return (
        *of_doubts([scan.estimate.reason if scan.estimate.status == "doubtful" else "" for scan in scans]),
        *_of_number(scans, solution, scatter, len(compared) - len(used)),
        *_of_scatter(max(scatter, chi_square / 6), too_few),
        *_of_layout(scans, solution, model, scatter),
        *_of_shape(scans),
    )


def _of_number(scans: Sequence[MocapScan], solution: Solution, scatter: float, rejected: int) -> list[Finding]:
    degrees, metres = _sigmas(scans, solution, scatter)
    known = f"T_lidar_mocap is known to {degrees:.1f} deg and {1e3 * metres:.0f} mm (sd) at the targets"
    found = []
    if (count := placements(scans)) < FEWEST:
        one = "1 placement" if count == 1 else f"{count} placements"
        found.append(Finding(
            f"{one} of the target: no other shows whether one is wrong, and {known}; take {FEWEST} or more, at "
            f"different places and angles", True,
        ))  # fmt: skip
    elif degrees > LOOSEST[0] or metres > LOOSEST[1]:
        found.append(Finding(f"{known}: add scans nearer by, or at other places and angles", True))
    if rejected:
        total = len(scans) + rejected
        found.append(
            Finding(f"{rejected} of {total} scans contradict the others and were left out", 3 * rejected > total)
        )
    return found


def _of_scatter(scatter: float, contradicting_few: Sequence[str]) -> list[Finding]:
    if scatter > MOST_SCATTER:
        return [Finding(
            f"the scans disagree {np.sqrt(scatter):.1f} times as much as their covariances say: something is wrong "
            f"with scans, markers or target that none of them shows alone", True,
        )]  # fmt: skip
    if contradicting_few:
        return [Finding(
            f"{contradicting_few[0]} contradicts the other scans, which are too few to show which of them is wrong",
            True,
        )]  # fmt: skip
    return []


def _of_layout(scans: Sequence[MocapScan], solution: Solution, model: MarkerModel, scatter: float) -> list[Finding]:
    offsets = solution.layout - scans[0].estimate.target.vertices
    variances = np.trace(solution.layout_covariance, axis1=1, axis2=2) * max(1.0, scatter)
    distances = np.linalg.norm(offsets, axis=1)
    k = int(np.argmax(distances))
    if distances[k] < 3 * model.layout_prior + 3 * np.sqrt(variances[k]):
        return []
    text = (
        f"by the LiDAR the marker of vertex {k} is {distances[k]:.3f} m from it; expected about "
        f"{model.layout_prior:.3f}: are the markers those of this target?"
    )
    return [Finding(text, True)]


def _of_shape(scans: Sequence[MocapScan]) -> list[Finding]:
    returns = [scan.returns for scan in scans if scan.returns is not None]
    text = wrong_size(returns, scans[0].estimate.target)
    return [Finding(text, True)] if text else []


def _sigmas(scans: Sequence[MocapScan], solution: Solution, scatter: float) -> tuple[float, float]:
    """Return the largest standard deviations of T_lidar_mocap at the middle of the targets, deg and metres."""
    middle = np.mean([scan.T_mocap_target[:3, 3] for scan in scans], axis=0)
    # A point of the motion-capture frame moves by R (omega x middle + v).
    covariance = solution.covariance * max(1.0, scatter)
    J = np.hstack([-skew(middle), np.eye(3)])
    largest = [float(np.linalg.eigvalsh(block)[-1]) for block in (covariance[:3, :3], J @ covariance @ J.T)]
    return float(np.degrees(np.sqrt(largest[0]))), float(np.sqrt(largest[1]))
