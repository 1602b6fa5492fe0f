"""A Markdown extension for what pages take from the package itself: the commands with their help, the schemas."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any

import click
from markdown import Markdown
from markdown.extensions import Extension
from markdown.preprocessors import Preprocessor

FIRST = 200
"""Before all else that reads the lines of a page."""


class FromPackage(Preprocessor):
    """Puts what the package says in place of the marks of a page."""

    def run(self, lines: list[str]) -> list[str]:
        """Return the lines of a page, its marks replaced."""
        found: list[str] = []
        for line in lines:
            mark = re.fullmatch(r"<!-- (\w+)(?: ([\w.]+))? -->", line)
            made = MARKS[mark[1]](*filter(None, [mark[2]])) if mark else [line]
            found += [part for text in made for part in text.split("\n")]
        return found


class FromPackageExtension(Extension):
    """Adds `FromPackage`."""

    def extendMarkdown(self, md: Markdown) -> None:
        """Register the preprocessor."""
        md.preprocessors.register(FromPackage(md), "from_package", FIRST)


def makeExtension(**options: Any) -> Extension:
    """Return the extension: what Python-Markdown asks a module for."""
    return FromPackageExtension(**options)


def all_commands() -> Iterator[str]:
    """Yield a section for every command."""
    from optshape_graph.cli.main import cli

    yield from command_sections(click.Context(cli, info_name="optshape", terminal_width=100), "")


def command_sections(context: click.Context, name: str) -> Iterator[str]:
    """Yield a section for a command, and for those in it if it is a group."""
    group = context.command
    if not isinstance(group, click.Group) or not name:
        yield f"## {name or 'optshape'}\n\n```text\n{context.get_help()}\n```\n"
    if isinstance(group, click.Group):
        for word in group.list_commands(context):
            command = group.get_command(context, word)
            assert command is not None
            inner = click.Context(command, parent=context, info_name=word, terminal_width=100)
            yield from command_sections(inner, f"{name} {word}".strip())


def schema_sections() -> Iterator[str]:
    """Yield a section for each form of file: its keys, what they are, and which must be there."""
    import optshape_graph

    for path in sorted((Path(optshape_graph.__file__).parent / "data" / "schemas").glob("*.schema.json")):
        schema = json.loads(path.read_text())
        form, _, version = path.name.removesuffix(".schema.json").rpartition("-")
        yield f"### optshape/{form}/{version}\n\n{schema.get('description', '')}\n\n| key | is | |\n|---|---|---|"
        for key, kind, description in keys(schema, schema, ""):
            yield f"| {key} | {kind} | {description} |"
        yield ""


def keys(node: dict[str, Any], schema: dict[str, Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Yield path, type and description of what may stand in an object, in depth; required keys are bold."""
    for form in forms(node, schema):
        for name, value in form.get("properties", {}).items():
            path = f"{prefix}{name}"
            shown = f"**`{path}`**" if name in form.get("required", []) else f"`{path}`"
            yield shown, kind_of(value, schema), described(value, schema)
            yield from keys(value, schema, f"{path}.")
        if isinstance(form.get("additionalProperties"), dict):
            yield from keys(form["additionalProperties"], schema, f"{prefix}NAME.")
        if isinstance(form.get("items"), dict):
            yield from keys(form["items"], schema, f"{prefix.removesuffix('.')}[].")


def forms(node: dict[str, Any], schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield what a value may be: references resolved, alternatives one by one."""
    if "$ref" in node:
        yield from forms(schema["$defs"][node["$ref"].rpartition("/")[2]], schema)
        return
    alternatives = [*node.get("anyOf", []), *node.get("oneOf", []), *(node[k] for k in ("then", "else") if k in node)]
    for alternative in alternatives:
        yield from forms(alternative, schema)
    if not alternatives or "properties" in node:
        yield node


def kind_of(node: dict[str, Any], schema: dict[str, Any]) -> str:
    """Return the type of a value, in words."""
    kinds: list[str] = []
    for form in forms(node, schema):
        if "const" in form:
            kinds.append(f"`{form['const']}`")
        elif "enum" in form:
            kinds += [f"`{value}`" for value in form["enum"]]
        else:
            kinds += [form["type"]] if isinstance(form.get("type"), str) else form.get("type", [])
    return " or ".join(dict.fromkeys(kinds))


def described(node: dict[str, Any], schema: dict[str, Any]) -> str:
    """Return what a value means: what is said of it here, and of the form that it refers to."""
    said = [node.get("description", ""), *(form.get("description", "") for form in forms(node, schema))]
    return " ".join(dict.fromkeys(text for text in said if text)).replace("|", "\\|")


def public_names(package: str) -> Iterator[str]:
    """Yield the rows of a table: what a package's `__all__` names, or else what its modules define, in a line each."""
    yield "| name | |\n|---|---|"
    module = import_module(package)
    if hasattr(module, "__all__"):
        found = [(f"{package}.{name}", name, getattr(module, name)) for name in module.__all__]
    else:
        inner = (import_module(f"{package}.{info.name}") for info in iter_modules(module.__path__))
        found = [
            (f"{one.__name__}.{name}", f"{one.__name__.removeprefix(package + '.')}.{name}", value)
            for one in inner
            for name, value in vars(one).items()
            if not name.startswith("_") and getattr(value, "__module__", "") == one.__name__
        ]
    for path, name, value in found:
        if inspect.isclass(value) or inspect.isroutine(value):
            first = (inspect.getdoc(value) or "").partition("\n")[0]
            shown = first.replace("|", "\\|")
            yield f"| [`{name}`][{path}] | {shown} |"
    yield ""


MARKS: dict[str, Callable[..., Iterator[str]]] = {
    "commands": all_commands,
    "schemas": schema_sections,
    "names": public_names,
}
"""What makes the lines that stand for `<!-- MARK ARGUMENT -->`."""
