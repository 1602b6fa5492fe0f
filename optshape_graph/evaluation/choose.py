"""The choice of a target: the smallest one whose pose a sensor finds as exactly as asked, at a range.

Sizes are tried along a ladder. The Cramer-Rao bound tells where to begin, and how to hang the target. Then scans are
simulated and estimated, since a bound does not tell how many scans are ambiguous or fail.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats, Value, frozen
from optshape_graph.design.pose_search import expected_covariance, horizon_gap
from optshape_graph.errors import EstimationError, InputError
from optshape_graph.evaluation.metrics import pose_error
from optshape_graph.pose import PoseEstimate, estimate_poses
from optshape_graph.se3 import rotation, transform
from optshape_graph.sensor import SensorModel
from optshape_graph.simulation import NoiseModel, simulate_target
from optshape_graph.target import Target

STEP = 1.12
"""Ratio of the widths of neighbouring sizes on the ladder: a quarter more area."""

SMALLEST, LARGEST = 0.02, 8.0
"""Areas of the ladder, square metres."""

SHARE = 0.95
"""Share of the scans that must be ok, with both errors as small as asked."""

SCANS = 100
"""Scans that are simulated for each size."""

AT_ONCE = 20
"""Scans whose poses are estimated at once; a size that does not do is given up before all are."""

HUNG_ROLL = np.radians(3.0)
HUNG_YAW = np.radians(20.0)
HUNG_HEIGHT = 0.02
HUNG_ELEVATION = np.radians(0.1)
"""Half widths of uniform distributions of how a target hangs: roll, rad; turn away from facing the sensor, rad; height,
metres; and the difference of the sensor's elevations from its file, rad."""

_NORMALS = np.random.default_rng(0).standard_normal((6, 400))


@dataclass(frozen=True)
class Wish:
    """The accuracy that is asked of a target.

    Attributes:
        sensor: the sensor, whose azimuth step must be known.
        range: of the target, metres.
        rotation: largest rotation error in 95 of 100 scans, rad.
        translation: largest translation error in 95 of 100 scans, metres.

    Raises:
        InputError: a number that is not positive, or an unknown azimuth step.
    """

    sensor: SensorModel
    range: float
    rotation: float
    translation: float

    def __post_init__(self) -> None:
        for name in ("range", "rotation", "translation"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name}: expected a positive number; found {value}")
        if self.sensor.azimuth_step is None:
            raise InputError(f"sensor '{self.sensor.name}': its azimuth step has to be known to choose a target for it")


@dataclass(frozen=True)
class Hanging:
    """The planned place of a target.

    Attributes:
        height: of its origin (the vertex mean) above the sensor, metres.
        roll: turn from the pose in its file, counter-clockwise about +x as seen from behind, rad.
    """

    height: float
    roll: float


@dataclass(frozen=True, eq=False, repr=False)
class Trial(Value):
    """One size, hung in the best way.

    Attributes:
        target: the target, turned as it hangs.
        height: of its origin above the sensor, metres.
        bound_rotation: 95th percentile of the error at the Cramer-Rao bound, rad.
        bound_translation: the same, metres.
        statuses: of the simulated scans; empty if none were simulated.
        e_r: (N,) rotation errors of the simulated scans, ok or not, rad; NaN if the estimate failed.
        e_t: (N,) translation errors likewise, metres.
        passes: whether enough scans are ok, with errors as small as asked.
    """

    target: Target
    height: float
    bound_rotation: float
    bound_translation: float
    statuses: tuple[str, ...] = ()
    e_r: Floats = field(default_factory=lambda: frozen([]))
    e_t: Floats = field(default_factory=lambda: frozen([]))
    passes: bool = False

    def quantile(self, errors: Floats) -> float | None:
        """Return the 95th percentile of errors (N,), rad or metres, of the scans that are ok; None without any."""
        ok = errors[np.array(self.statuses) == "ok"] if len(errors) else errors
        return float(np.quantile(ok, SHARE)) if len(ok) else None

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        rotation_95 = self.quantile(self.e_r)
        counts = {status: self.statuses.count(status) for status in ("ok", "ambiguous", "failed")}
        width, height = np.ptp(self.target.polygon, axis=0)
        return {
            "target": self.target.name,
            "area_m2": self.target.area,
            "width_m": float(width),
            "height_m": float(height),
            "centre_above_sensor_m": self.height,
            "bound_e_r_95_deg": float(np.degrees(self.bound_rotation)),
            "bound_e_t_95_m": self.bound_translation,
            "e_r_95_deg": None if rotation_95 is None else float(np.degrees(rotation_95)),
            "e_t_95_m": self.quantile(self.e_t),
            **counts,
            "does_it": self.passes,
        }


