"""Scans that break an assumption: how many poses are wrong and called ok, and how many clean scans are flagged.

    python -m pytest -m benchmark -s tests/statistics/test_violations.py

prints the table of every kind, on seeds that were not looked at while thresholds were chosen (development: 1, 2, 5, 9).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import chi2

from optshape_graph import EstimationError, PoseEstimate, Scan, SensorModel, Target
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import difference
from tests.casting.caster import Receiver, Wall, cast
from tests.statistics.violations import CLEAN, KINDS, Trial, World, by_simulator

SEED = 4003
"""Not looked at while working."""

THREE_SIGMA = chi2.ppf(0.997, 6)

UNTELLABLE = ("moving 5 m/s", "moving 20 m/s", "brightness x 3")
"""What one scan can't tell: a motion towards the target is a yaw of it, one across a stretch; and an error that all
ranges share."""


def by_caster(target: Target, sensor: SensorModel, T: np.ndarray, rng: np.random.Generator) -> Scan:
    """The independent ray caster: beams of sub-rays, a wall behind in half of the scans, azimuths with jitter."""
    wall = Wall(rng.uniform(1.0, 10.0), rng.uniform(0.1, 0.8)) if rng.uniform() < 0.5 else None
    receiver = Receiver(
        threshold=rng.uniform(0.2, 0.8),
        first=bool(rng.uniform() < 1 / 3),
        azimuth_jitter=np.radians(0.02),
        range_noise=sensor.range_noise * rng.uniform(0.5, 2.0),
        ring_bias=sensor.ring_bias,
        brightness=sensor.brightness_bias * rng.normal(),
        glow=rng.uniform(0.0, 0.1),
    )
    full, own = cast(target, sensor, T, receiver, rng, wall)
    return full.select(np.flatnonzero(own))


WORLDS = {
    "paper vlp32c": World(load_target("paper@0.7"), load_sensor("vlp32c"), (3.0, 12.0), by_simulator),
    "square vlp16": World(load_target("square@0.7"), load_sensor("vlp16"), (2.0, 5.0), by_simulator),
    "triangle os1-64": World(load_target("triangle@0.7"), load_sensor("os1-64"), (3.0, 12.0), by_simulator),
    "cast paper vlp32c": World(load_target("paper@0.7"), load_sensor("vlp32c"), (3.0, 12.0), by_caster),
    "cast square vlp16": World(load_target("square@0.7"), load_sensor("vlp16"), (2.0, 5.0), by_caster),
    "cast paper os1-64": World(load_target("paper@0.7"), load_sensor("os1-64"), (3.0, 10.0), by_caster),
}


def xi(estimate: PoseEstimate, trial: Trial) -> np.ndarray:
    """(6,) error against the nearest of the true poses."""
    poses = [T @ S for T in trial.T_lidar_target for S in trial.target.symmetry_transforms]
    errors = [difference(estimate.T_lidar_target, T) for T in poses]
    return min(errors, key=lambda error: float(error @ np.linalg.solve(estimate.covariance, error)))


def counts(
    world: World, kind: str, violate: Callable[[Trial, np.random.Generator], Trial], n: int, seed: int
) -> Counter[str]:
    """Statuses, `wrong` and `gross` of those called ok, `flagged`, and the sum of their NEES / dof."""
    found: Counter[str] = Counter()
    for k in range(n):
        rng = np.random.default_rng([seed, k, *kind.encode()])
        trial = violate(world.draw(rng), rng)
        try:
            estimate = estimate_pose(trial.scan, trial.target)
        except EstimationError:
            found["none"] += 1
            continue
        found[estimate.status] += 1
        found["flagged"] += bool(estimate.fit.flags)
        if estimate.status == "ok":
            error = xi(estimate, trial)
            square = float(error @ np.linalg.solve(estimate.covariance, error))
            turn, moved = np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:])
            found["wrong"] += bool(square > THREE_SIGMA or turn > 10)
            found["gross"] += bool(turn > 10 or moved > 0.15)
            found["nees"] += square / 6
    return found


def table(world: str, kinds: dict[str, Callable[[Trial, np.random.Generator], Trial]], n: int, seed: int):
    """Counts of every kind, printed."""
    result = {}
    for kind, violate in kinds.items():
        result[kind] = found = counts(WORLDS[world], kind, violate, n, seed)
        nees = found["nees"] / max(found["ok"], 1)
        print(
            f"{world}, {kind}: wrong and ok {found['wrong'] / n:.0%}, gross {found['gross']}, of {n}: {found['ok']} ok "
            f"(NEES / dof {nees:.2f}), {found['doubtful']} doubtful, {found['ambiguous']} ambiguous, "
            f"{found['failed'] + found['none']} failed"
        )
    return result


@pytest.mark.parametrize(
    "kind", ["folded 5 deg", "mixed pixels 1", "ends 30 cm behind", "cut 20 %", "bad day", "1 stray"]
)
def test_a_few_of_each(kind: str) -> None:
    """Of eight scans at most three are wrong and ok: where a fifth is, as many as are asked, four come once in 18."""
    assert counts(WORLDS["paper vlp32c"], kind, KINDS[kind], 8, 3)["wrong"] <= 3


@pytest.mark.benchmark
@pytest.mark.parametrize(("world", "n"), [("paper vlp32c", 60), ("square vlp16", 20), ("triangle os1-64", 20)])
def test_wrong_and_ok(world: str, n: int) -> None:
    """At most 4 % of all and 20 % of each kind that can be told, grossly 0.3 %; an ordinary bad day NEES / dof 1.5."""
    result = table(world, KINDS, n, SEED)
    told = {kind: found for kind, found in result.items() if kind not in UNTELLABLE}
    wrong = sum(found["wrong"] for found in told.values())
    print(f"{world}: wrong and ok {sum(found['wrong'] for found in result.values())} of {n * len(result)}; "
          f"of kinds that can be told {wrong} of {n * len(told)}")  # fmt: skip
    assert wrong <= 0.04 * n * len(told)
    assert sum(found["gross"] for found in told.values()) <= 0.003 * n * len(told)
    assert max(found["wrong"] for found in told.values()) <= 0.2 * n
    assert result["bad day"]["nees"] / result["bad day"]["ok"] <= 1.5


@pytest.mark.benchmark
def test_clean_scans_are_not_flagged() -> None:
    """At most 0.5 % in each world: of 200, and of 50 without rings."""
    flagged = {}
    for world in WORLDS:
        clean = table(world, {"clean": CLEAN["clean"]}, 200, SEED + 1)["clean"]
        ringless = table(world, {"clean, no rings": CLEAN["clean, no rings"]}, 50, SEED + 1)["clean, no rings"]
        flagged[world] = clean["flagged"] + ringless["flagged"]
    print(f"flagged of 250 each: {flagged}")
    assert max(flagged.values()) <= 0.005 * 250
