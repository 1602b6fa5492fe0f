"""Packages that import a module when one of its names is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy(package: str, modules: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package.

    Args:
        package: its name.
        modules: each module below the package, and the names that come from it, separated by spaces.
    """
    face = vars(sys.modules[package])
    homes = {name: module for module, names in modules.items() for name in names.split()}

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        face[name] = getattr(import_module(f"{package}.{homes[name]}"), name)
        return face[name]

    return attribute, lambda: sorted({*face, *homes})
