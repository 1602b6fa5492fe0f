"""YAML and JSON documents: read safely, with the place of every value for messages; written atomically.

Only plain data come out: mappings with text keys, lists, text, numbers, booleans and null. Duplicate keys, and
documents beyond a size or depth, are refused.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from optshape_graph._arrays import Floats, frozen
from optshape_graph.errors import InputError
from optshape_graph.io.files import inside, is_file, read_text, write_atomically
from optshape_graph.io.yaml_core import Key, dump_yaml, parse_yaml

__all__ = [
    "Node",
    "check_schema",
    "read_document",
    "read_json",
    "read_yaml",
    "write_atomically",
    "write_json",
    "write_yaml",
]

LARGEST_YAML = 16 << 20
LARGEST_JSON = 512 << 20


@dataclass(frozen=True)
class Node:
    """One value of a document, and where it stands.

    Attributes:
        value: plain data.
        path: the file.
        key: keys and indices from the document's root to this value.
        lines: the line of each key, counted from 1; empty for JSON.
        anywhere: whether the files that it names may be outside of its folder (see `place`).
    """

    value: Any
    path: Path
    key: Key = ()
    lines: Mapping[Key, int] = field(default_factory=dict, repr=False)
    anywhere: bool = True

    @property
    def where(self) -> str:
        """File, line and key, as messages begin."""
        line = self.lines.get(self.key)
        name = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in self.key).lstrip(".")
        return f"{self.path}{f':{line}' if line else ''}" + (f": {name}" if name else "")

    def fail(self, problem: str) -> NoReturn:
        """Raise the error that this value has a problem.

        Raises:
            InputError: always.
        """
        raise InputError(f"{self.where}: {problem}")

    def expected(self, what: str) -> NoReturn:
        """Raise the error that something else was expected here."""
        self.fail(f"expected {what}, found {_found(self.value)}")

    def at(self, key: str | int) -> Node:
        """The value under a key or index that is known to be there."""
        return Node(self.value[key], self.path, (*self.key, key), self.lines, self.anywhere)

    def entries(self) -> dict[str, Node]:
        """The values of a mapping whose keys are names that the author chose."""
        if not isinstance(self.value, dict):
            self.expected("a mapping")
        return {key: self.at(key) for key in self.value}

    def fields(self, required: Iterable[str] = (), optional: Iterable[str] = ()) -> dict[str, Node]:
        """The values of a mapping with known keys.

        Raises:
            InputError: a key is unknown, or a required one is missing.
        """
        entries, required = self.entries(), list(required)
        known = [*required, *optional]
        for key, node in entries.items():
            if key not in known:
                close = difflib.get_close_matches(key, known, 1)
                hint = f" (did you mean '{close[0]}'?)" if close else ""
                node.fail(f"unknown key '{key}'{hint}; expected one of: {', '.join(known)}")
        for key in required:
            if key not in entries:
                self.fail(f"the key '{key}' is missing; found only: {', '.join(entries) or 'nothing'}")
        return entries

    def items(self) -> list[Node]:
        """The values of a list."""
        if not isinstance(self.value, list):
            self.expected("a list")
        return [self.at(i) for i in range(len(self.value))]

    def text(self) -> str:
        """A text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            self.expected("a text" + (" (put it in quotes)" if isinstance(self.value, bool | int | float) else ""))
        return self.value

    def choice(self, choices: Sequence[str]) -> str:
        """One of several texts."""
        if self.value not in choices:
            self.expected(f"one of: {', '.join(choices)}")
        return str(self.value)

    def integer(self, least: int = 0) -> int:
        """An integer of at least `least`."""
        if isinstance(self.value, bool) or not isinstance(self.value, int) or self.value < least:
            self.expected(f"an integer of at least {least}")
        return self.value

    def number(self, least: float = -math.inf, above: float = -math.inf) -> float:
        """A finite number, of at least `least` and above `above`."""
        value = self.value
        bounds = [f"at least {least:g}"] * math.isfinite(least) + [f"above {above:g}"] * math.isfinite(above)
        what = " ".join(["a finite number", *bounds])
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.expected(what)
        if not (abs(value) < 1e300 and value >= least and value > above):  # also refuses NaN
            self.expected(what)
        return float(value)

    def numbers(self, *shape: int) -> Floats:
        """An array of finite numbers (...), as they stand; -1 in `shape` stands for any length but zero.

        Raises:
            InputError: another nesting, another length, or an element that is not a finite number.
        """

        def collect(node: Node, shape: tuple[int, ...]) -> Any:
            if not shape:
                return node.number()
            items = node.items()
            if len(items) != shape[0] and not (shape[0] == -1 and items):
                wanted = "at least one element" if shape[0] == -1 else f"{shape[0]} elements"
                node.fail(f"expected a list of {wanted}, found {len(items)}")
            return [collect(item, shape[1:]) for item in items]

        return frozen(collect(self, shape))

    def place(self) -> Path:
        """The path that this text is, whether or not there is a file; a relative one starts at the document's folder.

        Unless files may be anywhere, a relative path must lead into that folder, or into the one above, where the
        sessions of a campaign keep what they share (`../target.yaml`). What leads farther, by `..` or by a link, is
        refused: it means another file when the folder is moved or copied. An absolute path says where it leads, and is
        followed.

        Raises:
            InputError: it is no text, or leads too far.
        """
        text = self.text()
        path = self.path.parent / text
        if not self.anywhere and not Path(text).is_absolute():
            try:
                inside(path, self.path.parent.resolve().parent, "its folder and the one above,")
            except InputError as error:
                self.fail(f"{error}; write the whole path, or allow it (--allow-outside)")
        return path

    def file(self) -> Path:
        """The `place` of a file that exists."""
        path = self.place()
        if not is_file(path):
            self.fail(f"no such file: {path}")
        return path


