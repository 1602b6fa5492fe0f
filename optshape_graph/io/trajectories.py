"""Trajectories and pose graphs: TUM and its kin, KITTI and g2o, read and written."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.files import is_file, read_bytes, read_text, write_atomically
from optshape_graph.io.mocap import METRES, read_motive_bodies
from optshape_graph.io.times import parse_stamp

NORM_TOLERANCE = 1e-2
"""How far a quaternion's norm, or a rotation matrix's columns, may be from one: files carry four digits and up."""

LARGEST_BAD_SHARE = 0.1
"""Share of lines that may be no pose; they are left out and counted."""

FEWEST = 2
"""Poses that must be left beside one line that is none, however short the file."""

_ORDER = ("stamp", "x", "y", "z", "qx", "qy", "qz", "qw")

_NAMES: dict[str, tuple[str, ...]] = {
    "stamp": ("timestamp", "time", "stamp", "t", "ts", "sec", "seconds", "times", "timestampns", "timens", "nsec"),
    "x": ("x", "tx", "px", "prsrx", "posx", "positionx", "pos0", "translationx", "transx"),
    "y": ("y", "ty", "py", "prsry", "posy", "positiony", "pos1", "translationy", "transy"),
    "z": ("z", "tz", "pz", "prsrz", "posz", "positionz", "pos2", "translationz", "transz"),
    "qx": ("qx", "qrsx", "quatx", "orientationx", "rotx", "rotationx", "quaternionx", "orix"),
    "qy": ("qy", "qrsy", "quaty", "orientationy", "roty", "rotationy", "quaterniony", "oriy"),
    "qz": ("qz", "qrsz", "quatz", "orientationz", "rotz", "rotationz", "quaternionz", "oriz"),
    "qw": ("qw", "qrsw", "quatw", "orientationw", "rotw", "rotationw", "quaternionw", "oriw"),
    "roll": ("roll", "rollrad", "rolldeg", "rx"), "pitch": ("pitch", "pitchrad", "pitchdeg", "ry"),
    "yaw": ("yaw", "yawrad", "yawdeg", "rz", "heading"),
}  # fmt: skip
"""Names of columns, without case and separators."""

_SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0}

log = logging.getLogger(__name__)

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


def is_trajectory(name: str | Path) -> bool:
    """Say whether a name is that of a file to be read with `read_trajectory`: one that exists, or ends in `.tum`."""
    path = Path(name)
    return (
        path.suffix == ".tum"
        or is_file(path)
        or (":" in path.name and is_file(path.with_name(path.name.rpartition(":")[0])))
    )


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory with stamps, whatever the file's ending.

    - TUM: lines of `stamp tx ty tz qx qy qz qw`, separated by blanks or commas, `#` for comments.
    - The same with a line, a comment or not, that names the columns: their order and units are taken from it, as in
      EuRoC's and TUM-VI's CSV (nanoseconds, w first). Other columns are passed over.
    - A rigid body of an export of OptiTrack Motive; FILE:BODY names one of several.

    Stamps of an epoch in milli-, micro- or nanoseconds are told by their size. Lines that are no pose, and poses whose
    stamp is not after the one before, are left out, counted and said, as long as they are few
    (`LARGEST_BAD_SHARE`).

    Raises:
        InputError: not readable, poses without stamps (KITTI) or without quaternions, an order of the quaternion that
            nothing tells, or too many lines that are no pose.
    """
    path = Path(path)
    if not is_file(path) and ":" in path.name and is_file(path.with_name(path.name.rpartition(":")[0])):
        return read_rigid_body(path.with_name(path.name.rpartition(":")[0]), path.name.rpartition(":")[2])
    text = decode(read_bytes(path))
    if text.lstrip().startswith("Format Version"):
        return read_rigid_body(path)
    return _read_lines(path, text)


