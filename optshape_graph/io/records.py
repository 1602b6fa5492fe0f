"""Records: dataclasses as plain data, from which they are restored whole.

A record holds every field of a dataclass by its name. The types that the class declares tell how to restore it: a file
cannot choose which objects are made.
"""

from __future__ import annotations

import types
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from optshape_graph.errors import InputError

_NOT_FINITE = {"nan": float("nan"), "inf": float("inf"), "-inf": float("-inf")}
"""Numbers that JSON cannot write, and the texts that stand for them."""

_CLASS = "is"
"""Key of a record that names its class."""


def to_record(value: Any) -> Any:
    """Return a value as plain data: dataclasses and named tuples, arrays, containers, text, numbers, None.

    Raises:
        InputError: a value of another type.
    """
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else repr(value)
    if isinstance(value, np.generic):
        return to_record(value.item())
    if isinstance(value, np.ndarray):
        plain = value.tolist()
        return {"shape": list(value.shape)} if not value.size else plain if _finite(value) else to_record(plain)
    if is_dataclass(value) or _is_named_tuple(value):
        names = _names(value.__class__)
        return {_CLASS: type(value).__name__, **{name: to_record(getattr(value, name)) for name in names}}
    if isinstance(value, Mapping):
        return [[to_record(key), to_record(item)] for key, item in value.items()]
    if isinstance(value, frozenset | set):
        return [to_record(item) for item in sorted(value)]
    if isinstance(value, Sequence):
        return [to_record(item) for item in value]
    if isinstance(value, slice):
        return [value.start, value.stop]
    if isinstance(value, Path):
        return str(value)
    raise InputError(f"a {type(value).__name__} cannot be saved")


def from_record(kind: Any, data: Any, where: str) -> Any:
    """Restore a value.

    Args:
        kind: its class, or the declared type of a field.
        data: the record, as `to_record` returned it or a file held it.
        where: the file and the place in it, for messages.

    Raises:
        InputError: data of another type.
    """
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return data
    if origin in (Union, types.UnionType):
        return _one_of(arguments, data, where)
    if origin is Literal:
        return _checked(data, data in arguments, kind, where)
    if origin is np.ndarray:
        return _array(data, get_args(arguments[1])[0], where)
    if kind in (type(None), None):
        return _checked(data, data is None, kind, where)
    if kind is float:
        if isinstance(data, str) and data in _NOT_FINITE:
            return _NOT_FINITE[data]
        return float(_checked(data, isinstance(data, int | float) and not isinstance(data, bool), kind, where))
    if kind in (str, int, bool):
        return _checked(data, type(data) is kind, kind, where)
    if kind is Path:
        return Path(_checked(data, isinstance(data, str), kind, where))
    if kind is slice:
        start, stop = _items(data, 2, where)
        return slice(start, stop)
    if isinstance(kind, type) and (is_dataclass(kind) or hasattr(kind, "_fields")):
        return _instance(kind, data, where)
    if origin is tuple and len(arguments) == 2 and arguments[1] is Ellipsis:
        return tuple(from_record(arguments[0], item, f"{where}[{k}]") for k, item in enumerate(_items(data, -1, where)))
    if origin is tuple:
        items = _items(data, len(arguments), where)
        return tuple(from_record(one, item, where) for one, item in zip(arguments, items, strict=True))
    if origin is Counter:
        pairs = [_items(pair, 2, where) for pair in _items(data, -1, where)]
        return Counter({from_record(arguments[0], k, where): from_record(int, v, where) for k, v in pairs})
    if origin is not None and issubclass(origin, Mapping):
        pairs = [_items(pair, 2, where) for pair in _items(data, -1, where)]
        return {from_record(arguments[0], k, where): from_record(arguments[1], v, f"{where}.{k}") for k, v in pairs}
    if origin is not None and issubclass(origin, frozenset | set):
        return origin(from_record(arguments[0], item, where) for item in _items(data, -1, where))
    if origin is not None and issubclass(origin, Sequence):
        return tuple(from_record(arguments[0], item, where) for item in _items(data, -1, where))
    raise InputError(f"{where}: a {kind} cannot be loaded")


def _instance(kind: type, data: Any, where: str) -> Any:
    hints, names = _hints(kind), _names(kind)
    if not isinstance(data, dict) or data.get(_CLASS) != kind.__name__:
        raise InputError(f"{where}: expected the record of a {kind.__name__}")
    found = [name for name in data if name != _CLASS]
    if set(found) != set(names):
        differing = sorted(set(found) ^ set(names))
        raise InputError(f"{where}: a {kind.__name__} of another version of optshape_graph ({', '.join(differing)})")
    try:
        return kind(**{name: from_record(hints[name], data[name], f"{where}.{name}") for name in names})
    except InputError:
        raise
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: not a {kind.__name__} ({error})") from error


def _one_of(kinds: Sequence[Any], data: Any, where: str) -> Any:
    """Restore a value of one of several types: of the class that the record names, or of the first type that fits."""
    if isinstance(data, dict) and _CLASS in data:
        kinds = [kind for kind in kinds if getattr(kind, "__name__", "") == data[_CLASS]]
    problems = []
    for kind in kinds:
        try:
            return from_record(kind, data, where)
        except InputError as error:
            problems.append(error)
    raise problems[0] if problems else InputError(f"{where}: not of a type that can stand here")


def _array(data: Any, dtype: type, where: str) -> Any:
    if isinstance(data, dict):
        shape = data.get("shape")
        if isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape) and 0 in shape and len(shape) < 8:
            return np.zeros(shape, dtype)
    try:
        flat = np.array(data, dtype=object)
        values = np.array([_NOT_FINITE.get(item, item) for item in flat.flat]).reshape(flat.shape)
        if values.dtype.kind in "bif" and (dtype is not np.bool_ or values.dtype.kind == "b"):
            return values.astype(dtype)
    except (TypeError, ValueError):
        pass
    raise InputError(f"{where}: expected an array of numbers")


def _items(data: Any, count: int, where: str) -> list[Any]:
    if not isinstance(data, list) or count not in (-1, len(data)):
        raise InputError(f"{where}: expected a list" + (f" of {count}" if count >= 0 else ""))
    return data


def _checked(data: Any, good: bool, kind: Any, where: str) -> Any:
    if not good:
        raise InputError(f"{where}: expected {getattr(kind, '__name__', kind)}, found {str(data)[:60]!r}")
    return data


def _finite(array: np.ndarray) -> bool:
    return array.dtype.kind in "biu" or bool(np.isfinite(array).all())


def _is_named_tuple(value: Any) -> bool:
    return isinstance(value, tuple) and hasattr(value, "_fields")


@cache
def _names(kind: Any) -> tuple[str, ...]:
    """Return the names of the fields of a dataclass or named tuple."""
    if is_dataclass(kind):
        return tuple(field.name for field in fields(kind) if field.init)
    return tuple(kind._fields)


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)
