"""Judge a pose by every ray near it: on the target, behind it, in front of it, beside it."""

from __future__ import annotations

import numpy as np

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.detection.results import Evidence
from optshape_graph.detection.segments import OrderedScan, find_borders
from optshape_graph.pose import PoseEstimate
from optshape_graph.pose.likelihood import chords
from optshape_graph.se3 import apply

_CENTRAL = 1.96  # standard deviations about the plane within which 95 % of the returns lie


def edge_margin(scan: OrderedScan, estimate: PoseEstimate) -> float:
    """Return how far outside the outline a return of the target may lie, metres: half a beam, noise, the pose's error.

    A pose that is not determined would allow anything; a tenth of the target is enough.
    """
    distance = float(np.linalg.norm(estimate.T_lidar_target[:3, 3]))
    pose = 2.0 * float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[3:, 3:])[-1]))
    sampling = distance * (0.5 * scan.resolution.step + scan.resolution.beam)
    return sampling + scan.resolution.range_noise + min(pose, 0.1 * float(estimate.target.offsets.min()))


def returns_of(scan: OrderedScan, estimate: PoseEstimate, margin: float) -> Ints:
    """Return the rows (N,) of a target's returns: in its plane, inside its outline or at most `margin` outside.

    A ring whose rays nearly all pass through the target's place does not meet it: what returns there is a pole.
    """
    rows, yz, behind = _rays_near(scan, estimate, estimate.target.circumradius + margin)
    band = scan.band(estimate.plane[:3], estimate.T_lidar_target[:3, 3])
    within = estimate.target.contains(yz, margin)
    on, through = within & (np.abs(behind) <= band), within & (behind > band)
    n_rings = len(scan.elevations)
    count_on, count_through = (np.bincount(scan.ring[rows[which]], minlength=n_rings) for which in (on, through))
    pierced = count_through >= np.maximum(scan.options.pierced_rays, scan.options.pierced_share * count_on)
    return np.asarray(rows[on & ~pierced[scan.ring[rows]]])


def undoubted(scan: OrderedScan, estimate: PoseEstimate, rows: Ints) -> Bools:
    """(N,) which of a target's returns (N,) are its own beyond doubt: well inside its outline, and close to its plane.

    A return from the rim may owe part of its light to what is behind, and the outline's place has an error; so inside
    is more than a standard deviation of the position within it. Close to the plane are all but the outermost 5 %.
    """
    T = estimate.T_target_lidar
    points = scan.points[rows]
    normal, distance = estimate.plane[:3], -estimate.plane[3]
    on_plane = points * (distance / (points @ normal))[:, None]
    yz = apply(T, on_plane)[:, 1:]
    error = float(np.sqrt(np.linalg.eigvalsh(estimate.covariance[4:, 4:])[-1]))
    inset = min(error, 0.1 * float(estimate.target.offsets.min()))
    behind = points @ normal - distance
    return np.asarray(estimate.target.contains(yz, -inset) & (np.abs(behind) <= _CENTRAL * estimate.plane_rms))


def judge(scan: OrderedScan, connected: Ints, own: Ints, estimate: PoseEstimate, margin: float) -> Evidence:
    """Weigh what speaks for a target at a pose.

    Args:
        scan: the ordered scan.
        connected: (N,) rows of the ordered scan, the connected returns in the target's plane.
        own: (M,) rows of the ordered scan, the target's returns.
        estimate: the pose.
        margin: metres about the outline within which a ray may be on either side.
    """
    target = estimate.target
    slack = 2.0 * margin / float(target.offsets.min())
    outer = 1.0 + slack + scan.options.rim
    rows, yz, behind = _rays_near(scan, estimate, outer * target.circumradius)
    gauge = (yz @ (target.normals / target.offsets[:, None]).T).max(axis=1)
    band = scan.band(estimate.plane[:3], estimate.T_lidar_target[:3, 3])
    inside, beside = gauge < 1.0 - slack, (gauge > 1.0 + slack) & (gauge < outer)
    on, through, before = np.abs(behind) <= band, behind > band, behind < -band

    reference = float(np.arctan2(*estimate.T_lidar_target[[1, 0], 3]))

    def rays(scale: float) -> float:
        vertices = apply(estimate.T_lidar_target, scale * target.vertices)
        right, left = chords(vertices[None], scan.elevations, reference)
        return float(np.maximum(left - right, 0.0).sum() / scan.resolution.step)

    expected_inside = max(rays(max(1.0 - slack, 0.0)) - (inside & before).sum(), 1.0)
    expected_beside = max(rays(outer) - rays(1.0 + slack), 1.0)
    within = np.isin(connected, rows[gauge <= 1.0 + slack])
    n_on = float((inside & on).sum())
    return Evidence(
        contained=float(within.mean()),
        covered=min(n_on / float(expected_inside), 1.0),
        edged=_edged(scan, estimate),
        solid=n_on / max(n_on + float((inside & through).sum()), 1.0),
        free=max(1.0 - float((beside & (on | before)).sum() / expected_beside), 0.0),
        stepped=float(find_borders(scan, own).open.mean()),
    )


