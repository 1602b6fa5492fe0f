"""Pictures of a map from above: landmarks with their uncertainty, trajectories, and the structure of its graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.mapping.map import Landmark, Map
from optshape_graph.mapping.track import MappingProblem
from optshape_graph.viz.style import (
    GREY,
    INK,
    ORANGE,
    VERMILLION,
    colour,
    ellipse,
    legend_below,
    literal,
    magnification,
    new_figure,
    outline,
    plain,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = 3.0
"""Standard deviations that ellipses enclose in each direction."""

ARROWS = 24
"""Approximate number of headings that are drawn along a trajectory."""

MOST_NAMES = 40
"""Names are written if there are no more landmarks."""


def plot_map(result: Map, magnify: float | None = None) -> Figure:
    """Draw landmarks, the way they face and their ellipses of three standard deviations, and trajectories, from above.

    A trajectory has arrows along the x axis of its LiDAR. A landmark has an arrow to the side that the LiDAR sees,
    between the two limits of its heading at three standard deviations.

    Args:
        result: the map.
        magnify: factor by which the ellipses are enlarged; None: one that makes them visible.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, axes = _axes()
    for k, (name, trajectory) in enumerate(result.trajectories.items()):
        path = trajectory.poses[:, :3, 3]
        axes.plot(path[:, 0], path[:, 1], "-", color=colour(k), lw=1.2, label=f"trajectory {literal(name)}".strip())
        axes.plot(path[0, 0], path[0, 1], "o", color=colour(k), ms=5, label=None if k else "start")
        headings = trajectory.poses[:: max(len(path) // ARROWS, 1)]
        axes.quiver(
            *headings[:, :2, 3].T, *_unit(headings[:, :2, 0]).T, angles="xy", units="dots", scale_units="dots",
            width=3.0, headwidth=5, headlength=6, headaxislength=6, minlength=0, scale=1 / 26.0, color=colour(k),
            zorder=3,
        )  # fmt: skip
    drawn = [*(t.poses[:, :2, 3] for t in result.trajectories.values()), *(m.vertices[:, :2] for m in result.landmarks)]
    extent = float(np.ptp(np.vstack(drawn), axis=0).max()) if drawn else 1.0
    covariances = [_from_above(landmark) for landmark in result.landmarks]
    if magnify is None:
        sizes = [SIGMAS * np.sqrt(max(np.linalg.eigvalsh(C)[-1], 0.0)) for C in covariances]
        magnify = magnification(sizes, 0.5 * extent)
    for landmark, C in zip(result.landmarks, covariances, strict=True):
        outline(axes, landmark.vertices[:, :2])
        place = landmark.T_world_target[:2, 3]
        loop = place + magnify * ellipse(C, SIGMAS)
        axes.plot(loop[:, 0], loop[:, 1], color=VERMILLION, lw=1.0)
        tip = _facing(axes, landmark)
        if len(result.landmarks) <= MOST_NAMES:  # above outline and ellipse
            above = float(place[0]), float(max(loop[:, 1].max(), landmark.vertices[:, 1].max(), tip[1]))
            axes.annotate(literal(landmark.id), above, (0, 5), textcoords="offset points", ha="center", va="bottom")
    large = "" if magnify == 1 else f", drawn {magnify:g} times too large"
    axes.set_title(f"{len(result.landmarks)} landmarks; ellipses of {SIGMAS:g} standard deviations{large}")
    said = f"Orange: the way a landmark faces, and {SIGMAS:g} standard deviations to each side. Arrows: x of the LiDAR."
    if result.trajectories:
        legend_below(figure, caption=said)
    return figure


def plot_structure(problem: MappingProblem) -> Figure:
    """Draw the factor graph of a map from above: poses, odometry, and a line for every match.

    `viz.graph.plot_graph` draws any GTSAM graph.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, axes = _axes()
    from matplotlib.collections import LineCollection

    for k, track in enumerate(problem.tracks):
        path = track.T_world_lidar[:, :2, 3]
        seen = [(path[match.pose], problem.T_world_target[match.landmark][:2, 3]) for match in track.matches]
        moved = [(path[o.i], path[o.j]) for o in track.odometry]
        label = f"{len(seen)} matches" if k == 0 else None
        axes.add_collection(LineCollection(seen, colors=GREY, linewidths=0.5, label=label, zorder=1))
        axes.add_collection(LineCollection(moved, colors=colour(k), linewidths=1.2, zorder=2))
        axes.plot(
            path[:, 0], path[:, 1], ".", color=colour(k), ms=4, label=f"{len(path)} poses of {literal(track.name)}"
        )
    for name, T in problem.T_world_target.items():
        axes.plot(*T[:2, 3], "s", color=INK, ms=6, zorder=3)
        if len(problem.T_world_target) <= MOST_NAMES:
            axes.annotate(literal(name), tuple(T[:2, 3]), textcoords="offset points", xytext=(8, 6))
    axes.autoscale_view()
    axes.set_title(f"factor graph: {len(problem.T_world_target)} landmarks (squares), lines from where they were seen")
    legend_below(figure)
    return figure


def _axes() -> tuple[Figure, Axes]:
    figure = new_figure(8.0, 8.0)
    axes = plain(figure.subplots())
    axes.margins(0.15)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x of the world (m)", ylabel="y of the world (m)")
    return figure, axes


def _unit(xy: Floats) -> Floats:
    """Return directions (..., 2) of length 1."""
    return np.asarray(xy / np.maximum(np.linalg.norm(xy, axis=-1, keepdims=True), 1e-9))


def _facing(axes: Axes, landmark: Landmark) -> Floats:
    """Draw the direction that a landmark faces, and its limits at `SIGMAS`; return the end (2,) of the line."""
    place, facing = landmark.T_world_target[:2, 3], -_unit(landmark.T_world_target[:2, 0])
    R = landmark.T_world_target[:3, :3]
    sd = float(np.sqrt(max((R @ landmark.covariance[:3, :3] @ R.T)[2, 2], 0.0)))
    length = 0.75 * landmark.target.circumradius
    for turn in (-SIGMAS * sd, 0.0, SIGMAS * sd):
        c, s = np.cos(turn), np.sin(turn)
        end = place + length * np.array([[c, -s], [s, c]]) @ facing
        axes.plot(*np.column_stack([place, end]), color=ORANGE, lw=1.4 if turn == 0.0 else 0.7, zorder=2)
    return np.asarray(place + length * facing)


def _from_above(landmark: Landmark) -> np.ndarray:
    """Return the covariance (2, 2) of the place, seen along the world's -z."""
    R = landmark.T_world_target[:3, :3]
    return np.asarray((R @ landmark.covariance[3:, 3:] @ R.T)[:2, :2])
