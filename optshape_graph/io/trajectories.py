"""Trajectories and pose graphs: TUM, KITTI and g2o, read and written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.io.files import read_text, write_atomically

NORM_TOLERANCE = 1e-2
"""How far a quaternion's norm, or a rotation matrix's columns, may be from one: files carry four digits and up."""

TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
"""g2o's order of the tangent space (translation, rotation) in GTSAM's (rotation, translation), and back."""


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Value):
    """Poses over time.

    Attributes:
        poses: (N, 4, 4) T_world_body.
        stamps: (N,) seconds, increasing; None: the format has none.
        name: where it came from, for messages.

    Raises:
        InputError: shapes that do not fit, values that are not finite, stamps that do not increase.
    """

    poses: Floats
    stamps: Floats | None = None
    name: str = "trajectory"

    def __post_init__(self) -> None:
        poses = frozen(self.poses)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
            raise InputError(f"{self.name}: expected finite poses as N x 4 x 4, found shape {poses.shape}")
        object.__setattr__(self, "poses", poses)
        if self.stamps is None:
            return
        stamps = frozen(self.stamps)
        if stamps.shape != (len(poses),) or not np.isfinite(stamps).all():
            raise InputError(f"{self.name}: {len(poses)} poses but stamps of shape {stamps.shape}, or not finite")
        if (np.diff(stamps) <= 0).any():
            k = int((np.diff(stamps) <= 0).argmax())
            raise InputError(f"{self.name}: stamp {stamps[k + 1]:.9f} of pose {k + 1} does not exceed {stamps[k]:.9f}")
        object.__setattr__(self, "stamps", stamps)

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, eq=False, repr=False)
class PoseGraphEdge(Value):
    """A relative pose between two vertices.

    Attributes:
        i, j: vertices.
        T_i_j: (4, 4) pose of j in the frame of i.
        information: (6, 6) of its right perturbation, GTSAM's order (rotation first).
    """

    i: int
    j: int
    T_i_j: Floats
    information: Floats


@dataclass(frozen=True, eq=False, repr=False)
class PoseGraph(Value):
    """Poses with names, and measurements between them.

    Attributes:
        vertices: number to (4, 4) T_world_i.
        edges: measurements between them.
        fixed: numbers of the vertices that are held.
    """

    vertices: Mapping[int, Floats]
    edges: tuple[PoseGraphEdge, ...] = ()
    fixed: frozenset[int] = frozenset()


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory: lines of `stamp tx ty tz qx qy qz qw`, `#` for comments.

    Raises:
        InputError: a line that is not that, or stamps that do not increase.
    """
    path = Path(path)
    rows = list(_rows(path, 8))
    values = np.array([row for _, row in rows]).reshape(-1, 8)
    poses = _poses(values[:, 1:4], values[:, 4:], [where for where, _ in rows])
    return Trajectory(poses, values[:, 0], str(path))


def write_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write a TUM trajectory; stamps to the nanosecond.

    Raises:
        InputError: the trajectory has no stamps.
    """
    if trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: a TUM trajectory needs stamps")
    body = np.column_stack([trajectory.poses[:, :3, 3], _quaternions(trajectory.poses)])
    lines = [f"{stamp:.9f} {_numbers(row)}\n" for stamp, row in zip(trajectory.stamps, body, strict=True)]
    write_atomically(Path(path), "# stamp tx ty tz qx qy qz qw\n" + "".join(lines))


def read_kitti(path: str | Path, times: str | Path | None = None) -> Trajectory:
    """Read a KITTI trajectory: lines of the first three rows of T_world_body; `times` has one stamp a line.

    Raises:
        InputError: a line that is not that, a matrix that is no rotation, or as many stamps as there are not poses.
    """
    path = Path(path)
    rows = list(_rows(path, 12))
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3] = np.array([row for _, row in rows]).reshape(-1, 3, 4)
    for (where, _), R in zip(rows, T[:, :3, :3], strict=True):
        if np.abs(R.T @ R - np.eye(3)).max() > NORM_TOLERANCE or np.linalg.det(R) < 0:
            raise InputError(f"{where}: its 3 x 3 part is not a rotation")
    if len(T):
        T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    stamps = None if times is None else np.array([row[0] for _, row in _rows(Path(times), 1)])
    if stamps is not None and len(stamps) != len(T):
        raise InputError(f"{times}: {len(stamps)} stamps for the {len(T)} poses of {path}")
    return Trajectory(T, stamps, str(path))


def write_kitti(path: str | Path, trajectory: Trajectory, times: str | Path | None = None) -> None:
    """Write a KITTI trajectory, and its stamps to `times` if given.

    Raises:
        InputError: `times` is given and the trajectory has no stamps.
    """
    if times is not None and trajectory.stamps is None:
        raise InputError(f"{trajectory.name}: it has no stamps to write to {times}")
    write_atomically(Path(path), "".join(f"{_numbers(T[:3].ravel())}\n" for T in trajectory.poses))
    if times is not None and trajectory.stamps is not None:
        write_atomically(Path(times), "".join(f"{stamp:.9f}\n" for stamp in trajectory.stamps))


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a 3-D pose graph: VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX.

    The rotation part of an information matrix is taken as GTSAM takes it: of the rotation vector. (g2o itself
    means the vector part of the quaternion, which is half of that: in a file that g2o wrote, the information of the
    rotation vector is a quarter of the number, and of its coupling with the translation half.)

    Raises:
        InputError: another element, a line that does not parse, or an edge of a vertex that is not there.
    """
    path = Path(path)
    vertices: dict[int, Floats] = {}
    edges: list[tuple[str, PoseGraphEdge]] = []
    fixed: set[int] = set()
    for where, line in _lines(path):
        tag, *words = line.split()
        if tag == "VERTEX_SE3:QUAT":
            (number,), values = _element(words, 1, 7, where)
            if number in vertices:
                raise InputError(f"{where}: vertex {number} is there twice")
            vertices[number] = _poses(values[None, :3], values[None, 3:], [where])[0]
        elif tag == "EDGE_SE3:QUAT":
            (i, j), values = _element(words, 2, 28, where)
            T = _poses(values[None, :3], values[None, 3:7], [where])[0]
            edges.append((where, PoseGraphEdge(i, j, T, _information(values[7:], where))))
        elif tag == "FIX":
            fixed.update(_element(words, len(words), 0, where)[0])
        else:
            raise InputError(f"{where}: element '{tag}'; VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX are read")
    for where, edge in edges:
        if missing := {edge.i, edge.j} - vertices.keys():
            raise InputError(f"{where}: edge to vertex {min(missing)}, which is not there")
    return PoseGraph(vertices, tuple(edge for _, edge in edges), frozenset(fixed))


