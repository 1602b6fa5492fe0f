"""How well the returns fit the model, what was widened for it, and what else might explain them.

A wrong model gives a precise wrong pose. Where the size of an error is seen and its direction isn't (noise, ring
biases, a surface, ring ends that scatter), the covariance is widened, and the fit says by how much. Where another world
explains the returns better (a raised frame, two revolutions, a cut field of view), the pose is doubtful, and the fit
says which. Each limit stands beside its test: below it a pose that was widened still holds, and recordings of flat
boards by sensors that are described by their files stay below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.pose.evidence import PLANE, Coverage, Evidence, Finding, PlaneResiduals, Surface, coverages

RIM = 0.06
"""Width of a frame, metres: those of boards and panels are 3 to 8 cm wide."""


@dataclass(frozen=True, eq=False, repr=False)
class Flag(Value):
    """Something that the model doesn't explain.

    Attributes:
        kind: one word or two, such as "surface".
        excess: how many times its limit it is.
        reason: what was seen, with its number, and the likeliest cause.
    """

    kind: str
    excess: float
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Fit(Value):
    """How well the returns fit.

    Attributes:
        noise: standard deviation of ranges within rings that was used, metres: the scan's, or the file's if larger.
        ring_bias: standard deviation of rings' biases that was used, metres, likewise.
        noise_factor: it over the sensor file's.
        bias_factor: it over the sensor file's.
        edge_factor: what the standard deviations of ring ends were multiplied by.
        plane_chi_square: of the returns' distances from the plane, whitened by the noise that was used.
        plane_freedom: degrees of freedom of these.
        edge_chi_square: of the ring ends.
        edge_freedom: degrees of freedom of these.
        surface: shape in the distances from the plane; its size widened the pose.
        farthest_outside: of the returns, in beam widths beyond the outline.
        share_outside: of the returns, more than a beam width beyond the outline.
        missing_left: firings beyond the left ends of rings, inside the outline, that returned nothing.
        missing_right: the same on the right.
        missing_inside: between returns of a ring.
        missing_rings: rings above and below that should have returned.
        expected_returns: that the outline should have.
        ring_tilt: rms variation of elevations with azimuth within rings, rad: 0 in the sensor's own frame.
        duplicates: exact copies of returns that were dropped.
        flags: what makes the pose doubtful, the largest excess first.
        warnings: what was seen, widened for, and is unusual.
    """

    noise: float
    ring_bias: float
    noise_factor: float
    bias_factor: float
    edge_factor: float
    plane_chi_square: float
    plane_freedom: int
    edge_chi_square: float
    edge_freedom: int
    surface: Surface
    farthest_outside: float
    share_outside: float
    missing_left: float
    missing_right: float
    missing_inside: float
    missing_rings: int
    expected_returns: float | None
    ring_tilt: float | None
    duplicates: int
    flags: tuple[Flag, ...]
    warnings: tuple[str, ...]

    @property
    def summary(self) -> str:
        """The worst of `flags` in a word or two; where there is none, chi-square per degree of freedom."""
        if self.flags:
            return self.flags[0].kind
        parts = [(self.plane_chi_square, self.plane_freedom), (self.edge_chi_square, self.edge_freedom)]
        return " / ".join(f"{square / freedom:.1f}" for square, freedom in parts if freedom)

    @property
    def reason(self) -> str:
        """Why the pose is doubtful, the worst first; empty where it isn't."""
        return "; ".join(flag.reason for flag in self.flags)

    def to_dict(self) -> dict[str, Any]:
        """Return what `optshape/estimate` files hold under `fit`."""
        plain = {name: value for name, value in vars(self).items() if name not in ("surface", "flags", "warnings")}
        plain["summary"] = self.summary
        surface = {"shape": self.surface.shape, "rms_m": self.surface.size, "probability": self.surface.probability}
        flags = [vars(flag) for flag in self.flags]
        return {**plain, "surface": surface, "flags": flags, "warnings": list(self.warnings)}


