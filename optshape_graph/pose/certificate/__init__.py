"""Certificates: the relaxation, multipliers of its dual, and what they say of a pose."""

from optshape_graph.pose.certificate.certificates import NOT_TIGHT, Certificate, certify, certify_all
from optshape_graph.pose.certificate.relaxation import Backend, solve_relaxation

__all__ = ["NOT_TIGHT", "Backend", "Certificate", "certify", "certify_all", "solve_relaxation"]
