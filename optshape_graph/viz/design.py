"""Plots of target shapes: cells, sensitivity, comparison, search, and what makes a projective image convex."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.design.family import Family
from optshape_graph.design.judgement import DEGREE, Judgement, unit_area, worst_cell
from optshape_graph.design.polygons import rotated
from optshape_graph.design.problem import orientations
from optshape_graph.design.rings import Rings
from optshape_graph.design.sensitivity import cell_scores, edge_crossings, quadratic_forms, worst_motions
from optshape_graph.target import Target
from optshape_graph.viz.style import (
    BLUE,
    GREY,
    INK,
    VERMILLION,
    colour,
    legend_below,
    literal,
    new_figure,
    outline,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from optshape_graph.design.multistart import Search
    from optshape_graph.evaluation.shape_study import ShapeStudy


def plot_cells(target: Target, rings: Rings) -> Figure:
    """Plot the scores over orientation and lit area, and the worst cell: its rings, edge points and worst motion."""
    figure = new_figure(12.0, 5.0)
    map_axes, shape_axes = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    turns = orientations(rings, DEGREE)
    scores = cell_scores(rotated(unit_area(target), turns), rings)
    image = map_axes.imshow(
        scores.T,
        origin="lower",
        aspect="auto",
        extent=(0.0, float(np.degrees(turns[-1])) + 1.0, 0.5, scores.shape[1] + 0.5),
        norm="log",
        interpolation="nearest",
        cmap="viridis",
    )
    worst = worst_cell(target, turns, rings)
    map_axes.plot(np.degrees(worst.orientation) + 0.5, worst.area + 1, "o", mfc="none", mec="white", mew=2, ms=11)
    map_axes.set(xlabel="orientation (deg)", ylabel="area lit, from the lowest", title="score of every cell at 1 m²")
    map_axes.set_yticks(range(1, scores.shape[1] + 1))
    figure.colorbar(image, ax=map_axes, label="score, logarithmic")

    polygon, heights, motion = _worst(target, rings)
    crossings = edge_crossings(polygon, heights[:, worst.area, None])
    _shape(shape_axes, polygon)
    for height in heights.reshape(-1):
        shape_axes.axhline(height, color=GREY, lw=0.3, zorder=0)
    for height in heights[:, worst.area]:
        shape_axes.axhline(height, color=VERMILLION, lw=0.8, alpha=0.6, zorder=1)
    points = crossings.hit[..., 0]
    x, y = crossings.x[..., 0][points], np.broadcast_to(crossings.y[..., 0], points.shape)[points]
    speed = crossings.motion(motion[None])[..., 0, 0][points]
    shape_axes.plot(x, y, "o", color=VERMILLION, ms=5, zorder=3)
    longest = max(float(np.abs(speed).max(initial=0.0)), 1e-9)
    reach = 0.12 * float(np.ptp(polygon[:, 1])) / longest
    shape_axes.quiver(
        x, y, reach * speed, 0.0 * speed, color=BLUE, angles="xy", scale_units="xy", scale=1.0, width=0.008, zorder=4
    )
    omega, u, v = motion
    shape_axes.set_title(
        f"worst: {np.degrees(worst.orientation):.0f}°, area {worst.area + 1}, score {worst.score:.4f}\n"
        "least motion of edge points, under (ω, u, v)\n"
        f"= ({omega:+.2f}, {u:+.2f}, {v:+.2f}); the largest is {longest:.3f}",
        fontsize=10,
    )
    margin = 0.15 * float(np.ptp(polygon[:, 1]))
    (left, bottom), (right, top) = polygon.min(axis=0) - margin, polygon.max(axis=0) + margin
    shape_axes.set(xlim=(left, right), ylim=(bottom, top))
    shape_axes.set(xlabel="along the rings (m)", ylabel="across the rings (m)")
    return figure


def plot_sensitivity(target: Target, rings: Rings) -> Figure:
    """Plot how much the edge points of the worst cell move over the directions of motion, and where least."""
    figure = new_figure(9.0, 4.8)
    axes = figure.subplots()
    polygon, heights, motion = _worst(target, rings)
    area = worst_cell(target, orientations(rings, DEGREE), rings).area
    form = quadratic_forms(edge_crossings(polygon, heights[:, area, None]))[0]
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 181), np.linspace(0, 2 * np.pi, 361), indexing="ij")
    directions = np.stack([np.cos(polar), np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)], axis=-1)
    energy = np.einsum("abi,ij,abj->ab", directions, form, directions)
    levels = np.geomspace(max(energy.min(), 1e-6), energy.max(), 24)
    filled = axes.contourf(np.degrees(azimuth), np.degrees(polar), energy, levels=levels, norm="log", cmap="viridis")
    for sign in (1.0, -1.0):
        omega, u, v = sign * motion
        at = np.degrees(np.arctan2(v, u)) % 360.0, np.degrees(np.arccos(omega))
        axes.plot(*at, "o", mfc="none", mec=VERMILLION, mew=2, ms=11)
    bar = figure.colorbar(filled, ax=axes, label="sum of squared edge point motions")
    ticks = np.geomspace(levels[0], levels[-1], 5)
    bar.set_ticks(list(ticks), labels=[f"{tick:.2g}" for tick in ticks])
    bar.ax.minorticks_off()
    axes.set(
        xlabel="direction of the translation (deg): 0 along the rings, 90 across",
        ylabel="polar angle (deg): 0 turning, 90 translating",
        title=f"sensitivity of the worst cell; least (circles): {np.linalg.eigvalsh(form)[0]:.4f}",
    )
    axes.invert_yaxis()
    return figure


def plot_comparison(judgements: list[Judgement]) -> Figure:
    """Plot the shapes side by side at one scale, and their numbers below."""
    n = len(judgements)
    figure = new_figure(max(2.3 * n, 8.0), 6.4)
    rows = figure.subplots(2, 1, height_ratios=(1.0, 1.3))
    outlines, bars = rows
    x = np.arange(n)
    polygons = [unit_area(judgement.target) for judgement in judgements]
    size = 1.15 * max(float(np.ptp(polygon, axis=0).max()) for polygon in polygons)
    for i, (judgement, polygon) in enumerate(zip(judgements, polygons, strict=True)):
        _shape(outlines, polygon + np.array([i * size, 0.0]))
        outlines.text(i * size, 0.0, literal(judgement.target.name), ha="center", va="center", fontsize=9)
    outlines.set(xlim=(-0.5 * size, (n - 0.5) * size), title="at 1 m², seen from behind (y to the right)")
    outlines.set_axis_off()
    series = [
        ("six rotations", [judgement.six_rotations for judgement in judgements], GREY),
        ("every 1°", [judgement.every_degree for judgement in judgements], BLUE),
        ("every 0.1°", [judgement.every_tenth for judgement in judgements], VERMILLION),
    ]
    for k, (label, values, shade) in enumerate(series):
        drawn = bars.bar(x + 0.27 * (k - 1), values, 0.25, label=label, color=shade)
        bars.bar_label(drawn, fmt="%.4f", fontsize=9, rotation=90, padding=3)
    names = []
    for judgement in judgements:
        lines = [literal(judgement.target.name, 24), f"asymmetry {judgement.self_rotation.distance:.3f}"]
        if (bound := judgement.bound) is not None:
            median, worst = np.degrees(bound.e_in_plane)
            lines.append(f"in plane {median:.2f}°, worst {f'{worst:.2f}°' if np.isfinite(worst) else '∞'}")
            lines.append(f"at {bound.distance:g} m, {judgement.target.area:.2g} m²")
        names.append("\n".join(lines))
    bars.set_xticks(x, names, fontsize=9)
    bars.set(xlabel="shape, and the bound on its pose", ylabel="worst score", xlim=(-0.5, n - 0.5))
    bars.margins(y=0.3)
    legend_below(figure)
    plain(bars)
    return figure


def plot_search(search: Search) -> Figure:
    """Plot where every start of a search ended, best first, and the shapes of the best dozen."""
    figure = new_figure(9.0, 5.6)
    axes, shapes = figure.subplots(2, 1, height_ratios=(1.5, 1.0))
    ends = sorted(search.starts, key=lambda start: -start.score)
    x = np.arange(len(ends))
    admissible = np.array([start.slack >= 0 for start in ends])
    scores = np.array([start.score for start in ends])
    axes.plot(x[admissible], scores[admissible], "o", color=BLUE, ms=4, label="within the limits")
    if not admissible.all():
        axes.plot(x[~admissible], scores[~admissible], "x", color=VERMILLION, ms=5, label="outside the limits")
    axes.set(xlabel="start, best first", ylabel="worst score", title=f"{len(ends)} starts, seed {search.seed}")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(frameon=False)
    plain(axes)
    best = [start for start in ends if start.slack >= 0][:12]
    for i, start in enumerate(best):
        polygon = search.upright_polygon(start)
        _shape(shapes, 0.5 * polygon + np.array([i, 0.0]))
        shapes.text(i, -0.62, f"{start.score:.4f}", ha="center", fontsize=9)
    shapes.set(xlim=(-0.6, 11.6), ylim=(-0.7, 0.6))
    shapes.set_axis_off()
    return figure


def plot_study(study: ShapeStudy) -> Figure:
    """Plot the simulated rotation error of every shape over its score and over its Cramer-Rao bound."""
    figure = new_figure(10.0, 4.6)
    errors = np.degrees(study.medians("e_r"))
    sides = np.array([len(shape.target) for shape in study.shapes])
    predictors = (
        ("score", study.scores, "worst score, every 1°"),
        ("bound_r", np.degrees(study.medians("bound_r")), "median Cramér-Rao bound of the rotation (deg)"),
    )
    for axes, (name, values, label) in zip(figure.subplots(1, 2, sharey=True), predictors, strict=True):
        for k, (symbol, least, most) in enumerate((("^", 3, 3), ("s", 4, 4), ("p", 5, 5), ("o", 6, 10**6))):
            chosen = (sides >= least) & (sides <= most) & np.isfinite(values)
            if chosen.any():
                text = f"{least} sides" if least == most else "more sides"
                axes.scatter(
                    values[chosen], errors[chosen], marker=symbol, color=colour(k), s=36, alpha=0.75, label=text
                )
        for shape, x, y in zip(study.shapes, values, errors, strict=True):
            if not shape.target.name.startswith("random-") and np.isfinite(x):
                axes.annotate(literal(shape.target.name), (x, y), textcoords="offset points", xytext=(5, 4), fontsize=9)
        found = study.correlation(name)
        axes.set(xlabel=label, title=f"rank correlation {found.rho:+.2f} (p = {found.p_value:.1g})")
        plain(axes)
    figure.axes[0].set_ylabel("median simulated rotation error (deg)")
    figure.axes[0].legend(frameon=False)
    return figure


def plot_convexity() -> Figure:
    """Plot two projective images of a square: with all depths positive, and with one negative (paper, Fig. 4)."""
    figure = new_figure(9.0, 4.4)
    family = Family(4)
    for axes, elation in zip(figure.subplots(1, 2), ([0.35, 0.25], [1.8, 1.2]), strict=True):
        depths = family.depths(np.array([0.0, 0.0, 1.0, *elation]))
        image = family.nominal / depths[:, None]
        _shape(axes, family.nominal, colour=INK, fill=False)
        _shape(axes, image, colour=VERMILLION, fill=False)
        for corner, depth in zip(image, depths, strict=True):
            axes.annotate(f"{depth:+.2f}", corner, textcoords="offset points", xytext=(6, 8), color=VERMILLION)
        convex = "convex" if (depths > 0).all() else "not convex"
        axes.set_title(f"v = ({elation[0]:g}, {elation[1]:g}): {convex}\ndepths v₁x + v₂y + 1 at the corners")
        axes.margins(0.2)
        plain(axes).set(xlabel="x (sides of the square)", ylabel="y (sides of the square)")
    return figure


def _shape(axes: Axes, polygon: Floats, colour: str = BLUE, fill: bool = True) -> None:
    outline(axes, polygon, colour, lw=1.8)
    if fill:
        axes.fill(*polygon.T, color=colour, alpha=0.12, lw=0)
    axes.set_aspect("equal")


def _worst(target: Target, rings: Rings) -> tuple[Floats, Floats, Floats]:
    """The shape in its worst orientation (n, 2), all its rings (k, m), and its worst motion (3,)."""
    cell = worst_cell(target, orientations(rings, DEGREE), rings)
    polygon = rotated(unit_area(target), np.array([cell.orientation]))[0]
    heights = rings.heights(polygon[:, 1].min(), polygon[:, 1].max())
    return polygon, heights, worst_motions(polygon, rings)[cell.area]
