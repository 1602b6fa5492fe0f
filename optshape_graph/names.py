"""Names from data (targets, frames, topics, files) on their way out: one function for each place that they go to.

A file may call a target `../../x`, `$(reboot)`, `<script>` or anything else; each function here returns a form of the
name that is only a name where it goes.
"""

from __future__ import annotations

import html
import re
import shlex

LONGEST_FILE_NAME = 100
"""Characters of a name that becomes part of a file's name."""


def shown(text: object, longest: int | None = None) -> str:
    """Return a text for a terminal, in one line: what a terminal would obey is shown as an escape.

    Args:
        text: anything; its `str`.
        longest: characters from which on the rest is left out; None: all of it.
    """
    said = str(text)
    if longest is not None and len(said) > longest:
        said = said[: longest - 3] + "..."
    return said if said.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in said)


def file_name(text: str) -> str:
    """Return a text as part of a file's name, which leads to no other folder and is not hidden."""
    return re.sub(r"[^\w.+@-]+", "_", text)[:LONGEST_FILE_NAME].lstrip(".") or "_"


def shell_word(text: str) -> str:
    """Return a text as one word of a shell's command line, in quotes where it needs them."""
    return shlex.quote(shown(text))


def markup(text: object) -> str:
    """Return a text for HTML, SVG and URDF, as content or in an attribute's quotes: no tags, no control characters."""
    return html.escape(shown(text))


def _escape(character: str) -> str:
    return character.encode("unicode_escape", "backslashreplace").decode()
