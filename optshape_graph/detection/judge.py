"""A pose judged by every ray near it: on the target, behind it, in front of it, beside it."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.detection.borders import borders
from optshape_graph.detection.results import Evidence
from optshape_graph.detection.segments import Sweep
from optshape_graph.pose import PoseEstimate
from optshape_graph.pose.likelihood import chords

MIN_CONTAINED, MIN_COVERED, MIN_EDGED, MIN_SOLID, MIN_FREE, MIN_STEPPED = 0.8, 0.6, 0.75, 0.9, 0.75, 0.75
"""Least shares of `Evidence` that a target has: stands and arms touch it, hands hide it, returns get lost."""

RIM = 0.4
"""Width of the rim beside a target that is looked at, in parts of the distance from its origin to its outline."""


PIERCED_LEAST, PIERCED_SHARE = 6, 3.0
"""Rays of a ring, and their number against that of its returns, that pass through where a target cannot be then."""

CENTRAL = 1.96
"""Standard deviations about the plane within which 95 % of the returns lie."""


def edge_margin(sweep: Sweep, estimate: PoseEstimate) -> float:
    """How far outside the outline a return of the target may lie, metres: half a beam, noise, the pose's own error.

    A pose that is not determined would allow anything; a tenth of the target is enough.
    """
    distance = float(np.linalg.norm(estimate.T_lidar_target[:3, 3]))
    pose = 2.0 * float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[3:, 3:])[-1]))
    sampling = distance * (0.5 * sweep.resolution.step + sweep.resolution.beam)
    return sampling + sweep.resolution.range_noise + min(pose, 0.1 * float(estimate.target.offsets.min()))


def returns_of(sweep: Sweep, estimate: PoseEstimate, margin: float) -> Ints:
    """(N,) rows of the sweep that are a target's returns: in its plane, inside its outline or `margin` outside.

    A ring whose rays nearly all pass through there is none of the target's: what returns on it is its stand's pole.
    """
    rows, yz, behind = _rays_near(sweep, estimate, estimate.target.circumradius + margin)
    band, within = _band(sweep, estimate), estimate.target.contains(yz, margin)
    on, through = within & (np.abs(behind) <= band), within & (behind > band)
    n_rings = len(sweep.elevations)
    count_on, count_through = (np.bincount(sweep.ring[rows[which]], minlength=n_rings) for which in (on, through))
    pierced = count_through >= np.maximum(PIERCED_LEAST, PIERCED_SHARE * count_on)
    return np.asarray(rows[on & ~pierced[sweep.ring[rows]]])


def undoubted(sweep: Sweep, estimate: PoseEstimate, rows: Ints) -> Bools:
    """(N,) which of a target's returns (N,) are its own whoever looks: well inside its outline, and close to its plane.

    A return from the rim may owe part of its light to what is behind, and the outline's place has an error; so inside
    is more than a standard deviation of the position within it. Close to the plane are all but the outermost 5 %.
    """
    T = estimate.T_target_lidar
    points = sweep.points[rows]
    normal, distance = estimate.plane[:3], -estimate.plane[3]
    on_plane = points * (distance / (points @ normal))[:, None]
    yz = (on_plane @ T[:3, :3].T + T[:3, 3])[:, 1:]
    error = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[4:, 4:])[-1]))
    inset = min(error, 0.1 * float(estimate.target.offsets.min()))
    behind = points @ normal - distance
    return np.asarray(estimate.target.contains(yz, -inset) & (np.abs(behind) <= CENTRAL * estimate.plane_rms))


def judge(sweep: Sweep, connected: Ints, own: Ints, estimate: PoseEstimate, margin: float) -> Evidence:
    """Weigh what speaks for a target at a pose.

    Args:
        sweep: the scan.
        connected: (N,) rows of the sweep, the connected returns in the target's plane.
        own: (M,) rows of the sweep, the target's returns.
        estimate: the pose.
        margin: metres about the outline within which a ray may be on either side.
    """
    target = estimate.target
    slack = 2.0 * margin / float(target.offsets.min())
    outer = 1.0 + slack + RIM
    rows, yz, behind = _rays_near(sweep, estimate, outer * target.circumradius)
    gauge = (yz @ (target.normals / target.offsets[:, None]).T).max(axis=1)
    band = _band(sweep, estimate)
    inside, beside = gauge < 1.0 - slack, (gauge > 1.0 + slack) & (gauge < outer)
    on, through, before = np.abs(behind) <= band, behind > band, behind < -band

    reference = float(np.arctan2(*estimate.T_lidar_target[[1, 0], 3]))

    def rays(scale: float) -> float:
        vertices = (scale * target.vertices) @ estimate.T_lidar_target[:3, :3].T + estimate.T_lidar_target[:3, 3]
        right, left = chords(vertices[None], sweep.elevations, reference)
        return float(np.maximum(left - right, 0.0).sum() / sweep.resolution.step)

    expected_inside = max(rays(max(1.0 - slack, 0.0)) - (inside & before).sum(), 1.0)
    expected_beside = max(rays(outer) - rays(1.0 + slack), 1.0)
    within = np.isin(connected, rows[gauge <= 1.0 + slack])
    n_on = float((inside & on).sum())
    return Evidence(
        contained=float(within.mean()),
        covered=min(n_on / float(expected_inside), 1.0),
        edged=_edged(sweep, estimate),
        solid=n_on / max(n_on + float((inside & through).sum()), 1.0),
        free=max(1.0 - float((beside & (on | before)).sum() / expected_beside), 0.0),
        stepped=float(borders(sweep, own).open.mean()),
    )


def objection(evidence: Evidence) -> str:
    """Say what speaks against a target; empty: nothing does."""
    if evidence.contained < MIN_CONTAINED:
        return f"{1 - evidence.contained:.0%} of the connected returns lie outside its outline"
    if evidence.covered < MIN_COVERED:
        return f"only {evidence.covered:.0%} of the rays that should meet it return from its plane"
    if evidence.edged < MIN_EDGED:
        return f"only {evidence.edged:.0%} of the ends of its rings lie on its outline"
    if evidence.solid < MIN_SOLID:
        return f"{1 - evidence.solid:.0%} of the returns inside its outline come from behind it"
    if evidence.free < MIN_FREE:
        return f"{1 - evidence.free:.0%} of the rays beside it return from its plane or from before it"
    if evidence.stepped < MIN_STEPPED:
        return not_stepped(evidence.stepped)
    return ""


def not_stepped(share: float) -> str:
    """Say that too few rings end in a jump of the range."""
    return f"only at {share:.0%} of the ends of its rings does the range jump back"


def _band(sweep: Sweep, estimate: PoseEstimate) -> float:
    centre, normal = estimate.T_lidar_target[:3, 3], estimate.T_lidar_target[:3, 0]
    return sweep.resolution.band(float(normal @ centre / np.linalg.norm(centre)))


def _edged(sweep: Sweep, estimate: PoseEstimate) -> float:
    """Share of ring ends that lie where the outline's are expected: within two standard deviations.

    A ring's last return lies up to a step inside the outline, uniformly; how much of a beam must hit shifts all of
    them by up to half a beam, the one that suits them best, and each by as much again.
    """
    target, edges, T = estimate.target, estimate.edge_points, estimate.T_target_lidar
    yz = (edges.points @ T[:3, :3].T + T[:3, 3])[:, 1:]
    outward = (edges.outward(estimate.plane[:3]) @ T[:3, :3].T)[:, 1:]
    distance = np.linalg.norm(edges.points, axis=1)
    last_hit = target.outside_distance(yz)
    first_miss = target.outside_distance(yz + edges.azimuth_step * outward)
    boundary = 0.5 * (last_hit + first_miss)
    beam, floor = sweep.resolution.beam, sweep.resolution.range_noise
    most = beam + floor / distance.mean()
    shifts = np.linspace(-most, most, 11)[:, None] * distance
    variance = (first_miss - last_hit) ** 2 / 12 + (beam * distance) ** 2 / 3 + (0.5 * floor) ** 2
    return float(((boundary - shifts) ** 2 < 4.0 * variance).mean(axis=1).max())


def _rays_near(sweep: Sweep, estimate: PoseEstimate, radius: float) -> tuple[Ints, Floats, Floats]:
    """Rays that pass within `radius` of a target's origin in its plane.

    Returns:
        Rows of the sweep (N,), where their rays meet the plane (N, 2), target frame, and how far behind the plane they
        returned (N,), metres across it, negative in front.
    """
    T = estimate.T_lidar_target
    centre, normal = T[:3, 3], T[:3, 0]
    away = float(np.linalg.norm(centre))
    cosine = np.sqrt(max(1.0 - (radius / away) ** 2, 0.0))
    near = np.flatnonzero(sweep.points @ centre >= cosine * away * sweep.range)
    points = sweep.points[near]
    along = points @ normal
    ahead = along > 1e-3 * sweep.range[near]
    near, points, along = near[ahead], points[ahead], along[ahead]
    distance = float(normal @ centre)
    yz = ((points * (distance / along)[:, None] - centre) @ T[:3, :3])[:, 1:]
    close = (yz**2).sum(axis=1) < radius**2
    return near[close], yz[close], (along - distance)[close]
