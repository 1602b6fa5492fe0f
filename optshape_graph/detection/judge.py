"""Judge a pose by every ray near it: on the target, behind it, in front of it, beside it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from scipy.special import chdtrc, expit

from optshape_graph._arrays import Bools, Floats, Ints
from optshape_graph.detection.candidates import Candidate
from optshape_graph.detection.outline import OutlineFit
from optshape_graph.detection.rays import Rays, fired_near, returned_near
from optshape_graph.detection.results import Evidence
from optshape_graph.detection.segments import Borders, OrderedScan
from optshape_graph.pose import PoseEstimate
from optshape_graph.se3 import apply, cross
from optshape_graph.target import Target

_ALIKE = 14.0  # log odds given to a rectangular target, which cannot differ from rectangles of nearly its size
_CENTRAL = 1.96  # standard deviations about the plane within which 95 % of the returns lie
_IN_PLANE = np.ix_([0, 4, 5], [0, 4, 5])  # rotation about the normal, y and z
_BY_CHANCE = 1e-3  # probability of ring ends as far off an outline as seen, above which it counts as theirs


def edge_margin(scan: OrderedScan, target: Target, T_lidar_target: Floats, pose_sd: float) -> float:
    """Return how far outside the outline a return of the target may lie, metres: half a beam, noise, the pose's error.

    The margin is at most a tenth of the target, since a pose that is not determined would allow any.

    Args:
        scan: the ordered scan.
        target: the template.
        T_lidar_target: (4, 4).
        pose_sd: standard deviation of the outline's place, metres.
    """
    distance = float(np.linalg.norm(T_lidar_target[:3, 3]))
    sampling = distance * (0.5 * scan.resolution.step + scan.resolution.beam)
    return sampling + scan.resolution.range_noise + min(2.0 * pose_sd, 0.1 * float(target.offsets.min()))


def outline_error(estimate: PoseEstimate) -> float:
    """Return the largest standard deviation of the outline's place among the rays, metres.

    An error of the plane moves outline and returns along the same rays, so the plane counts as exact.
    """
    given = np.linalg.inv(np.linalg.inv(estimate.covariance)[_IN_PLANE])
    return float(np.sqrt(np.linalg.eigvalsh(given[1:, 1:])[-1]))


def returns_of(scan: OrderedScan, target: Target, T_lidar_target: Floats, margin: float) -> Ints:
    """Return the rows (N,) of a target's returns: in its plane, inside its outline or at most `margin` outside.

    If nearly all rays of a ring pass through the target's place, its returns there are not of the target but of a pole.
    Rays within the margin may pass beside the target, as most do at a sharp tip; they count only if the returns are in
    the margin, too.
    """
    rays = returned_near(scan, T_lidar_target, target.circumradius + margin)
    band = scan.band(T_lidar_target[:3, 0], T_lidar_target[:3, 3])
    outside, behind, ring = target.outside_distance(rays.crossing), rays.points[:, 0], scan.ring[rays.rows]
    within, inside = outside <= margin, outside <= 0.0
    on, through = within & (np.abs(behind) <= band), within & (behind > band)

    def by_ring(which: Bools) -> Ints:
        return np.bincount(ring[which], minlength=len(scan.elevations))

    beside = 2 * by_ring(on & inside) < by_ring(on)
    count_through = np.where(beside, by_ring(through), by_ring(through & inside))
    pierced = count_through >= np.maximum(scan.options.pierced_rays, scan.options.pierced_share * by_ring(on))
    return np.asarray(rays.rows[on & ~pierced[ring]])


def undoubted(scan: OrderedScan, estimate: PoseEstimate, rows: Ints) -> Bools:
    """Return (N,) which of a target's returns (N,) are certain: well inside its outline, and close to its plane.

    Part of the light of a return from the rim may come from behind, and the outline's place has an error; so a return
    must be more than a standard deviation of the position inside. All but the outermost 5 % are close to the plane.
    """
    yz, behind = _met(scan, estimate, rows)
    inset = min(outline_error(estimate), 0.1 * float(estimate.target.offsets.min()))
    return np.asarray(estimate.target.contains(yz, -inset) & (np.abs(behind) <= _CENTRAL * estimate.plane_rms))


def _met(scan: OrderedScan, estimate: PoseEstimate, rows: Ints) -> tuple[Floats, Floats]:
    """Return where the rays of returns (N,) meet the target's plane, (N, 2), and how far behind it they end, metres."""
    points = scan.points[rows]
    normal, distance = estimate.plane[:3], -estimate.plane[3]
    along = points @ normal
    return apply(estimate.T_target_lidar, points * (distance / along)[:, None])[:, 1:], along - distance


