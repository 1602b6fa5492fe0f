"""Pictures of a rig: places of its sensors with their uncertainty, errors of sightings, errors of LiDARs' rings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph.calibration.rig import RigCalibration
from optshape_graph.viz.style import (
    BLUE,
    GREEN,
    GREY,
    VERMILLION,
    colour,
    ellipse,
    legend_below,
    literal,
    magnification,
    marker,
    new_figure,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = 3.0
"""Standard deviations that ellipses enclose in each direction."""

VIEWS = (("from above", 0, 1), ("from the side", 0, 2))
"""Views of the rig: name, and the two axes of the base that are drawn."""


def plot_rig(result: RigCalibration, magnify: float | None = None) -> Figure:
    """Draw the sensors' frames, and ellipses of three standard deviations of their places, from above and the side.

    Args:
        result: the calibration.
        magnify: factor by which the ellipses are enlarged; None: one that makes them visible.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(11.0, 6.0)
    places = np.array([sensor.T_base_sensor[:3, 3] for sensor in result.sensors])
    extent = float(max(np.ptp(places, axis=0).max(), 0.2))
    base, covariances = result.names[0], []
    for sensor in result.sensors[1:]:
        R = sensor.T_base_sensor[:3, :3]
        covariances.append(R @ result.transform(base, sensor.name)[1][3:, 3:] @ R.T)
    if magnify is None:
        sizes = [SIGMAS * np.sqrt(max(float(np.linalg.eigvalsh(C)[-1]), 0.0)) for C in covariances]
        magnify = magnification(sizes, extent)
    for axes, (words, i, j) in zip(figure.subplots(1, 2), VIEWS, strict=True):
        plain(axes)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set(xlabel=f"{'xyz'[i]} of {literal(base)} (m)", ylabel=f"{'xyz'[j]} of {literal(base)} (m)", title=words)
        for number, sensor in enumerate(result.sensors):
            _frame(axes, sensor.T_base_sensor, (i, j), 0.15 * extent, first=number == 0)
            place = sensor.T_base_sensor[[i, j], 3]
            axes.annotate(literal(sensor.name), tuple(place), textcoords="offset points", xytext=(8, -14), zorder=4,
                          bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1.0})  # fmt: skip
            if number:
                loop = place + magnify * ellipse(covariances[number - 1][np.ix_([i, j], [i, j])], SIGMAS)
                axes.plot(loop[:, 0], loop[:, 1], color=GREY, lw=1.2)
        axes.margins(0.12)
    large = "" if magnify == 1 else f", drawn {magnify:g} times too large"
    figure.suptitle(f"{len(result.sensors)} sensors; ellipses of {SIGMAS:g} standard deviations{large}")
    legend_below(figure, figure.axes[0])
    return figure


def plot_sightings(result: RigCalibration) -> Figure:
    """Draw the errors of each sensor's sightings, each placement predicted by the others.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(10.0, 5.0)
    columns = (("centre_error_m", 1e3, "target's centre (mm)"), ("turn_error_deg", 1.0, "target's rotation (deg)"))
    for axes, (key, unit, label) in zip(figure.subplots(1, 2), columns, strict=True):
        plain(axes)
        for number, sensor in enumerate(result.sensors):
            found = [getattr(one, key) for one in result.sightings if one.sensor == sensor.name]
            values = np.array([unit * value for value in found if value is not None])
            spread = np.linspace(-0.25, 0.25, len(values)) if len(values) else values
            axes.plot(number + spread, np.sort(values), marker(number), color=colour(number), ms=4, alpha=0.8)
            if len(values):
                axes.plot([number - 0.3, number + 0.3], [np.median(values)] * 2, color=colour(number), lw=1.5)
        axes.set_xticks(range(len(result.sensors)), [literal(name) for name in result.names])
        axes.set(ylabel=label, ylim=(0, None))
    figure.suptitle("Each placement predicted by the others; lines: medians (the printed table has means)")
    return figure


def plot_rings(result: RigCalibration) -> Figure:
    """Draw the errors of each LiDAR's rings, in standard deviations of its sensor file, with their uncertainty.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    lidars = [sensor for sensor in result.sensors if sensor.rings]
    figure = new_figure(max(4.0, 3.6 * len(lidars)), 5.5)
    for axes, sensor in zip(np.atleast_1d(figure.subplots(1, max(len(lidars), 1))), lidars, strict=False):
        plain(axes)
        kinds = list(dict.fromkeys(ring.kind for ring in sensor.rings if ring.ring is not None))
        for number, kind in enumerate(kinds):
            beside = 0.2 * (number - (len(kinds) - 1) / 2)
            rings = [ring for ring in sensor.rings if ring.kind == kind and ring.ring is not None]
            axes.errorbar(
                [ring.value for ring in rings], [(ring.ring or 0) + beside for ring in rings],
                xerr=[ring.sigma for ring in rings], fmt=marker(number), ms=3, lw=0.8, color=colour(number), label=kind,
            )  # fmt: skip
        axes.axvline(0.0, color=GREY, lw=0.8)
        axes.set(
            title=literal(sensor.name),
            xlabel="error, in its sensor file's\nstandard deviations",
            ylabel="ring, from the lowest",
        )
    if lidars:
        legend_below(figure, figure.axes[0])
    return figure


def _frame(axes: Axes, T: np.ndarray, shown: tuple[int, int], length: float, first: bool) -> None:
    """Draw the axes of a frame, seen along the one that is not shown."""
    start = T[list(shown), 3]
    for k, (shade, name) in enumerate(zip((VERMILLION, GREEN, BLUE), "xyz", strict=True)):
        end = start + length * T[list(shown), k]
        axes.plot([start[0], end[0]], [start[1], end[1]], color=shade, lw=2.0, label=name if first else None)