def read_tum(path: str | Path) -> Trajectory:
    """Read a TUM trajectory: lines of `stamp tx ty tz qx qy qz qw`, `#` for comments; see `read_trajectory`.

    Raises:
        InputError: as `read_trajectory`.
    """
    return _read_lines(Path(path), decode(read_bytes(path)))


@dataclass(frozen=True)
class _Layout:
    """Which word of a line is what: stamp, x y z, and the quaternion x y z w; with units in seconds and metres."""

    words: tuple[int, ...] = tuple(range(8))
    stamp_unit: float | None = None
    length_unit: float = 1.0
    width: int = 8
    named: bool = False


def _read_lines(path: Path, text: str) -> Trajectory:
    layout, bad = _Layout(), _BadLines(path)
    rows: list[tuple[int, list[str]]] = []
    for number, line in enumerate(text.splitlines(), 1):
        comment = line.lstrip().startswith(("#", "%", "//"))
        words = re.sub(r"[,;]", " ", re.sub(r"\s*[\[(]([^\])]*)[\])]", r"[\1]", line.lstrip(" #%/"))).split()
        if not words or words == ["[]"]:
            continue
        if comment or not _are_numbers(words[:1]):
            layout = (not rows and _layout(path, _names(line))) or layout
            if not (comment or layout.named):
                bad.add(number, f"could not convert string to float: '{words[0]}'")
            continue
        rows.append((number, words))
    _check_width(path, rows, layout, "," in text.partition("\n")[2] or "," in text[:400])
    stamps: list[float] = []
    values: list[list[float]] = []
    places: list[str] = []
    for number, words in rows:
        try:
            stamp, numbers = _pose_of_line(words, layout)
        except ValueError as error:
            bad.add(number, str(error))
            continue
        if stamps and stamp <= stamps[-1]:
            bad.add(number, f"stamp {stamp:.9f} does not exceed {stamps[-1]:.9f}")
            continue
        stamps.append(stamp)
        values.append(numbers)
        places.append(f"{path}:{number}")
    bad.judge(len(stamps))
    array = np.array(values).reshape(-1, 7)
    return Trajectory(_poses(array[:, :3], array[:, 3:], places), np.array(stamps, dtype=float), str(path))


def _pose_of_line(words: list[str], layout: _Layout) -> tuple[float, list[float]]:
    """Stamp, and position and quaternion (x y z w), of a line.

    Raises:
        ValueError: it is no pose; the message says why.
    """
    if len(words) < layout.width or (not layout.named and len(words) != layout.width):
        raise ValueError(f"expected {layout.width} numbers, found {len(words)} words")
    picked = [words[k] for k in layout.words]
    numbers = [float(word) for word in picked[1:]]
    for word, number in zip(picked[1:], numbers, strict=True):
        if not math.isfinite(number):
            raise ValueError(f"{word} is not a finite number")
    stamp = parse_stamp(picked[0]) if layout.stamp_unit is None else float(picked[0]) * layout.stamp_unit
    if stamp is None or not math.isfinite(stamp):
        raise ValueError(f"expected a stamp, found '{picked[0]}'")
    norm = math.sqrt(sum(q * q for q in numbers[3:]))
    if abs(norm - 1) > NORM_TOLERANCE:
        raise ValueError(f"quaternion {numbers[3:]} has norm {norm:g}; expected 1")
    return stamp, [x * layout.length_unit for x in numbers[:3]] + numbers[3:]


class _BadLines:
    """Lines that are left out, and whether they are too many."""

    def __init__(self, path: Path) -> None:
        self.path, self.count, self.first = path, 0, ""

    def add(self, line: int, problem: str) -> None:
        self.count += 1
        self.first = self.first or f"{self.path}:{line}: {problem}"

    def judge(self, good: int) -> None:
        if self.count > LARGEST_BAD_SHARE * (self.count + good) and (self.count > 1 or good < FEWEST):
            raise InputError(self.first)
        if self.count:
            log.warning(
                "%d of %d lines are no pose and left out, the first: %s", self.count, self.count + good, self.first
            )


