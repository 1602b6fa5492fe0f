"""Parts of drawings: lines, areas and texts on layers, in millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from optshape_graph._arrays import Floats, Value, frozen

MM = 1000.0
"""Millimetres in a metre."""


class Layer(StrEnum):
    """Purpose of a line or a text; the name of its layer in a DXF file."""

    CUT = "CUT"
    PRINT = "PRINT"
    DIMENSION = "DIMENSION"
    MARK = "MARK"
    SHEET = "SHEET"


@dataclass(frozen=True, eq=False, repr=False)
class Polyline(Value):
    """A polyline.

    Attributes:
        points: (N, 2) mm.
        layer: its purpose.
        closed: whether the last point joins the first.
        name: its name in files that have names.
        filled: whether it is a black area without an outline.
    """

    points: Floats
    layer: Layer
    closed: bool = False
    name: str = ""
    filled: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", frozen(self.points))


@dataclass(frozen=True)
class Text:
    """A line of text centred on a point.

    Attributes:
        position: (x, y) of its centre, mm.
        text: the text.
        layer: its purpose.
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
        title: its title.
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
