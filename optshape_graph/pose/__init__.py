"""One target in one scan: association, posterior, certificate."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from optshape_graph.pose.enumerated import estimate_enumerated, refine
from optshape_graph.pose.estimate import Ambiguity, PoseEstimate
from optshape_graph.pose.paper import estimate_as_paper
from optshape_graph.pose.ringless import estimate_ringless
from optshape_graph.pose.sdp import Backend, Certificate, certify, solve_relaxation
from optshape_graph.scan import Scan
from optshape_graph.target import Target

Method = Literal["global", "paper"]

__all__ = [
    "Ambiguity",
    "Backend",
    "Certificate",
    "Method",
    "PoseEstimate",
    "certify",
    "estimate_pose",
    "refine",
    "solve_relaxation",
]


def estimate_pose(scan: Scan, target: Target, method: Method = "global", backend: Backend = "clarabel") -> PoseEstimate:
    """Estimate the pose of a target from its returns.

    Args:
        scan: the returns on the target and no others; its sensor, where known, gives azimuth step, noise and the
            rings that should have hit.
        target: the template.
        method: "global" enumerates every consistent association of edge points to edges, finds the posterior of the
            pose under the best of them, and certifies it; of a cloud without rings it finds the posterior over all
            poses that contain the returns. "paper" is the alternation of Huang, Clark and Grizzle, for comparison.
        backend: what solves the relaxation.

    Returns:
        The estimate. Its status says whether it can be used.

    Raises:
        EstimationError: the returns determine no pose at all: none, fewer than three, all on a line, no
            azimuth step to be found.
    """
    if method == "paper":
        estimate = estimate_as_paper(scan, target, backend)
    elif scan.ring is None:
        estimate = estimate_ringless(scan, target, backend)
    else:
        estimate = estimate_enumerated(scan, target, backend)
    return replace(estimate, scan=scan.name)
