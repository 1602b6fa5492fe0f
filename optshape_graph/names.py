"""Names that come from data (targets, frames, topics, files), made safe for each place where they are written.

A file may call a target `../../x`, `$(reboot)`, `<script>` or anything else. Each function returns a form of the name
that cannot be taken for a path, a command, or markup.
"""

from __future__ import annotations

import html
import re
import shlex

LONGEST_FILE_NAME = 100
"""Characters that a name keeps as part of a file's name."""


def shown(text: object, longest: int | None = None) -> str:
    """Return a text as one line for a terminal, with control characters as escapes.

    Args:
        text: anything; its `str`.
        longest: characters that are kept; None: all.
    """
    said = str(text)
    if longest is not None and len(said) > longest:
        said = said[: longest - 3] + "..."
    return said if said.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in said)


def file_name(text: str) -> str:
    """Return a text as part of a file's name, which stays in its folder and is not hidden."""
    return re.sub(r"[^\w.+@-]+", "_", text)[:LONGEST_FILE_NAME].lstrip(".") or "_"


def shell_word(text: str) -> str:
    """Return a text as one word of a shell's command line, in quotes where it needs them."""
    return shlex.quote(shown(text))


def markup(text: object) -> str:
    """Return a text for HTML, SVG and URDF, as content or in an attribute's quotes: no tags, no control characters."""
    return html.escape(shown(text))


def _escape(character: str) -> str:
    return character.encode("unicode_escape", "backslashreplace").decode()
