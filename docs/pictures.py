"""The pictures of README and documentation, made again: `python docs/pictures.py`.

Of bundled data and of simulated scans only: the same pictures everywhere, matplotlib's version apart.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import gtsam
import numpy as np

from optshape_graph.detection import detect_targets
from optshape_graph.io import load_sensor, load_target, read_scan
from optshape_graph.mapping import LandmarkSlam, Map, Sighting, solve_batch
from optshape_graph.mapping.recording import MotionNoise
from optshape_graph.pose import estimate_pose
from optshape_graph.simulation import NoiseModel, pose_from_rpy, room, simulate
from optshape_graph.viz.map import plot_map
from optshape_graph.viz.pose import plot_fit
from optshape_graph.viz.style import save_figure

IMAGES = Path(__file__).parent / "images"
STEPS, PERIOD = 28, 0.5


def main() -> None:
    """Write docs/images/*.png."""
    scan = read_scan(str(files("optshape_graph") / "data" / "demo" / "8m_angled.pcd"), load_sensor("vlp32c"))
    print(save_figure(plot_fit(scan, estimate_pose(scan, load_target("built"))), IMAGES / "fit.png"))
    print(save_figure(plot_map(drive()), IMAGES / "map.png"))


def drive() -> Map:
    """Map three targets from a drive round a room, odometry drifting."""
    rng, sensor = np.random.default_rng(0), load_sensor("vlp32c")
    noise, drift = NoiseModel.of(sensor), MotionNoise(metres=0.05, radians=np.radians(0.5))
    bias = noise.draw_range_bias(sensor.n_rings, rng)
    targets = [load_target(name) for name in ("paper", "triangle", "pose-optimal")]
    places = [(8.0, 3.0, 0.3), (-6.5, -4.0, -2.6), (1.0, -7.0, -1.4)]
    scene = room([(t, pose_from_rpy([x, y, 0.1], [0, 0, yaw])) for t, (x, y, yaw) in zip(targets, places, strict=True)])
    slam, before = LandmarkSlam(name="of the LiDAR"), np.eye(4)
    for k in range(STEPS):
        turn = 2 * np.pi * k / STEPS
        T = pose_from_rpy([4.0 * np.sin(turn), 2.2 * (1 - np.cos(turn)) - 2.2, 0.0], [0.0, 0.0, turn])
        if k:
            motion = np.linalg.inv(before) @ T
            covariance = drift.covariance(float(np.linalg.norm(motion[:3, 3])), PERIOD)
            wrong = gtsam.Pose3.Expmap(rng.multivariate_normal(np.zeros(6), covariance)).matrix()
            slam.add_odometry(k * PERIOD, motion @ wrong, covariance)
        else:
            slam.add_odometry(0.0)
        before = T
        found = detect_targets(simulate(scene, sensor, T, noise=noise, rng=rng, range_bias=bias).scan, targets).found
        slam.add_measurements([Sighting.of(one.estimate) for one in found if one.estimate.status == "ok"])
    return solve_batch(slam.problem()).map()


if __name__ == "__main__":
    main()
