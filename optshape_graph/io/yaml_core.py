"""YAML and plain data: read through the parser's events, so that nothing in a file chooses what is constructed.

PyYAML's own composer recurses in C without a limit (a deep document crashes the process), keeps the last of duplicate
keys, and resolves as YAML 1.1 does. Here scalars resolve as in the core schema of YAML 1.2: `1e-3` is a number; `no`,
`12:30` and `2024-01-01` are text. Tags, anchors and aliases are refused, and with them aliases that expand without end;
in files of other programs tags, and anchors that nothing refers to, are passed over: no tag ever chooses a type.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, TypeAlias

import yaml

from optshape_graph.errors import InputError

DEEPEST = 50
"""Levels of nesting; the deepest form of this package has eight."""

MOST_VALUES = 500_000
"""Values of a document: each costs some hundred bytes. A session of ten thousand views has a tenth of that."""

Key: TypeAlias = tuple[str | int, ...]
"""Keys and indices from the root of a document to a value."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml where PyYAML was built with it
_NULL = {"", "~", "null", "Null", "NULL"}
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_INTEGER = re.compile(r"(?:[-+]?[0-9]+|0x[0-9a-fA-F]+|0o[0-7]+)\Z")
_FLOAT = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?\Z")
_OPENCV_LINE = re.compile(r"\A(?=%YAML:)")
_NON_FINITE = re.compile(r"(?:[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z")


def parse_yaml(path: str | Path, text: str, foreign: bool = False) -> tuple[Any, dict[Key, int]]:
    """Return the one document of a YAML text, and the line, from 1, of each key.

    Args:
        path: the file, for messages.
        text: its content.
        foreign: whether another program wrote it; then tags, anchors without aliases, and the first line that OpenCV
            writes (`%YAML:1.0`, which no version of YAML has) are ignored.

    Raises:
        InputError: not YAML, empty, several documents, or with a feature that is refused.
    """
    if foreign:
        text = _OPENCV_LINE.sub("#", text)
    return _Builder(Path(path), text, foreign).build()


def dump_yaml(value: Mapping[str, Any]) -> str:
    """Return the YAML text of a mapping of plain data, in its order; short lists on one line."""
    text: str = yaml.dump(dict(value), None, _Dumper, sort_keys=False, default_flow_style=None)
    return text


class _Dumper(yaml.SafeDumper):
    """Writes text in quotes if `parse_yaml`, or a reader of YAML 1.1, would take it for something else."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", _INTEGER, list("-+0123456789"))
_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+.0123456789"))


class _Builder:
    """Makes plain data of the parser's events, and notes their lines."""

    def __init__(self, path: Path, text: str, foreign: bool) -> None:
        self.path, self.foreign = path, foreign
        self.events = yaml.parse(text, _LOADER)
        self.lines: dict[Key, int] = {}

    def build(self) -> tuple[Any, dict[Key, int]]:
        try:
            event = self._next()  # stream start
            event = self._next()
            if isinstance(event, yaml.StreamEndEvent):
                raise InputError(f"{self.path}: the file is empty")
            value = self._value((), self._next())
            lines = self.lines.copy()
            self._next()  # document end
            while not isinstance(self._next(), yaml.StreamEndEvent):
                if self._value((), self._next()) is not None:  # `topic echo` ends with an empty document
                    raise InputError(f"{self.path}: expected one YAML document, found several")
                self._next()
            return value, lines
        except yaml.MarkedYAMLError as error:
            line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
            problem = " ".join(part for part in (error.context, error.problem) if part)
            if "nesting depth" in problem:  # libyaml's own limit, if it has one, comes first
                raise InputError(f"{self.path}{line}: nested more than {DEEPEST} levels deep") from error
            raise InputError(f"{self.path}{line}: not YAML ({problem})") from error
        except yaml.YAMLError as error:
            raise InputError(f"{self.path}: not YAML ({' '.join(str(error).split())})") from error

    def _next(self) -> yaml.Event:
        event: yaml.Event = next(self.events)
        return event

    def _fail(self, event: yaml.Event, problem: str) -> NoReturn:
        raise InputError(f"{self.path}:{_line(event)}: {problem}")

    def _value(self, key: Key, event: yaml.Event) -> Any:
        anchor = getattr(event, "anchor", None)  # of an alias too
        if anchor and not (self.foreign and not isinstance(event, yaml.AliasEvent)):
            self._fail(event, f"anchors and aliases are not read ('{anchor}'); write the value out")
        if len(key) > DEEPEST:
            self._fail(event, f"nested more than {DEEPEST} levels deep")
        if (tag := getattr(event, "tag", None)) not in (None, "!") and not self.foreign:
            self._fail(event, f"tags are not read, found '{tag}'; expected plain values")
        self.lines.setdefault(key, _line(event))
        if len(self.lines) > MOST_VALUES:
            self._fail(event, f"more than {MOST_VALUES} values; expected large data in other files")
        if isinstance(event, yaml.ScalarEvent):
            return self._scalar(event)
        if isinstance(event, yaml.SequenceStartEvent):
            items: list[Any] = []
            while not isinstance(event := self._next(), yaml.SequenceEndEvent):
                items.append(self._value((*key, len(items)), event))
            return items
        mapping: dict[str, Any] = {}
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                self._fail(event, "expected a text as key")
            name = event.value
            if name in mapping:
                self._fail(event, f"the key '{name}' is given twice, first on line {self.lines[(*key, name)]}")
            self.lines[(*key, name)] = _line(event)
            mapping[name] = self._value((*key, name), self._next())
        return mapping

    def _scalar(self, event: yaml.ScalarEvent) -> Any:
        text: str = event.value
        if event.style or event.tag == "!":  # quoted, or a block of text
            return text
        if text in _NULL:
            return None
        if text in _BOOLEANS:
            return _BOOLEANS[text]
        if _INTEGER.match(text):
            if len(text) > 100:
                self._fail(event, f"an integer of {len(text)} digits; expected a number of sensible size")
            return int(text, 0 if text[:2] in ("0x", "0o") else 10)
        if _FLOAT.match(text):
            return float(text)
        if _NON_FINITE.match(text):
            return float(text.replace(".", "", 1))
        return text


def _line(event: yaml.Event) -> int:
    return event.start_mark.line + 1 if event.start_mark else 0
