"""What every picture owes its reader, checked on what is drawn."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from optshape_graph.viz.style import DPI

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.text import Text

SMALLEST_PT = 9.0
"""Of a text, at a width of 8 inches, which are 1200 pixels."""


def assert_legible(figure: Figure) -> None:
    """Axes are labelled and named; no text is cut off, tiny, or lies over a title or a label; 1200 pixels wide."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    assert figure.get_figwidth() * DPI >= 1200
    assert any(axes.get_title() for axes in figure.axes) or figure.get_suptitle()
    for axes in figure.axes:
        bar = axes.get_label() == "<colorbar>"
        if axes.axison and not bar:
            assert axes.get_xlabel() or _shared(axes, axes.get_shared_x_axes()), "an axis has no label"
            assert axes.get_ylabel() or _shared(axes, axes.get_shared_y_axes()), "an axis has no label"
    texts = [text for text in figure.findobj(_is_text) if text.get_visible() and text.get_text().strip()]
    whole = figure.bbox.padded(2.0)
    boxes = {text: text.get_window_extent(renderer) for text in texts}
    for text in _fixed(figure):
        box = boxes.get(text)
        if box is not None:
            assert text.get_fontsize() >= SMALLEST_PT, f"'{text.get_text()}' is tiny"
            assert whole.contains(box.x0, box.y0), f"'{text.get_text()}' is cut off"
            assert whole.contains(box.x1, box.y1), f"'{text.get_text()}' is cut off"
    for a, b in combinations([text for text in _fixed(figure) if text in boxes], 2):
        assert not boxes[a].padded(-1.0).overlaps(boxes[b].padded(-1.0)), f"'{a.get_text()}' lies over '{b.get_text()}'"


def _fixed(figure: Figure) -> list[Text]:
    """Titles, axis labels, tick labels and legends: what has its own place."""
    texts = [figure._suptitle] if figure._suptitle else []
    for axes in figure.axes:
        if axes.axison:
            texts += [axes.title, axes.xaxis.label, axes.yaxis.label]
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                inside = [tick for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
                texts += [tick.label1 for tick in inside if tick.label1.get_visible()]
        if axes.get_legend():
            texts += axes.get_legend().get_texts()
    for legend in figure.legends:
        texts += [*legend.get_texts(), legend.get_title()]
    return [text for text in texts if text.get_text().strip()]


def _shared(axes: object, group: object) -> bool:
    return len(group.get_siblings(axes)) > 1


def _is_text(artist: object) -> bool:
    from matplotlib.text import Text

    return isinstance(artist, Text)
