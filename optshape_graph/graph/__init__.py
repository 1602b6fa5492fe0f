"""The engine: poses, known or not, linked by template measurements and by GTSAM's own factors; solved, and judged.

Mapping and the calibrations are built on it. A measurement is of T_target_lidar, which is a *chain* of known transforms
and variables; measurements of one kind are a *term*, evaluated as arrays; everything else is a GTSAM factor. A LiDAR,
mounted somewhere on a robot, sees two targets that stand somewhere, from three places between which there is odometry:

>>> import gtsam, numpy as np
>>> from gtsam.symbol_shorthand import B, E, L
>>> from optshape_graph.factors import TemplateMeasurement
>>> from optshape_graph.graph import Inverse, Templates, solve
>>> from optshape_graph.se3 import apply, exp, inverse
>>> from optshape_graph.target import Target
>>> square = Target.from_polygon([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
>>> def measured(T_target_lidar):
...     edge, along = np.repeat(np.arange(4), 10), np.tile(np.linspace(0.1, 0.9, 10), 4)[:, None]
...     on_edge = (1 - along) * square.vertices[edge] + along * square.vertices[(edge + 1) % 4]
...     points = apply(inverse(T_target_lidar), on_edge)
...     return TemplateMeasurement.from_edge_points(
...         points, square.normals[edge], square.offsets[edge], 0.01, 0.01, T_target_lidar
...     )
>>> T_body_lidar = exp([0.1, 0.0, 0.2, 0.3, 0.0, 0.5])
>>> T_world_body = exp([[0, 0, 0, 0, 0, 0], [0.2, 0, 0.3, 1, 0, 0], [0, 0.2, 0.6, 2, 0.5, 0]])
>>> T_world_target = exp([[0, 0, 0, 6, 1, 0], [0, 0, 0.2, 6, -1, 0]])

T_target_lidar is T_target_world T_world_body T_body_lidar: a variable is its key, inverted where that is needed, and
what is known is a (4, 4). The odometry holds the first body where it is, so that the world is its frame:

>>> seen = [(j, i) for j in range(2) for i in range(3)]
>>> measurements = [measured(inverse(T_world_target[j]) @ T_world_body[i] @ T_body_lidar) for j, i in seen]
>>> term = Templates.of(measurements, [[Inverse(L(j)), B(i), E(0)] for j, i in seen])
>>> factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
>>> precise = gtsam.noiseModel.Isotropic.Sigma(6, 0.001)
>>> factors.push_back(gtsam.PriorFactorPose3(B(0), gtsam.Pose3(), precise))
>>> for i in range(2):
...     motion = gtsam.Pose3(inverse(T_world_body[i]) @ T_world_body[i + 1])
...     factors.push_back(gtsam.BetweenFactorPose3(B(i), B(i + 1), motion, precise))
>>> for key, T in [(E(0), np.eye(4)), *[(B(i), T_world_body[i]) for i in range(3)]]:
...     values.insert(key, gtsam.Pose3(T))
>>> for j in range(2):
...     values.insert(L(j), gtsam.Pose3(T_world_target[j]))
>>> solution = solve(values, [term], factors, names={E(0): "T_body_lidar"})
>>> solution.converged, solution.unobservable
(True, ())
>>> bool(np.allclose(solution.pose(E(0)), T_body_lidar, atol=1e-6))
True
>>> solution.covariance([E(0), L(1)]).shape  # of both together, rotation first
(12, 12)
>>> T_lidar_target, covariance = solution.relative([Inverse(E(0)), Inverse(B(2)), L(1)])

- `solve(values, terms, factors, names)` minimises the cost and returns a `Solution`: `values`, `pose`, `error`,
  `converged`, `covariance(keys)`, `relative(chain)`, and `unobservable`, which says in words what nothing determines.
- `Templates` are template measurements, with a robust loss if wanted. `SharedErrors` are measurements with the errors
  that those of one sensor share (its rings' biases, an offset at edges) as variables. `JointPoses` are measured poses
  with a joint covariance, such as a map. A new kind of measurement is a class with `at(state)`, which returns its
  exact `error` and adds its linearisation to a graph (`Term`, `Model`); `Chains` evaluates and differentiates poses.
- `build(observations)` names scans and targets, places them, and chooses among the poses of symmetric targets.
"""

from optshape_graph.graph.chain import Chain, Chains, Inverse, State
from optshape_graph.graph.observation import Estimate, Observation
from optshape_graph.graph.scans_and_targets import Residual, TargetGraph, TargetSolution, build
from optshape_graph.graph.shared import SharedErrors
from optshape_graph.graph.solution import Solution, UnobservableDirection
from optshape_graph.graph.solve import solve
from optshape_graph.graph.terms import JointPoses, Model, Templates, Term, add_rows

__all__ = [
    "Chain",
    "Chains",
    "Estimate",
    "Inverse",
    "JointPoses",
    "Model",
    "Observation",
    "Residual",
    "SharedErrors",
    "Solution",
    "State",
    "TargetGraph",
    "TargetSolution",
    "Templates",
    "Term",
    "UnobservableDirection",
    "add_rows",
    "build",
    "solve",
]
