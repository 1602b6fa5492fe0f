"""JSON Schemas (draft 2020-12) of every file form, published with the package: `data/schemas/KIND-VERSION.schema.json`.

Each is the one description of its form: what may stand in a file, with units and frames. The readers check with it
(`validation`) and then what it can't say (files that exist, polygons that are convex); the documentation's tables are
made from it; what commands write is held against it by the tests. YAML files are validated as the plain data they hold.
Results, which others read, may carry more keys than their schema names.

Versions. A file says `schema: optshape/KIND/VERSION`.

- The version stays while every file that was good stays good and means the same. So an optional key may be added, and a
  key may be added to a result.
- It rises by one where a key goes, becomes required, or changes its meaning, its unit, its frame or its type.
- A reader refuses another version than its own by name, and says which one it reads: it does not guess. Older versions
  are read as long as a reader of them is kept; their schemas stay published.
- A reader of results takes those of its version, and does not mind keys that it does not know.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from optshape_graph.errors import InputError

_FOLDER = Path(__file__).resolve().parents[1] / "data" / "schemas"
_ENDING = ".schema.json"


def schema_names() -> list[str]:
    """Return the forms that have a schema, as KIND-VERSION: "target-1", "estimate-1", ..."""
    return sorted(path.name.removesuffix(_ENDING) for path in _FOLDER.glob(f"*{_ENDING}"))


def load_schema(name: str) -> dict[str, Any]:
    """Return a form's JSON Schema as plain data, to validate with any library that knows draft 2020-12.

    Args:
        name: KIND ("target"), KIND-VERSION ("target-1"), or what files say ("optshape/target/1"); without a version,
            the newest.

    Raises:
        InputError: there is no such form.
    """
    wanted = name.removeprefix("optshape/").replace("/", "-")
    names = schema_names()
    versions = [known for known in names if wanted in (known, known.rpartition("-")[0])]
    if not versions:
        raise InputError(f"no schema '{name}'; expected one of: {', '.join(names)}")
    newest = max(versions, key=lambda known: int(known.rpartition("-")[2]))
    schema: dict[str, Any] = json.loads((_FOLDER / f"{newest}{_ENDING}").read_text(encoding="utf-8"))
    return schema
