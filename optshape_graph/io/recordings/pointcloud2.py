"""PointCloud2: the fields of its points as arrays, without a copy and without a loop over points."""

from __future__ import annotations

from typing import Any

import numpy as np

from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.recordings.stream import BadMessage

FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""sensor_msgs/PointField datatype to NumPy type."""


def point_columns(message: Any, name: str) -> Columns:
    """Return the scalar fields of a sensor_msgs/PointCloud2, each (height * width,).

    They keep the type and byte order in which they were sent. Fields of several values (descriptors), of an unknown
    type or outside the point are left out, and their names are kept; unnamed fields (padding) are left out.

    Args:
        message: the deserialised message.
        name: of the cloud, for messages.

    Raises:
        BadMessage: no points, data shorter than declared, fields outside the point, no x, y or z.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if height * width == 0:
        raise BadMessage("empty", f"{height} x {width} points")
    row_step = int(message.row_step) if height > 1 else width * step
    if row_step < width * step and len(message.data) == height * width * step:
        row_step = width * step  # 0, or the width: some drivers do not fill it in
    needed = (height - 1) * row_step + width * step
    if step == 0 or row_step < width * step:
        raise BadMessage("malformed", f"{width} points of {step} bytes do not fit in rows of {row_step}")
    if len(message.data) < needed:
        raise BadMessage("truncated", f"{len(message.data)} bytes of data, {needed} declared")
    points = np.ndarray((height, width), _point_type(message), message.data, strides=(row_step, step))
    values = {field: points[field].reshape(-1) for field in points.dtype.names or ()}
    left_out = dict.fromkeys(str(field.name) for field in message.fields if field.name and field.name not in values)
    return Columns(values, height, name, left_out=tuple(left_out))


def _point_type(message: Any) -> np.dtype[Any]:
    """Return the structured type of a point, of point_step bytes."""
    step = int(message.point_step)
    order = ">" if message.is_bigendian else "<"
    named: dict[str, tuple[str, int]] = {}
    wrong: list[str] = []
    for field in message.fields:
        if not field.name or field.name in named or field.count > 1:
            continue
        if field.datatype not in FORMATS:
            wrong.append(f"field '{field.name}' has datatype {field.datatype}; 1 to 8 are defined")
            continue
        kind = np.dtype(order + FORMATS[field.datatype])
        if field.offset + kind.itemsize > step:
            wrong.append(f"field '{field.name}' at byte {field.offset} of a point of {step}")
            continue
        named[field.name] = (kind.str, int(field.offset))
    if missing := {"x", "y", "z"} - named.keys():
        if wrong:
            raise BadMessage("malformed", wrong[0])
        raise BadMessage("no coordinates", f"fields {', '.join(named)}; {', '.join(sorted(missing))} missing")
    formats, offsets = zip(*named.values(), strict=True)
    return np.dtype({"names": list(named), "formats": formats, "offsets": offsets, "itemsize": step})
