"""Every command's help ends with a line to copy, whose command and options there are."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

import click
import pytest

from optshape_graph.cli.main import cli

Words = tuple[str, ...]


def commands(group: click.Command = cli, words: Words = ()) -> Iterator[tuple[Words, click.Command]]:
    """Every command that is no group, with the words that lead to it."""
    if not isinstance(group, click.Group):
        yield words, group
        return
    context = click.Context(group)
    for name in group.list_commands(context):
        inner = group.get_command(context, name)
        assert inner is not None
        yield from commands(inner, (*words, name))


ALL = dict(commands())


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_help_ends_with_an_example_that_parses(words: Words) -> None:
    command = ALL[words]
    text = command.get_help(click.Context(command, info_name=" ".join(words), terminal_width=200))
    _, found, example = text.partition("Example:\n")
    assert found
    start = f"optshape {' '.join(words)}"
    assert start in example
    line = re.sub(r"\\\n", "", example[example.index(start) + len(start) :])
    given = [word for word in shlex.split(line.split("|")[0].split(")")[0], comments=True) if word.startswith("-")]
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    assert {word for word in given if not re.fullmatch(r"-[\d.]+", word)} <= options


@pytest.mark.parametrize(
    ("old", "new"),
    [("--distance", "--range"), ("--distances", "--ranges"), ("--plots", "--plot"), ("--targets", "--target")],
)
def test_an_old_name_of_an_option_stays_beside_the_new_one(old: str, new: str) -> None:
    for words, command in ALL.items():
        for parameter in command.params:
            if parameter.nargs == 1:  # else it is something else that is called so
                assert old not in parameter.opts or new in parameter.opts, f"{' '.join(words)}: {old}"
