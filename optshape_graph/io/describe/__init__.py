"""What a file or folder is, in a few facts: one module for each kind of file; `files` chooses among them."""

from optshape_graph.io.describe.facts import Facts
from optshape_graph.io.describe.files import describe

__all__ = ["Facts", "describe"]
