"""Sheets of paper over which a drawing is spread, with marks for cutting and joining them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from optshape_graph._arrays import Bools, Floats
from optshape_graph.design.limits import SHEETS
from optshape_graph.design.polylines import MM, Drawing, Layer, Polyline, Text
from optshape_graph.errors import InputError

BORDER = 12.0
"""Blank border of a sheet, mm, which printers need."""

Orientation = Literal["auto", "portrait", "landscape"]

MOST_SHEETS = 400
"""Sheets of a drawing at most: A4 for a target of 3.5 m."""


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


def lay_out(drawing: Drawing, paper: str | None, orientation: Orientation = "auto") -> list[Sheet]:
    """Spread a drawing over sheets, row by row from the top left; sheets that would stay empty are left out.

    Neighbouring sheets are cut along the same line: cut at the marks, and butt them together.

    Args:
        drawing: the drawing.
        paper: name of a format (A0 ... A4); None: one sheet as large as the drawing.
        orientation: of the sheets: `portrait`, `landscape`, or `auto`: whichever needs fewer sheets.

    Raises:
        InputError: an unknown format, or more than `MOST_SHEETS` sheets.
    """
    if paper is None:
        return _spread(drawing, np.array(drawing.high) - np.array(drawing.low) + 2 * BORDER)
    if paper not in SHEETS:
        raise InputError(f"paper '{paper}' is not known; expected one of {', '.join(SHEETS)}")
    portrait = MM * np.array(SHEETS[paper])
    sizes = {"portrait": (portrait,), "landscape": (portrait[::-1],), "auto": (portrait, portrait[::-1])}[orientation]
    return min((_spread(drawing, size) for size in sizes), key=len)


def plan(drawing: Drawing, sheets: list[Sheet], notes: list[str], orientation: Orientation = "auto") -> Drawing:
    """Draw the places of the sheets on one sheet of the same size, with notes below.

    Args:
        drawing: the drawing that the sheets show.
        sheets: of that drawing.
        notes: lines of text.
        orientation: of the plan.
    """
    size = np.array(sheets[0].size)
    if orientation != "auto":
        size = np.sort(size) if orientation == "portrait" else np.sort(size)[::-1]
    room = size - 2 * BORDER
    h = float(np.clip(room[1] / 90.0, 2.2, 8.0))
    below = (len(notes) + 3) * 2.0 * h
    corner = np.min([sheet.window[:2] for sheet in sheets], axis=0)
    far = np.max([np.add(sheet.window[:2], sheet.window[2:]) for sheet in sheets], axis=0)
    scale = float(np.min((room - [0.0, below]) / (far - corner)))
    lines = [replace(line, points=scale * (line.points - corner), name="") for line in drawing.polylines]
    texts = []
    for number, sheet in enumerate(sheets, 1):
        x, y, w, height = sheet.window
        box = np.array([[x, y], [x + w, y], [x + w, y + height], [x, y + height]])
        lines.append(Polyline(scale * (box - corner), Layer.SHEET, closed=True))
        middle = scale * (box.mean(axis=0) - corner)
        texts.append(Text((float(middle[0]), float(middle[1])), str(number), Layer.SHEET, 1.6 * h))
    heading = f"{drawing.title}: plan of {len(sheets)} sheets, numbered as the pages; NOT 1:1"
    for row, note in enumerate([heading, *notes], 1):
        at = (float(room[0]) / 2, -2.0 * h * row)
        texts.append(Text(at, note, Layer.MARK, min(h, float(room[0]) / (0.75 * max(len(note), 1)))))
    top = float(room[1]) - below
    return Drawing(drawing.title, tuple(lines), tuple(texts), (0.0, -below), (float(room[0]), top))


def _spread(drawing: Drawing, size: Floats) -> list[Sheet]:
    """Return the sheets of a size, mm, that show a part of a drawing."""
    low, extent = np.array(drawing.low), np.array(drawing.high) - np.array(drawing.low)
    window = size - 2 * BORDER
    columns, rows = (int(count) for count in np.ceil(extent / window - 1e-9))
    if columns * rows > MOST_SHEETS:
        width, height = extent / MM
        raise InputError(
            f"{drawing.title}: {width:.1f} x {height:.1f} m are {columns * rows} sheets "
            f"of {size[0]:g} x {size[1]:g} mm; at most {MOST_SHEETS} are made: take larger paper, or one large sheet"
        )
    corner = low - (np.array([columns, rows]) * window - extent) / 2
    starts, ends = _segments(drawing)
    sheets: list[Sheet] = []
    for row in range(rows):
        for column in range(columns):
            at = corner + window * [column, rows - 1 - row]
            if not _meet(starts, ends, at, at + window).any():
                continue
            label = (
                f"{drawing.title}: sheet {len(sheets) + 1}, row {row + 1} of {rows}, column {column + 1} of {columns}"
            )
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


def _segments(drawing: Drawing) -> tuple[Floats, Floats]:
    """Return starts and ends (N, 2) of all that is drawn: lines, both diagonals of areas, and texts from end to end."""
    starts, ends = [], []
    for line in drawing.polylines:
        starts.append(line.points if line.closed else line.points[:-1])
        ends.append(np.roll(line.points, -1, axis=0)[: len(starts[-1])])
        if line.filled:
            starts.append(line.points)
            ends.append(np.roll(line.points, -2, axis=0))
    for text in drawing.texts:
        half = 0.4 * text.height * len(text.text) * np.array([np.cos(text.angle), np.sin(text.angle)])
        starts.append(np.array([text.position - half]))
        ends.append(np.array([text.position + half]))
    return np.concatenate(starts), np.concatenate(ends)


def _meet(starts: Floats, ends: Floats, low: Floats, high: Floats) -> Bools:
    """Return (N,) which segments meet a box (Liang and Barsky)."""
    along = ends - starts
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    a, b = (low - starts) / along, (high - starts) / along
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.asarray((enter <= leave) & (leave >= 0) & (enter <= 1))


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
