"""What damaged files may do: be read all the same, or be refused by name."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from optshape_graph import InputError


@contextlib.contextmanager
def read_or_refused(path: Path) -> Iterator[None]:
    """Let an `InputError` pass that names `path`; every other exception is a failure."""
    try:
        yield
    except InputError as error:
        if str(path) not in str(error):
            raise
