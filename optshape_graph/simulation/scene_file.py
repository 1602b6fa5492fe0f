"""Scene files: `schema: optshape/scene/1`.

    schema: optshape/scene/1
    targets:
      - {target: paper, position: [8, 0, 0.2], rpy_deg: [5, 10, 10], reflectivity: 0.9}
    floor: {height: -1.5}
    walls:
      - {size: [10, 3], position: [12, 0, 0]}
    boxes:
      - {size: [0.05, 0.05, 1.6], position: [8.1, 0, -0.7]}
    meshes:
      - {file: chair.ply, position: [5, 2, -1.5], rpy_deg: [0, 0, 90], scale: 0.001}
    lidar: {position: [0, 0, 0], rpy_deg: [0, 0, 0], velocity: [1, 0, 0], angular_velocity_deg: [0, 0, 20]}

Positions are in the world, metres: of the vertex mean of a target, and of the centre of a wall or box. `rpy_deg` are
roll, pitch and yaw with R = Rx Ry Rz. Like a target, a wall lies in its plane x = 0, with its size along y and z.
Velocities are in the LiDAR's own frame, m/s and deg/s; without them it stands still. All keys but `schema` are
optional.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.io.documents import Node, read_document
from optshape_graph.io.targets import load_target
from optshape_graph.simulation.mesh import Mesh
from optshape_graph.simulation.motion import ConstantTwist, Motion
from optshape_graph.simulation.placement import pose_from_rpy
from optshape_graph.simulation.scene import Scene
from optshape_graph.simulation.surfaces import Box, Floor, Patch, Surface
from optshape_graph.target import Target


def load_scene(path: str | Path) -> tuple[Scene, Floats | Motion]:
    """Read a scene and the LiDAR's pose (4, 4) or motion in it: T_world_lidar.

    Raises:
        InputError: not readable, an unknown key, or a value that does not fit.
        MissingExtraError: the scene has meshes and Open3D is absent.
    """
    root = read_document(path, "scene")
    fields = root.entries()
    background: list[Surface] = []
    if "floor" in fields:
        floor = fields["floor"].entries()
        background.append(Floor(floor["height"].number(), _reflectivity(floor, 0.3)))
    background += [_wall(node) for node in _items(fields, "walls")]
    background += [_box(node) for node in _items(fields, "boxes")]
    background += [_mesh(node) for node in _items(fields, "meshes")]
    targets = tuple(_target(node) for node in _items(fields, "targets"))
    return Scene(targets, tuple(background)), _lidar(fields["lidar"]) if "lidar" in fields else np.eye(4)


def _items(fields: dict[str, Node], key: str) -> list[Node]:
    return fields[key].items() if key in fields else []


def _target(node: Node) -> Patch:
    fields = node.entries()
    target = load_target(fields["target"].text(), node.path.parent)
    return Patch(target, _pose(fields), _reflectivity(fields, 0.8))


def _wall(node: Node) -> Patch:
    fields = node.entries()
    y, z = fields["size"].numbers(2) / 2
    shape = Target.from_polygon([[y, -z], [y, z], [-y, z], [-y, -z]], "wall")
    return Patch(shape, _pose(fields), _reflectivity(fields, 0.5))


def _box(node: Node) -> Box:
    fields = node.entries()
    return Box(fields["size"].numbers(3), _pose(fields), _reflectivity(fields, 0.5))


def _mesh(node: Node) -> Mesh:
    fields = node.entries()
    scale = fields["scale"].number() if "scale" in fields else 1.0
    return Mesh.read(fields["file"].file(), _pose(fields), scale, _reflectivity(fields, 0.5))


def _lidar(node: Node) -> Floats | Motion:
    fields = node.entries()
    T_world_lidar = _pose(fields)
    velocity = fields["velocity"].numbers(3) if "velocity" in fields else np.zeros(3)
    turning = np.radians(fields["angular_velocity_deg"].numbers(3)) if "angular_velocity_deg" in fields else np.zeros(3)
    if not (velocity.any() or turning.any()):
        return T_world_lidar
    return ConstantTwist(T_world_lidar, np.concatenate([turning, velocity]))


def _pose(fields: dict[str, Node]) -> Floats:
    position = fields["position"].numbers(3) if "position" in fields else np.zeros(3)
    rpy = np.radians(fields["rpy_deg"].numbers(3)) if "rpy_deg" in fields else np.zeros(3)
    return pose_from_rpy(position, rpy)


def _reflectivity(fields: dict[str, Node], default: float) -> float:
    return fields["reflectivity"].number() if "reflectivity" in fields else default
