"""Pictures of a full scan, as the LiDAR sees it and from above, with the targets in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.detection import Detections, Rejection
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply
from optshape_graph.simulation import SimulatedScan
from optshape_graph.viz.style import INK, PALE, VERMILLION, colour, literal, new_figure, outline, plain, short

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_RETURNS = 60_000
"""Returns that are drawn at most: of a larger scan every k-th."""


def plot_scan(scan: Scan, targets: Mapping[str, Floats] | None = None, title: str = "") -> Figure:
    """Draw a scan twice: azimuth and elevation, coloured by range; and from above, with the targets' outlines.

    Args:
        scan: a full revolution, or part of it.
        targets: vertices (n, 3) of the outlines by name, LiDAR frame, metres.
        title: of the figure; "": the scan's name.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, _, _ = _drawn(scan, targets or {})
    figure.suptitle(title or f"{short(scan.name)}: {len(scan)} returns")
    return figure


def plot_detections(scan: Scan, detections: Detections) -> Figure:
    """Draw a full scan, the targets found in it, and rejected surfaces (crosses).

    Args:
        scan: the scan.
        detections: what was found in it.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    names = _unique([f"{literal(one.target.name)}, {one.status}, score {one.score:.2f}" for one in detections.found])
    outlines = {name: one.estimate.vertices for name, one in zip(names, detections.found, strict=True)}
    figure, seen, above = _drawn(scan, outlines)
    centres = np.array([one.centre for one in detections.rejected if not _is_found(one, detections)])
    if len(centres):
        seen.plot(*_angles(centres), "x", color=INK, ms=6, mew=1.4)
        above.plot(centres[:, 0], centres[:, 1], "x", color=INK, ms=6, mew=1.4, label="looked at, and no target")
        above.legend(loc="upper right", fontsize=9)
    n = len(detections.found)
    figure.suptitle(f"{short(scan.name)}: {n} target{'' if n == 1 else 's'} found among {len(scan)} returns")
    return figure


def plot_found(detections: Detections) -> Figure:
    """Draw detections from above: outlines of targets, crosses for rejected surfaces.

    Args:
        detections: what was found.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(6.0, 5.0)
    axes = plain(figure.subplots(), equal=True)
    axes.plot(0.0, 0.0, "^", color=INK, label="LiDAR")
    for k, one in enumerate(detections.found):
        outline(axes, one.estimate.vertices[:, :2], colour(k), label=literal(f"{one.target.name}, {one.status}"))
    if detections.rejected:
        centres = np.array([one.centre for one in detections.rejected])
        axes.plot(centres[:, 0], centres[:, 1], "x", color=INK, label="looked at, and no target")
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.legend(fontsize=9)
    return figure


def plot_simulation(simulated: SimulatedScan) -> Figure:
    """Draw a simulated scan, with the true outlines of the targets.

    Args:
        simulated: the scan and its truth.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    patches, poses = simulated.scene.targets, simulated.T_lidar_targets
    outlines = {
        name: apply(T, patch.shape.vertices)
        for name, patch, T in zip(
            _unique([literal(patch.shape.name) for patch in patches]), patches, poses, strict=True
        )
    }
    return plot_scan(simulated.scan, outlines)


def _drawn(scan: Scan, targets: Mapping[str, Floats]) -> tuple[Figure, Axes, Axes]:
    """Return a figure, its view from the LiDAR and its view from above."""
    figure = new_figure(10.0, 11.0)
    seen, above = figure.subplots(2, 1, height_ratios=(1.0, 2.4))
    points = scan.points[:: len(scan) // MOST_RETURNS + 1]
    distance = np.linalg.norm(points, axis=1)
    drawn = seen.scatter(*_angles(points), c=distance, s=2, cmap="viridis", norm="log", linewidths=0)
    bar = figure.colorbar(drawn, ax=seen, label="range (m)", pad=0.01)
    ticks = np.outer(10.0 ** np.arange(-1, 4), [1.0, 2.0, 5.0]).ravel()
    ticks = ticks[(ticks >= distance.min()) & (ticks <= distance.max())]
    bar.set_ticks(list(ticks), labels=[f"{tick:g}" for tick in ticks])
    bar.ax.minorticks_off()
    plain(seen).set(xlabel="azimuth (deg), to the left", ylabel="elevation (deg)", title="as the LiDAR sees it")
    seen.invert_xaxis()
    above.plot(points[:, 0], points[:, 1], ".", color=PALE, ms=2, zorder=1)
    plain(above, equal=True).set(xlabel="x of the LiDAR (m)", ylabel="y of the LiDAR (m)", title="from above")
    if _goes_round(points):
        above.plot(0.0, 0.0, "+", color=INK, ms=10, mew=1.5)
        reach = max([np.percentile(distance, 90), *(1.5 * np.linalg.norm(v, axis=1).max() for v in targets.values())])
        beyond = float(np.mean(np.abs(points[:, :2]).max(axis=1) > reach))
        left_out = f" ({beyond:.0%} of the returns are beyond, to {distance.max():.0f} m)" if beyond else ""
        above.set(xlim=(-reach, reach), ylim=(-reach, reach), title=f"from above{left_out}")
    seen.set_autoscalex_on(False)
    for name, vertices in targets.items():
        closed = np.vstack([vertices, vertices[:1]])
        azimuth, elevation = _angles(closed)
        azimuth = np.unwrap(azimuth, period=360.0)
        for turn in (-360.0, 0.0, 360.0):  # across the seam behind the sensor it is drawn at both ends
            if (np.abs(azimuth + turn) <= 180.0).any():
                seen.plot(azimuth + turn, elevation, color=VERMILLION, lw=1.6)
        above.plot(closed[:, 0], closed[:, 1], color=VERMILLION, lw=2.4, zorder=3)
        x, y = vertices.mean(axis=0)[:2]
        above.annotate(
            name, (x, y), textcoords="offset points", xytext=(12 if x < 0 else -12, 10), color=VERMILLION,
            ha="left" if x < 0 else "right", bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1.0}, zorder=4,
        )  # fmt: skip
    return figure, seen, above


def _is_found(rejection: Rejection, detections: Detections) -> bool:
    """Return whether a rejected surface was found to be another target."""
    return any(
        np.linalg.norm(one.estimate.T_lidar_target[:3, 3] - rejection.centre) < one.target.circumradius
        for one in detections.found
    )


def _goes_round(points: Floats) -> bool:
    """Return whether there are returns in front, behind and at the sides."""
    x, y = points[:, 0], points[:, 1]
    return bool(x.min() < 0 < x.max() and y.min() < 0 < y.max())


def _angles(points: Floats) -> tuple[Floats, Floats]:
    """Return azimuth and elevation, degrees."""
    x, y, z = points.T
    return np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))


def _unique(names: list[str]) -> list[str]:
    return [name if names.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(names)]
