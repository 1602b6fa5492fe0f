"""Files of drawings at 1:1: SVG and PDF (matplotlib), DXF (ezdxf), written atomically."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from optshape_graph.design.polylines import Drawing, Layer, Polyline
from optshape_graph.design.sheets import Orientation, Sheet, lay_out, plan
from optshape_graph.errors import InputError, importing_matplotlib, missing_extra
from optshape_graph.io.documents import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("svg", "pdf", "dxf")

MM_PER_INCH = 25.4
POINTS_PER_MM = 72.0 / MM_PER_INCH

CAP_HEIGHT = 0.729
"""Height of capitals over font size, of DejaVu Sans, which comes with matplotlib."""

COLOURS = {
    Layer.CUT: "black",
    Layer.PRINT: "black",
    Layer.DIMENSION: "#1f5fa8",
    Layer.MARK: "#444444",
    Layer.SHEET: "#c03020",
}
WIDTHS_MM = {Layer.CUT: 0.5, Layer.PRINT: 0.0, Layer.DIMENSION: 0.18, Layer.MARK: 0.25, Layer.SHEET: 0.18}
DXF_COLOURS = {Layer.CUT: 7, Layer.PRINT: 250, Layer.DIMENSION: 5, Layer.MARK: 8, Layer.SHEET: 1}
"""AutoCAD colour indices."""

DXF_DASH_SCALE = 20.0
"""Scale of the standard dash pattern, which is made for drawings of a few millimetres."""


def export(
    drawing: Drawing,
    path: Path,
    paper: str | None = None,
    orientation: Orientation = "auto",
    notes: Sequence[str] = (),
) -> list[Path]:
    """Write a drawing at 1:1 in the format that the file name ends in.

    A PDF has a page for each sheet. An SVG of several sheets becomes several files, numbered from the top left. A DXF
    is for a machine, and always whole. Several sheets come with a plan, as the last page or as NAME-plan.svg.

    Args:
        drawing: the drawing.
        path: the file: .svg, .pdf or .dxf.
        paper: size of the sheets of an SVG or a PDF, A0 ... A4; None: one sheet as large as the drawing.
        orientation: of the sheets.
        notes: lines of text for the plan, such as the parts.

    Returns:
        the files written.

    Raises:
        InputError: the format or the paper is not known.
        MissingExtraError: the drawing library is absent.
    """
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in FORMATS:
        raise InputError(f"{path}: expected a file name that ends in .{', .'.join(FORMATS)}")
    if suffix == "dxf":
        write_atomically(path, _dxf(drawing))
        return [path]
    sheets = lay_out(drawing, paper, orientation)
    pages = [(drawing, sheet) for sheet in sheets]
    if len(sheets) > 1:
        overview = plan(drawing, sheets, list(notes), orientation)
        pages += [(overview, lay_out(overview, None)[0])]
    if suffix == "pdf":
        write_atomically(path, _pdf(pages))
        return [path]
    paths = _named(path, len(sheets))
    for page_path, (page, sheet) in zip(paths, pages, strict=True):
        write_atomically(page_path, _svg(page, sheet))
    return paths


def files_of(drawing: Drawing, path: Path, paper: str | None = None, orientation: Orientation = "auto") -> list[Path]:
    """Return the files that `export` writes.

    Args:
        drawing: the drawing.
        path: the file: .svg, .pdf or .dxf.
        paper: as `export` takes it.
        orientation: as `export` takes it.

    Raises:
        InputError: the paper is not known, or there would be too many sheets.
    """
    if path.suffix.lower() == ".dxf":
        return [path]
    sheets = lay_out(drawing, paper, orientation)
    return _named(path, len(sheets)) if path.suffix.lower() == ".svg" else [path]


def _named(path: Path, sheets: int) -> list[Path]:
    """Return the name of a single sheet, or those of several and of their plan."""
    if sheets == 1:
        return [path]
    return [path.with_stem(f"{path.stem}-{name}") for name in [*range(1, sheets + 1), "plan"]]


def figure_of(drawing: Drawing, sheet: Sheet) -> Figure:
    """Return one sheet as a figure of the paper's size: a millimetre of the drawing is a millimetre of paper.

    Raises:
        MissingExtraError: matplotlib is absent.
        InputError: its settings are wrong.
    """
    with importing_matplotlib("design"):
        from matplotlib.figure import Figure
        from matplotlib.patches import Polygon, Rectangle
    width, height = sheet.size
    x, y = sheet.origin
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    figure.patch.set_visible(False)  # else a cutting machine would cut out the page
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(x, x + width), ylim=(y, y + height))
    axes.set_axis_off()
    window = Rectangle(sheet.window[:2], *sheet.window[2:], transform=axes.transData)
    labels = () if sheet.label is None else (sheet.label,)
    for lines, texts, clip in ((drawing.polylines, drawing.texts, window), (sheet.marks, labels, None)):
        for line in lines:
            patch = Polygon(line.points, closed=line.closed, gid=line.name or None, **_look(line))
            axes.add_patch(patch)
            if clip is not None:
                patch.set_clip_path(clip)
        for text in texts:
            artist = axes.text(
                *text.position,
                text.text,
                ha="center",
                va="center",
                rotation=float(np.degrees(text.angle)),
                rotation_mode="anchor",
                color=COLOURS[text.layer],
                fontsize=text.height / CAP_HEIGHT * POINTS_PER_MM,
                family="DejaVu Sans",
                parse_math=False,  # a name may have dollars
            )
            if clip is not None:
                artist.set_clip_path(clip)
                artist.set_clip_on(True)
    return figure


def _look(line: Polyline) -> dict[str, Any]:
    """Return how matplotlib draws a line or an area."""
    if line.filled:
        # Edges are not blended, which would leave white seams between neighbours.
        return {"facecolor": COLOURS[line.layer], "edgecolor": "none", "linewidth": 0.0, "antialiased": False}
    return {
        "fill": False,
        "edgecolor": COLOURS[line.layer],
        "linewidth": WIDTHS_MM[line.layer] * POINTS_PER_MM,
        "linestyle": (0, (12, 6)) if line.name.startswith("diagonal") else "solid",
        "joinstyle": "miter",
    }


def _svg(drawing: Drawing, sheet: Sheet) -> bytes:
    figure = figure_of(drawing, sheet)
    import matplotlib

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": drawing.title, "path.simplify": False}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Title": drawing.title})
    return buffer.getvalue()


def _pdf(sheets: Sequence[tuple[Drawing, Sheet]]) -> bytes:
    figures = [figure_of(drawing, sheet) for drawing, sheet in sheets]
    import matplotlib
    from matplotlib.backends.backend_pdf import PdfPages

    buffer = io.BytesIO()
    with (
        matplotlib.rc_context({"pdf.fonttype": 42, "path.simplify": False}),
        PdfPages(buffer, metadata={"CreationDate": None, "Title": sheets[0][0].title}) as pages,
    ):
        for figure in figures:
            pages.savefig(figure)
    return buffer.getvalue()


def _dxf(drawing: Drawing) -> str:
    try:
        from ezdxf.enums import TextEntityAlignment
        from ezdxf.filemanagement import new
    except ImportError as cause:
        raise missing_extra("ezdxf", "design", cause) from cause
    document = new("R2010", setup=True, units=4)  # 4: millimetres
    for layer in Layer:
        document.layers.add(layer, color=DXF_COLOURS[layer])
    space = document.modelspace()
    for line in drawing.polylines:
        if line.filled:
            hatch = space.add_hatch(color=DXF_COLOURS[line.layer], dxfattribs={"layer": line.layer})
            hatch.paths.add_polyline_path(line.points.tolist(), is_closed=True)
            continue
        linetype = "DASHED" if line.name.startswith("diagonal") else "BYLAYER"
        space.add_lwpolyline(
            line.points.tolist(),
            close=line.closed,
            dxfattribs={"layer": line.layer, "linetype": linetype, "ltscale": DXF_DASH_SCALE},
        )
    for text in drawing.texts:
        entity = space.add_text(
            text.text, height=text.height, rotation=float(np.degrees(text.angle)), dxfattribs={"layer": text.layer}
        )
        entity.set_placement(text.position, align=TextEntityAlignment.MIDDLE_CENTER)
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue()