def objection(evidence: Evidence, least: Evidence) -> str:
    """Say what speaks against a target that must reach the `least` shares; empty: nothing does."""
    if evidence.contained < least.contained:
        return f"{1 - evidence.contained:.0%} of the connected returns lie outside its outline"
    if evidence.covered < least.covered:
        return f"only {evidence.covered:.0%} of the rays that should meet it return from its plane"
    if evidence.edged < least.edged:
        return f"only {evidence.edged:.0%} of the ends of its rings lie on its outline"
    if evidence.solid < least.solid:
        return f"{1 - evidence.solid:.0%} of the returns inside its outline come from behind it"
    if evidence.free < least.free:
        return f"{1 - evidence.free:.0%} of the rays beside it return from its plane or from before it"
    if evidence.stepped < least.stepped:
        return not_stepped(evidence.stepped)
    return ""


def not_stepped(share: float) -> str:
    """Say that too few rings end in a jump of the range."""
    return f"only at {share:.0%} of the ends of its rings does the range jump back"


def _edged(scan: OrderedScan, estimate: PoseEstimate) -> float:
    """Share of ring ends that lie where the outline's are expected: within two standard deviations.

    A ring's last return lies up to a step inside the outline, uniformly; how much of a beam must hit shifts all of
    them by up to half a beam, the one that suits them best, and each by as much again.
    """
    target, edges, T = estimate.target, estimate.edge_points, estimate.T_target_lidar
    yz = apply(T, edges.points)[:, 1:]
    outward = (edges.outward(estimate.plane[:3]) @ T[:3, :3].T)[:, 1:]
    distance = np.linalg.norm(edges.points, axis=1)
    last_hit = target.outside_distance(yz)
    first_miss = target.outside_distance(yz + edges.azimuth_step * outward)
    boundary = 0.5 * (last_hit + first_miss)
    beam, floor = scan.resolution.beam, scan.resolution.range_noise
    most = beam + floor / distance.mean()
    shifts = np.linspace(-most, most, 11)[:, None] * distance
    variance = (first_miss - last_hit) ** 2 / 12 + (beam * distance) ** 2 / 3 + (0.5 * floor) ** 2
    return float(((boundary - shifts) ** 2 < 4.0 * variance).mean(axis=1).max())


def _rays_near(scan: OrderedScan, estimate: PoseEstimate, radius: float) -> tuple[Ints, Floats, Floats]:
    """Rays that pass within `radius` of a target's origin in its plane.

    Returns:
        Rows of the ordered scan (N,), where their rays meet the plane (N, 2), target frame, and how far behind the
        plane they returned (N,), metres across it, negative in front.
    """
    T = estimate.T_lidar_target
    centre, normal = T[:3, 3], T[:3, 0]
    away = float(np.linalg.norm(centre))
    cosine = np.sqrt(max(1.0 - (radius / away) ** 2, 0.0))
    near = np.flatnonzero(scan.points @ centre >= cosine * away * scan.range)
    points = scan.points[near]
    along = points @ normal
    ahead = along > 1e-3 * scan.range[near]
    near, points, along = near[ahead], points[ahead], along[ahead]
    distance = float(normal @ centre)
    yz = ((points * (distance / along)[:, None] - centre) @ T[:3, :3])[:, 1:]
    close = (yz**2).sum(axis=1) < radius**2
    return near[close], yz[close], (along - distance)[close]
