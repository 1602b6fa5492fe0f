"""A window of Open3D that shows points and lines."""

from __future__ import annotations

from typing import Any

import numpy as np

from optshape_graph.errors import InputError, missing_extra
from optshape_graph.viz.spatial import Lines, Points, Spatial, require_screen


def show(seen: Spatial, step: int = 0, name: str = "optshape") -> None:
    """Open a window, and wait until it is closed.

    Args:
        seen: what to show.
        step: the scan to show, if there are several.
        name: the window's title.

    Raises:
        MissingExtraError: Open3D is absent.
        InputError: there is no screen, or the window cannot be opened.
    """
    o3d = _open3d()
    require_screen("Open3D")  # without one Open3D would draw where nobody sees it, and wait for ever
    window = o3d.visualization.Visualizer()
    if not window.create_window(window_name=name, width=1280, height=960):
        raise InputError("Open3D could not open a window; write a file for Rerun instead: --save FILE.rrd")
    for geometry in geometries(seen, step):
        window.add_geometry(geometry)
    window.run()
    window.destroy_window()


def geometries(seen: Spatial, step: int = 0) -> list[Any]:
    """Return Open3D's point clouds and line sets of what is shown at a step."""
    o3d, shown = _open3d(), []
    for item in seen.items:
        if item.step is None or item.step == step:
            shown.append(_cloud(o3d, item) if isinstance(item, Points) else _lines(o3d, item))
    return shown


def _cloud(o3d: Any, item: Points) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(item.points)))
    cloud.colors = o3d.utility.Vector3dVector(np.array(np.broadcast_to(item.colours / 255.0, item.points.shape)))
    return cloud


def _lines(o3d: Any, item: Lines) -> Any:
    starts = np.cumsum([0, *(len(strip) for strip in item.strips)])[:-1]
    pairs = [
        (first + k, first + k + 1)
        for first, strip in zip(starts, item.strips, strict=True)
        for k in range(len(strip) - 1)
    ]
    colours = np.broadcast_to(item.colours / 255.0, (len(item.strips), 3))
    each = np.repeat(colours, [len(strip) - 1 for strip in item.strips], axis=0)
    lines = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(np.vstack(item.strips)), o3d.utility.Vector2iVector(np.array(pairs, dtype=np.int32))
    )
    lines.colors = o3d.utility.Vector3dVector(each)
    return lines


def _open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as cause:
        raise missing_extra("open3d", "mesh", ImportError(str(cause))) from cause
    return open3d
