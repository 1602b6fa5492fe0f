"""Read-only arrays for frozen dataclasses."""

from __future__ import annotations

from collections.abc import Mapping
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


def refreeze(value: Any) -> None:
    """Make the arrays in a value read-only: pickles and deep copies bring them back writable."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple | list):
        for item in value:
            refreeze(item)
    elif isinstance(value, Mapping):
        for item in value.values():
            refreeze(item)


def alike(a: Any, b: Any) -> bool:
    """Say whether two values are the same, arrays and what holds them included; NaN is the same as NaN."""
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f" and b.dtype.kind == "f")
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(alike(value, b[key]) for key, value in a.items())
    return bool(a == b or (a != a and b != b))
