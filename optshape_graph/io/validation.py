"""Check a document against the schema of its form, with messages that name file, line and key.

The published JSON Schemas are the only description of this package's forms: the documentation's tables are made from
them, and the readers check with this module. It knows the keywords that the schemas of input files use (`KEYWORDS`).
The library jsonschema knows all keywords, and the tests compare with it; but importing it takes as long as importing
GTSAM, and its messages would have to be reworded.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from optshape_graph.io.nodes import Node, found_in_words
from optshape_graph.io.yaml_core import Key

Schema = Mapping[str, Any]
Problem = tuple[Key, str]
"""The place of an error, from the document's root, and what is wrong there."""

LARGEST_NUMBER = 1e300
"""Larger numbers count as not finite, since their squares are not."""


def check(root: Node, schema: Schema) -> None:
    """Check a document against a schema.

    Raises:
        InputError: it does not fit; the message names the first such place and what was expected there.
    """
    for key, problem in _problems(root.value, schema, schema, ()):
        node = root
        for step in key:
            node = node.at(step)
        node.fail(problem)


def _problems(value: Any, schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    """Yield what is wrong with a value, the outermost first."""
    if "$ref" in schema:
        yield from _problems(value, root["$defs"][schema["$ref"].rpartition("/")[2]], root, key)
    for keyword, rule in KEYWORDS.items():
        if keyword in schema:
            yield from rule(value, schema[keyword], schema, root, key)


def _fits(value: Any, schema: Schema, root: Schema) -> bool:
    return next(_problems(value, schema, root, ()), None) is None


def _is_type(value: Any, name: str) -> bool:
    if name in ("number", "integer"):
        whole = isinstance(value, int) and not isinstance(value, bool)
        return (whole or (name == "number" and isinstance(value, float))) and bool(abs(value) < LARGEST_NUMBER)
    kinds = {"object": (dict,), "array": (list,), "string": (str,), "boolean": (bool,), "null": (type(None),)}[name]
    return isinstance(value, kinds)


def _type(value: Any, wanted: str | list[str], schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    names = [wanted] if isinstance(wanted, str) else wanted
    if not any(_is_type(value, name) for name in names):
        quotes = " (put it in quotes)" if names == ["string"] and isinstance(value, bool | int | float) else ""
        words = " or ".join(_in_words(name, schema) for name in names)
        yield key, f"expected {words}{quotes}, found {found_in_words(value)}"


def _in_words(name: str, schema: Schema) -> str:
    """Return a type in words, with the bounds that the schema sets."""
    if name not in ("number", "integer"):
        return {"object": "a mapping", "array": "a list", "string": "a text", "boolean": "true or false",
                "null": "null"}[name]  # fmt: skip
    kind = "an integer" if name == "integer" else "a finite number"
    for words, *keywords in _BOUNDS:
        if all(keyword in schema for keyword in keywords):
            return f"{kind} {words.format(*(schema[keyword] for keyword in keywords))}"
    return kind


_BOUNDS = (
    ("from {:g} to {:g}", "minimum", "maximum"),
    ("above {:g} and below {:g}", "exclusiveMinimum", "exclusiveMaximum"),
    ("of at least {:g}", "minimum"),
    ("above {:g}", "exclusiveMinimum"),
    ("of at most {:g}", "maximum"),
    ("below {:g}", "exclusiveMaximum"),
)
"""Words for the bounds of a number, and the keywords whose values they state."""


def _bound(holds: Callable[[float, float], bool]) -> Rule:
    def rule(value: Any, limit: float, schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
        if _is_type(value, "number") and not holds(value, limit):
            kind = "integer" if schema.get("type") == "integer" else "number"
            yield key, f"expected {_in_words(kind, schema)}, found {found_in_words(value)}"

    return rule


def _const(value: Any, wanted: Any, _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if value != wanted or isinstance(value, bool) != isinstance(wanted, bool):
        yield key, f"expected {wanted!r}, found {found_in_words(value)}"


def _enum(value: Any, choices: Sequence[Any], _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if value not in choices:
        yield key, f"expected one of: {', '.join(map(str, choices))}, found {found_in_words(value)}"


def _length(value: Any, _wanted: int, schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    least, most = schema.get("minItems", 0), schema.get("maxItems", math.inf)
    if isinstance(value, list) and not least <= len(value) <= most:
        count = str(least) if least == most else f"{least} or more" if math.isinf(most) else f"{least} to {most}"
        yield key, f"expected a list of {count} elements, found {len(value)}"


def _min_length(value: Any, least: int, _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, str) and len(value) < least:
        yield key, f"expected a text, found {found_in_words(value)}"


def _pattern(value: Any, pattern: str, schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, str) and not re.search(pattern, value):
        yield key, f"expected {schema.get('description', 'a text like ' + pattern)}, found {found_in_words(value)}"


def _items(value: Any, wanted: Schema, schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, list):
        for i in range(len(schema.get("prefixItems", ())), len(value)):
            yield from _problems(value[i], wanted, root, (*key, i))


def _prefix_items(value: Any, wanted: list[Schema], _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, list):
        for i, (item, form) in enumerate(zip(value, wanted, strict=False)):
            yield from _problems(item, form, root, (*key, i))


def _required(value: Any, names: list[str], _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict):
        for name in names:
            if name not in value:
                yield key, f"the key '{name}' is missing; found only: {', '.join(value) or 'nothing'}"


def _dependent(value: Any, wanted: Mapping[str, Any], _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict):
        for name, others in wanted.items():
            for other in others:
                if name in value and other not in value:
                    yield (*key, name), f"the key '{other}' is missing beside it"


def _properties(value: Any, wanted: Mapping[str, Any], _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict):
        for name, item in value.items():
            if name in wanted:
                yield from _problems(item, wanted[name], root, (*key, name))


def _other_properties(value: Any, wanted: Schema | bool, schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if not isinstance(value, dict):
        return
    known = list(schema.get("properties", ()))
    for name in (name for name in value if name not in known):
        if wanted is False:
            close = difflib.get_close_matches(name, known, 1)
            hint = f" (did you mean '{close[0]}'?)" if close else ""
            yield (*key, name), f"unknown key '{name}'{hint}; expected one of: {', '.join(known)}"
        elif wanted is not True:
            yield from _problems(value[name], wanted, root, (*key, name))


def _names(value: Any, wanted: Schema, _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict):
        for name in value:
            for _, problem in _problems(name, wanted, root, ()):
                yield (*key, name), f"as key {problem}"


def _min_properties(value: Any, least: int, _schema: Schema, _root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict) and len(value) < least:
        yield key, f"expected {least} or more entries, found {len(value)}"


def _any_of(value: Any, forms: list[Schema], _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    """Check alternatives: the one of the value's type reports errors; of those that require keys, any will do."""
    if any(_fits(value, form, root) for form in forms):
        return
    if all("required" in form and "type" not in form for form in forms):
        names = " or ".join(repr(form["required"][0]) for form in forms)
        yield key, f"expected {names}, found only: {', '.join(value) or 'nothing'}"
        return
    for form in forms:
        if "type" in form and _fits(value, {"type": form["type"]}, root):
            yield from _problems(value, form, root, key)
            return
    words = " or ".join(_in_words(form["type"], form) for form in forms)
    yield key, f"expected {words}, found {found_in_words(value)}"


def _one_of(value: Any, forms: list[Schema], _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    """Check that exactly one of several keys is there."""
    if sum(_fits(value, form, root) for form in forms) != 1:
        names = [form["required"][0] for form in forms]
        there = [name for name in names if name in value]
        words = f"expected {' or '.join(repr(name) for name in names)}"
        if there:
            yield (*key, there[0]), f"{words}, found both"
        else:
            yield key, f"{words}, found only: {', '.join(value) or 'nothing'}"


def _not(value: Any, form: Schema, _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    if isinstance(value, dict) and _fits(value, form, root):
        names = form["required"]
        yield (*key, names[0]), f"expected {' or '.join(repr(name) for name in names)}, found both"


def _all_of(value: Any, forms: list[Schema], _schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    for form in forms:
        yield from _problems(value, form, root, key)


def _if(value: Any, form: Schema, schema: Schema, root: Schema, key: Key) -> Iterator[Problem]:
    branch = schema.get("then" if _fits(value, form, root) else "else")
    if branch is not None:
        yield from _problems(value, branch, root, key)


Rule = Callable[[Any, Any, Schema, Schema, Key], Iterator[Problem]]
"""Yields what is wrong with a value by one keyword: value, what the keyword says, its schema, the root's, the key."""

KEYWORDS: dict[str, Rule] = {
    "type": _type,
    "const": _const,
    "enum": _enum,
    "additionalProperties": _other_properties,
    "required": _required,
    "properties": _properties,
    "propertyNames": _names,
    "minProperties": _min_properties,
    "dependentRequired": _dependent,
    "minItems": _length,
    "maxItems": _length,
    "prefixItems": _prefix_items,
    "items": _items,
    "minLength": _min_length,
    "pattern": _pattern,
    "minimum": _bound(lambda value, limit: value >= limit),
    "exclusiveMinimum": _bound(lambda value, limit: value > limit),
    "maximum": _bound(lambda value, limit: value <= limit),
    "exclusiveMaximum": _bound(lambda value, limit: value < limit),
    "allOf": _all_of,
    "anyOf": _any_of,
    "oneOf": _one_of,
    "not": _not,
    "if": _if,
}
"""The keywords that are checked, in this order: a misspelt key is named before the one that is missing. `$ref` is
followed; annotations say nothing of what fits."""
