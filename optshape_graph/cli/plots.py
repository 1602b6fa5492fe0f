"""`--plot DIR`, `--plot-format`: pictures of what a command found; their names are printed at the end."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.options import FOLDER
from optshape_graph.names import file_name

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from optshape_graph.scan import Scan

ENDING = "optshape_graph.cli.plots.ending"
"""Key under which the context of a command keeps the ending of its pictures."""

IMAGES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")


def plot_option(what: str, *aliases: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the decorator that adds `--plot DIR`, whose value the command takes as `plots`.

    Args:
        what: the pictures, for the help.
        aliases: other names of the option.
    """

    def add(function: Callable[..., Any]) -> Callable[..., Any]:
        folder = click.option(
            "--plot", *aliases, "plots", type=FOLDER, metavar="DIR",
            callback=_checked, help=f"Write pictures to this folder: {what}.",
        )  # fmt: skip
        return folder(plot_format_option(function))

    return add


def plot_format_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--plot-format` to a command; `picture_ending` returns its value."""
    return click.option(
        "--plot-format", type=click.Choice(["png", "svg", "pdf"]), default="png", show_default=True,
        help="Of the pictures.", expose_value=False, is_eager=True, callback=_keep_ending,
    )(function)  # fmt: skip


def picture_ending() -> str:
    """Return the ending of pictures that the running command was asked for."""
    context = click.get_current_context(silent=True)
    return "png" if context is None else str(context.meta.get(ENDING, "png"))


def _keep_ending(context: click.Context, parameter: click.Parameter, value: str) -> None:
    context.meta[ENDING] = value


class Pictures:
    """Pictures for a folder; one of the same name is replaced.

    Args:
        folder: made with the first picture.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.ending = folder, picture_ending()
        self.paths: list[Path] = []

    def save(self, name: str, figure: Figure) -> None:
        """Write a figure; its name may have any characters."""
        self.paths.append(save_picture(self.folder, name, figure, self.ending))

    def tell(self) -> None:
        """Name the files."""
        for path in self.paths:
            say(f"picture: {path}")


def save_picture(folder: Path, name: str, figure: Figure, ending: str = "png") -> Path:
    """Write a figure as NAME.ENDING into a folder, and return its path; the name may have any characters."""
    from optshape_graph.viz.style import save_figure

    return save_figure(figure, folder / f"{file_name(name)}.{ending}")


def names_of(paths: Sequence[str]) -> dict[str, str]:
    """Return a name for the pictures of each file: its own without the ending, numbered if two are equal."""
    times = Counter(Path(path).stem for path in paths)
    stems = ((k, path, Path(path).stem) for k, path in enumerate(paths))
    return {path: stem if times[stem] == 1 else f"{k:03d}_{stem}" for k, path, stem in stems}


@dataclass(frozen=True)
class Draw:
    """Draws what was found in a scan; tasks of `run_files` call it, in any process.

    Attributes:
        folder: for the pictures.
        names: of the pictures of each scan, by its path.
        figures: takes the scan's name, the scan and what was found, and returns the figures by name.
        ending: of the pictures.
    """

    folder: Path
    names: dict[str, str]
    figures: Callable[[str, Scan, Any], dict[str, Figure]]
    ending: str = field(default_factory=picture_ending)

    def __call__(self, path: str, scan: Scan, found: Any) -> list[Path]:
        figures = self.figures(self.names[path], scan, found)
        return [save_picture(self.folder, name, figure, self.ending) for name, figure in figures.items()]


def check_picture(path: Path | None) -> None:
    """Check before the work that a picture of that name can be drawn.

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
    """Check before the work that pictures can be drawn."""
    if value is None:
        return None
    if value.suffix.lower() in IMAGES:
        raise click.BadParameter(f"expected a folder, in which pictures have names of their own; found '{value}'")
    from optshape_graph.viz.style import new_figure

    new_figure()
    return value
