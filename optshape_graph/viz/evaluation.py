"""The paper's line charts: errors over distance, one line per noise level and orientation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from optshape_graph.evaluation.harness import Row
from optshape_graph.viz.style import GREY, colour, legend_below, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = ("-", "--", ":", "-.")
"""Line styles of the orientations, in turn."""

PANELS = (("rmse_m", "RMSE of the vertices (m)"), ("e_t_m", "translation (m)"), ("e_r_deg", "rotation (deg)"))


def plot_sweep(cells: Sequence[Row]) -> Figure:
    """Plot mean errors over distance, with bars up to the 95th percentile: a row per error, a column per method.

    Every orientation has its line style. The Cramer-Rao bound of the first noise level is grey, if rows have one.

    Args:
        cells: as `summarise` returns them, by method, noise, orientation and range.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    methods, levels, orientations = (_in_order(cells, name) for name in ("method", "noise", "orientation"))
    figure = new_figure(max(5.5 * len(methods), 8.0), 10.0)
    axes = figure.subplots(len(PANELS), len(methods), sharex=True, sharey="row", squeeze=False)
    for column, method in enumerate(methods):
        axes[0, column].set_title(f"method: {method}")
        axes[-1, column].set_xlabel("distance (m)")
        for row, (name, label) in enumerate(PANELS):
            panel = axes[row, column]
            panel.set_yscale("log")
            plain(panel)
            if column == 0:
                panel.set_ylabel(label)
            for k, orientation in enumerate(orientations):
                style = STYLES[k % len(STYLES)]
                for number, level in enumerate(levels):
                    line = [
                        c for c in cells if (c["method"], c["noise"], c["orientation"]) == (method, level, orientation)
                    ]
                    drawn = [c for c in line if c[f"{name}_mean"] is not None]
                    means = [c[f"{name}_mean"] for c in drawn]
                    bars = [max(c[f"{name}_p95"] - c[f"{name}_mean"], 0.0) for c in drawn]
                    panel.errorbar(
                        [c["range_m"] for c in drawn], means, yerr=[[0.0] * len(bars), bars], ls=style, lw=1.3,
                        color=colour(number), elinewidth=0.7, capsize=2, label=f"noise {level}, {orientation}",
                    )  # fmt: skip
                    bounded = [c for c in line if c[f"{name}_bound"] is not None]
                    if level == levels[0]:
                        panel.plot(
                            [c["range_m"] for c in bounded], [c[f"{name}_bound"] for c in bounded], style,
                            color=GREY, lw=1.0, label=f"bound, {orientation}",
                        )  # fmt: skip
    said = "Bars: up to the 95th percentile. Grey: Cramér-Rao bound of the first noise level."
    legend_below(figure, axes[0, 0], columns=3, caption=said)
    figure.suptitle("mean errors over distance")
    return figure


def _in_order(cells: Sequence[Row], name: str) -> list[str]:
    return list(dict.fromkeys(cell[name] for cell in cells))
