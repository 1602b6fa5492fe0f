"""What the estimate of a pose assumes about targets and returns, and where its verdict draws the line."""

from __future__ import annotations

from dataclasses import dataclass, fields

from optshape_graph.errors import InputError
from optshape_graph.target import FLATNESS


@dataclass(frozen=True)
class PoseOptions:
    """Assumptions and thresholds of `estimate_pose`. Beside each: how it was chosen, and the test that it moves.

    All tests are in `tests/pose/test_options.py`.

    Attributes:
        flatness: standard deviation, metres, of what no sensor file states: how flat and how true to its drawing a
            target is. Chosen: by hand, for a sawn board. Test: `test_flatness`.
        lost_ends: share of ring ends whose return is not within a step of the edge: lost there, or mixed with the
            background. Chosen: between recorded scans, whose likelihood grows up to 0.4, and simulated ones, which lose
            fewer; with ten rings and more it hardly matters. Test: `test_lost_ends`.
        lost_ends_of_rays: the same for a beam without width, which no edge splits. Chosen: by hand. Test:
            `test_lost_ends_of_rays`.
        lost_span: where the boundary may be beyond those ends, in azimuth steps outwards from the ring's last return.
            Chosen: up to two returns lost, or one too many. Test: `test_lost_span`.
        strays: share of returns that may lie anywhere, without rings: mixed with the background, or on something that
            touches the target. Chosen: by hand. Test: `test_strays`.
        min_explained: share of ring ends that must end on the target's edges: with fewer, these are not this target's
            returns. Chosen: the right target explains 0.80 in the worst recorded scan, 0.94 in the next, a wrong one
            0.5 in the median. Test: `test_min_explained`.
        max_outside: share of returns that may lie outside the outline by more than the beam allows, without rings.
            Chosen: ten times `strays`. Test: `test_max_outside`.
        ambiguity_margin: difference of log likelihoods below which a different pose is not ruled out. Chosen: odds of
            150 to 1; over scans with angular noise the share of wrong choices is the mean of 1 / (1 + exp(margin))
            (tests/benchmarks/test_evidence.py). Test: `test_ambiguity_margin`.
        unobservable_sd: standard deviation, rad or target radii, beyond which a direction counts as not observable.
            Chosen: by hand, 23 degrees. Test: `test_unobservable_sd`.
        largest_turn_sd: standard deviation, rad, of the least certain rotation of a pose that is ok: 5.7 degrees.
            Chosen: by hand, so that an error of 15 degrees is rare; 3 % of the poses that are told apart are less
            certain. Test: `test_largest_sds`.
        largest_shift_sd: the same of the least certain translation, target radii. Chosen: alike. Test:
            `test_largest_sds`.
        certified_gap: largest distance from the lower bound at which a pose is certified as the global minimum,
            metres: root of the cost per residual. Chosen: a hundredth of a LiDAR's range noise. Test:
            `test_certified_gap`.

    Raises:
        InputError: a value that is not positive, or a span that is empty.
    """

    flatness: float = FLATNESS
    lost_ends: float = 0.1
    lost_ends_of_rays: float = 0.02
    lost_span: tuple[float, float] = (-1.0, 3.0)
    strays: float = 2e-3
    min_explained: float = 0.8
    max_outside: float = 0.02
    ambiguity_margin: float = 5.0
    unobservable_sd: float = 0.4
    largest_turn_sd: float = 0.1
    largest_shift_sd: float = 0.1
    certified_gap: float = 1e-4

    def __post_init__(self) -> None:
        low, high = self.lost_span
        if not low < high:
            raise InputError(f"lost_span is {self.lost_span}; expected two numbers, the smaller first")
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "lost_span" and not value > 0:
                raise InputError(f"{field.name} is {value}; expected a positive number")
