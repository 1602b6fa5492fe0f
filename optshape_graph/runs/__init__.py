"""Many tasks: workers and clusters, journals of what is finished, interruption. Knows no LiDAR."""

from optshape_graph.runs.interruption import Stopped
from optshape_graph.runs.journal import Journal
from optshape_graph.runs.workers import Lost, Pool, in_order

__all__ = ["Journal", "Lost", "Pool", "Stopped", "in_order"]
