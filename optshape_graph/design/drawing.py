"""The workshop drawing of a target, as plain lines and texts in millimetres.

It shows the face that the LiDAR sees: x to the viewer's right is -y of the target frame, y up is z. The mirror image
of the vertex list, which is given as seen from the other side.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.design.polygons import centroids
from optshape_graph.target import Target

MM = 1000.0
"""Millimetres in a metre."""


CHECK = 100.0
"""Length of the bar by which a print is measured, mm."""


class Layer(StrEnum):
    """What a line or a text is for; the name of its layer in a DXF file."""

    CUT = "CUT"
    DIMENSION = "DIMENSION"
    MARK = "MARK"
    SHEET = "SHEET"


@dataclass(frozen=True, eq=False, repr=False)
class Polyline(Value):
    """A polyline.

    Attributes:
        points: (N, 2) mm.
        layer: what it is for.
        closed: whether the last point joins the first.
        name: what it is called in the files that name things.
    """

    points: Floats
    layer: Layer
    closed: bool = False
    name: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", frozen(self.points))


@dataclass(frozen=True)
class Text:
    """A line of text centred on a point.

    Attributes:
        position: (x, y) of its centre, mm.
        text: the text.
        layer: what it is for.
        height: of capitals, mm.
        angle: of the baseline, counter-clockwise, rad.
    """

    position: tuple[float, float]
    text: str
    layer: Layer
    height: float = 8.0
    angle: float = 0.0


@dataclass(frozen=True)
class Drawing:
    """Lines and texts at 1:1, mm, x right and y up.

    Attributes:
        title: what it is called.
        polylines: the lines.
        texts: the texts.
        low: (x, y) of the lower left corner of what is drawn.
        high: (x, y) of the upper right corner.
    """

    title: str
    polylines: tuple[Polyline, ...]
    texts: tuple[Text, ...]
    low: tuple[float, float]
    high: tuple[float, float]


def lidar_face(target: Target) -> Floats:
    """(n, 2) vertices as the LiDAR sees them, mm, x right and y up, about the target's origin: clockwise."""
    return np.asarray(target.polygon * np.array([-MM, MM]))


def vertices_of(face: Floats) -> Floats:
    """(n, 2) vertices (y, z) of the target frame, metres, of a drawn face: the inverse of `lidar_face`."""
    return np.asarray(face / np.array([-MM, MM]))


def draw(target: Target) -> Drawing:
    """Draw the face of a target that the LiDAR sees, with its dimensions."""
    face = lidar_face(target)
    low, high = face.min(axis=0), face.max(axis=0)
    size = float(np.max(high - low))
    h = float(np.clip(size / 70.0, 2.5, 14.0))
    lines = [Polyline(face, Layer.CUT, closed=True, name="outline")]
    texts: list[Text] = []
    _edges(face, h, texts)
    _diagonals(face, h, lines, texts)
    _extents(low, high, h, lines, texts)
    _centre_and_up(face, h, lines, texts)
    _title(target, face, h, texts)
    _check_bar(low, h, lines, texts)
    right, bottom = 5.5 * h, 8.0 * h
    return Drawing(
        target.name,
        tuple(lines),
        tuple(texts),
        (float(low[0] - 7.5 * h), float(low[1] - bottom)),
        (float(high[0] + right), float(high[1] + 7.5 * h)),
    )


def _edges(face: Floats, h: float, texts: list[Text]) -> None:
    """Number the vertices, and write each edge's length beside it, outside."""
    for k, (start, end) in enumerate(zip(face, np.roll(face, -1, axis=0), strict=True)):
        along = (end - start) / np.linalg.norm(end - start)
        outward = np.array([-along[1], along[0]])  # a drawn face runs clockwise
        length = float(np.linalg.norm(end - start))
        texts.append(_text((start + end) / 2 + 1.3 * h * outward, f"{length:.1f}", Layer.DIMENSION, h, along))
        away = _bisector(face, k)
        texts.append(_text(start + 1.6 * h * away, f"{k}", Layer.MARK, h))
        texts.append(_text(start - 3.2 * h * away, f"{_angle_deg(face, k):.1f}°", Layer.DIMENSION, 0.7 * h))


def _diagonals(face: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Draw the diagonals, which check the cut, with their lengths; of a polygon with many sides, only the longest."""
    n = len(face)
    pairs = [(i, j) for i in range(n) for j in range(i + 2, n) if (i, j) != (0, n - 1)]
    if n > 6:
        pairs = [max(pairs, key=lambda pair: float(np.linalg.norm(face[pair[0]] - face[pair[1]])))]
    for i, j in pairs:
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


def _centre_and_up(face: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Mark the origin of the target frame, and which way is up."""
    circle = np.radians(np.arange(0.0, 360.0, 10.0))
    lines.append(Polyline(h * np.column_stack([np.cos(circle), np.sin(circle)]), Layer.MARK, closed=True))
    lines.append(Polyline(np.array([[-2 * h, 0.0], [2 * h, 0.0]]), Layer.MARK, name="centre-level"))
    lines.append(Polyline(np.array([[0.0, -2 * h], [0.0, 2 * h]]), Layer.MARK, name="centre-upright"))
    tip = 8.0 * h
    lines.append(Polyline(np.array([[0.0, 3 * h], [0.0, tip]]), Layer.MARK, name="up"))
    lines.append(Polyline(np.array([[-0.6 * h, tip - 1.5 * h], [0.0, tip], [0.6 * h, tip - 1.5 * h]]), Layer.MARK))
    texts.append(Text((1.6 * h, tip - 1.0 * h), "UP", Layer.MARK, h))


def _title(target: Target, face: Floats, h: float, texts: list[Text]) -> None:
    x = float(centroids(face)[0])
    y = float(face[:, 1].min()) - 3.8 * h
    texts.append(Text((0.0, -4.0 * h), "THIS SIDE TO THE LiDAR", Layer.MARK, 1.1 * h))
    texts.append(Text((x, y), f"{target.name}   {target.area:.4g} m²   scale 1:1   mm", Layer.MARK, h))


def _check_bar(low: Floats, h: float, lines: list[Polyline], texts: list[Text]) -> None:
    """Draw a bar of known length, by which a print is measured."""
    x, y = float(low[0]), float(low[1]) - 6.4 * h
    bar = np.array([[0.0, h / 2], [0.0, -h / 2], [0.0, 0.0], [CHECK, 0.0], [CHECK, h / 2], [CHECK, -h / 2]])
    lines.append(Polyline(bar + np.array([x, y]), Layer.DIMENSION, name="check-bar"))
    texts.append(Text((x + CHECK / 2, y + 0.9 * h), f"{CHECK:g}", Layer.DIMENSION, 0.8 * h))


def _text(at: Floats, text: str, layer: Layer, height: float, along: Floats | None = None) -> Text:
    """Make a text along a direction, turned so that it is not upside down."""
    angle = 0.0 if along is None else float(np.arctan(along[1] / along[0])) if along[0] else np.pi / 2
    return Text((float(at[0]), float(at[1])), text, layer, float(height), angle)


def _bisector(face: Floats, k: int) -> Floats:
    """(2,) unit vector out of the polygon at vertex k, halfway between its edges."""
    arms = face[[k - 1, (k + 1) % len(face)]] - face[k]
    inward = (arms / np.linalg.norm(arms, axis=1, keepdims=True)).sum(axis=0)
    return np.asarray(-inward / np.linalg.norm(inward))


def _angle_deg(face: Floats, k: int) -> float:
    a, b = face[[k - 1, (k + 1) % len(face)]] - face[k]
    return float(np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b))))
