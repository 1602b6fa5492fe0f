"""Every public name is documented: what, shapes, units, frames, errors."""

from pathlib import Path

import pytest

from tests.docs.docstrings import check_package, count_public

PACKAGE = Path(__file__).resolve().parents[2] / "optshape_graph"


def test_public_names_are_documented() -> None:
    assert count_public(PACKAGE) > 1000
    problems = check_package(PACKAGE)
    assert not problems, "\n" + "\n".join(map(str, problems))


@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("def f(): ...", "no docstring"),
        ("class C: ...", "the class has no docstring"),
        (
            'def f(a: Floats):\n    """Do it with (N, 3) metres.\n\n    Args:\n        b: of no use.\n    """',
            "Args names b",
        ),
        ('def f(a: Floats):\n    """Turn points, metres."""', "a is an array of no stated shape"),
        ('def f(a: Floats):\n    """Turn points (N, 3)."""', "a is an array of no stated unit"),
        ('def f(a: Floats):\n    """Turn coordinates (x, y, z), metres."""', "a is an array of no stated shape"),
        ('def f() -> Floats:\n    """Make points (N, 3)."""', "returns is an array of no stated unit"),
        ('def f():\n    """Do it."""\n    raise InputError("")', "raises InputError"),
        ('def f():\n    """Do it."""\n    _g()\ndef _g():\n    raise EstimationError("")', "raises EstimationError"),
        (
            'class C:\n    """It.\n\n    Attributes:\n        b: it.\n    """\n    a: int',
            "field a is not under Attributes",
        ),
        ('class C:\n    """It."""\n    def f(self, a: Floats) -> None: ...', "no docstring"),
    ],
)
def test_gaps_are_found(tmp_path: Path, source: str, what: str) -> None:
    package = tmp_path / "package"
    package.mkdir()
    (package / "module.py").write_text(f'"""A module."""\n{source}\n')
    assert [problem for problem in check_package(package) if what in str(problem)]


def test_what_is_documented_passes(tmp_path: Path) -> None:
    package = tmp_path / "package"
    package.mkdir()
    (package / "_private.py").write_text("def f(): ...")
    (package / "module.py").write_text(
        '''"""A module."""

def f(points: Floats, T_a_b: Floats) -> Floats:
    """Move points (N, 3), metres, by T_a_b (4, 4).

    Raises:
        InputError: no points.
    """
    _g(points)

def _g(points):
    raise InputError("")
'''
    )
    assert check_package(package) == []
