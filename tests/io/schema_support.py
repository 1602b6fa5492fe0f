"""Files of the package against their published schemas."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from optshape_graph.io.documents import read_json, read_yaml
from optshape_graph.io.schemas import load_schema

OPEN = {"sweep"}
"""Forms whose other keys are the caller's."""


def validator(name: str, closed: bool = False) -> Any:
    """A validator of a form; closed: it refuses keys that the schema does not name, as a test of what is written."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = load_schema(name)
    return jsonschema.Draft202012Validator(_closed(schema) if closed else schema)


def complaint(path: Path) -> str | None:
    """What a file's schema has against it; None: nothing. Every key must be one that the schema names."""
    root = read_json(path) if path.suffix == ".json" else read_yaml(path)
    kind = root.value["schema"].split("/")[1]
    error = next(validator(root.value["schema"], kind not in OPEN).iter_errors(root.value), None)
    return None if error is None else f"{path.name}: {error.json_path}: {error.message[:300]}"


def _closed(schema: Any) -> Any:
    if isinstance(schema, list):
        return [_closed(item) for item in schema]
    if not isinstance(schema, dict):
        return schema
    inner = {key: _closed(value) for key, value in schema.items()}
    return (
        {"additionalProperties": False, **inner} if "properties" in inner and inner.get("type") == "object" else inner
    )