@dataclass(frozen=True, eq=False, repr=False)
class Choice(Value):
    """The smallest target that is as accurate as asked, and alternatives.

    Attributes:
        wish: the accuracy asked for.
        chosen: the target.
        smaller: the sizes below it, largest first, each with the largest range at which it is accurate enough, metres.
            The first of them was simulated at the range asked for, and is not accurate enough there.
    """

    wish: Wish
    chosen: Trial
    smaller: tuple[tuple[Trial, float], ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as plain data."""
        return {
            "schema": "optshape/design-choice/1",
            "sensor": self.wish.sensor.name,
            "range_m": self.wish.range,
            "rotation_deg": float(np.degrees(self.wish.rotation)),
            "translation_m": self.wish.translation,
            "scans": SCANS,
            "chosen": self.chosen.to_dict(),
            "smaller": [{**trial.to_dict(), "does_it_at_m": nearer} for trial, nearer in self.smaller],
        }


def choose_target(
    wish: Wish, shapes: Sequence[Target], *, seed: int = 0, progress: Callable[[int, int], None] | None = None
) -> Choice:
    """Choose the smallest target that is as accurate as asked.

    Args:
        wish: the accuracy asked for.
        shapes: shapes to choose from, of any size; the one that can be smallest by the bound is taken.
        seed: of the simulated scans, the same for every size.
        progress: called with the numbers of simulated and of expected scans.

    Raises:
        EstimationError: no target of up to `LARGEST` square metres is accurate enough.
    """
    ladder = _Ladder(wish, tuple(shapes), seed, progress)
    step = ladder.first_by_bound()
    trial = ladder.simulated(step)
    while not trial.passes:
        step += 1
        if step >= len(ladder.areas):
            raise ladder.too_far()
        trial = ladder.simulated(step)
    while step > 0 and ladder.simulated(step - 1).passes:
        step -= 1
    chosen = ladder.simulated(step)
    smaller = [
        ladder.simulated(k) if k == step - 1 else ladder.bounded(k) for k in range(step - 1, step - 3, -1) if k >= 0
    ]
    # The bound tells how errors change with the range; the simulation, by what factor they exceed the bound.
    excess = ladder.excess(chosen)
    return Choice(wish, chosen, tuple((trial, ladder.nearer(trial.target, excess)) for trial in smaller))


class _Ladder:
    """Sizes of one shape, each bounded and simulated once."""

    def __init__(
        self, wish: Wish, shapes: tuple[Target, ...], seed: int, progress: Callable[[int, int], None] | None
    ) -> None:
        self.wish, self.shapes, self.seed, self.progress = wish, shapes, seed, progress
        count = int(np.ceil(np.log(LARGEST / SMALLEST) / np.log(STEP**2))) + 1
        self.areas = LARGEST * STEP ** (-2.0 * np.arange(count)[::-1])
        self._bounded: dict[int, Trial] = {}
        self._simulated: dict[int, Trial] = {}

    @cached_property
    def shape(self) -> Target:
        """The shape whose errors at the bound are least, over a middling size of all."""
        middle = self.areas[len(self.areas) // 2]
        needs = []
        for shape in self.shapes:
            trial = _bounded_trial(shape.scaled_to_area(float(middle)), self.wish, self.wish.range)
            needs.append(_need(self.wish, trial.bound_rotation, trial.bound_translation))
        return self.shapes[int(np.argmin(needs))]

    def bounded(self, step: int) -> Trial:
        if step not in self._bounded:
            target = self.shape.scaled_to_area(float(self.areas[step]))
            self._bounded[step] = _bounded_trial(target, self.wish, self.wish.range)
        return self._bounded[step]

    def simulated(self, step: int) -> Trial:
        if step not in self._simulated:
            before = SCANS * len(self._simulated)

            def report(scans: int) -> None:
                if self.progress is not None:
                    self.progress(before + scans, max(4 * SCANS, before + SCANS))

            self._simulated[step] = _simulated_trial(self.bounded(step), self.wish, self.seed, report)
        return self._simulated[step]

    def first_by_bound(self) -> int:
        """Return the smallest size that would be accurate enough if its errors were at the bound."""
        low, high = 0, len(self.areas)  # errors at the bound fall with the size
        while low < high:
            middle = (low + high) // 2
            trial = self.bounded(middle)
            if _need(self.wish, trial.bound_rotation, trial.bound_translation) <= 1.0:
                high = middle
            else:
                low = middle + 1
        if low >= len(self.areas):
            raise self.too_far()
        return low

    def excess(self, trial: Trial) -> float:
        """Return the ratio of the simulated errors to the bound, at least 1."""
        e_r, e_t = trial.quantile(trial.e_r), trial.quantile(trial.e_t)
        assert e_r is not None
        assert e_t is not None
        return max(1.0, _need(self.wish, e_r, e_t) / _need(self.wish, trial.bound_rotation, trial.bound_translation))

    def nearer(self, target: Target, excess: float) -> float:
        """Return the largest range, metres, at which a target is accurate enough, by the bound and its excess."""
        low, high = 0.1 * self.wish.range, self.wish.range
        for _ in range(6):
            middle = 0.5 * (low + high)
            trial = _bounded_trial(target, self.wish, middle)
            if excess * _need(self.wish, trial.bound_rotation, trial.bound_translation) <= 1.0:
                low = middle
            else:
                high = middle
        return low

    def too_far(self) -> EstimationError:
        largest = self.shape.scaled_to_area(LARGEST)
        nearer = self.nearer(largest, 1.3)
        return EstimationError(
            f"no target of up to {LARGEST:g} m2 does it at {self.wish.range:g} m with '{self.wish.sensor.name}': "
            f"ask for less, or hang one nearer (about {nearer:.1f} m at that size)"
        )


def _need(wish: Wish, e_r: float, e_t: float) -> float:
    """Return the ratio of errors to those asked for; at most 1 is accurate enough."""
    return max(e_r / wish.rotation, e_t / wish.translation)


def _placements(hanging: Hanging, wish: Wish, distance: float, count: int, rng: np.random.Generator) -> Floats:
    """Return T_lidar_target (count, 4, 4) of a target that hangs as planned, as exactly as people hang targets."""
    rolls = hanging.roll + HUNG_ROLL * rng.uniform(-1, 1, count)
    yaws = HUNG_YAW * rng.uniform(-1, 1, count)
    spread = HUNG_HEIGHT + HUNG_ELEVATION * distance
    heights = hanging.height + spread * rng.uniform(-1, 1, count)
    R = rotation(np.outer(yaws, [0.0, 0.0, 1.0])) @ rotation(np.outer(rolls, [1.0, 0.0, 0.0]))
    sideways = rng.uniform(-0.1, 0.1, count)
    return transform(R, np.column_stack([np.full(count, distance), sideways, heights]))


def _bounded_trial(target: Target, wish: Wish, distance: float) -> Trial:
    """Hang a target at that one of several heights and rolls at which its errors at the bound are smallest."""
    gap = horizon_gap(wish.sensor)
    heights = distance * np.tan(np.linspace(gap[0], gap[1], 6)) if wish.sensor.n_rings > 1 else [0.0]
    plans = [Hanging(float(height), roll) for height in heights for roll in np.arange(0.0, 2 * np.pi, np.pi / 12)]
    rng = np.random.default_rng(0)
    count = 6
    poses = np.concatenate([_placements(plan, wish, distance, count, rng) for plan in plans])
    covariances = expected_covariance(target, wish.sensor, poses)
    draws = np.linalg.cholesky(covariances) @ _NORMALS
    e_r, e_t = (np.linalg.norm(draws[:, part], axis=1).reshape(len(plans), -1) for part in (slice(0, 3), slice(3, 6)))
    rotations, translations = np.quantile(e_r, SHARE, axis=1), np.quantile(e_t, SHARE, axis=1)
    best = int(np.maximum(rotations / wish.rotation, translations / wish.translation).argmin())
    c, s = np.cos(plans[best].roll), np.sin(plans[best].roll)
    turned = Target.from_polygon(target.polygon @ np.array([[c, s], [-s, c]]), target.name)
    return Trial(turned, plans[best].height, float(rotations[best]), float(translations[best]))


def _simulated_trial(trial: Trial, wish: Wish, seed: int, report: Callable[[int], None]) -> Trial:
    """Simulate and estimate scans of a target as it hangs, until it cannot pass any more."""
    noise = NoiseModel.of(wish.sensor)
    poses = _placements(Hanging(trial.height, 0.0), wish, wish.range, SCANS, np.random.default_rng([seed, 1]))
    statuses, e_r, e_t, missed = [], [], [], 0
    allowed = int(np.floor((1 - SHARE) * SCANS + 1e-9))

    def estimates() -> Iterator[PoseEstimate | EstimationError]:
        for first in range(0, SCANS, AT_ONCE):
            scans = []
            for number, T in enumerate(poses[first : first + AT_ONCE], start=first):
                report(number)
                rng = np.random.default_rng([seed, 2, number])
                scans.append(simulate_target(trial.target, wish.sensor, T, noise=noise, rng=rng))
            yield from estimate_poses(scans, trial.target)

    for number, (T, estimate) in enumerate(zip(poses, estimates(), strict=False)):
        if isinstance(estimate, EstimationError):
            statuses.append("failed")
            e_r.append(np.nan)
            e_t.append(np.nan)
            missed += 1
        else:
            error = pose_error(trial.target, estimate.T_lidar_target, T)
            statuses.append(estimate.status)
            e_r.append(error.e_r)
            e_t.append(error.e_t)
            missed += estimate.status != "ok" or _need(wish, error.e_r, error.e_t) > 1.0
        if missed > allowed and number >= SCANS // 4:
            break
    return replace(trial, statuses=tuple(statuses), e_r=frozen(e_r), e_t=frozen(e_t), passes=bool(missed <= allowed))
