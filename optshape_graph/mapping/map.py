"""The map: landmarks with their joint covariance, and the trajectories that they were seen from. It is a file, too.

`schema: optshape/map/1`, JSON. The covariances of single landmarks share the drift of the trajectory, so the joint one
is kept beside them: without it a map that is used again would count that drift once for each landmark, and believe
itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen, shortened
from optshape_graph.errors import InputError
from optshape_graph.io.documents import Node, read_document
from optshape_graph.io.results import Result, Row
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.se3 import apply, as_transform
from optshape_graph.target import Target

SCHEMA = "optshape/map/1"


@dataclass(frozen=True, eq=False, repr=False)
class Landmark(Value):
    """A target that stands somewhere.

    Attributes:
        id: its name in the map.
        target: its template; with as-built vertices, where those were refined.
        T_world_target: (4, 4).
        covariance: (6, 6) of the right perturbation of T_world_target, rotation first.
        observations: number of scans that it was measured in; 0: surveyed.

    Raises:
        InputError: a pose or covariance that is none.
    """

    id: str
    target: Target
    T_world_target: Floats
    covariance: Floats
    observations: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_world_target", as_transform(self.T_world_target, f"landmark '{self.id}'"))
        object.__setattr__(self, "covariance", _covariance(self.covariance, 6, f"landmark '{self.id}'"))

    @property
    def vertices(self) -> Floats:
        """(n, 3) vertices, world frame, metres."""
        return apply(self.T_world_target, self.target.vertices)

    @property
    def position(self) -> tuple[float, float, float]:
        """x, y, z of the target's origin in the world, metres."""
        x, y, z = self.T_world_target[:3, 3].tolist()
        return x, y, z


@dataclass(frozen=True, eq=False, repr=False)
class Map(Result):
    """Landmarks, and where they were seen from.

    Attributes:
        landmarks: in the order of their blocks in `joint_covariance`.
        joint_covariance: (6 m, 6 m) matrix of all landmarks; None: they are independent, as if surveyed one by one.
        trajectories: T_world_lidar over time, by the name of the session.

    Raises:
        InputError: two landmarks of one name, or a covariance that does not fit.
    """

    FORM: ClassVar[str] = "map"

    landmarks: tuple[Landmark, ...]
    joint_covariance: Floats | None = None
    trajectories: Mapping[str, Trajectory] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [landmark.id for landmark in self.landmarks]
        if len(set(names)) < len(names):
            raise InputError(f"two landmarks are called '{next(n for n in names if names.count(n) > 1)}'")
        if self.joint_covariance is not None:
            joint = _covariance(self.joint_covariance, 6 * len(names), "joint covariance")
            object.__setattr__(self, "joint_covariance", joint)

    @property
    def covariance(self) -> Floats:
        """(6 m, 6 m) joint covariance of the landmarks, rotation first, each of its own right perturbation."""
        if self.joint_covariance is not None:
            return self.joint_covariance
        joint = np.zeros((6 * len(self.landmarks), 6 * len(self.landmarks)))
        for k, landmark in enumerate(self.landmarks):
            joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = landmark.covariance
        return joint

    def __getitem__(self, name: str) -> Landmark:
        """Return a landmark by its name.

        Raises:
            KeyError: there is none.
        """
        for landmark in self.landmarks:
            if landmark.id == name:
                return landmark
        raise KeyError(name)

    def __repr__(self) -> str:
        names = ", ".join(landmark.id for landmark in self.landmarks[:5]) + (", ..." if len(self.landmarks) > 5 else "")
        poses = sum(len(trajectory) for trajectory in self.trajectories.values())
        return shortened(f"Map({len(self.landmarks)} landmarks: {names or 'none'}; {poses} poses)")

    def to_dict(self) -> dict[str, Any]:
        """Return the map as plain data of its JSON form.

        Raises:
            InputError: a trajectory without stamps.
        """
        only = next(iter(self.trajectories)) if len(self.trajectories) == 1 else ""
        joint = {} if self.joint_covariance is None else {"joint_covariance": self.joint_covariance.tolist()}
        return {
            "schema": SCHEMA,
            "targets": {landmark.id: {"vertices": landmark.target.vertices.tolist()} for landmark in self.landmarks},
            "landmarks": [
                {
                    "id": landmark.id,
                    "target": landmark.target.name,
                    "T_world_target": landmark.T_world_target.tolist(),
                    "covariance": landmark.covariance.tolist(),
                    "vertices": landmark.vertices.tolist(),
                    "observations": landmark.observations,
                }
                for landmark in self.landmarks
            ],
            **joint,
            **({"session": only} if only else {}),
            "trajectory": [
                {**({} if only else {"session": name}), "stamp": stamp, "T_world_lidar": T.tolist()}
                for name, trajectory in self.trajectories.items()
                for stamp, T in zip(_stamps(trajectory), trajectory.poses, strict=True)
            ],
        }

    def rows(self) -> list[Row]:
        """Return a row for each landmark."""
        return [
            {
                "landmark": one.id, "target": one.target.name,
                "x_m": one.position[0], "y_m": one.position[1], "z_m": one.position[2],
                "sd_mm": 1e3 * float(np.sqrt(np.diag(one.covariance)[3:].max())),
                "sd_deg": float(np.degrees(np.sqrt(np.diag(one.covariance)[:3].max()))),
                "observations": one.observations,
            }
            for one in self.landmarks
        ]  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> Map:
        """Read a map, whoever wrote it; see `load_map`.

        Args:
            path: of the file.
        """
        return load_map(path)

    def _document(self) -> dict[str, Any]:
        return self.to_dict()


