"""What importing the readers costs."""

from __future__ import annotations

import subprocess
import sys

HEAVY = ("cv2", "cvxpy", "ezc3d", "gtsam", "matplotlib", "open3d", "pandas", "rosbags", "scipy")


def test_nothing_heavy_is_imported() -> None:
    code = f"import sys, optshape_graph.io; print(*[name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
