"""What the runs read: one folder with a good file of each kind, and bad files and names of every kind."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np

from optshape_graph import estimate_pose
from optshape_graph.io import demo_folder, load_sensor, load_target, read_scan, write_scan
from optshape_graph.io.trajectories import Trajectory
from optshape_graph.mapping import Landmark, Map, save_map
from optshape_graph.simulation import NoiseModel, pose_from_rpy, room, simulate
from tests.fuzz.readers import SCENE

HOSTILE = (
    "", " ", "-", "--help", "../../evil", "/etc/passwd", "$(touch evil)", "`touch evil`", "front; touch evil", "a\nb",
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "a\tb", "<script>alert(1)</script>", "'\"", "%s%n", "{0}", "\u202egnp",
    "x" * 300, "ü" * 130, "NaN", "@", "*", "a\\b", "paper@", "paper@nan", "paper@-1", "paper@1e400", "paper@1@2",
)  # fmt: skip
"""Names from nobody's friend."""


def make_inputs(folder: Path) -> None:
    """Fill a folder with good files."""
    folder.mkdir()
    for file in demo_folder().iterdir():
        shutil.copy(file, folder / file.name)
    sensor = load_sensor("vlp16")
    places = [(load_target("square@1"), pose_from_rpy([6.0, 0.5, 0.0], [0.0, 0.1, 0.2]))]
    write_scan(folder / "room.pcd", simulate(room(places), sensor, pose_from_rpy([0, 0, 0], [0, 0, 0]),
                                             noise=NoiseModel.of(sensor), rng=1).scan)  # fmt: skip
    (folder / "scene.yaml").write_text(SCENE)
    (folder / "clouds").mkdir()
    for k in range(2):
        shutil.copy(folder / "room.pcd", folder / "clouds" / f"{k}.pcd")
    (folder / "clouds" / "timestamps.txt").write_text("0.0\n0.1\n")
    landmarks = tuple(
        Landmark(f"L{k}", load_target("square@1"), pose_from_rpy([4, k, 0], [0, 0, 0.1 * k]), 1e-4 * np.eye(6), 3)
        for k in range(3)
    )
    for name in ("map", "other"):
        drive = Trajectory(np.tile(np.eye(4), (2, 1, 1)), np.array([0.0, 1.0]), name)
        save_map(folder / f"{name}.json", Map(landmarks, 1e-4 * np.eye(18), {name: drive}))
    (folder / "list.txt").write_text("4m.pcd\n8m.pcd\n")
    estimate_pose(read_scan(folder / "8m.pcd", load_sensor("vlp32c")), load_target("built")).save(
        folder / "result.json"
    )


def make_bad(folder: Path) -> None:
    """Fill a folder with files that are none of what they say."""
    folder.mkdir()
    for ending in ("pcd", "ply", "npz", "csv", "yaml", "json", "bag", "tum", "las"):
        (folder / f"empty.{ending}").write_bytes(b"")
        (folder / f"junk.{ending}").write_bytes(bytes(range(256)) * 20)
        (folder / f"text.{ending}").write_text("hello there\n" * 3)
    (folder / "deep.json").write_text("[" * 5000)
    (folder / "huge.yaml").write_text("a: [" + "1," * 20_000 + "1]\n")
    (folder / "folder.pcd").mkdir()
    os.mkfifo(folder / "fifo.pcd")
    os.mkfifo(folder / "fifo.yaml")
    (folder / "loop.pcd").symlink_to("loop.pcd")
    (folder / "dangling.yaml").symlink_to("nowhere")
    (folder / "list.txt").write_text("nope.pcd\nempty.pcd\n")
