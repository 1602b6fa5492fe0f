"""Read-only arrays, and frozen dataclasses that hold them: equal by value, printed in a line, frozen when copied."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, ClassVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optshape_graph.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

LONGEST_REPR = 200
"""Characters that a `repr` has at most."""


def frozen(values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return `values` as a read-only array: a copy, unless they are a read-only array that owns its memory."""
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None and not values.flags.writeable:
        return values
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


def numbers(what: str, values: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return what a caller gave as numbers as a read-only array, as `frozen` does.

    Raises:
        InputError: text, complex numbers, rows of different lengths; `what` names them.
    """
    try:
        array = np.asarray(values)
        if array.dtype.kind == "c":
            raise TypeError("complex")
        return frozen(array, dtype)
    except (TypeError, ValueError) as error:
        raise InputError(f"{what}: expected real numbers ({error})") from error


@overload
def owned(values: None, dtype: Any) -> None: ...
@overload
def owned(values: ArrayLike, dtype: Any) -> NDArray[Any]: ...
def owned(values: ArrayLike | None, dtype: Any) -> NDArray[Any] | None:
    """Return values as a read-only array that `frozen` does not copy. The caller must not write to them afterwards."""
    if values is None:
        return None
    array = np.asarray(values, dtype=dtype)
    array = array if array.base is None else array.copy()
    array.setflags(write=False)
    return array


def refreeze(value: Any) -> None:
    """Make the arrays in a value read-only again: after a pickle or a deep copy they are writable."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple | list):
        for item in value:
            refreeze(item)
    elif isinstance(value, Mapping):
        for item in value.values():
            refreeze(item)


def alike(a: Any, b: Any) -> bool:
    """Return whether two values are equal, with the arrays in them compared by their numbers; NaN equals NaN."""
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


class Value:
    """Base of frozen dataclasses, which are declared with `eq=False, repr=False`: equality, hash, `repr`, copies."""

    if TYPE_CHECKING:
        __dataclass_fields__: ClassVar[dict[str, Any]]

    def __eq__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        names = [field.name for field in fields(self) if field.compare]
        return all(alike(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        return hash((type(self), *(_key(getattr(self, field.name)) for field in fields(self) if field.compare)))

    def __repr__(self) -> str:
        parts = [f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self) if field.repr]
        return shortened(f"{type(self).__name__}({', '.join(parts)})")

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the fields from a pickle or a copy, arrays read-only."""
        refreeze(state)
        self.__dict__.update(state)


def brief(value: Any) -> str:
    """Return a value in a few characters: an array as its shape, or as its numbers where there are few."""
    if isinstance(value, np.ndarray):
        if value.ndim == 1 and value.size <= 3:
            return "(" + ", ".join(f"{number:g}" for number in value) + ")"
        return "x".join(map(str, value.shape)) + f" {value.dtype.name}"
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, Value) or is_dataclass(value):
        return f"{type(value).__name__}({getattr(value, 'name', '...')})"
    if isinstance(value, tuple | list | dict | frozenset) and len(value) > 3:
        return f"{len(value)} items"
    return repr(value) if not isinstance(value, str) or len(value) <= 40 else repr(value[:37] + "...")


def shortened(text: str) -> str:
    """Return the text of a `repr` in one line, cut to `LONGEST_REPR`."""
    line = " ".join(text.split())
    return line if len(line) <= LONGEST_REPR else line[: LONGEST_REPR - 4] + "...)"


def _key(value: Any) -> Hashable:
    """Return a key that equal values share: -0.0 equals 0.0, NaN equals NaN, and dictionaries have no order."""
    if isinstance(value, np.ndarray):
        return value.shape, (value + 0).tobytes()
    if isinstance(value, Mapping):
        return frozenset((key, _key(item)) for key, item in value.items())
    if isinstance(value, tuple | list):
        return tuple(map(_key, value))
    return value if value == value else "nan"
