"""Pictures of an estimate: the fit from the front and the side, edge labels, residuals, vertices, the runner-up.

Fronts are drawn as the LiDAR sees the target, so the target's y runs to the left.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.errors import InputError
from optshape_graph.pose import PoseEstimate, PoseOptions
from optshape_graph.pose.fit import Fit
from optshape_graph.scan import Scan
from optshape_graph.se3 import apply, inverse
from optshape_graph.target import Target
from optshape_graph.viz.style import (
    BLUE,
    GREY,
    INK,
    PALE,
    VERMILLION,
    colour,
    ellipse,
    legend_below,
    literal,
    magnification,
    marker,
    new_figure,
    outline,
    plain,
    short,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGMAS = 3.0
"""Standard deviations that ellipses enclose."""

INSETS = "A ring's last return is inside the true edge, by up to one azimuth step along the ring."
"""Caption of pictures of ring ends."""

FRONT_TO_SIDE = 2.2
"""Width of the front view over that of the side view."""


def plot_estimate(scan: Scan, estimate: PoseEstimate) -> dict[str, Figure]:
    """Draw all pictures of an estimate: fit, edges, residuals, vertices, and the runner-up if that is not ruled out.

    Args:
        scan: the returns that the estimate was made of.
        estimate: of the pose. Vertices are left out if it failed, edges if the cloud has no rings.

    Returns:
        The figures by name.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figures = {"fit": plot_fit(scan, estimate), "residuals": plot_residuals(scan, estimate)}
    if len(estimate.edge_points):
        figures["edges"] = plot_edge_labels(estimate, scan.name)
    if estimate.status != "failed":
        figures["vertices"] = plot_vertices(estimate, scan.name)
    rivalled = estimate.ambiguity.margin < PoseOptions.ambiguity_margin
    if estimate.status == "ambiguous" and rivalled and estimate.ambiguity.T_lidar_target is not None:
        figures["runner_up"] = plot_runner_up(scan, estimate)
    return figures


def plot_fit(scan: Scan, estimate: PoseEstimate) -> Figure:
    """Draw the returns and the fitted template, from the front and from the side (as the paper's Fig. 7).

    Args:
        scan: the returns that the estimate was made of, or the full scan, of which the part near the target is drawn.
        estimate: the target's pose in it.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure, front, side = _front_and_side(estimate.target)
    points = _near(scan, estimate)
    front.plot(points[:, 1], points[:, 2], ".", color=GREY, ms=3, label="returns")
    if len(estimate.edge_points):
        edges = _in_target(estimate, estimate.edge_points.points)
        front.plot(edges[:, 1], edges[:, 2], ".", color=VERMILLION, ms=6, label="edge points: ends of rings")
    outline(front, estimate.target.polygon, BLUE, label="fitted template")
    _name_vertices(front, estimate.target)

    side.plot(1e3 * points[:, 0], points[:, 2], ".", color=GREY, ms=3)
    side.plot(
        [0.0, 0.0], [estimate.target.polygon[:, 1].min(), estimate.target.polygon[:, 1].max()], color=BLUE, lw=1.6
    )
    reach = max(1.15e3 * float(np.abs(points[:, 0]).max(initial=0.0)), 5.0)
    side.set(xlim=(-reach, reach), xlabel="distance behind the plane (mm)")
    side.set_title(f"side, stretched\n{1e3 * estimate.plane_rms:.1f} mm rms from the plane", fontsize=11)
    figure.suptitle(_title(scan, estimate))
    legend_below(figure, front, caption=f"{INSETS} So edge points lie a little inside the template.")
    return figure


def plot_edge_labels(estimate: PoseEstimate, name: str = "") -> Figure:
    """Draw the edge that each edge point was assigned to, and where along its ring that edge may lie.

    Args:
        estimate: of the pose.
        name: of the scan, for the title.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    figure = new_figure(8.0, 6.6)
    axes = figure.subplots()
    target, edges = estimate.target, estimate.edge_points
    _front_axes(axes, target)
    outward = edges.outward(estimate.T_lidar_target[:3, 0])
    points = _in_target(estimate, edges.points)[:, 1:]
    near = _in_target(estimate, edges.points + edges.lower[:, None] * outward)[:, 1:]
    far = _in_target(estimate, edges.points + edges.upper[:, None] * outward)[:, 1:]
    for k in range(len(target)):
        ends = target.polygon[[k, (k + 1) % len(target)]]
        axes.plot(*ends.T, color=colour(k), lw=1.6)
        mine = estimate.labels == k
        count = int(mine.sum())
        label = f"edge {k}: {count} point{'' if count == 1 else 's'}"
        axes.plot(*points[mine].T, ls="", marker=marker(k), color=colour(k), ms=5, label=label)
        for a, b in zip(near[mine], far[mine], strict=True):
            axes.plot([a[0], b[0]], [a[1], b[1]], color=colour(k), lw=1.0, alpha=0.7)
    _name_vertices(axes, target)
    axes.set_title(f"{_colon(name)}{len(points)} edge points, and where along the ring the edge is (lines)")
    legend_below(figure, axes, caption=f"{INSETS} The line of each point is that step.")
    return figure