def plane_flags(evidence: Evidence, rim_step: float, rim_chance: float) -> list[Flag]:
    """Ask the distances from the plane.

    Args:
        evidence: what the fit is judged by.
        rim_step: how far the rim stands behind the rest, metres.
        rim_chance: probability of so much.
    """
    r, s, two, (before, by) = evidence.residuals, evidence.surface, evidence.sheets, evidence.in_front
    tilt = np.degrees(2 * s.size / evidence.problem.target.gyration)
    off = float(np.mean(~r.usual))
    ends = np.zeros(1)
    if evidence.scan.ring is not None:
        ends = np.abs(r.rest[np.column_stack([r.rings.first, r.rings.last])]).ravel()
    scale = max(1.0, float(r.noise[0]) / 0.01)
    far, near = ends > 0.06 * scale, ends > 0.03 * scale
    mean = float(np.minimum(ends, 0.06 * scale).mean())
    return [
        Flag("surface", tilt / TILT_DEG * (s.probability < 1e-6),
             f"the returns lie on a {s.shape} of {1e3 * s.size:.0f} mm rms, which leaves {tilt:.1f} deg of tilt open: "
             "a target that isn't flat"),
        Flag("raised frame", abs(rim_step) / RIM_STEP * (rim_chance < 10**-6.5),
             f"returns within {100 * RIM:.0f} cm of the rim stand {1e3 * abs(rim_step):.0f} mm "
             f"{'in front' if rim_step < 0 else 'behind'}: a raised frame"),
        Flag("mixed ends", max(far.mean() / 0.07, near.mean() / 0.20, mean / scale / 0.020) * (near.sum() > 3),
             f"{near.mean():.0%} of the ring ends lie more than {3 * scale:.0f} cm off their ring: mixed with the "
             "background, or a frame"),
        Flag("off the plane", off / OFF_PLANE,
             f"{off:.0%} of the returns lie off the plane: something else is among them"),
        Flag("in front", min(before / 1.5, before / len(r.e) / IN_FRONT),
             f"{before} neighbouring returns stand {100 * by:.0f} cm in front of the plane: a hand or a bracket hides "
             "a part of the target"),
        Flag("two sheets", max(min(two.correlation / -0.25, two.score / -6.0),
                               two.apart / SHEETS_APART * (two.probability < 1e-8)),
             f"returns lie in two sheets{f' {2e3 * two.apart:.0f} mm apart' if two.apart else ''}: revolutions merged "
             "while something moved"),
    ]  # fmt: skip


TILT_DEG = 3.5
"""Tilt, deg, that a surface may leave open, as a standard deviation. The widening still holds at twice that; a pose
that may be tilted by more is not what a user of "ok" expects. A board held in the hands leaves 2.5."""

RIM_STEP = 0.012
"""Step of the rim, metres: twice what a white border or a batten makes in recordings."""

OFF_PLANE = 0.1
"""Share of returns off the plane. In recordings 0.3 % are."""

IN_FRONT = 0.006
"""Share of returns in front, in pairs. Of 41 recorded boards one has 0.45 %, by steps of 35 mm within its rings; the
others have 0.1 % at most, and 275 clean scans none. Single ones are mixed returns and strays."""

SHEETS_APART = 2.5e-3
"""Rms of the distance of two revolutions from their mean, metres: range steps of real sensors are 2 to 4 mm."""


CUT_SHORT = 3.0
"""Standard deviations. Of 890 clean scans none has more. A square whose edge runs with a column of 128 rings has in one
scan of six, but not by half of the ends."""

STRAIGHT = 0.015
"""How straight and true the edges of real boards are, metres: where rings are close, a bent edge looks like a cut."""


def cut_short(azimuth: Floats, z: Floats, step: float) -> float:
    """Return how far ends at the outermost azimuth lie inside the outline together, in standard deviations.

    Where a view is cut, the fit trades the ends of some rings for the others: two or more, and half of those in one
    column of firings, the last that there is, lie short of their edges. One alone may be an odd end; and along an edge
    that runs with a column many end there, a few of them short by chance.

    Args:
        azimuth: (R,) of the rings' ends on one side, growing outwards, rad.
        z: (R,) their residuals in standard deviations, positive outside.
        step: azimuth between two firings, rad.
    """
    last = z[azimuth > azimuth.max() - 1.3 * step]
    short = last[last < -1.5]
    return float(np.linalg.norm(short)) if len(short) >= max(2, len(last) / 2) else 0.0


