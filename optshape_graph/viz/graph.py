"""The structure of any GTSAM factor graph."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.viz.style import GREY, INK, PURPLE, colour, legend_below, literal, marker, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_NAMES = 25
"""Names are written if no more variables have the same letter."""

KINDS = ("Pose3", "Point3", "Pose2", "Point2")
"""Types of variables that have a place, as GTSAM's accessors call them."""


def plot_graph(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, names: Mapping[int, str] | None = None
) -> Figure:
    """Draw a factor graph from above: variables where they are, a line for every factor between two of them.

    A factor on one variable is a ring around it; a factor on more than two is a star from their middle. Variables are
    coloured by the letter of their symbol. Variables without a place (a bias, a scale) are counted below.

    Args:
        graph: the factors.
        values: of the variables, in one world frame.
        names: names of variables by key; without one a variable goes by its symbol.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(9.0, 7.6)
    axes = plain(figure.subplots())
    places = {key: place for key in values.keys() if (place := _place(values, key)) is not None}  # noqa: SIM118 - no mapping
    kinds = _lines(axes, graph, places)
    letters = sorted({_letter(key) for key in places})
    rare = {c for c in letters if sum(_letter(key) == c for key in places) <= MOST_NAMES}
    for k, letter in enumerate(letters):
        keys = [key for key in places if _letter(key) == letter]
        xy = np.array([places[key] for key in keys])
        label = f"{len(keys)} variables {letter}"
        axes.plot(*xy.T, ls="", marker=marker(k), color=colour(k), ms=5, label=label, zorder=3)
        for key, (x, y) in zip(keys, xy, strict=True):
            if letter in rare:
                name = (names or {}).get(key, gtsam.DefaultKeyFormatter(key))
                axes.annotate(literal(name), (x, y), textcoords="offset points", xytext=(6, 5), fontsize=9)
    if without := values.size() - len(places):
        axes.plot([], [], " ", label=f"{without} variables without a place")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set(xlabel="x of the world (m)", ylabel="y of the world (m)")
    axes.set_title(f"{values.size()} variables, {sum(kinds.values())} factors: {_said(kinds)}")
    legend_below(figure, columns=3)
    return figure


def _lines(axes: Axes, graph: gtsam.NonlinearFactorGraph, places: Mapping[int, Floats]) -> dict[str, int]:
    """Draw the factors; return their count by the number of their variables."""
    from matplotlib.collections import LineCollection

    alike: list[tuple[Floats, Floats]] = []
    unlike: list[tuple[Floats, Floats]] = []
    alone: list[Floats] = []
    kinds: dict[str, int] = {}
    for factor in (graph.at(k) for k in range(graph.size())):
        if factor is None:
            continue
        every = list(factor.keys())
        keys, n = [key for key in every if key in places], len(every)
        kinds[_arity(n)] = kinds.get(_arity(n), 0) + 1
        if n == 1 and keys:
            alone.append(places[keys[0]])
        elif len(keys) == 2:
            same = _letter(keys[0]) == _letter(keys[1])
            (alike if same else unlike).append((places[keys[0]], places[keys[1]]))
        elif keys:
            middle = np.mean([places[key] for key in keys], axis=0)
            unlike += [(middle, places[key]) for key in keys]
    for lines, shade, width, label in (
        (unlike, GREY, 0.7, "factors between different letters"),
        (alike, INK, 1.2, "factors between the same letter"),
    ):
        if lines:
            axes.add_collection(LineCollection(lines, colors=shade, linewidths=width, label=label))
    if alone:
        axes.plot(*np.array(alone).T, "o", mfc="none", color=PURPLE, ms=12, mew=1.5, label="factors on one variable")
    return kinds


def _place(values: gtsam.Values, key: int) -> Floats | None:
    """Return x and y (2,) of a variable; None: it has no place."""
    for kind in KINDS:
        try:
            value = getattr(values, f"at{kind}")(key)
        except RuntimeError:
            continue
        point = value.translation() if kind.startswith("Pose") else value
        return np.asarray(point, float)[:2]
    return None


def _letter(key: int) -> str:
    return chr(gtsam.symbolChr(key)) if gtsam.symbolChr(key) else "by number"


def _arity(n: int) -> str:
    return {1: "on one", 2: "between two"}.get(n, "on more")


def _said(kinds: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in sorted(kinds.items()))