def plot_residuals(scan: Scan, estimate: PoseEstimate) -> Figure:
    """Plot how far the edge points are from their edges, and how far each ring is from the plane.

    The offset that all edge points share (dashed) depends on beam and surface; the estimate allows for it.

    Args:
        scan: the returns that the estimate was made of.
        estimate: of the pose.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    ends = len(estimate.edge_points) > 0
    figure = new_figure(9.0, 7.0 if ends else 4.5)
    panels = [plain(axes) for axes in figure.subplots(1 + ends, 1, sharex=True, squeeze=False)[:, 0]]
    if ends:
        _edge_residuals(panels[0], estimate)
    _plane_residuals(panels[-1], scan, estimate)
    taken = "The boundary is taken to be half an azimuth step beyond a ring's last return."
    said = f"{taken if estimate.inset.any() else INSETS}\nWhat all have in common (dashed) depends on beam and surface."
    legend_below(figure, *panels, columns=7, caption=said if ends else None)
    figure.suptitle(_title(scan, estimate))
    return figure


def plot_vertices(estimate: PoseEstimate, name: str = "") -> Figure:
    """Draw the vertices with their covariance ellipses, from the front and from the side.

    Args:
        estimate: of the pose.
        name: of the scan, for the title.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    target = estimate.target
    figure, front, side = _front_and_side(target)
    R = estimate.T_lidar_target[:3, :3]
    covariances = np.swapaxes(R[None], 1, 2) @ estimate.vertex_covariances @ R
    sd = np.sqrt(np.array([np.linalg.eigvalsh(C).max() for C in covariances]))
    factor = magnification(SIGMAS * sd, float(np.ptp(target.polygon, axis=0).max()))
    outline(front, target.polygon, BLUE)
    for k, (vertex, C) in enumerate(zip(target.vertices, covariances, strict=True)):
        in_plane, across = np.sqrt(np.linalg.eigvalsh(C[1:, 1:]).max()), np.sqrt(C[0, 0])
        loop = vertex[1:] + factor * ellipse(C[1:, 1:], SIGMAS)
        front.fill(*loop.T, color=colour(k), alpha=0.35, lw=0)
        front.plot(*loop.T, color=colour(k), lw=1.2, label=f"{k}: {1e3 * in_plane:.1f} mm, across {1e3 * across:.1f}")
        front.plot(*vertex[1:], ".", color=INK, ms=4)
        loop = vertex[[0, 2]] + factor * ellipse(C[np.ix_([0, 2], [0, 2])], SIGMAS)
        side.fill(*loop.T, color=colour(k), alpha=0.35, lw=0)
        side.plot(*loop.T, color=colour(k), lw=1.2)
        side.plot(*vertex[[0, 2]], ".", color=INK, ms=4)
    _name_vertices(front, target, factor * SIGMAS * sd)
    heights = target.polygon[:, 1]
    side.plot([0.0, 0.0], [heights.min(), heights.max()], color=BLUE, lw=1.6, zorder=0)
    reach = float(np.ptp(front.get_xlim())) / (2 * FRONT_TO_SIDE)
    side.set(xlim=(-reach, reach), xlabel="distance behind the plane (m)", title="side")
    large = "" if factor == 1 else f", drawn {factor:g} times too large"
    figure.suptitle(f"{_colon(name)}vertices, ellipses of {SIGMAS:g} standard deviations{large}")
    legend_below(figure, front, caption="vertex: largest standard deviation in the plane, and across it")
    return figure


