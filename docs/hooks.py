"""What pages take from the package itself when they are built: the commands with their help, the schemas."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

COMMANDS = "<!-- commands -->\n"
SCHEMAS = "<!-- schemas -->\n"
"""Lines that all commands, and all schemas, replace."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put what the package says in place of the marks of a page."""
    if COMMANDS in markdown:
        from optshape_graph.cli.main import cli

        root = click.Context(cli, info_name="optshape", terminal_width=100)
        markdown = markdown.replace(COMMANDS, "\n".join(command_sections(root, "")))
    if SCHEMAS in markdown:
        markdown = markdown.replace(SCHEMAS, "\n".join(schema_sections()))
    return markdown


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