def write_g2o(path: str | Path, graph: PoseGraph) -> None:
    """Write a 3-D pose graph; see `read_g2o` for the meaning of its information matrices."""
    lines = []
    for number, T in graph.vertices.items():
        lines.append(f"VERTEX_SE3:QUAT {number} {_pose_numbers(T)}\n")
    lines += [f"FIX {number}\n" for number in sorted(graph.fixed)]
    for edge in graph.edges:
        swapped = edge.information[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
        upper = _numbers(swapped[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {edge.i} {edge.j} {_pose_numbers(edge.T_i_j)} {upper}\n")
    write_atomically(Path(path), "".join(lines))


def _lines(path: Path) -> Iterator[tuple[str, str]]:
    """Yield where and what every line is that is neither empty nor a comment."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if line.strip() and not line.lstrip().startswith("#"):
            yield f"{path}:{number}", line


def _rows(path: Path, columns: int) -> Iterator[tuple[str, list[float]]]:
    for where, line in _lines(path):
        words = line.replace(",", " ").split()
        if len(words) != columns:
            raise InputError(f"{where}: expected {columns} numbers, found {len(words)} words")
        yield where, _floats(words, where)


def _floats(words: list[str], where: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {error}") from error
    if not np.isfinite(values).all():
        raise InputError(f"{where}: {next(w for w, v in zip(words, values, strict=True) if not np.isfinite(v))}"
                         " is not a finite number")  # fmt: skip
    return values


def _element(words: list[str], n_numbers: int, n_values: int, where: str) -> tuple[list[int], Floats]:
    if len(words) != n_numbers + n_values:
        raise InputError(
            f"{where}: expected {n_numbers} vertex numbers and {n_values} values, found {len(words)} words"
        )
    try:
        numbers = [int(word) for word in islice(words, n_numbers)]
    except ValueError as error:
        raise InputError(f"{where}: a vertex number is an integer: {error}") from error
    return numbers, np.array(_floats(words[n_numbers:], where))


def _information(upper: Floats, where: str) -> Floats:
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = upper
    matrix = matrix + np.triu(matrix, 1).T
    if np.linalg.eigvalsh(matrix).min() < -1e-9 * np.abs(matrix).max():
        raise InputError(f"{where}: its information matrix has a negative eigenvalue")
    return matrix[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]


def _poses(translations: Floats, quaternions: Floats, where: list[str]) -> Floats:
    """(N, 4, 4) of (N, 3) translations and (N, 4) quaternions, x y z w."""
    poses = np.tile(np.eye(4), (len(translations), 1, 1))
    norms = np.linalg.norm(quaternions, axis=1)
    for k in np.flatnonzero(np.abs(norms - 1) > NORM_TOLERANCE)[:1]:
        raise InputError(f"{where[k]}: quaternion {quaternions[k].tolist()} has norm {norms[k]:g}; expected 1")
    if len(poses):
        poses[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    poses[:, :3, 3] = translations
    return poses


def _quaternions(poses: Floats) -> Floats:
    """(N, 4) x y z w with w >= 0."""
    if not len(poses):
        return np.zeros((0, 4))
    return np.asarray(Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True))


def _pose_numbers(T: Floats) -> str:
    return f"{_numbers(T[:3, 3])} {_numbers(_quaternions(T[None])[0])}"


def _numbers(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)
