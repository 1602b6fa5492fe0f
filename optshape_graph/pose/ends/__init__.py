"""Ring ends: where they lie against the edges of the target, and what they say of its pose."""

from optshape_graph.pose.ends.candidates import alternative_labels, firsts, work_out
from optshape_graph.pose.ends.fit import SEEN, EndsFit, fit_ends
from optshape_graph.pose.ends.posterior import Posterior, concatenate
from optshape_graph.pose.ends.propagation import DAMPING, posterior_step, residual_intervals, update_sites
from optshape_graph.pose.ends.ring_ends import EdgeGeometry, Problem, RingEnds
from optshape_graph.pose.ends.rows import EdgeRows

__all__ = [
    "DAMPING",
    "SEEN",
    "EdgeGeometry",
    "EdgeRows",
    "EndsFit",
    "Posterior",
    "Problem",
    "RingEnds",
    "alternative_labels",
    "concatenate",
    "firsts",
    "fit_ends",
    "posterior_step",
    "residual_intervals",
    "update_sites",
    "work_out",
]