def _bounded(scan: OrderedScan, candidate: Candidate, estimate: PoseEstimate, margin: float) -> float:
    """Return the share of `Evidence.bounded`.

    An end is beyond the outline if the last two returns of its ring are, since the last alone may be mixed. One end
    alone is a stray. Where the ends on the outline fit it up to chance, what goes on beyond is of a stand or of a hand;
    another shape, cut to this one, leaves ends that miss it, too.

    Args:
        scan: the ordered scan.
        candidate: the surface.
        estimate: the pose.
        margin: distance from the outline, metres, within which a return may be the target's.
    """
    fit = estimate.fit
    if chdtrc(max(fit.edge_freedom, 1), fit.edge_chi_square) > _BY_CHANCE:
        return 1.0
    inward = np.repeat([1, -1], len(candidate.ends) // 2)
    before = (candidate.ends + inward).clip(0, len(scan) - 1)
    last_two = np.concatenate([candidate.ends, before])
    beyond = estimate.target.outside_distance(_met(scan, estimate, last_two)[0]) > margin
    beyond &= np.isin(last_two, candidate.rows)
    count = int(beyond.reshape(2, -1).all(axis=0).sum())
    return 1.0 - count / len(candidate.ends) if count > 1 else 1.0


def judge(
    scan: OrderedScan,
    candidate: Candidate,
    borders: Borders,
    look: OutlineFit,
    rectangle: float,
    estimate: PoseEstimate,
    margin: float,
) -> Evidence:
    """Return the evidence for a target at a pose.

    Args:
        scan: the ordered scan.
        candidate: the surface.
        borders: the ring ends of the target's returns.
        look: its outline laid over them.
        rectangle: log odds of a rectangle laid over them; see `rectangle_log_odds`.
        estimate: the pose.
        margin: distance from the outline, metres, within which a ray may be on either side.
    """
    target = estimate.target
    slack = 2.0 * margin / float(target.offsets.min())
    outer = 1.0 + slack + scan.options.rim
    rays = returned_near(scan, estimate.T_lidar_target, outer * target.circumradius)
    fired = fired_near(scan, estimate.T_lidar_target, outer * target.circumradius)
    band = scan.band(estimate.plane[:3], estimate.T_lidar_target[:3, 3])
    behind = rays.points[:, 0]
    on, through, before = np.abs(behind) <= band, behind > band, behind < -band

    def regions(crossing: Floats) -> tuple[Bools, Bools, Bools]:
        """Return which rays are inside the outline, which beside it, and which are either or on its rim."""
        gauge = ((target.normals / target.offsets[:, None]) @ crossing.T).max(axis=0)
        return gauge < 1.0 - slack, (gauge > 1.0 + slack) & (gauge < outer), gauge <= 1.0 + slack

    inside, beside, upto_rim = regions(rays.crossing)
    fired_inside, fired_beside, _ = regions(fired)
    expected = max(float(fired_inside.sum() - (inside & before).sum()), 1.0)
    n_on = float((inside & on).sum())
    contained = np.zeros(len(scan), dtype=bool)
    contained[rays.rows[upto_rim]] = True
    against_rectangle = look.log_odds - rectangle + (_ALIKE if _is_rectangle(target) else 0.0)
    apart, seen = _beyond_sides(scan, estimate, rays, fired, band)
    return Evidence(
        contained=float(contained[candidate.rows].mean()),
        bounded=_bounded(scan, candidate, estimate, margin + max(look.shift, 0.0)),
        covered=min(n_on / expected, 1.0),
        edged=look.edged,
        solid=n_on / max(n_on + float((inside & through).sum()), 1.0),
        free=max(1.0 - float((beside & (on | before)).sum()) / max(float(fired_beside.sum()), 1.0), 0.0),
        stepped=float(borders.open.mean()),
        apart=apart,
        seen=seen,
        distinct=float(expit(min(look.log_odds, against_rectangle))),
    )


def objections(evidence: Evidence, least: Evidence) -> list[str]:
    """Return the reasons against a target that must reach the `least` shares, the largest shortfall first."""
    reasons = {
        "contained": f"{1 - evidence.contained:.0%} of the connected returns lie outside its outline",
        "bounded": f"the surface goes on beyond its outline at {1 - evidence.bounded:.0%} of the ends of its rings",
        "covered": f"only {evidence.covered:.0%} of the rays that should meet it return from its plane",
        "edged": f"only {evidence.edged:.0%} of the ends of its rings lie on its outline",
        "solid": f"{1 - evidence.solid:.0%} of the returns inside its outline come from behind it",
        "free": f"{1 - evidence.free:.0%} of the rays beside it return from its plane or from before it",
        "stepped": not_stepped(evidence.stepped),
        "apart": f"at one side {1 - evidence.apart:.0%} of the rays just beyond meet something that begins there",
        "seen": f"only {evidence.seen:.0%} of its outline has rays that pass just beyond it",
        "distinct": "its ring ends would fit a surface of another shape too",
    }
    reached = {
        field.name: getattr(evidence, field.name) / (getattr(least, field.name) or 1e-9) for field in fields(least)
    }
    return [reasons[name] for name in sorted(reasons, key=lambda name: reached[name]) if reached[name] < 1.0]


def not_stepped(share: float) -> str:
    """Return the reason that too few rings end in a jump of the range."""
    return f"only at {share:.0%} of the ends of its rings does the range jump back"


def _beyond_sides(
    scan: OrderedScan, estimate: PoseEstimate, rays: Rays, fired: Floats, band: float
) -> tuple[float, float]:
    """Return the shares of `Evidence.apart` and `Evidence.seen`.

    The first is the share, at the worst side, of the rays just beyond a side that do not meet something that begins at
    that side. The second is the share of the outline beyond which rays pass unhindered, at least half as densely as
    elsewhere.

    A ray that misses a side by q meets a surface through that side, such as the next face of a box, within
    q / cos(incidence) of it. Returns in the target's own plane, up to the noise, do not count. Objects behind a target
    are further away. In front of a target the floor may be seen at a grazing angle, so a wider strip is used there.
    """
    options, target, sensor = scan.options, estimate.target, estimate.T_target_lidar[:3, 3]
    start = target.polygon
    along = np.roll(start, -1, axis=0) - start
    length = np.linalg.norm(along, axis=1)
    density = max(float(target.contains(fired).sum()), 1.0) / target.area
    strip = np.maximum(options.side_strip, 2.0 * options.fewest_returns / (density * length)) + 2.0 * band
    rim = np.maximum(strip, options.rim * target.offsets.min())

    def passed(crossing: Floats, reach: Floats) -> tuple[Ints, Ints, Floats]:
        """Return the rays (M,) that pass a side within its reach (n,), metres, the side, and the distance from it."""
        beyond = target.normals @ crossing.T - target.offsets[:, None]
        outside = beyond.max(axis=0)
        rows = np.flatnonzero((outside > 0) & (outside < reach.max()))
        side, outside = beyond[:, rows].argmax(axis=0), outside[rows]
        within = outside < reach[side]
        return rows[within], side[within], outside[within]

    near, side, outside = passed(rays.crossing, rim)
    _, fired_side, fired_outside = passed(fired, rim)
    points = rays.points[near]
    behind = points[:, 0]
    # Distances across the side's line: of the return, and of the ray.
    of_return = np.hypot(behind, ((points[:, 1:] - start[side]) * target.normals[side]).sum(axis=1))
    line = np.column_stack([np.zeros(len(start)), along / length[:, None]])[side]
    normal = cross(points - sensor, line)
    to_line = np.column_stack([np.zeros(len(start)), start])[side] - sensor
    of_ray = np.abs((normal * to_line).sum(axis=1)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    slack = options.band_sigmas * scan.resolution.range_noise
    on = np.abs(behind) <= band

    def attached(reach: Floats, angle: float, farthest: float, off_plane: Bools) -> float:
        """Return, at the worst side, the share of the rays within `reach` (n,) beyond it whose surface begins there."""
        there = outside < reach[side]
        begins = there & off_plane & (of_return <= np.minimum(of_ray / np.cos(angle) + slack, farthest))
        beyond = fired_outside < reach[fired_side]
        of_side = [
            np.bincount(which, minlength=len(start)) for which in (fired_side[beyond], side[there & on], side[begins])
        ]
        expected = of_side[0] - of_side[1]
        told = expected >= options.fewest_returns
        return float((of_side[2][told] / expected[told]).max(initial=0.0))

    at_back = attached(strip, options.steepest, options.hung_before - band, behind > band)
    in_front = attached(rim, options.grazing, np.inf, behind < -band)
    stopped = (outside < strip[side]) & (behind < -band)
    there = fired_outside < strip[fired_side]
    count = np.bincount(fired_side[there], minlength=len(start)) - np.bincount(side[stopped], minlength=len(start))
    seen = np.clip(count / (0.5 * density * length * strip), 0.0, 1.0)
    return max(1.0 - max(at_back, in_front), 0.0), float(length @ seen / length.sum())


def _is_rectangle(target: Target) -> bool:
    corners = (target.normals * np.roll(target.normals, 1, axis=0)).sum(axis=1)
    return len(target) == 4 and bool((np.abs(corners) < 0.02).all())
