"""Pictures of a sensor's calibration: residuals of rings on boards, before and after, and deviations of each ring."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph.calibration.sensor import SensorCalibration
from optshape_graph.viz.style import INK, colour, legend_below, marker, new_figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANELS = (
    ("range_bias_mm", "range_bias_sd_mm", "range, too far by (mm)"),
    ("elevation_off_deg", "elevation_sd_deg", "elevation, higher by (deg)"),
    ("azimuth_off_deg", "azimuth_sd_deg", "azimuth, farther left by (deg)"),
)


def plot_ring_residuals(result: SensorCalibration) -> Figure:
    """Plot how far each ring's returns are behind boards that took no part, by the given file and as calibrated.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(7.5, 4.2)
    axes = plain(figure.subplots())
    rings = np.arange(result.given.n_rings)
    for k, (name, values) in enumerate((("by the given file", result.before), ("calibrated", result.after))):
        known = values[np.isfinite(values)]
        rms = 1e3 * float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
        axes.plot(
            rings, 1e3 * values, ls="", marker=marker(k), color=colour(k), ms=6, label=f"{name}, {rms:.1f} mm in all"
        )
    axes.set_xlabel("ring, from the lowest")
    axes.set_ylabel("off boards that took no part (mm, rms)")
    axes.set_ylim(bottom=0.0)
    axes.set_title(f"Rings of {result.sensor.name}, before and after")
    legend_below(figure, axes)
    return figure


def plot_ring_deviations(result: SensorCalibration) -> Figure:
    """Plot how far each ring deviates from the given file, with standard deviations.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(7.5, 7.0)
    panels = figure.subplots(3, 1, sharex=True)
    rows = result.rows()
    rings = np.array([row["ring"] for row in rows])
    for axes, (value, sd, label) in zip(panels, PANELS, strict=True):
        plain(axes).set_ylabel(label)
        axes.axhline(0.0, color=INK, lw=0.8)
        axes.errorbar(
            rings, [row[value] for row in rows], [row[sd] for row in rows], ls="", marker="o", ms=4, color=colour(0)
        )
    panels[0].set_title(f"Rings of {result.sensor.name} against the given file, with standard deviations")
    panels[-1].set_xlabel("ring, from the lowest")
    return figure
