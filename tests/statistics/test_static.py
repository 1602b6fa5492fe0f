"""Ten scans of a static scene, fused: as sure as the errors allow that all of them share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from optshape_graph.errors import EstimationError
from optshape_graph.factors import fuse_static
from optshape_graph.factors.measurement import refine
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.se3 import difference, inverse
from optshape_graph.simulation import NoiseModel, pose_from_rpy, simulate_target

SEED, SCENES, SCANS = 60615, 40, 10

PLACES = {"vlp32c": (3.0, 12.0), "vlp16": (2.5, 6.0), "os1-64": (3.0, 12.0)}
"""Ranges, metres."""


def fused_nees(name: str, scene: int) -> float | None:
    """NEES / dof of the fused pose of one scene; None where fewer than eight of its scans are ok.

    What a static scene keeps is drawn once: rings' range biases, elevations, off by 0.1 deg, and azimuths, the target's
    brightness, and which part of a beam must hit it. Noise, phase, blooming and odd ends are drawn for each scan.
    """
    sensor, target, rng = load_sensor(name), load_target("paper@0.7"), np.random.default_rng([SEED, scene])
    T = pose_from_rpy([rng.uniform(*PLACES[name]), *rng.uniform(-0.3, 0.3, 2)], np.radians(rng.uniform(-30, 30, 3)))
    noise = replace(NoiseModel.of(sensor), elevation_error=np.radians(0.1))
    bias = noise.draw_range_bias(sensor.n_rings, rng) + float(noise.draw_brightness_bias(1, rng)[0])
    angles = noise.draw_angle_errors(sensor.n_rings, rng)
    radii = rng.uniform(-1, 1)  # from a beam's axis to the border of a half plane, which covers this much of it
    covered = float((np.arccos(radii) - radii * np.sqrt(1 - radii**2)) / np.pi)
    noise = replace(noise, brightness_bias=0.0, hit_fraction=covered, common_edge_spread=0.0)
    found = []
    for _ in range(SCANS):
        scan = simulate_target(target, sensor, T, noise=noise, rng=rng, range_bias=bias, angle_errors=angles)
        try:
            estimate = estimate_pose(scan, target)
        except EstimationError:
            continue
        if estimate.status == "ok" and estimate.shared is not None:
            found.append(estimate.shared)
    if len(found) < 8:
        return None
    fused = fuse_static(found, 1.0)
    T_target_lidar = refine(fused.at(found[0].T_target_lidar))
    information = fused.at(T_target_lidar).information()
    xi = difference(T_target_lidar, inverse(T))
    return float(xi @ information @ xi) / 6


@pytest.mark.benchmark
@pytest.mark.parametrize("name", PLACES)
def test_static_fusion(name: str) -> None:
    """NEES / dof of ten scans, elevations 0.1 deg off: at most 1.5."""
    nees = [value for scene in range(SCENES) if (value := fused_nees(name, scene)) is not None]
    print(f"{name}: NEES / dof {np.mean(nees):.2f} of {len(nees)} scenes, +- {np.std(nees) / np.sqrt(len(nees)):.2f}")
    assert np.mean(nees) <= 1.5
