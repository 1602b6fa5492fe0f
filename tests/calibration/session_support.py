"""A session folder of crops and images, for tests of what reads files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from optshape_graph.evaluation.rendering import render_target
from optshape_graph.io import save_camera, save_target, write_scan
from optshape_graph.io.documents import write_yaml
from optshape_graph.simulation.scene import simulate_target
from tests.calibration.camera.support import BOARD, FISHEYE, T_CAMERA_LIDAR, Sensor, placement

SESSION_VIEWS = 4


def write_session(folder: Path) -> Path:
    """Write a board, a camera, and views with crops and images; return the folder."""
    rng = np.random.default_rng(0)
    lidar = Sensor.drawn("vlp16", rng)
    save_target(folder / "board.yaml", BOARD)
    save_camera(folder / "camera.yaml", replace(FISHEYE, name="front"))
    views = []
    for k in range(SESSION_VIEWS):
        T = placement(rng)
        scan = simulate_target(BOARD, lidar.model, T, noise=lidar.noise, rng=rng, range_bias=lidar.range_bias)
        write_scan(folder / f"{k}.pcd", scan)
        cv2.imwrite(str(folder / f"{k}.png"), render_target(BOARD, FISHEYE, T_CAMERA_LIDAR @ T, rng))
        views.append({"scan": f"{k}.pcd", "target_points": f"{k}.pcd", "image": f"{k}.png"})
    session = {"schema": "optshape/session/1", "sensor": "vlp16", "target": "board.yaml", "camera": "camera.yaml"}
    write_yaml(folder / "session.yaml", session | {"views": views})
    return folder