def ring_flags(found: Finding, cover: Coverage, outside: Floats) -> list[Flag]:
    """Ask ring ends, firings that are missing, and returns outside, by how many beam widths they are (N,)."""
    ends, edges = found.ends, found.evidence.problem.edges
    assert ends is not None
    chi, beyond, run = ends.clipped_mean_square, ends.share_beyond, ends.longest_run
    missing, side = max((cover.missing_left, "left"), (cover.missing_right, "right"))
    share = missing / max(cover.expected, 1.0)
    count = int(np.count_nonzero(outside > 1.0))
    of_all = count / len(outside)
    tilt, chance = found.evidence.tilt or (0.0, 1.0)
    further = float(np.hypot(ends.offset, ends.blooming))  # most of the one where the other has no room
    z, left, right = ends.z * ends.sd / np.hypot(ends.sd, STRAIGHT), edges.azimuth[0::2], -edges.azimuth[1::2]
    short, short_side = max((cut_short(left, z[0::2], edges.azimuth_step), "left"),
                            (cut_short(right, z[1::2], edges.azimuth_step), "right"))  # fmt: skip
    larger, smaller = (further / 4.4, 0.0) if ends.blooming > ends.offset else (0.0, further / 3.2)
    return [
        Flag("edges", max(chi / 3.2 * (ends.probability < 1e-6), beyond / 0.25),
             f"ring ends miss the edges by {np.sqrt(chi):.1f} standard deviations, {beyond:.0%} by more than 3: "
             "another shape, a moving sensor, or mixed returns"),
        Flag("strain", ends.strain / 0.015 * (ends.strain_probability < 10**-4.3),
             f"the outline is stretched by {ends.strain:.1%}: a moving sensor, or a board that isn't as drawn"),
        Flag("size", max(larger, smaller),
             f"the outline is {'larger' if larger else 'smaller'} than the drawing by {further:.1f} standard "
             "deviations of what a beam's width allows: another size, or a board that blooms"),
        Flag("run of ends", run / 2.9,
             "neighbouring ring ends all lie on one side of their edge: a part is hidden, or the shape is another"),
        Flag("cut", (cover.cut + 1) / 5.5,
             f"{cover.cut} rings end at one azimuth inside the outline: the view is cut there"),
        Flag("cut short", short / CUT_SHORT,
             f"rings that reach furthest {short_side} end at one azimuth, {short:.1f} standard deviations together "
             "short of their edges: the view is cut there"),
        Flag("missing side", min(share / 0.04, missing / 6),
             f"{missing:.0f} firings on the {side} returned nothing though the outline is there: the view is cut"),
        Flag("missing rings", (cover.missing_rings + 1) / 2.5,
             f"{cover.missing_rings} rings beyond those with returns should have hit: the view is cut, or hidden"),
        Flag("outside", min(of_all / 0.035, count / 4),
             f"{of_all:.0%} of the returns lie outside the outline by more than a beam: not all are this target's"),
        Flag("frame", tilt / 3e-4 * (chance < 1e-6),
             f"elevations vary by {np.degrees(tilt):.2f} deg within rings: points not in the sensor's own frame"),
    ]  # fmt: skip


def measure_fit(findings: Sequence[Finding]) -> list[Fit]:
    """Say how well the returns of B scans fit the poses that were found."""
    if not findings:
        return []
    residuals = PlaneResiduals.side_by_side([found.evidence.residuals for found in findings])
    further = [max(found.ends.blooming, 0.0) * found.evidence.problem.beam.blooming if found.ends else 0.0
               for found in findings]  # fmt: skip
    outside = [
        found.evidence.outside(found.measurement.T_target_lidar, more)
        for found, more in zip(findings, further, strict=True)
    ]
    place = np.arange(len(residuals.e)) - residuals.rings.each(residuals.rings.first)
    inner = (place > 1) & (place < residuals.rings.each(residuals.rings.counts) - 2)
    steps, chances = residuals.rim_step(np.concatenate([metres for metres, _ in outside]) > -RIM, inner)
    plane = residuals.beyond(PLANE, np.zeros((len(residuals.e), 0)))
    square, freedom = plane.gram[:, -1, -1] / residuals.noise**2, plane.freedom.astype(int)
    covers = _covers(findings, further)
    return [
        _fit_of(found, covers[k], beams, plane_flags(found.evidence, steps[k], chances[k]), square[k], freedom[k])
        for k, (found, (_, beams)) in enumerate(zip(findings, outside, strict=True))
    ]


