"""`--plot DIR`: pictures of what a command found, as PNG files whose names are told at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say
from optshape_graph.names import file_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")


def plot_option(what: str, *aliases: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator that adds `--plot DIR`, whose value the command takes as `plots`.

    Args:
        what: the pictures, for the help.
        aliases: other names of the option.
    """
    return click.option(
        "--plot", *aliases, "plots", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", callback=_checked,
        help=f"Write pictures to this folder: {what}.",
    )  # fmt: skip


class Pictures:
    """Pictures on their way into a folder. One of the same name that is there is replaced.

    Args:
        folder: where to; it is made when there is a first one.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.paths: list[Path] = []

    def save(self, name: str, figure: Figure) -> None:
        """Write a figure as NAME.png, whatever characters the name has."""
        self.paths.append(save_picture(self.folder, name, figure))

    def tell(self) -> None:
        """Name the files."""
        for path in self.paths:
            say(f"picture: {path}")


def save_picture(folder: Path, name: str, figure: Figure) -> Path:
    """Write a figure as NAME.png into a folder, whatever characters the name has; return its path."""
    from optshape_graph.viz.style import save_figure

    return save_figure(figure, folder / f"{file_name(name)}.png")


def names_of(paths: Sequence[str]) -> dict[str, str]:
    """Return a name for the pictures of each file: its own without the ending, numbered where two are alike."""
    times = Counter(Path(path).stem for path in paths)
    stems = ((k, path, Path(path).stem) for k, path in enumerate(paths))
    return {path: stem if times[stem] == 1 else f"{k:03d}_{stem}" for k, path, stem in stems}


def check_picture(path: Path | None) -> None:
    """Find out before the work is done that a picture of that name cannot be drawn.

    Args:
        path: of the picture; None: none is wanted.

    Raises:
        MissingExtraError: matplotlib is absent.
    """
    if path is None:
        return
    from optshape_graph.viz.style import FORMATS, new_figure

    if path.suffix.lower().lstrip(".") not in ("", *FORMATS):
        raise click.BadParameter(f"expected the name of a picture to end in .{', .'.join(FORMATS)}; found '{path}'")
    new_figure()


def _checked(ctx: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
    """Find out before the work is done, and not after it, that nothing could be drawn."""
    if value is None:
        return None
    if value.suffix.lower() in IMAGES:
        raise click.BadParameter(f"expected a folder, in which pictures have names of their own; found '{value}'")
    from optshape_graph.viz.style import new_figure

    new_figure()
    return value
