"""Read-only arrays for frozen dataclasses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return a read-only copy of `values`, so that what a dataclass holds cannot change under it."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array
