"""Facts about text files: motion capture, markers, a trajectory, stamps, a cloud, or a sensor's angles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.clouds.text import decode
from optshape_graph.io.describe.clouds import cloud_facts
from optshape_graph.io.describe.documents import maker_table_facts
from optshape_graph.io.describe.facts import Facts, span_text
from optshape_graph.io.describe.mocap import mocap_facts
from optshape_graph.io.files import read_bytes
from optshape_graph.io.mocap import form_of
from optshape_graph.io.trajectories.g2o import is_g2o, read_g2o
from optshape_graph.io.trajectories.kitti import read_kitti


def text_facts(path: Path, columns: list[str] | None) -> Facts:
    """Return what a text file of any ending holds: the facts of the first form that reads it.

    Args:
        path: the file.
        columns: names of a cloud's columns, in order; with them the file is read as a cloud only.

    Raises:
        InputError: no form reads it; the message says why it is no cloud.
    """
    text = decode(read_bytes(path))
    lines = text.splitlines()
    if form_of(text) is not None:
        return mocap_facts(path, "motion capture")
    if is_g2o(text):
        return _pose_graph(path)
    first = next((line.strip() for line in lines if line.strip()), "")
    names = [word.strip().lower() for word in first.lstrip("#/ ").replace(";", ",").split(",")]
    if sorted(names) == ["frame", "marker", "x", "y", "z"]:
        return _markers(path)
    if {"u", "v"} <= set(names) and ("vertex" in names or {"y", "z"} <= set(names)):
        return {"form": "pixels of a target's points (session key `corners`)", "lines": len(lines) - 1}
    said: list[str] = []
    attempts: tuple[Callable[[], Facts], ...] = (
        lambda: _trajectory(path), lambda: _stamps(path, lines), lambda: _kitti(path), lambda: cloud_facts(path),
        lambda: _angles(path),
    )  # fmt: skip
    for attempt in attempts if columns is None else (lambda: cloud_facts(path, columns),):
        try:
            return attempt()
        except InputError as error:
            said.append(str(error).removeprefix(str(path)))
    raise InputError(f"{path}: text of no form that is read here. As a cloud{said[-2] if len(said) > 1 else said[-1]}")


def _trajectory(path: Path) -> Facts:
    from optshape_graph.io.trajectories import read_trajectory

    trajectory = read_trajectory(path)
    if len(trajectory) < 2:
        raise InputError(f"{path}: {len(trajectory)} poses")
    assert trajectory.stamps is not None  # what is read has them
    length = float(np.linalg.norm(np.diff(trajectory.poses[:, :3, 3], axis=0), axis=1).sum())
    start, end = float(trajectory.stamps[0]), float(trajectory.stamps[-1])
    rate = float(1 / np.median(np.diff(trajectory.stamps)))
    return {
        "form": "trajectory (--odometry takes it)", "poses": len(trajectory), "length": f"{length:.3f} m",
        "stamps": span_text(start, end), "rate": f"{rate:.1f} Hz",
        "numbers": {"stamps": len(trajectory), "span_s": [start, end], "length_m": length, "rate_hz": rate},
    }  # fmt: skip


def _kitti(path: Path) -> Facts:
    return {"form": "trajectory without stamps (KITTI; read by `io.trajectories.read_kitti`)",
            "poses": len(read_kitti(path))}  # fmt: skip


def _pose_graph(path: Path) -> Facts:
    graph = read_g2o(path)
    return {"form": "pose graph (g2o; read by `io.trajectories.read_g2o`)", "vertices": len(graph.vertices),
            "edges": len(graph.edges), "fixed": len(graph.fixed)}  # fmt: skip


def _stamps(path: Path, lines: list[str]) -> Facts:
    from optshape_graph.io.recordings.folders import STAMP_FILES
    from optshape_graph.io.times import parse_stamp

    if path.name not in STAMP_FILES:
        raise InputError(f"{path}: not called {', '.join(STAMP_FILES)}")
    words = [word for line in lines if line.strip() and not line.startswith("#") for word in line.split(",")[:1]]
    stamps = [stamp for word in words if (stamp := parse_stamp(word.strip().replace(" ", "T", 1))) is not None]
    facts: Facts = {"form": "stamps of the files beside it", "stamps": len(stamps), "span": "none"}
    facts["numbers"] = {"stamps": len(stamps)}
    if stamps:
        facts["span"] = span_text(min(stamps), max(stamps))
        facts["numbers"]["span_s"] = [min(stamps), max(stamps)]
    return facts


def _angles(path: Path) -> Facts:
    facts = maker_table_facts(path) if path.suffix.lower() in (".csv", ".dat", ".txt") else None
    if facts is None:
        raise InputError(f"{path}: no table of a sensor's angles")
    return facts


def _markers(path: Path) -> Facts:
    from optshape_graph.io.markers import UNITS, read_markers

    fitting = {}
    for unit in UNITS:
        try:
            fitting[unit] = read_markers(path, unit)
        except InputError as error:
            said = error
    if not fitting:
        raise said
    markers = next(iter(fitting.values()))
    return {"form": "markers (session key `mocap`)", "unit, by their size": " or ".join(fitting),
            "frames": len(markers.frames), "markers": ", ".join(markers.names)}  # fmt: skip