def _names(line: str) -> list[str]:
    """The names of a line of names: between commas, semicolons or tabs, or between blanks; units stay with them."""
    line = re.sub(r"\s*[\[(]([^\])]*)[\])]", r"[\1]", line.strip().lstrip("#%/ "))
    delimiter = next((d for d in ",;\t" if d in line), None)
    return line.split(delimiter)


def _layout(path: Path, words: list[str]) -> _Layout | None:
    """The layout that names of columns state; None: they are no names of a trajectory's columns.

    Raises:
        InputError: names of poses without quaternions.
    """
    found: dict[str, tuple[int, str]] = {}
    for k, word in enumerate(words):
        name, _, unit = word.lower().partition("[")
        path_in_message = [part for part in re.split(r"[./]", name) if part]  # of ROS: field.pose.pose.position.x
        plain = re.sub(r"[^a-z0-9]", "", "".join(path_in_message[-2:]))
        role = next((role for role, names in _NAMES.items() if plain in names), None)
        if role is not None:
            found.setdefault(role, (k, unit.rstrip("]")))
    if {"stamp", "x", "y", "z"} <= found.keys() and not {"qx", "qy", "qz", "qw"} <= found.keys():
        if {"roll", "pitch", "yaw"} & found.keys():
            raise InputError(f"{path}: orientations as roll, pitch and yaw; expected quaternions, x y z w")
        return None
    if not set(_ORDER) <= found.keys():
        return None
    unit = found["stamp"][1]
    length = METRES.get(found["x"][1] or "m")
    if length is None:
        raise InputError(f"{path}: unit of length '{found['x'][1]}'; expected one of {', '.join(METRES)}")
    indices = tuple(found[role][0] for role in _ORDER)
    return _Layout(indices, _SECONDS.get(unit), length, max(indices) + 1, True)


def _check_width(path: Path, rows: list[tuple[int, list[str]]], layout: _Layout, commas: bool) -> None:
    """Refuse other forms by name, and an order of the quaternion that nothing tells."""
    if not rows or layout.named:
        return
    number, words = rows[0]
    if len(words) == 12:
        raise InputError(f"{path}:{number}: twelve numbers a line are KITTI's poses, which have no stamps; expected "
                         "'stamp tx ty tz qx qy qz qw'")  # fmt: skip
    whole = re.fullmatch(r"\d{16,20}", words[0]) is not None
    if whole and commas and len(words) >= 8:
        raise InputError(
            f"{path}:{number}: stamps in nanoseconds, and no line of names that tells whether w is the first or "
            "the last of the quaternion; expected one, as '#timestamp, p_x, p_y, p_z, q_w, q_x, q_y, q_z'"
        )


def _are_numbers(words: list[str]) -> bool:
    return all(parse_stamp(word) is not None or word.lower().lstrip("+-") in ("nan", "inf") for word in words)


def read_rigid_body(path: str | Path, body: str | None = None) -> Trajectory:
    """Read the poses of a rigid body in a CSV export of OptiTrack Motive: T_mocap_body, stamps since the capture began.

    Frames in which the body was not seen are left out.

    Args:
        path: the file.
        body: its name; None: the only one.

    Raises:
        InputError: no such body, several and no name, or rotations that are no quaternions.
    """
    times, bodies, name = read_motive_bodies(Path(path))
    if body is None and len(bodies) == 1:
        (body,) = bodies
    if body is None or body not in bodies:
        asked = f"no rigid body '{body}'; " if body is not None else ""
        raise InputError(f"{path}: {asked}it has {', '.join(bodies) or 'none'}: name one, as {Path(path).name}:NAME")
    values = bodies[body]
    seen = np.isfinite(values).all(axis=1)
    places = [f"{name}, frame {k}" for k in np.flatnonzero(seen)]
    return Trajectory(_poses(values[seen, :3], values[seen, 3:], places), times[seen], str(path))


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
