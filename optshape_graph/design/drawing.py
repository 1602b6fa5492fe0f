"""The workshop drawing of a target, as plain lines and texts in millimetres.

It shows the face that the LiDAR sees: x to the viewer's right is -y of the target frame, y up is z. It is the mirror
image of the vertex list, which is given as seen from the other side.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.patterns import pattern_of
from optshape_graph.design.polygons import centroids
from optshape_graph.design.polylines import MM, Drawing, Layer, Polyline, Text
from optshape_graph.errors import InputError
from optshape_graph.names import shown
from optshape_graph.target import Target

CHECK = 100.0
"""Length of the bar that tells the scale of a print, mm."""


def lidar_face(target: Target) -> Floats:
    """Return the vertices (n, 2) as the LiDAR sees them, mm, x right and y up, about the target's origin; clockwise."""
    return np.asarray(target.polygon * np.array([-MM, MM]))


def vertices_of(face: Floats) -> Floats:
    """Return the vertices (n, 2), (y, z) of the target frame, metres, of a drawn face: the inverse of `lidar_face`."""
    return np.asarray(face / np.array([-MM, MM]))


@dataclass(frozen=True)
class Workshop:
    """Marks and holes that a workshop makes, millimetres; 0: none.

    Attributes:
        marker_inset: of a cross for a motion-capture marker, from each vertex inwards along its bisector.
        hole_diameter: of a hole near each vertex, cut through.
        hole_inset: of the hole's centre, from each vertex inwards along its bisector.

    Raises:
        InputError: a negative number, or a hole that reaches beyond the edge.
    """

    marker_inset: float = 0.0
    hole_diameter: float = 0.0
    hole_inset: float = 30.0

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) >= 0:
                raise InputError(f"{field.name}: expected millimetres, at least 0; found {getattr(self, field.name)}")


def draw(target: Target, workshop: Workshop | None = None) -> Drawing:
    """Draw the face of a target that the LiDAR sees: outline, printed pattern, marks, holes and dimensions.

    Nothing else is drawn over a printed pattern, so that cameras find it.

    Args:
        target: the target.
        workshop: marks and holes, if any.

    Raises:
        InputError: the pattern, a marker or a hole is not within the outline.
        MissingExtraError: the target has tags, and OpenCV is absent.
    """
    workshop = Workshop() if workshop is None else workshop
    face = lidar_face(target)
    low, high = face.min(axis=0), face.max(axis=0)
    size = float(np.max(high - low))
    h = float(np.clip(size / 70.0, 2.5, 14.0))
    pattern = pattern_of(target)
    lines = [*pattern, Polyline(face, Layer.CUT, closed=True, name="outline")]
    texts: list[Text] = []
    _edges(face, h, texts)
    if not pattern:
        _angles(face, h, texts)
        _diagonals(target, h, lines, texts)
        _centre(h, lines)
    _marks(target, workshop, h, lines)
    _extents(low, high, h, lines, texts)
    _up(np.array([float(high[0]) + 3.2 * h if pattern else 0.0, 0.0]), h, lines, texts)
    _title(target, face, h, bool(pattern), texts)
    _check_bar(low, h, lines, texts)
    right, bottom = 5.5 * h, 8.0 * h + (1.8 * h if pattern else 0.0)
    return Drawing(
        shown(target.name),
        tuple(lines),
        tuple(texts),
        (float(low[0] - 7.5 * h), float(low[1] - bottom)),
        (float(high[0] + right), float(high[1] + 7.5 * h)),
    )


def diagonals(target: Target) -> list[tuple[int, int]]:
    """Return the pairs of vertices whose distances check a cut: the farthest pair, if there are many sides."""
    n, face = len(target), target.polygon
    pairs = [(i, j) for i in range(n) for j in range(i + 2, n) if (i, j) != (0, n - 1)]
    if n > 6:
        pairs = [max(pairs, key=lambda pair: float(np.linalg.norm(face[pair[0]] - face[pair[1]])))]
    return pairs


def _edges(face: Floats, h: float, texts: list[Text]) -> None:
    """Number the vertices, and write each edge's length beside it, outside."""
    for k, (start, end) in enumerate(zip(face, np.roll(face, -1, axis=0), strict=True)):
        along = (end - start) / np.linalg.norm(end - start)
        outward = np.array([-along[1], along[0]])  # a drawn face runs clockwise
        length = float(np.linalg.norm(end - start))
        texts.append(_text((start + end) / 2 + 1.3 * h * outward, f"{length:.1f}", Layer.DIMENSION, h, along))
        away = _bisector(face, k)
        texts.append(_text(start + 1.6 * h * away, f"{k}", Layer.MARK, h))


def _angles(face: Floats, h: float, texts: list[Text]) -> None:
    """Write each corner's angle into it."""
    for k, corner in enumerate(face):
        at = corner - 3.2 * h * _bisector(face, k)
        texts.append(_text(at, f"{_angle_deg(face, k):.1f}°", Layer.DIMENSION, 0.7 * h))


