"""Sheets of paper: how a drawing is spread over them, with marks by which they are cut and joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optshape_graph.design.drawing import Drawing, Layer, Polyline, Text
from optshape_graph.design.limits import SHEETS
from optshape_graph.errors import InputError

BORDER = 12.0
"""Around the part of a sheet that is drawn on, mm: printers leave the edge of a sheet blank."""

MM = 1000.0

MOST_SHEETS = 400
"""Of one drawing: A4 of a target of 3.5 m."""


@dataclass(frozen=True)
class Sheet:
    """One sheet: a window of the drawing, and the marks around it.

    Attributes:
        size: (width, height) of the paper, mm.
        origin: (x, y) of the paper's lower left corner in the drawing, mm.
        window: (x, y, width, height) of the drawing that the sheet shows, mm, in the drawing.
        marks: cut and registration marks, in the drawing's coordinates.
        label: which sheet it is.
    """

    size: tuple[float, float]
    origin: tuple[float, float]
    window: tuple[float, float, float, float]
    marks: tuple[Polyline, ...]
    label: Text | None


def lay_out(drawing: Drawing, paper: str | None) -> list[Sheet]:
    """Spread a drawing over sheets, row by row from the top left.

    Neighbouring sheets share the line at which both are cut: cut along the marks, and butt them together.

    Args:
        drawing: the drawing.
        paper: name of a format (A0 ... A4), taken upright or level, whichever needs fewer sheets; None: one sheet as
            large as the drawing.

    Raises:
        InputError: the format is not known, or there would be more sheets than anybody joins.
    """
    low, high = np.array(drawing.low), np.array(drawing.high)
    extent = high - low
    if paper is None:
        size = extent + 2 * BORDER
    elif paper in SHEETS:
        upright = MM * np.array(SHEETS[paper])
        size = min((upright, upright[::-1]), key=lambda s: int(np.prod(np.ceil(extent / (s - 2 * BORDER)))))
    else:
        raise InputError(f"paper '{paper}' is not known; expected one of {', '.join(SHEETS)}")
    window = size - 2 * BORDER
    columns, rows = (int(count) for count in np.ceil(extent / window - 1e-9))
    if columns * rows > MOST_SHEETS:
        width, height = extent / MM
        raise InputError(
            f"{drawing.title}: {width:.1f} x {height:.1f} m are {columns * rows} sheets of {paper}; "
            f"at most {MOST_SHEETS} are made: take larger paper, or one large sheet"
        )
    corner = low - (np.array([columns, rows]) * window - extent) / 2
    sheets = []
    for row in range(rows):
        for column in range(columns):
            at = corner + window * [column, rows - 1 - row]
            label = f"{drawing.title}: row {row + 1} of {rows}, column {column + 1} of {columns}"
            x, y = (float(value) for value in at)
            w, h = (float(value) for value in window)
            sheets.append(
                Sheet(
                    (float(size[0]), float(size[1])),
                    (x - BORDER, y - BORDER),
                    (x, y, w, h),
                    _marks(x, y, w, h),
                    Text((x + w / 2, y - BORDER / 2), label, Layer.SHEET, 3.0) if rows * columns > 1 else None,
                )
            )
    return sheets


def _marks(x: float, y: float, w: float, h: float) -> tuple[Polyline, ...]:
    """Cut marks at the corners and registration crosses at the middles of the sides, outside the window."""
    near, far = 2.0, BORDER - 2.0
    corners = [(x, y, -1, -1), (x + w, y, 1, -1), (x, y + h, -1, 1), (x + w, y + h, 1, 1)]
    lines = []
    for px, py, sx, sy in corners:
        lines.append([[px + sx * near, py], [px + sx * far, py]])
        lines.append([[px, py + sy * near], [px, py + sy * far]])
    for px, py in ((x + w / 2, y), (x + w / 2, y + h)):
        lines.append([[px, py - 3.0], [px, py + 3.0]])
    for px, py in ((x, y + h / 2), (x + w, y + h / 2)):
        lines.append([[px - 3.0, py], [px + 3.0, py]])
    return tuple(Polyline(np.array(line), Layer.SHEET) for line in lines)
