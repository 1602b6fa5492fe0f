"""Pose graphs, and the g2o files that hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.errors import InputError
from optshape_graph.io.files import write_atomically
from optshape_graph.io.trajectories.numbers import lines_of, numbers_in, pose_text, poses_of, text_of

TRANSLATION_FIRST = [3, 4, 5, 0, 1, 2]
"""Indices that turn g2o's order of the tangent space (translation, rotation) into GTSAM's, and back."""


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
    """Poses, and measurements between them.

    Attributes:
        vertices: number to (4, 4) T_world_i.
        edges: measurements between them.
        fixed: numbers of the vertices that are held.
    """

    vertices: Mapping[int, Floats]
    edges: tuple[PoseGraphEdge, ...] = ()
    fixed: frozenset[int] = frozenset()


def is_g2o(text: str) -> bool:
    """Return whether a text is a pose graph: its first line that is no comment begins with the name of an element."""
    first = next((line for line in text.splitlines() if line.strip() and not line.startswith("#")), "")
    return first.startswith(("VERTEX_", "EDGE_", "FIX "))


def read_g2o(path: str | Path) -> PoseGraph:
    """Read a 3-D pose graph: VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX.

    The rotation part of an information matrix is taken to be that of the rotation vector, as GTSAM takes it. g2o
    itself means the vector part of the quaternion, which is half the rotation vector: in a file that g2o wrote, the
    information of the rotation vector is a quarter of the number, and its coupling with the translation is half.

    Raises:
        InputError: another element, a line that does not parse, or an edge to a vertex that is not there.
    """
    path = Path(path)
    vertices: dict[int, Floats] = {}
    edges: list[tuple[str, PoseGraphEdge]] = []
    fixed: set[int] = set()
    for where, line in lines_of(path):
        tag, *words = line.split()
        if tag == "VERTEX_SE3:QUAT":
            (number,), values = _element(words, 1, 7, where)
            if number in vertices:
                raise InputError(f"{where}: vertex {number} is there twice")
            vertices[number] = poses_of(values[None, :3], values[None, 3:], [where])[0]
        elif tag == "EDGE_SE3:QUAT":
            (i, j), values = _element(words, 2, 28, where)
            T = poses_of(values[None, :3], values[None, 3:7], [where])[0]
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
        lines.append(f"VERTEX_SE3:QUAT {number} {pose_text(T)}\n")
    lines += [f"FIX {number}\n" for number in sorted(graph.fixed)]
    for edge in graph.edges:
        swapped = edge.information[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
        upper = text_of(swapped[np.triu_indices(6)])
        lines.append(f"EDGE_SE3:QUAT {edge.i} {edge.j} {pose_text(edge.T_i_j)} {upper}\n")
    write_atomically(Path(path), "".join(lines))


def _element(words: list[str], n_numbers: int, n_values: int, where: str) -> tuple[list[int], Floats]:
    """Return the vertex numbers and the values of an element."""
    if len(words) != n_numbers + n_values:
        raise InputError(
            f"{where}: expected {n_numbers} vertex numbers and {n_values} values, found {len(words)} words"
        )
    try:
        numbers = [int(word) for word in islice(words, n_numbers)]
    except ValueError as error:
        raise InputError(f"{where}: a vertex number is an integer: {error}") from error
    return numbers, np.array(numbers_in(words[n_numbers:], where))


def _information(upper: Floats, where: str) -> Floats:
    """Return the information matrix (6, 6), in GTSAM's order, of its upper triangle (21,) in g2o's order."""
    matrix = np.zeros((6, 6))
    matrix[np.triu_indices(6)] = upper
    matrix = matrix + np.triu(matrix, 1).T
    if np.linalg.eigvalsh(matrix).min() < -1e-9 * np.abs(matrix).max():
        raise InputError(f"{where}: its information matrix has a negative eigenvalue")
    return matrix[np.ix_(TRANSLATION_FIRST, TRANSLATION_FIRST)]
