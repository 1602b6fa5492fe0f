"""Where the LiDAR sits on the body: by frames that messages name, and static transforms between them."""

import numpy as np
import pytest
from hypothesis import given

from optshape_graph.io.recordings import Recording
from optshape_graph.io.recordings.topics import chained
from tests.factors.support import random_pose, seeds
from tests.io.recordings.writing import maker, points, write_bag


@given(seeds)
def test_chains_compose_up_and_down_the_tree(seed):
    rng = np.random.default_rng(seed)
    base_mast, mast_lidar, base_imu = (random_pose(rng) for _ in range(3))
    static = {("base", "mast"): base_mast, ("mast", "lidar"): mast_lidar, ("base", "imu"): base_imu}
    np.testing.assert_allclose(chained(static, "base", "lidar"), base_mast @ mast_lidar, atol=1e-12)
    np.testing.assert_allclose(
        chained(static, "imu", "lidar"), np.linalg.inv(base_imu) @ base_mast @ mast_lidar, atol=1e-9
    )
    np.testing.assert_array_equal(chained(static, "lidar", "lidar"), np.eye(4))
    assert chained(static, "base", "camera") is None


@pytest.mark.parametrize("storage", ["ros1", "sqlite3", "bare"])
def test_the_mounting_is_found_in_a_bag(tmp_path, storage):
    make, rng = maker(storage), np.random.default_rng(0)
    base_mast, mast_lidar = random_pose(rng), random_pose(rng)
    cloud = make.cloud(100.0, points("velodyne"))
    items = [
        ("/tf_static", make.tf(make.transform(0.0, base_mast, "base", "mast"))),
        ("/tf_static", make.tf(make.transform(0.0, mast_lidar, "/mast", cloud.header.frame_id))),
        ("/points", cloud),
        ("/odom", make.odometry(100.0, np.eye(4))),
        ("/pose", make.pose_stamped(100.0, np.eye(4))),
        ("/tf", make.tf(make.transform(100.0, np.eye(4), "odom", "mast"))),
    ]
    recording = Recording(write_bag(tmp_path, storage, items))
    found = recording.mounting(pose_topic="/odom")
    assert (found.body, found.lidar) == ("base", cloud.header.frame_id.lstrip("/"))
    np.testing.assert_allclose(found.T_body_lidar, base_mast @ mast_lidar, atol=1e-9)
    np.testing.assert_allclose(recording.mounting(pose_topic="/tf:odom:mast").T_body_lidar, mast_lidar, atol=1e-9)
    unknown = recording.mounting(pose_topic="/pose")
    assert (unknown.body, unknown.T_body_lidar) == ("", None)
