"""The fenced blocks of a page: what a reader would copy."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
"""All that is written for users."""

_FENCE = re.compile(r'^( *)```(\w+)?(?: title="([^"]+)")?\n(.*?)^\1```$', flags=re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        language: `sh`, `python`, `yaml`, `text`, ...
        title: the file that the reader is to make of it; empty: none.
        text: without the fences.
        line: of its first line, counted from 1.
    """

    language: str
    title: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Return the fenced blocks of a page, in order."""
    text = page.read_text()
    return [
        Block(
            match.group(2) or "",
            match.group(3) or "",
            re.sub(rf"^{match.group(1)}", "", match.group(4), flags=re.MULTILINE),
            text.count("\n", 0, match.start(4)) + 1,
        )
        for match in _FENCE.finditer(text)
    ]