def _diagonals(target: Target, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Draw the diagonals with their lengths."""
    face = lidar_face(target)
    for i, j in diagonals(target):
        lines.append(Polyline(face[[i, j]], Layer.DIMENSION, name=f"diagonal-{i}-{j}"))
        along = face[j] - face[i]
        length = float(np.linalg.norm(along))
        at = face[i] + 0.26 * along + 0.9 * h * np.array([-along[1], along[0]]) / length
        texts.append(_text(at, f"{length:.1f}", Layer.DIMENSION, 0.8 * h, along))


def _extents(low: Floats, high: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Dimension the full height at the left and the full width above."""
    x, y = low[0] - 5.0 * h, high[1] + 5.0 * h
    for a, b, extent in (
        (np.array([x, low[1]]), np.array([x, high[1]]), high[1] - low[1]),
        (np.array([low[0], y]), np.array([high[0], y]), high[0] - low[0]),
    ):
        along = (b - a) / np.linalg.norm(b - a)
        across = np.array([-along[1], along[0]])
        lines.append(Polyline(np.array([a, b]), Layer.DIMENSION))
        for tip, inward in ((a, along), (b, -along)):
            barbs = [tip + h * (inward + side * 0.3 * across) for side in (1, -1)]
            lines.append(Polyline(np.array([barbs[0], tip, barbs[1]]), Layer.DIMENSION))
            lines.append(Polyline(np.array([tip - h * across, tip + h * across]), Layer.DIMENSION))
        texts.append(_text((a + b) / 2 + 1.2 * h * across, f"{extent:.1f}", Layer.DIMENSION, h, along))


def _centre(h: float, lines: list[Polyline]) -> None:
    """Mark the origin of the target frame."""
    lines.append(Polyline(_circle(np.zeros(2), h), Layer.MARK, closed=True))
    lines.append(Polyline(np.array([[-2 * h, 0.0], [2 * h, 0.0]]), Layer.MARK, name="centre-level"))
    lines.append(Polyline(np.array([[0.0, -2 * h], [0.0, 2 * h]]), Layer.MARK, name="centre-upright"))


def _up(at: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Mark which way is up, above a point."""
    tip = 8.0 * h
    lines.append(Polyline(at + np.array([[0.0, 3 * h], [0.0, tip]]), Layer.MARK, name="up"))
    lines.append(Polyline(at + np.array([[-0.6 * h, tip - 1.5 * h], [0.0, tip], [0.6 * h, tip - 1.5 * h]]), Layer.MARK))
    texts.append(_text(at + np.array([1.6 * h, tip - h]), "UP", Layer.MARK, h))


def _marks(target: Target, workshop: Workshop, h: float, lines: list[Polyline]) -> None:
    """Mark where markers go, and draw the holes."""
    face = lidar_face(target)
    for k, corner in enumerate(face):
        inward = -_bisector(face, k)
        if workshop.marker_inset > 0:
            at = corner + workshop.marker_inset * inward
            _check_inside(target, at, 0.0, f"the marker at vertex {k}")
            for name, arm in (("level", [h, 0.0]), ("upright", [0.0, h])):
                lines.append(Polyline(np.array([at - arm, at + arm]), Layer.MARK, name=f"marker-{k}-{name}"))
        if workshop.hole_diameter > 0:
            at = corner + workshop.hole_inset * inward
            _check_inside(target, at, workshop.hole_diameter / 2, f"the hole at vertex {k}")
            circle = _circle(at, workshop.hole_diameter / 2)
            lines.append(Polyline(circle, Layer.CUT, closed=True, name=f"hole-{k}"))


def _check_inside(target: Target, at: Floats, radius: float, what: str) -> None:
    room = -MM * float(target.outside_distance(vertices_of(at[None]))[0])
    if room <= radius:
        raise InputError(
            f"target '{target.name}': {what} is {room:.0f} mm from the edge; expected over {radius:.0f} mm"
        )


def _circle(centre: Floats, radius: float) -> Floats:
    angles = np.radians(np.arange(0.0, 360.0, 5.0))
    return np.asarray(centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]))


def _title(target: Target, face: Floats, h: float, below: bool, texts: list[Text]) -> None:
    """Write the title; `below` the drawing also the texts that would cover the pattern."""
    x = float(centroids(face)[0])
    y = float(face[:, 1].min()) - 3.8 * h
    facing = (x, y - 4.8 * h) if below else (0.0, -4.0 * h)
    texts.append(Text(facing, "THIS SIDE TO THE LiDAR", Layer.MARK, 1.1 * h))
    texts.append(Text((x, y), f"{shown(target.name)}   {target.area:.4g} m²   scale 1:1   mm", Layer.MARK, h))
    if below:
        named = [f"{i}-{j}: {np.linalg.norm(face[i] - face[j]):.1f}" for i, j in diagonals(target)]
        if named:
            texts.append(Text((x, y - 1.7 * h), f"diagonals {', '.join(named)}", Layer.DIMENSION, 0.8 * h))


def _check_bar(low: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Draw a bar of known length, which tells the scale of a print."""
    x, y = float(low[0]), float(low[1]) - 6.4 * h
    bar = np.array([[0.0, h / 2], [0.0, -h / 2], [0.0, 0.0], [CHECK, 0.0], [CHECK, h / 2], [CHECK, -h / 2]])
    lines.append(Polyline(bar + np.array([x, y]), Layer.DIMENSION, name="check-bar"))
    texts.append(Text((x + CHECK / 2, y + 0.9 * h), f"{CHECK:g}", Layer.DIMENSION, 0.8 * h))


def _text(at: Floats, text: str, layer: Layer, height: float, along: Floats | None = None) -> Text:
    """Return a text along a direction, not upside down."""
    angle = 0.0 if along is None else float(np.arctan(along[1] / along[0])) if along[0] else np.pi / 2
    return Text((float(at[0]), float(at[1])), text, layer, float(height), angle)


def _bisector(face: Floats, k: int) -> Floats:
    """Return the unit vector (2,) out of the polygon at vertex k, halfway between its edges."""
    arms = face[[k - 1, (k + 1) % len(face)]] - face[k]
    inward = (arms / np.linalg.norm(arms, axis=1, keepdims=True)).sum(axis=0)
    return np.asarray(-inward / np.linalg.norm(inward))


def _angle_deg(face: Floats, k: int) -> float:
    a, b = face[[k - 1, (k + 1) % len(face)]] - face[k]
    return float(np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))
