"""Reading and writing of clouds: files and messages of every form become one `Scan`."""

from optshape_graph.io.clouds.columns import Columns
from optshape_graph.io.clouds.files import ENDINGS, read_columns, read_scan, read_scans, write_scan
from optshape_graph.io.clouds.scans import make_scan

__all__ = ["ENDINGS", "Columns", "make_scan", "read_columns", "read_scan", "read_scans", "write_scan"]