def read_document(path: str | Path, kind: str, version: int = 1, anywhere: bool = True) -> Node:
    """Read a file of this package's forms and check what it says it is.

    Args:
        path: a `.json` file, or else YAML.
        kind: what the file should be, as in `schema: optshape/<kind>/<version>`.
        version: the version that the caller reads.
        anywhere: whether the files that it names may be outside of its folder (see `Node.place`).

    Raises:
        InputError: not readable, not well-formed, or of another kind or version.
    """
    root = read_json(path) if Path(path).suffix.lower() == ".json" else read_yaml(path)
    check_schema(root, kind, version)
    return replace(root, anywhere=anywhere)


def check_schema(root: Node, kind: str, version: int = 1) -> None:
    """Check that a document says it is of a kind and version.

    Raises:
        InputError: it says nothing, or something else.
    """
    wanted = f"optshape/{kind}/{version}"
    if not isinstance(root.value, dict):
        root.expected(f"a mapping with 'schema: {wanted}'")
    if "schema" not in root.value:
        root.fail(f"the key 'schema' is missing; a {kind} file says 'schema: {wanted}'")
    schema = root.at("schema")
    if schema.value != wanted:
        found = re.fullmatch(rf"optshape/{re.escape(kind)}/([0-9]{{1,9}})", str(schema.value))
        if found and int(found[1]) > version:
            schema.fail(
                f"'{schema.value}' is a newer form of {kind} file; this version of optshape_graph reads '{wanted}'"
            )
        schema.expected(f"'{wanted}'")


def read_yaml(path: str | Path) -> Node:
    """Read a YAML document.

    Raises:
        InputError: not readable, not well-formed, or with what this package refuses in YAML.
    """
    text = read_text(path, LARGEST_YAML)
    value, lines = parse_yaml(path, text)
    return Node(value, Path(path), (), lines)


def read_json(path: str | Path) -> Node:
    """Read a JSON document.

    Raises:
        InputError: not readable, not well-formed, with a duplicate key, NaN or infinity, or nested too deeply.
    """
    text = read_text(path, LARGEST_JSON)

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping = dict(pairs)
        if len(mapping) < len(pairs):
            ((name, _),) = Counter(name for name, _ in pairs).most_common(1)
            raise InputError(f"{path}: the key '{name}' is given twice")
        return mapping

    def refuse(name: str) -> NoReturn:
        raise InputError(f"{path}: {name} is not a JSON number; expected finite numbers")

    try:
        return Node(json.loads(text, object_pairs_hook=unique, parse_constant=refuse), Path(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}: not JSON ({error.msg}, column {error.colno})") from error
    except RecursionError as error:
        raise InputError(f"{path}: nested too deeply") from error
    except InputError:
        raise
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"{path}: not usable JSON ({error})") from error


def write_json(path: str | Path, value: Any) -> None:
    """Write plain data, NumPy arrays and scalars as JSON: floats read back as they were, one row of numbers per line.

    Raises:
        InputError: a number is not finite, a value has no JSON form, or the file cannot be written.
    """
    write_atomically(path, _encode(value, str(path), "") + "\n")


def json_text(value: Any, what: str, indent: str = "") -> str:
    """Return plain data, NumPy arrays and scalars as `write_json` writes them.

    Args:
        value: the data.
        what: they are, for messages.
        indent: of all lines but the first.

    Raises:
        InputError: a number is not finite, or a value has no JSON form.
    """
    return _encode(value, what, indent)


def write_yaml(path: str | Path, value: Mapping[str, Any]) -> None:
    """Write a mapping of plain data as YAML, in its order.

    Raises:
        InputError: the file cannot be written.
    """
    write_atomically(path, dump_yaml(value))


def _encode(value: Any, key: str, indent: str) -> str:
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    inner = indent + "  "
    if isinstance(value, Mapping):
        if not all(isinstance(name, str) for name in value):
            raise InputError(f"{key}: JSON keys are text, found {list(value)[:5]}")
        parts = [f"{json.dumps(name)}: {_encode(item, f'{key}: {name}', inner)}" for name, item in value.items()]
        return _block("{", parts, "}", indent)
    if isinstance(value, list | tuple):
        if all(item is None or isinstance(item, bool | int | float | str | np.generic) for item in value):
            return "[" + ", ".join(_encode(item, key, inner) for item in value) + "]"
        return _block("[", [_encode(item, f"{key}[{i}]", inner) for i, item in enumerate(value)], "]", indent)
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{key}: {value} has no JSON form; expected finite numbers (null stands for 'none')")
    if value is None or isinstance(value, bool | int | float | str):
        return json.dumps(value)
    raise InputError(f"{key}: {type(value).__name__} has no JSON form")


def _block(opening: str, parts: list[str], closing: str, indent: str) -> str:
    if not parts:
        return opening + closing
    return opening + "".join(f"\n{indent}  {part}," for part in parts)[:-1] + f"\n{indent}{closing}"


def _found(value: Any) -> str:
    match value:
        case None:
            return "nothing (null)"
        case dict():
            return "a mapping"
        case list():
            return f"a list of {len(value)}"
    shown = repr(value)
    return shown if len(shown) <= 80 else shown[:77] + "..."
