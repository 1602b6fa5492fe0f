"""`optshape completion`: the script that lets a shell complete commands, options and files."""

from __future__ import annotations

import click

from optshape_graph.cli.options import example

SHELLS = {
    "bash": 'eval "$(optshape completion bash)"   # in ~/.bashrc',
    "zsh": 'eval "$(optshape completion zsh)"   # in ~/.zshrc, after compinit',
    "fish": "optshape completion fish | source   # in ~/.config/fish/config.fish",
}


@click.command(epilog=example(*SHELLS.values()))
@click.argument("shell", type=click.Choice(list(SHELLS)))
def command(shell: str) -> None:
    """Print the script that makes SHELL complete what is typed after `optshape`."""
    from click.shell_completion import get_completion_class

    from optshape_graph.cli.main import cli

    kind = get_completion_class(shell)
    assert kind is not None  # click knows all three
    click.echo(kind(cli, {}, "optshape", "_OPTSHAPE_COMPLETE").source())
