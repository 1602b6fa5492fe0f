"""Run the blocks of a page in the current folder: `python -m tests.docs.run_page README.md`.

Python blocks share one namespace, as if typed in one session; shell blocks stop at the first error.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.docs.examples import prepare
from tests.docs.snippets import blocks

SYSTEM = re.compile(r"(git clone|cd optshape|make|pip install)\b.*")
"""Commands that set up the system; what they name is checked otherwise."""


def main(page: Path) -> None:
    """Make the files that the page speaks of, and run its blocks in order."""
    found = blocks(page)
    prepare(Path(), "\n".join(block.text for block in found if block.language in ("sh", "python")))
    namespace: dict[str, Any] = {"__name__": "page"}
    for block in found:
        if block.title:
            Path(block.title).write_text(block.text)
        elif block.language == "python":
            code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
            exec(code, namespace)
        elif block.language == "sh":
            commands = "\n".join(line for line in block.text.splitlines() if not SYSTEM.fullmatch(line.strip()))
            print(f"{page.name}:{block.line}\n{commands}", flush=True)
            subprocess.run(["bash", "-euo", "pipefail", "-c", commands], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
