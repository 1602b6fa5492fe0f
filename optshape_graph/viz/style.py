"""Common parts of all pictures: palette, axes, names, and writing to a file."""

from __future__ import annotations

from collections.abc import Sequence
from colorsys import hls_to_rgb
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError, importing_matplotlib
from optshape_graph.io.files import write_atomically
from optshape_graph.names import shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, GREY, PALE = "#222222", "#8c8c8c", "#d0d0d0"
BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
"""Colours of series, edges, trajectories, which the colour-blind can distinguish (Okabe and Ito, 2008)."""

MARKERS = ("o", "s", "^", "D", "v", "P")
"""Markers that go with the colours, so that series differ in black and white, too."""

FORMATS = ("png", "pdf", "svg")
"""Formats of pictures, which are the endings of their names."""

CAPTION_PT = 9.0
"""Size of the text below a figure, points."""

DPI = 150
"""Dots per inch of files: a figure 8 inches wide has 1200 pixels."""


def new_figure(width: float = 8.0, height: float = 6.0) -> Figure:
    """Return an empty figure, inches.

    Raises:
        MissingExtraError: matplotlib is absent.
        InputError: its settings are wrong.
    """
    with importing_matplotlib("plot"):
        from matplotlib.figure import Figure
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure, whole or not at all, in the format of its ending; its folder is made.

    Args:
        figure: what to write.
        path: ends in .png, .pdf or .svg; without an ending it is a PNG.

    Raises:
        InputError: another ending, or the place cannot be written.
    """
    from io import BytesIO

    stream, path = BytesIO(), Path(path)
    kind = path.suffix.lower().lstrip(".") or "png"
    if kind not in FORMATS:
        raise InputError(f"{path}: expected the name of a picture to end in .{', .'.join(FORMATS)}")
    figure.savefig(stream, format=kind, dpi=DPI)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, stream.getvalue())
    return path


def colour(k: int) -> str:
    """Return the k-th colour of a series: those of `COLOURS`, then others, all different."""
    if k < len(COLOURS):
        return COLOURS[k]
    further = k - len(COLOURS)
    # Hues a golden section apart, in three shades in turn.
    red, green, blue = hls_to_rgb(0.05 + further * 0.618034 % 1.0, (0.32, 0.5, 0.68)[further % 3], 0.55)
    return f"#{round(255 * red):02x}{round(255 * green):02x}{round(255 * blue):02x}"


def marker(k: int) -> str:
    """Return the k-th marker of a series."""
    return MARKERS[k % len(MARKERS)]


def plain(axes: Axes, *, equal: bool = False) -> Axes:
    """Draw a faint grid and no frame at the top and right; `equal`: one scale on both axes, for geometry."""
    axes.grid(alpha=0.3, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if equal:
        axes.set_aspect("equal", adjustable="box")
    return axes


def legend_below(figure: Figure, *axes: Axes, columns: int = 4, caption: str | None = None) -> None:
    """Put one legend below a figure, of some axes or of all, with a caption above it."""
    handles, labels = [], []
    for axis in axes or figure.axes:
        found = axis.get_legend_handles_labels()
        handles += found[0]
        labels += found[1]
    figure.legend(
        handles, labels, loc="outside lower center", ncols=min(len(labels), columns), frameon=False, title=caption,
        title_fontsize=CAPTION_PT,
    )  # fmt: skip


def literal(text: str, longest: int = 48) -> str:
    """Return a name for drawing: shortened, on one line, with dollars that do not start mathematics."""
    text = shown(text)
    if len(text) > longest:
        text = f"{text[: longest // 2]}…{text[-(longest // 2 - 1) :]}"
    return text.replace("$", r"\$")


def short(name: str) -> str:
    """Return a scan's name for drawing: the last part, if it is a path."""
    return literal(PurePath(name).name or name)


def outline(axes: Axes, polygon: Floats, colour: str = INK, **style: object) -> None:
    """Draw a closed polygon (n, 2), in the unit of the axes."""
    closed = np.vstack([polygon, polygon[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=colour, **{"lw": 1.6, **style})  # type: ignore[arg-type]  # any keyword


def ellipse(covariance: Floats, sigmas: float) -> Floats:
    """Return the outline (K, 2) of `sigmas` standard deviations of a covariance (2, 2) about the origin."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2 * np.pi, 73)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def magnification(sizes: Sequence[float] | Floats, extent: float) -> float:
    """Return the factor, of 1, 2, 5, 10, ..., that enlarges the largest size to about a tenth of an extent.

    Args:
        sizes: (N,) in any unit.
        extent: of the picture, in that unit.
    """
    largest = float(np.max(sizes, initial=0.0))
    wanted = 0.1 * extent / largest if largest > 0 else 1.0
    steps = np.outer(10.0 ** np.arange(7), [1.0, 2.0, 5.0]).ravel()
    return float(steps[steps <= max(wanted, 1.0)].max())
