"""JSON Schemas (draft 2020-12) of every file form, published with the package: `data/schemas/KIND-VERSION.schema.json`.

A schema is the only description of its form: the keys of a file, with units and frames. The readers check files with it
(`validation`), and then check what a schema cannot say (that files exist, that polygons are convex). The tables of the
documentation are made from it, and the tests check what commands write against it. YAML files are validated as plain
data. Results, which others read, may carry more keys than their schema names.

Versions. A file says `schema: optshape/KIND/VERSION`.

- The version stays as long as every valid file stays valid and keeps its meaning. So an optional key may be added, and
  so may a key of a result.
- The version rises by one if a key is removed, becomes required, or changes its meaning, its unit, its frame or its
  type.
- A reader refuses a version other than its own, and states the one that it reads. Older versions are read as long as a
  reader for them is kept; their schemas stay published.
- A reader of results ignores keys that it does not know.
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
    """Return the JSON Schema of a form as plain data, for any library that knows draft 2020-12.

    Args:
        name: KIND ("target"), KIND-VERSION ("target-1"), or as files state it ("optshape/target/1"); without a version,
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
