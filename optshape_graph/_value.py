"""What every frozen dataclass of the package does alike: compare by value, print in a line, stay frozen when copied."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from optshape_graph._arrays import alike, refreeze

LONGEST_REPR = 200
"""Characters of a `repr`."""


class Value:
    """Base of frozen dataclasses, which are declared with `eq=False, repr=False`: what they do alike is here."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if other.__class__ is not self.__class__:
            return NotImplemented
        assert is_dataclass(self)
        names = [field.name for field in fields(self) if field.compare]
        return all(alike(getattr(self, name), getattr(other, name)) for name in names)

    def __hash__(self) -> int:
        assert is_dataclass(self)
        return hash((type(self), *(_hashed(getattr(self, field.name)) for field in fields(self) if field.compare)))

    def __repr__(self) -> str:
        assert is_dataclass(self)
        parts = [f"{field.name}={brief(getattr(self, field.name))}" for field in fields(self) if field.repr]
        return shortened(f"{type(self).__name__}({', '.join(parts)})")

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take what a pickle or a copy brings, arrays read-only."""
        refreeze(state)
        self.__dict__.update(state)


def brief(value: Any) -> str:
    """Return a value in a few characters: arrays by their shape, or their numbers where there are few."""
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
    """Return the text of a `repr`, of one line and not longer than one may be."""
    line = " ".join(text.split())
    return line if len(line) <= LONGEST_REPR else line[: LONGEST_REPR - 4] + "...)"


def _hashed(value: Any) -> Any:
    """Something of a value that equal ones have in common."""
    if isinstance(value, np.ndarray):
        return value.shape
    if isinstance(value, str | int | float | bool | None) and value == value:
        return value
    return len(value) if isinstance(value, tuple | list | dict) else None
