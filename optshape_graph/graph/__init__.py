"""Several scans and several targets in one factor graph: build, solve, and what the solution is worth."""

from optshape_graph.graph.observation import Estimate, Observation
from optshape_graph.graph.problem import TargetGraph, build
from optshape_graph.graph.solution import Residual, Solution, UnobservableDirection
from optshape_graph.graph.solve import solve

__all__ = [
    "Estimate",
    "Observation",
    "Residual",
    "Solution",
    "TargetGraph",
    "UnobservableDirection",
    "build",
    "solve",
]
