"""Rigid transforms under their old name; `optshape_graph.se3` is the module."""

from optshape_graph.se3 import adjoint, inverse, inverse_covariance, skew, vec, vec_derivative

__all__ = ["adjoint", "inverse", "inverse_covariance", "skew", "vec", "vec_derivative"]
