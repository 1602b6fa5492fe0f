"""Files in, files out: clouds, targets, sensors, sessions, markers, cameras. Knows the nouns only.

Names are imported when they are first used.
"""

from typing import TYPE_CHECKING

from optshape_graph._lazy import lazy

if TYPE_CHECKING:
    from optshape_graph.io.builtin import demo_folder
    from optshape_graph.io.cameras import load_camera, save_camera
    from optshape_graph.io.clouds import Columns, make_scan, read_scan, write_scan
    from optshape_graph.io.markers import Markers, read_markers
    from optshape_graph.io.schemas import load_schema, schema_names
    from optshape_graph.io.sensors import load_sensor, save_sensor
    from optshape_graph.io.sessions import Mocap, Session, View, load_session
    from optshape_graph.io.targets import load_target, save_target

_HOME = {
    "Columns": "clouds",
    "Markers": "markers",
    "Mocap": "sessions",
    "Session": "sessions",
    "View": "sessions",
    "demo_folder": "builtin",
    "load_camera": "cameras",
    "load_schema": "schemas",
    "load_sensor": "sensors",
    "load_session": "sessions",
    "load_target": "targets",
    "make_scan": "clouds",
    "read_markers": "markers",
    "read_scan": "clouds",
    "save_camera": "cameras",
    "save_sensor": "sensors",
    "save_target": "targets",
    "schema_names": "schemas",
    "write_scan": "clouds",
}

__all__ = [
    "Columns",
    "Markers",
    "Mocap",
    "Session",
    "View",
    "demo_folder",
    "load_camera",
    "load_schema",
    "load_sensor",
    "load_session",
    "load_target",
    "make_scan",
    "read_markers",
    "read_scan",
    "save_camera",
    "save_sensor",
    "save_target",
    "schema_names",
    "write_scan",
]

__getattr__, __dir__ = lazy(__name__, _HOME)