def plot_runner_up(scan: Scan, estimate: PoseEstimate) -> Figure:
    """Draw the best pose and the best different pose on the same returns.

    Args:
        scan: the returns that the estimate was made of.
        estimate: of the pose.

    Raises:
        InputError: no different pose was found.
        MissingExtraError: matplotlib is absent.
    """
    rival = estimate.ambiguity.T_lidar_target
    if rival is None:
        raise InputError(f"{scan.name}: no different pose of target '{estimate.target.name}' was found to draw")
    figure = new_figure(8.0, 6.6)
    axes = figure.subplots()
    target = estimate.target
    T_target_rival = inverse(estimate.T_lidar_target) @ rival
    other = apply(T_target_rival, target.vertices)[:, 1:]
    points = _near(scan, estimate)
    _front_axes(axes, target, np.vstack([target.polygon, other]))
    axes.plot(points[:, 1], points[:, 2], ".", color=GREY, ms=4, label="returns")
    outline(axes, target.polygon, BLUE, lw=2.0, label="best pose")
    outline(axes, other, VERMILLION, lw=2.0, ls="--", label="runner-up")
    _name_vertices(axes, target)
    for k, (y, z) in enumerate(other):
        away = np.array([y, z]) / max(float(np.hypot(y, z)), 1e-9)
        axes.annotate(f"{k}'", (y, z), textcoords="offset points", xytext=(14 * away[0], -14 * away[1]),
                      ha="center", va="center", color=VERMILLION)  # fmt: skip
    axes.set_title(
        f"{short(scan.name)}, {estimate.status}: "
        f"the runner-up's log likelihood is {estimate.ambiguity.margin:.1f} lower\n"
        f"(below {PoseOptions.ambiguity_margin:g} a different pose is not ruled out)", fontsize=11,
    )  # fmt: skip
    legend_below(figure, axes)
    return figure


def _edge_residuals(axes: Axes, estimate: PoseEstimate) -> None:
    """Plot the distances of the edge points from their edges, and the offset that they share."""
    rings, labels, n = estimate.edge_points.ring, estimate.labels, len(estimate.target)
    residual, sigma = 1e3 * estimate.edge_residuals, 1e3 * estimate.edge_sigma
    for k in range(n):
        mine = labels == k
        offset = 0.5 * (k / max(n - 1, 1) - 0.5)
        axes.errorbar(rings[mine] + offset, residual[mine], sigma[mine], ls="", marker=marker(k), ms=4, lw=0.9,
                      color=colour(k), label=f"edge {k}")  # fmt: skip
    axes.axhline(0.0, color=INK, lw=0.8)
    common = float(np.average(residual, weights=1 / sigma**2))
    normalised = float(np.sqrt(np.mean(((residual - common) / sigma) ** 2)))
    axes.axhline(common, color=GREY, lw=1.0, ls="--", label="in common")
    axes.set_ylabel("distance from the edge (mm)\noutside: positive")
    axes.set_title(
        f"edges: {common:+.0f} mm in common, and {normalised:.2f} standard deviations rms about that (bars: ± 1)",
        fontsize=11,
    )
    reach = 1.2 * float(np.abs(residual).max(initial=1.0)) + float(np.median(sigma))
    axes.set_ylim(-reach, reach)  # the bar of an end that tells nothing of its edge may go beyond