def save_map(path: str | Path, result: Map) -> None:
    """Write a map as JSON, as `Map.save` does.

    Raises:
        InputError: a trajectory without stamps, or the file cannot be written.
    """
    result.save(path)


def load_map(path: str | Path) -> Map:
    """Read a map.

    Raises:
        InputError: not readable, or not of the schema; the message names file and key.
    """
    root = read_document(path, "map")
    fields = root.entries()
    templates = {name: node.at("vertices").numbers(-1, 3) for name, node in fields["targets"].entries().items()}
    landmarks = tuple(_landmark(node, templates) for node in fields["landmarks"].items())
    only = fields["session"].text() if "session" in fields else ""
    joint = None
    if "joint_covariance" in fields:
        joint = fields["joint_covariance"].numbers(6 * len(landmarks), 6 * len(landmarks))
    try:
        return Map(landmarks, joint if landmarks else None, _trajectories(fields["trajectory"], only))
    except InputError as error:
        root.fail(str(error))


def _covariance(covariance: Floats, size: int, what: str) -> Floats:
    C = frozen(covariance)
    if C.shape != (size, size) or not np.isfinite(C).all():
        raise InputError(f"{what}: expected a finite covariance as {size} x {size}, found shape {C.shape}")
    tolerance = 1e-6 * np.abs(C).max(initial=0.0)
    if size and (np.abs(C - C.T).max() > tolerance or np.linalg.eigvalsh(C).min() < -tolerance):
        raise InputError(f"{what}: its covariance is not symmetric and positive")
    return C


def _stamps(trajectory: Trajectory) -> list[float]:
    if trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: the trajectory of a map needs stamps")
    return [float(stamp) for stamp in trajectory.stamps]


def _landmark(node: Node, templates: Mapping[str, Floats]) -> Landmark:
    fields = node.entries()
    name = fields["id"].text()
    if name not in templates:
        fields["id"].fail(f"no template for landmark '{name}' under 'targets'")
    observations = fields["observations"].integer() if "observations" in fields else 0
    try:
        target = Target(templates[name], fields["target"].text())
        T, C = fields["T_world_target"].numbers(4, 4), fields["covariance"].numbers(6, 6)
        return Landmark(name, target, T, C, observations)
    except InputError as error:
        node.fail(str(error))


def _trajectories(node: Node, only: str) -> dict[str, Trajectory]:
    """Trajectories by their session; of poses that name none, `only`."""
    stamps: dict[str, list[float]] = {}
    poses: dict[str, list[Floats]] = {}
    for entry in node.items():
        fields = entry.entries()
        name = fields["session"].text() if "session" in fields else only
        stamps.setdefault(name, []).append(fields["stamp"].number())
        poses.setdefault(name, []).append(as_transform(fields["T_world_lidar"].numbers(4, 4), entry.where))
    return {name: Trajectory(np.array(poses[name]), np.array(stamps[name]), name or "trajectory") for name in poses}
