"""What an installed copy must do, with no repository beside it: `python smoke.py`, in any folder but the checkout's.

Needs what the package itself needs, and nothing else.
"""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path


def main() -> None:
    """Import the layers, run the commands on the bundled session, and solve a graph with a factor of the package."""
    import gtsam
    from gtsam.symbol_shorthand import L, X

    import optshape_graph
    from optshape_graph.factors import SummaryFactor
    from optshape_graph.io import load_sensor, load_target, read_scan
    from optshape_graph.pose import estimate_pose

    place = Path(optshape_graph.__file__).parent
    assert importlib.metadata.version("optshape-graph") == optshape_graph.__version__
    assert (place / "py.typed").is_file()
    assert (place / "factors" / "__init__.py").is_file()
    assert not Path("optshape_graph").exists(), "run this beside no checkout"

    demo = Path(str(files("optshape_graph") / "data" / "demo"))
    help_text = run("--help")
    assert all(command in help_text for command in ("estimate", "detect", "calibrate", "map"))
    assert run("--version").split()[-1] == optshape_graph.__version__
    with tempfile.TemporaryDirectory() as folder:
        poses = Path(folder) / "poses.json"
        run("estimate", demo / "4m.pcd", "--target", "built", "--sensor", "vlp32c", "--json", poses)
        [scan] = json.loads(poses.read_text())["scans"]
        assert scan["status"] == "ok", scan["reason"]
        run("calibrate", "mocap", demo / "session.yaml", "--json", Path(folder) / "mocap.json")
        run("simulate", "--range", "8", "-o", Path(folder) / "scan.pcd")

    estimate = estimate_pose(read_scan(demo / "4m.pcd", load_sensor("vlp32c")), load_target("built"))
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    graph.push_back(SummaryFactor(estimate.measurement, L(0), X(0)))
    values.insert(X(0), gtsam.Pose3())
    values.insert(L(0), gtsam.Pose3(estimate.T_lidar_target))
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    error = solution.atPose3(L(0)).localCoordinates(gtsam.Pose3(estimate.T_lidar_target))
    assert abs(error).max() < 1e-3
    print(f"optshape-graph {optshape_graph.__version__} works on Python {sys.version.split()[0]}: {place}")


def run(*arguments: object) -> str:
    """Run the command line in a process of its own."""
    command = [sys.executable, "-m", "optshape_graph", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main()
