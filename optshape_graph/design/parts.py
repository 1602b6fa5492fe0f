"""The parts that a workshop needs to build a target: plate, cuts, marks, prints, stand."""

from __future__ import annotations

import numpy as np

from optshape_graph.design.drawing import Workshop, diagonals
from optshape_graph.design.polylines import MM
from optshape_graph.design.sheets import Sheet
from optshape_graph.target import Target

DIBOND_3MM = 3.8
"""Mass of aluminium composite panel, 3 mm, kg per square metre."""

STAND = 0.5
"""Largest width of the stand over that of the target, so that the LiDAR does not see it beside the target."""


def parts_list(target: Target, workshop: Workshop | None = None, sheets: list[Sheet] | None = None) -> list[str]:
    """Return the parts, one line each.

    Args:
        target: the target.
        workshop: marks and holes, if any.
        sheets: of the printed drawing, if it is printed.
    """
    workshop = Workshop() if workshop is None else workshop
    width, height = MM * np.ptp(target.polygon, axis=0)
    lengths = MM * target.edge_lengths
    n = len(target)
    parts = [
        f"1 plate, {width:.0f} x {height:.0f} mm at least, stiff and flat to 2 mm, matt and light on the face "
        f"(aluminium composite, 3 mm: {DIBOND_3MM * target.area:.1f} kg)",
        "cut: edges " + ", ".join(f"{k}-{(k + 1) % n} {length:.1f}" for k, length in enumerate(lengths)) + " mm",
    ]
    checks = [f"{i}-{j} {MM * np.linalg.norm(target.polygon[i] - target.polygon[j]):.1f}" for i, j in diagonals(target)]
    if checks:
        parts.append("check: diagonals " + ", ".join(checks) + " mm, to 1 mm")
    if workshop.marker_inset > 0:
        parts.append(
            f"{n} markers, each {workshop.marker_inset:g} mm in from its corner: name them corner0 ... corner{n - 1}"
        )
    if workshop.hole_diameter > 0:
        parts.append(f"{n} holes of {workshop.hole_diameter:g} mm, each {workshop.hole_inset:g} mm in from its corner")
    if target.chessboard is not None:
        n_z, n_y = target.chessboard.inner_corners
        parts.append(
            f"print: chessboard, {n_z + 1} x {n_y + 1} squares of {MM * target.chessboard.square:.1f} mm, matt"
        )
    if target.tags is not None:
        numbers = ", ".join(str(number) for number in target.tags.centres)
        parts.append(f"print: {target.tags.dictionary} {numbers}, black square {MM * target.tags.size:.1f} mm, matt")
    if sheets is not None and len(sheets) > 1:
        w, h = sheets[0].size
        parts.append(f"{len(sheets)} sheets of {w:.0f} x {h:.0f} mm, cut at the marks and butted together")
    parts.append(
        f"1 stand behind the plate, no wider than {STAND * width:.0f} mm, nothing else within 0.5 m behind the edges"
    )
    return parts
