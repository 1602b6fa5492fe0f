"""Places: what distance and odometry rule out, the covariance of the graph would have ruled out too."""

import numpy as np
import pytest

from optshape_graph.mapping import Landmark, LandmarkSlam, Map, Sighting, Start
from optshape_graph.mapping.association import gated, predictions
from optshape_graph.mapping.places import Places
from optshape_graph.mapping.track import Odometry
from tests.factors.support import TARGET, retract
from tests.mapping.support import at, covariance, loop

WORLD = loop(length=160.0, n_poses=80, n_targets=8, laps=1, sigma_m=0.03, sigma_deg=0.3)
SURVEY = covariance([0.01] * 6)


def may_be_of(slam: LandmarkSlam, sighting: Sighting) -> set[str]:
    """Return the landmarks that a sighting from the newest pose passes the gate with, all of them asked for."""
    graph, newest = slam._graph, len(slam._poses) - 1
    now = graph.T_world_lidar(newest)
    pairings = predictions([sighting], [slam.landmarks], now)
    order = {name: k for k, name in enumerate(slam.landmarks)}
    return {pairing.landmark for pairing in gated(pairings, graph.covariance(list(order), [newest]), order)}


@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_what_passes_the_gate_is_not_ruled_out(known, seed):
    rng = np.random.default_rng(seed)
    survey = [
        Landmark(f"t{j}", TARGET, retract(T, 0.01 * rng.normal(size=6)), SURVEY)
        for j, T in enumerate(WORLD.targets[:3])
    ]
    slam = LandmarkSlam(Map(tuple(survey)) if known else None, Start(WORLD.poses[0], 1e-8 * np.eye(6)))
    odometry, compared, passed = WORLD.odometry(rng), 0, 0
    for i in range(len(WORLD.poses)):
        slam.add_odometry(float(i), *((odometry[i - 1], covariance(WORLD.motion_sigma)) if i else ()))
        sightings = [WORLD.sighting(rng, i, j, None) for j in WORLD.near(i, 15.0)]
        for sighting in sightings if slam.landmarks else []:
            near = set(slam._graph.near(sighting, slam.pose))
            right = may_be_of(slam, sighting)
            assert right <= near
            compared, passed = compared + len(near), passed + len(right)
        slam.add_measurements(sightings)
    assert len(slam.landmarks) == 8
    assert passed <= compared <= 2 * passed  # little else is compared


def test_after_a_jump_anything_may_be_anywhere():
    places = Places()
    places.add("far", TARGET.name, np.array([500.0, 0.0, 0.0]))
    rng = np.random.default_rng(0)
    sighting = WORLD.sighting(rng, 0, 0, None)
    places.move(Odometry(0, 1, at(1.0, 0.0, 0.0), covariance([0.001] * 6)))
    places.see("far", 1, sighting.summaries[0])
    assert places.near(sighting, np.eye(4)) == []
    places.jump(2)
    assert places.near(sighting, np.eye(4)) == ["far"]
    assert places.apart(1, 10.0) == np.inf
    places.remove("far")
    assert places.near(sighting, np.eye(4)) == []


def test_landmarks_that_moved_are_found_where_they_are():
    """A loop that closes moves landmarks by more than the array knows."""
    world = loop(length=400.0, n_poses=200, n_targets=20, laps=2, sigma_m=0.05, sigma_deg=0.5)
    rng = np.random.default_rng(3)
    slam, odometry = LandmarkSlam(confirmations=1), world.odometry(rng)
    for i in range(260):
        slam.add_odometry(float(i), *((odometry[i - 1], covariance(world.motion_sigma)) if i else ()))
        slam.add_measurements([world.sighting(rng, i, j, None) for j in world.near(i, 15.0)])
    assert len(slam.landmarks) == 20
    for T in slam.landmarks.values():
        found = slam._graph.within(T[:3, 3], 1.0)
        assert len(found) == 1
        np.testing.assert_allclose(next(iter(found.values())), T)
