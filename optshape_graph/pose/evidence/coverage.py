"""Where returns are lacking, against the outline of a target at a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optshape_graph._arrays import Floats, Value
from optshape_graph.chords import chords, sight_planes
from optshape_graph.groups import Groups
from optshape_graph.pose.evidence.records import Evidence, ends_of


@dataclass(frozen=True, eq=False, repr=False)
class Coverage(Value):
    """Where returns are lacking, against the outline.

    Attributes:
        missing_left: firings beyond the left ends of rings that should have returned and didn't.
        missing_right: the same beyond right ends.
        missing_rings: rings above and below those that returned whose chord holds two firings and more.
        expected: number of returns that the outline should have.
        cut: most neighbouring ends of one side at one azimuth where the outline isn't.
    """

    missing_left: float
    missing_right: float
    missing_rings: int
    expected: float
    cut: int


def coverages(evidences: Sequence[Evidence], T_target_lidar: Floats, further: Floats) -> list[Coverage]:
    """Count firings that are missing inside the outlines of scans whose targets have as many edges.

    Args:
        evidences: of B scans with rings.
        T_target_lidar: (B, 4, 4).
        further: (B,) azimuth by which the rings are seen to reach further, by blooming, rad.
    """
    ends, edges = ends_of(evidences), [evidence.problem.edges for evidence in evidences]
    rings, step = Groups(np.array([one.n_rings for one in edges])), ends.azimuth_step
    x, y, z = np.moveaxis(ends.points[:, : 2 * rings.counts.max() : 2], -1, 0)
    elevation = np.column_stack([np.arctan2(z, np.hypot(x, y)), ends.elevations])
    sides = sight_planes((ends.vertices - T_target_lidar[:, None, :3, 3]) @ T_target_lidar[:, :3, :3])
    right, left = chords(sides, elevation[:, None], ends.reference_azimuth[:, None])
    beside = (left - right)[:, rings.counts.max() :]
    mine = np.arange(elevation.shape[1]) < rings.counts[:, None]
    chord = np.column_stack([left[mine], -right[mine]])  # of the R rings, and both ends outwards
    at = np.concatenate([one.azimuth.reshape(-1, 2) for one in edges]) * [1.0, -1.0]
    # A ring that looks elsewhere than the table says ends elsewhere, far from there where it runs along the edge.
    geometry = ends.geometry(T_target_lidar)
    elsewhere = 2 * np.sqrt(geometry.of_ring) / np.maximum(np.abs(geometry.along), 1e-6)
    elsewhere = elsewhere[np.arange(elsewhere.shape[1]) < 2 * rings.counts[:, None]].reshape(-1, 2)
    reach = [np.median(one.reach(more) / one.ranges) for one, more in zip(evidences, further, strict=True)]
    slack = rings.each(step + np.array(reach))[:, None] + elsewhere

    missing = rings.sum(np.maximum(chord - at - slack, 0.0)) / step[:, None]
    length = np.maximum(chord.sum(axis=1), 0.0)
    expected = rings.sum(length * np.concatenate([one.revolutions[::2] for one in edges])) / step
    missing_rings = np.count_nonzero((beside > (2 * step + reach)[:, None]) & ends.silent, axis=1)
    odd = np.abs(chord - at) > rings.each(step)[:, None] + slack
    return [
        Coverage(
            missing_left=float(missing[k, 0]),
            missing_right=float(missing[k, 1]),
            missing_rings=int(missing_rings[k]),
            expected=float(expected[k]),
            cut=max(_at_one_azimuth(at[rows, side][odd[rows, side]], step[k]) for side in (0, 1)),
        )
        for k, rows in enumerate(rings.slices)
    ]


def _at_one_azimuth(azimuth: Floats, step: float) -> int:
    """Most of some ends of rings within 1.5 steps of azimuth."""
    odd = np.sort(azimuth)
    return int((np.searchsorted(odd, odd + 1.5 * step, side="right") - np.arange(len(odd))).max(initial=0))
