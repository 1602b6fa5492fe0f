"""Read-only arrays for frozen dataclasses, which compare by value and stay frozen."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar

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


class Value:
    """Base of frozen dataclasses with arrays (`eq=False`): equal by value, hashed by it, and frozen in every copy."""

    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Any]]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(_same(getattr(self, field.name), getattr(other, field.name)) for field in fields(self))

    def __hash__(self) -> int:
        return hash((type(self), *(_key(getattr(self, field.name)) for field in fields(self))))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickle or a deep copy, in which NumPy leaves arrays writeable."""
        for value in state.values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)
        self.__dict__.update(state)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return a is not None and b is not None and np.array_equal(a, b)
    return bool(a == b)


def _key(value: Any) -> Hashable:
    """What hashes alike for equal values: -0.0 equals 0.0, and a dictionary has no order."""
    if isinstance(value, np.ndarray):
        return value.shape, (value + 0).tobytes()
    if isinstance(value, Mapping):
        return frozenset(value.items())
    return value  # type: ignore[no-any-return]
