"""What is locked is what is asked for: every requirement has a version that its range allows."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
APART = {"velodyne", "ouster", "supply"}
"""Extras that the tests do not install, or only where they can be had."""


def requirements() -> list[Requirement]:
    """All that `.ci/setup` installs for the tests."""
    wanted = [*PROJECT["dependencies"], *(line for name in EXTRAS if name not in APART for line in EXTRAS[name])]
    return [Requirement(line) for line in dict.fromkeys(wanted) if not line.startswith("optshape-graph")]


def locked() -> dict[str, str]:
    lines = (ROOT / ".ci" / "constraints.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


@pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="the lock is in the repository")
def test_every_requirement_is_locked_within_its_range() -> None:
    versions = locked()
    for requirement in requirements():
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        assert name in versions, f"{requirement} is not in .ci/constraints.txt: run `make lock`"
        assert requirement.specifier.contains(versions[name]), (str(requirement), versions[name])


def test_every_requirement_has_an_upper_bound() -> None:
    for requirement in requirements():
        assert any(bound.operator == "<" for bound in requirement.specifier), str(requirement)


@pytest.mark.skipif(not (ROOT / ".ci").is_dir(), reason="the lock is in the repository")
def test_every_locked_package_has_its_licence_in_the_docs() -> None:
    page = (ROOT / "docs" / "licences.md").read_text()
    for name, version in locked().items():
        assert f"| {name} | {version} | " in page
