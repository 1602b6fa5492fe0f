"""The leaderboard: `make leaderboard` writes docs/leaderboard.md. Fixed seeds; nothing is tuned to them.

Clouds come from the package's simulator and from the independent caster of `tests/casting`, whose beams have a disc and
whose receiver has a threshold, so that no method is judged by its own model alone.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from optshape_graph.design.bound import covariance_bound
from optshape_graph.design.pose_search import attitudes
from optshape_graph.errors import EstimationError
from optshape_graph.evaluation.baselines import icp_to_template, ransac_corners
from optshape_graph.evaluation.metrics import normalised_error, pose_error
from optshape_graph.io.sensors import load_sensor
from optshape_graph.io.targets import load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.simulation import NoiseModel, simulate_target
from tests.casting.caster import Receiver, cast

CELLS = (("vlp32c", 10.0), ("vlp32c", 20.0), ("vlp16", 8.0), ("os1-64", 10.0), ("os1-64", 20.0))
TARGETS = ("paper", "pose-optimal")
TILT = np.radians(50.0)
TURNED = np.radians(25.0)
SEED = 2026
PAGE = Path(__file__).resolve().parents[2] / "docs" / "leaderboard.md"


def ours(scan, target):
    estimate = estimate_pose(scan, target)
    return estimate.T_lidar_target, estimate.covariance, estimate.status


def paper(scan, target):
    estimate = estimate_pose(scan, target, method="paper")
    return estimate.T_lidar_target, estimate.covariance, "ok"  # it says nothing of its doubts


METHODS = {
    "this package": ours,
    "the paper's alternation": paper,
    "lines by RANSAC, corners": lambda scan, target: (ransac_corners(scan, target), None, "ok"),
    "ICP to the template": lambda scan, target: (icp_to_template(scan, target), None, "ok"),
}


def clouds(target, sensor, distance, count, cell):
    """Scans, true poses and bounds: from both simulators in turn."""
    rng = np.random.default_rng([SEED, cell])
    receiver = Receiver(range_noise=sensor.range_noise, ring_bias=sensor.ring_bias)
    for number, T in enumerate(attitudes(sensor, distance, count, TILT, rng)):
        own = np.random.default_rng([SEED, cell, number])
        if number % 2:
            scan = cast(target, sensor, T, receiver, own)[0]
        else:
            scan = simulate_target(target, sensor, T, noise=NoiseModel.of(sensor), rng=own)
        if len(scan) >= 3:
            yield number % 2, scan, T, covariance_bound(target, sensor, T)


def run(count):
    """Rows: target, source, method, and what came out, over all cells."""
    found = {}
    for name in TARGETS:
        target = load_target(name).scaled_to_area(1.0)
        for cell, (sensor_name, distance) in enumerate(CELLS):
            for source, scan, T, bound in clouds(target, load_sensor(sensor_name), distance, count, cell):
                limits = np.sqrt([np.trace(bound[:3, :3]), np.trace(bound[3:, 3:])])
                for method, function in METHODS.items():
                    start = time.process_time()
                    row = {"status": "failed"}
                    try:
                        pose, covariance, status = function(scan, target)
                    except EstimationError:
                        pass
                    else:
                        error = pose_error(target, pose, T)
                        row = {"status": status, "e_r": error.e_r, "e_t": error.e_t, "bound": limits}
                        if covariance is not None and np.isfinite(covariance).all():
                            row["nees"] = normalised_error(target, pose, covariance, T).nees
                    row["ms"] = 1e3 * (time.process_time() - start)
                    found.setdefault((name, source, method), []).append(row)
    return found


def line(key, rows):
    name, source, method = key
    given = [row for row in rows if row["status"] == "ok"]
    e_r, e_t = (np.array([row[column] for row in given]) for column in ("e_r", "e_t"))
    over = np.array([[row["e_r"] / row["bound"][0], row["e_t"] / row["bound"][1]] for row in given
                     if np.isfinite(row["bound"]).all()])  # fmt: skip
    nees = [row["nees"] / 6 for row in given if "nees" in row]
    statuses = [row["status"] for row in rows]
    unsure = len(rows) - len(given) - statuses.count("failed")
    cells = [
        name,
        ("simulator", "caster")[source],
        method,
        f"{len(given)} / {unsure} / {statuses.count('failed')}",
        f"{np.degrees(np.median(e_r)):.2f} / {np.degrees(np.quantile(e_r, 0.95)):.2f}",
        f"{1e3 * np.median(e_t):.1f} / {1e3 * np.quantile(e_t, 0.95):.1f}",
        f"{np.median(over[:, 0]):.1f} / {np.median(over[:, 1]):.1f}",
        f"{np.mean(nees):.2g}" if nees else "none",
        str(int((e_r > TURNED).sum())),
        f"{np.median([row['ms'] for row in rows]):.0f}",
    ]
    return "| " + " | ".join(cells) + " |"


HEAD = """# Leaderboard

Made by `make leaderboard`: {count} scans of each target (1 m²) in each of {cells} cells: {where}. Any roll, tilts of
up to 50°; half of the clouds are from the package's simulator, half from an independent ray caster, the same for every
method. Seed {seed}; nothing is tuned to it.

Errors are those of the scans that a method calls ok; only this package ever says that it is not sure. *Over bound*:
median error over the Cramér-Rao bound of that scan. *NEES*: mean normalised error squared over its 6 degrees of
freedom, 1 where the covariance is right. *Turned*: called ok and off by more than 25°. *ms*: processor time of a scan,
median.

The paper's alternation starts where the template lies in its file, as published; at any other roll it mostly ends in
another pose. RANSAC takes lines of edge points, corners from their intersections; ICP starts from the principal axes.

"""
COLUMNS = (
    "target", "clouds", "method", "ok / not sure / failed", "e_r, deg, median / 95 %", "e_t, mm, median / 95 %",
    "over bound e_r / e_t", "NEES", "turned", "ms",
)  # fmt: skip

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=60, help="of each target in each cell")
    arguments = parser.parse_args()
    found = run(arguments.scans)
    where = ", ".join(f"{sensor} at {distance:g} m" for sensor, distance in CELLS)
    head = HEAD.format(count=arguments.scans, cells=len(CELLS), where=where, seed=SEED)
    table = [
        f"| {' | '.join(COLUMNS)} |",
        "|---" * len(COLUMNS) + "|",
        *(line(key, rows) for key, rows in found.items()),
    ]
    PAGE.write_text(head + "\n".join(table) + "\n", encoding="utf-8")
    print(PAGE.read_text(encoding="utf-8"))
