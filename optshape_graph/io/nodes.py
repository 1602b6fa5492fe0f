"""One value of a YAML or JSON document, with its place in the file for messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from optshape_graph._arrays import Floats, frozen
from optshape_graph.errors import InputError
from optshape_graph.io.files import inside, is_file
from optshape_graph.io.yaml_core import Key


@dataclass(frozen=True)
class Node:
    """One value of a document, and its place in the file.

    Attributes:
        value: plain data.
        path: the file.
        key: keys and indices from the document's root to this value.
        lines: the line of each key, counted from 1; empty for JSON.
        anywhere: whether the files that it names may lie outside its folder (see `place`).
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
        """Raise an error that begins with the place of this value.

        Raises:
            InputError: always.
        """
        raise InputError(f"{self.where}: {problem}")

    def expected(self, what: str) -> NoReturn:
        """Raise the error that something else was expected than this value."""
        self.fail(f"expected {what}, found {found_in_words(self.value)}")

    def at(self, key: str | int) -> Node:
        """Return the value under a key or index that is known to be there."""
        return Node(self.value[key], self.path, (*self.key, key), self.lines, self.anywhere)

    def entries(self) -> dict[str, Node]:
        """Return the values of a mapping whose keys are names that the author chose."""
        if not isinstance(self.value, dict):
            self.expected("a mapping")
        return {key: self.at(key) for key in self.value}

    def fields(self, required: Iterable[str] = ()) -> dict[str, Node]:
        """Return the values of a mapping; keys beside the required ones are allowed.

        Raises:
            InputError: a required key is missing.
        """
        entries = self.entries()
        for key in required:
            if key not in entries:
                self.fail(f"the key '{key}' is missing; found only: {', '.join(entries) or 'nothing'}")
        return entries

    def items(self) -> list[Node]:
        """Return the values of a list."""
        if not isinstance(self.value, list):
            self.expected("a list")
        return [self.at(i) for i in range(len(self.value))]

    def text(self) -> str:
        """Return this value, which must be a text that is not empty."""
        if not isinstance(self.value, str) or not self.value:
            self.expected("a text" + (" (put it in quotes)" if isinstance(self.value, bool | int | float) else ""))
        return self.value

    def integer(self) -> int:
        """An integer."""
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            self.expected("an integer")
        return self.value

    def number(self) -> float:
        """A finite number."""
        value = self.value
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:  # also NaN
            self.expected("a finite number")
        return float(value)

    def numbers(self, *shape: int) -> Floats:
        """Return this value as an array of finite numbers (...); -1 in `shape` stands for any length but zero.

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
        """Return this text as a path, whether or not there is a file; a relative one starts at the document's folder.

        Unless files may be anywhere, a relative path must stay in that folder or in the one above, where the sessions
        of a campaign keep what they share (`../target.yaml`). A path that leads farther, by `..` or by a link, is
        refused, because it means another file once the folder is moved or copied. An absolute path is followed.

        Raises:
            InputError: not a text, or a path that leads too far.
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
        """Return the `place` of a file, which must exist."""
        path = self.place()
        if not is_file(path):
            self.fail(f"no such file: {path}")
        return path


def found_in_words(value: Any) -> str:
    """Return a value as messages show it, at most 80 characters."""
    match value:
        case None:
            return "nothing (null)"
        case dict():
            return "a mapping"
        case list():
            return f"a list of {len(value)}"
    shown = repr(value)
    return shown if len(shown) <= 80 else shown[:77] + "..."
