"""Pictures of estimates against motion capture: errors of scans, placements of the target, the marker layout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from optshape_graph.calibration.mocap.comparison import ScanError
from optshape_graph.calibration.mocap.result import MocapCalibration
from optshape_graph.evaluation.harness import Row
from optshape_graph.se3 import apply
from optshape_graph.viz.style import (
    INK,
    colour,
    ellipse,
    legend_below,
    literal,
    magnification,
    marker,
    new_figure,
    outline,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIGMAS = 3.0
"""Standard deviations that ellipses enclose."""

VISIBLE = 0.015
"""Radius of an ellipse that shows beside a marker's dot, as a share of the target."""

PANELS = (("rmse_m", 1e3, "vertices, rms (mm)"), ("e_t_m", 1e3, "translation (mm)"), ("e_r_deg", 1.0, "rotation (deg)"))


def plot_errors(
    series: Mapping[str, Sequence[ScanError | None]], title: str = "LiDAR estimates against the markers"
) -> Figure:
    """Plot the errors of every scan, and their means, for one or several ways to estimate or to compare.

    Args:
        series: errors of the same scans in the same order, by the name of the series; None: the scan has none.
        title: what one sees.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    names = next(([one.scan for one in errors if one] for errors in series.values() if all(errors)), [])
    rows = np.arange(max(len(errors) for errors in series.values()))
    figure = new_figure(10.0, 1.8 + 0.32 * max(len(rows), 5))
    panels = figure.subplots(1, 3, sharey=True)
    for axes, (field, scale, label) in zip(panels, PANELS, strict=True):
        plain(axes).set_xlabel(label)
        for k, (name, errors) in enumerate(series.items()):
            values = np.array([scale * getattr(one, field) if one else np.nan for one in errors], dtype=float)
            shift = 0.16 * (k - 0.5 * (len(series) - 1))
            mean = float(np.nanmean(values)) if np.isfinite(values).any() else np.nan
            axes.plot(values, rows + shift, ls="", marker=marker(k), color=colour(k), ms=6, label=name)
            axes.axvline(mean, color=colour(k), lw=1.2, ls="--")
        axes.set_xlim(left=0.0)
    panels[0].set_yticks(rows, [literal(name) for name in names] or [str(k) for k in rows])
    panels[0].invert_yaxis()
    legend_below(figure, panels[0])
    figure.suptitle(f"{title} (dashed: means)")
    return figure


def plot_calibration_errors(calibration: MocapCalibration) -> Figure:
    """Plot the errors of a calibration's scans: leave-one-out, and in-sample.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    series = {
        "leave-one-out: frames tied by the other scans": calibration.leave_one_out,
        "in-sample: frames tied by all scans": calibration.in_sample,
    }
    return plot_errors(series)


def plot_table(rows: Sequence[Row], series: Mapping[str, str]) -> Figure:
    """Plot the errors of several sessions' scans beside those of other methods.

    Args:
        rows: of `evaluate_mocap`.
        series: prefix of columns to what their errors are called; see `evaluation.mocap.PROTOCOLS`.

    Raises:
        MissingExtraError: matplotlib is absent.
    """

    def errors(row: Row, prefix: str) -> ScanError | None:
        values = [row[f"{prefix}{field}"] for field, _, _ in PANELS]
        return None if None in values else ScanError(f"{row['session']}/{row['scan']}", *values)

    return plot_errors({name: [errors(row, prefix) for row in rows] for prefix, name in series.items()})


def plot_placements(calibration: MocapCalibration) -> Figure:
    """Draw from above where the target stood by the LiDAR and by the markers, in the LiDAR frame.

    Args:
        calibration: the result.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(10.0, 6.0)
    axes = plain(figure.subplots())
    T, scans = calibration.T_lidar_mocap, calibration.scans
    axes.plot(0.0, 0.0, "+", color=INK, ms=12, mew=2)
    axes.annotate("LiDAR", (0.0, 0.0), textcoords="offset points", xytext=(8, 8))
    for k, scan in enumerate(scans):
        seen = apply(T, calibration.scale * scan.markers)
        outline(axes, scan.estimate.vertices[:, :2], colour(k), label=literal(scan.name))
        axes.plot(
            *seen[:, :2].T,
            ls="",
            marker="o",
            mfc="none",
            color=INK,
            ms=5,
            label="markers" if k == len(scans) - 1 else None,
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x of the LiDAR (m)", ylabel="y of the LiDAR (m)")
    figure.legend(loc="outside right upper", frameon=False, title="targets, by the LiDAR")
    sd = np.sqrt(np.diag(calibration.covariance))
    axes.set_title(
        f"where the target stood, from above; T_lidar_mocap is known to {1e3 * sd[3:].max():.1f} mm and "
        f"{np.degrees(sd[:3].max()):.2f} deg (sd)",
        fontsize=11,
    )
    return figure


def plot_marker_layout(calibration: MocapCalibration) -> Figure:
    """Draw where the markers are on the target, with ellipses of three standard deviations.

    Args:
        calibration: with the layout.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(9.0, 6.6)
    axes = plain(figure.subplots(), equal=True)
    target, layout, sigma = calibration.target, calibration.marker_layout, calibration.layout_sigma
    offsets = layout - target.vertices
    size = float(np.ptp(target.polygon, axis=0).max())
    factor = magnification(np.linalg.norm(offsets, axis=1), size)
    outline(axes, target.polygon, INK)
    for k, (vertex, offset, sd) in enumerate(zip(target.vertices, offsets, sigma, strict=True)):
        place = vertex[1:] + factor * offset[1:]
        loop = place + factor * ellipse(np.diag(sd[1:] ** 2), SIGMAS)
        depth = f"{1e3 * abs(offset[0]):.0f} {'behind' if offset[0] > 0 else 'before'} the plane"
        axes.plot(*np.column_stack([vertex[1:], place]), color=colour(k), lw=1.5)
        axes.plot(*loop.T, color=colour(k), lw=1.0, ls=":")
        size_mm = f"{1e3 * np.linalg.norm(offset):.0f} mm ± {1e3 * sd.max():.1f}"
        axes.plot(*place, "o", color=colour(k), ms=5, label=f"vertex {k}: {size_mm}, {depth}")
        inwards = -target.polygon[k] / np.linalg.norm(target.polygon[k])
        axes.annotate(f"{k}", tuple(vertex[1:]), textcoords="offset points", fontweight="bold",
                      xytext=(-22 * inwards[0], 22 * inwards[1]), ha="center", va="center")  # fmt: skip
    axes.margins(0.2)
    axes.invert_xaxis()
    axes.set(xlabel="y of the target (m), to the left", ylabel="z of the target (m)")
    large = "" if factor == 1 else f"; offsets drawn {factor:g} times too large"
    axes.set_title(f"markers and vertices, as the LiDAR sees them{large}")
    visible = factor * SIGMAS * float(sigma.max()) > VISIBLE * size
    dotted = f"; dotted: {SIGMAS:g} standard deviations" if visible else ""
    legend_below(figure, columns=2, caption=f"from each vertex to its marker, ± its largest standard deviation{dotted}")
    return figure
