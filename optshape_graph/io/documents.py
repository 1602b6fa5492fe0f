"""YAML and JSON documents: read safely, with the place of every value for messages; written atomically.

Reading gives plain data only: mappings with text keys, lists, text, numbers, booleans and null. Duplicate keys, and
documents beyond a size or depth, are refused.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from optshape_graph.errors import InputError
from optshape_graph.io.files import is_file, read_text, write_atomically
from optshape_graph.io.nodes import Node
from optshape_graph.io.schemas import load_schema
from optshape_graph.io.validation import check
from optshape_graph.io.yaml_core import dump_yaml, parse_yaml

__all__ = [
    "Node",
    "check_document",
    "named_files",
    "read_document",
    "read_json",
    "read_plain",
    "read_yaml",
    "write_atomically",
    "write_json",
    "write_yaml",
]

LARGEST_YAML = 16 << 20
LARGEST_JSON = 512 << 20


def read_document(path: str | Path, kind: str, version: int = 1, anywhere: bool = True) -> Node:
    """Read a file of this package's forms, and check it against the form's schema.

    Args:
        path: a `.json` file, or else YAML.
        kind: what the file should be, as in `schema: optshape/<kind>/<version>`.
        version: the version that the caller reads.
        anywhere: whether the files that it names may lie outside its folder (see `Node.place`).

    Raises:
        InputError: not readable, not well-formed, of another kind or version, or in conflict with the schema.
    """
    root = read_plain(path)
    check_document(root, kind, version)
    return replace(root, anywhere=anywhere)


def read_plain(path: str | Path) -> Node:
    """Read a `.json` file, or else YAML, of any form.

    Raises:
        InputError: not readable, or not well-formed.
    """
    return read_json(path) if Path(path).suffix.lower() == ".json" else read_yaml(path)


def check_document(root: Node, kind: str, version: int = 1) -> None:
    """Check that a document states a kind and version, and fits the schema of that form.

    Raises:
        InputError: it states none or another, or does not fit.
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
    check(root, load_schema(f"{kind}-{version}"))


def named_files(path: str | Path) -> list[Path]:
    """Return the files that a document names under any key: texts that are paths of files from its folder.

    Raises:
        InputError: the document is not readable.
    """

    def texts(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict | list):
            for item in value.values() if isinstance(value, dict) else value:
                yield from texts(item)

    folder = Path(path).parent
    return [folder / text for text in dict.fromkeys(texts(read_plain(path).value)) if is_file(folder / text)]


def read_yaml(path: str | Path) -> Node:
    """Read a YAML document.

    Raises:
        InputError: not readable, not well-formed, or YAML that this package refuses (tags, duplicate keys, ...).
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
    """Write plain data, NumPy arrays and scalars as JSON. Floats keep all bits; a row of numbers is one line.

    Raises:
        InputError: a number is not finite, a value has no JSON form, or the file cannot be written.
    """
    write_atomically(path, _encode(value, str(path), "") + "\n")


def json_text(value: Any, what: str, indent: str = "") -> str:
    """Return plain data, NumPy arrays and scalars as `write_json` writes them.

    Args:
        value: the data.
        what: the name of the data in messages.
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