def _plane_residuals(axes: Axes, scan: Scan, estimate: PoseEstimate) -> None:
    """Plot the distances of the returns from the plane, over rings or, without rings, over elevations."""
    from matplotlib.ticker import MaxNLocator

    depth = 1e3 * _in_target(estimate, scan.points)[:, 0]
    title = f"plane: {1e3 * estimate.plane_rms:.1f} mm rms"
    if scan.ring is None:
        x, y, z = scan.points.T
        axes.plot(np.degrees(np.arctan2(z, np.hypot(x, y))), depth, ".", color=GREY, ms=3, label="returns")
        axes.set_xlabel("elevation (deg)")
    else:
        present = np.unique(scan.ring)
        means = [float(depth[scan.ring == ring].mean()) for ring in present]
        axes.plot(scan.ring, depth, ".", color=PALE, ms=3, label="returns")
        axes.plot(present, means, "_", color=BLUE, ms=12, mew=2, label="mean of the ring")
        axes.set_xlabel("ring, counted from the lowest")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        title += f"; a ring's mean is its range bias ({np.std(means):.1f} mm over rings)"
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_ylabel("distance from the plane (mm)\nbehind: positive")
    axes.set_title(title, fontsize=11)


def _in_target(estimate: PoseEstimate, points: Floats) -> Floats:
    return apply(estimate.T_target_lidar, points)


def _near(scan: Scan, estimate: PoseEstimate) -> Floats:
    """Return the returns near the target, in its frame."""
    points = _in_target(estimate, scan.points)
    radius = 1.5 * estimate.target.circumradius
    return np.asarray(points[np.linalg.norm(points, axis=1) < radius])


def _front_and_side(target: Target) -> tuple[Figure, Axes, Axes]:
    """Return a figure with axes for the front and, of the same height, for the side."""
    figure = new_figure(10.0, 6.6)
    front, side = figure.subplots(1, 2, width_ratios=(FRONT_TO_SIDE, 1.0), sharey=True)
    _front_axes(front, target)
    front.set_title("front, as the LiDAR sees it")
    plain(side).set_box_aspect(FRONT_TO_SIDE * float(np.ptp(front.get_ylim()) / np.ptp(front.get_xlim())))
    return figure, front, side


def _front_axes(axes: Axes, target: Target, within: Floats | None = None) -> None:
    """Set axes to the target's plane as the LiDAR sees it: y to the left, z up, wide enough for all that is drawn."""
    plain(axes, equal=True)
    drawn = target.polygon if within is None else within
    (y_min, z_min), (y_max, z_max) = drawn.min(axis=0), drawn.max(axis=0)
    room = 0.2 * target.circumradius
    axes.set(xlim=(y_max + room, y_min - room), ylim=(z_min - room, z_max + room))
    axes.set(xlabel="y of the target (m), to the left", ylabel="z of the target (m)")


def _name_vertices(axes: Axes, target: Target, beyond: Floats | float = 0.0) -> None:
    """Write each vertex's number outside the target, `beyond` metres away and a little more."""
    for k, far in enumerate(np.broadcast_to(beyond, len(target))):
        away = target.polygon[k] / np.linalg.norm(target.polygon[k])
        place = tuple(target.polygon[k] + far * away)
        axes.annotate(f"{k}", place, textcoords="offset points", xytext=(14 * -away[0], 14 * away[1]), ha="center",
                      va="center", color=INK, fontweight="bold")  # fmt: skip


def _colon(name: str) -> str:
    return f"{short(name)}: " if name else ""


def _fit(fit: Fit) -> str:
    """Return a fit in a title's words: what is unusual, or how large the residuals are."""
    if fit.flags:
        return f"does not fit the model: {', '.join(flag.kind for flag in fit.flags)}"
    parts = (("plane", fit.plane_chi_square, fit.plane_freedom), ("edges", fit.edge_chi_square, fit.edge_freedom))
    return "chi-square per degree of freedom: " + ", ".join(
        f"{name} {square / freedom:.1f}" for name, square, freedom in parts if freedom
    )


def _title(scan: Scan, estimate: PoseEstimate) -> str:
    distance, rings = float(np.linalg.norm(estimate.T_lidar_target[:3, 3])), estimate.edge_points.n_rings
    return (
        f"{short(scan.name)}: '{literal(estimate.target.name)}' at {distance:.2f} m, {estimate.status}; "
        f"{estimate.n_returns} returns {f'on {rings} rings' if rings else 'without rings'}\n{_fit(estimate.fit)}"
    )