def _covers(findings: Sequence[Finding], further: Sequence[float]) -> list[Coverage | None]:
    """Return the coverage of each scan with rings, those of targets with as many edges at once; None without."""
    covers: list[Coverage | None] = [None] * len(findings)
    sizes = [len(found.evidence.problem.target) if found.ends else 0 for found in findings]
    for size in set(sizes) - {0}:
        chosen = [k for k, other in enumerate(sizes) if other == size]
        T = np.array([findings[k].measurement.T_target_lidar for k in chosen])
        some = coverages([findings[k].evidence for k in chosen], T, np.array([further[k] for k in chosen]))
        for k, cover in zip(chosen, some, strict=True):
            covers[k] = cover
    return covers


def _fit_of(
    found: Finding, cover: Coverage | None, outside: Floats, flags: list[Flag], square: float, freedom: int
) -> Fit:
    """Put together the fit of one scan.

    Args:
        found: what was found in it.
        cover: where returns are lacking; None without rings.
        outside: (N,) how many beam widths the returns lie outside.
        flags: of the distances from the plane.
        square: chi-square of these.
        freedom: their degrees of freedom.
    """
    evidence, ends = found.evidence, found.ends
    r, normal = evidence.residuals, found.measurement.T_target_lidar[0, :3]
    cosine = float(np.mean(np.abs(evidence.scan.points @ normal) / evidence.ranges))
    if ends is not None and cover is not None:
        flags = [*flags, *ring_flags(found, cover, outside)]
    else:
        turned = Flag("mirrored", found.mirrored / evidence.problem.options.ambiguity_margin,
                      f"the mirror image of the target fits better (log likelihood {found.mirrored:.1f}): it is hung "
                      "back to front")  # fmt: skip
        flags = [*flags, turned]
    noise, bias = float(r.noise[0]), float(r.bias[0])
    noise_factor, bias_factor = noise / float(r.file_noise[0]), bias / float(r.file_bias[0])
    warnings = [
        f"{what} is {factor:.1f} times the sensor file's"
        for what, factor, limit in (("range noise", noise_factor, 2.8), ("ring bias", bias_factor, 4.0))
        if factor > limit
    ]
    if cover and cover.expected and not 0.72 < len(outside) / cover.expected < 1.35:
        warnings.append(f"{len(outside)} returns where the outline should have {cover.expected:.0f}")
    return Fit(
        noise=noise / cosine,
        ring_bias=bias / cosine,
        noise_factor=noise_factor,
        bias_factor=bias_factor,
        edge_factor=ends.factor if ends else 1.0,
        plane_chi_square=float(square),
        plane_freedom=int(freedom),
        edge_chi_square=ends.chi_square if ends else 0.0,
        edge_freedom=ends.freedom if ends else 0,
        surface=evidence.surface,
        farthest_outside=float(outside.max()),
        share_outside=float(np.mean(outside > 1.0)),
        missing_left=cover.missing_left if cover else 0.0,
        missing_right=cover.missing_right if cover else 0.0,
        missing_inside=evidence.missing_inside,
        missing_rings=cover.missing_rings if cover else 0,
        expected_returns=cover.expected if cover else None,
        ring_tilt=evidence.tilt[0] if evidence.tilt else None,
        duplicates=evidence.duplicates,
        flags=tuple(sorted((flag for flag in flags if flag.excess > 1.0), key=lambda flag: -flag.excess)),
        warnings=tuple(warnings),
    )
