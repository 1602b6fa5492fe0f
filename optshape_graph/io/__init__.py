"""Reading and writing of files: clouds, targets, sensors, sessions, markers, cameras. It knows the nouns only.

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
    "builtin": "demo_folder",
    "cameras": "load_camera save_camera",
    "clouds": "Columns make_scan read_scan write_scan",
    "markers": "Markers read_markers",
    "schemas": "load_schema schema_names",
    "sensors": "load_sensor save_sensor",
    "sessions": "Mocap Session View load_session",
    "targets": "load_target save_target",
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
