"""What public docstrings do not say, found in the source alone: nothing is imported.

Every public name has one. Where arrays come in or go out, it states their shapes and units; the package's errors that
a function raises, itself or through private functions of its module, are under `Raises:`.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ERRORS = frozenset({"InputError", "EstimationError", "UnobservableError"})
"""Errors that a caller is expected to handle. That an extra is missing depends on no argument: it is said once, for all
functions that need one."""

ARRAY = re.compile(r"\b(ArrayLike|Floats|Ints|Bools|ndarray|NDArray)\b")
_SIZE = r"(\.\.\.|(?![xyzuv]\b)(\d+ )?[\w.^]+( ?[-+*/] ?\w+)?)"
SHAPE = re.compile(rf"\({_SIZE}(,|(, ?{_SIZE})+|(?<=\.))\)")
"""(N,), (N, 3), (..., 4, 4), (6,): letters and numbers, as NumPy prints them; (x, y, z) are coordinates."""

CONVENTION = re.compile(r"\bT_\w+|4, 4\)|6, 6\)")
"""Transforms and covariances of poses: the conventions fix their units."""

UNIT = re.compile(
    r"\b(m|mm|(milli|square )?metres?|m2|m²|m\^2|rad|radians|deg|degrees?|s|(nano)?seconds?|Hz|pixels?)\b|"
    # what has none
    r"\b(units?|beam widths|ratio|relative|whitened|weights?|weighted|probabilit(y|ies)|shares?|fractions?|chi-square|"
    r"log likelihoods?|scores?|indices|index|numbers?|labels?|standard deviations|as recorded|unknowns?|"
    r"rotations?|orthonormal|colours?|blue|grey|rows?|columns?|matrix|form|tangent|information|whether|squared|"
    r"parameters)\b"
)
"""Words that say the unit, or that there is none, or that it is that of something else."""


@dataclass(frozen=True)
class Problem:
    """One thing that a docstring does not say.

    Attributes:
        where: module, and name in it.
        what: in words.
    """

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def check_package(package: Path) -> list[Problem]:
    """Return the problems of all public modules below a package's folder."""
    return [
        problem
        for path in sorted(package.rglob("*.py"))
        if not _private(path.relative_to(package))
        for problem in _Module(path, package).problems()
    ]


def count_public(package: Path) -> int:
    """Return how many public names there are, dataclass fields included."""
    return sum(
        1
        for path in sorted(package.rglob("*.py"))
        if not _private(path.relative_to(package))
        for _ in _Module(path, package).names()
    )


def _private(path: Path) -> bool:
    return any(part.startswith("_") and part != "__init__.py" for part in path.parts)


class _Module:
    def __init__(self, path: Path, package: Path) -> None:
        parts = path.relative_to(package.parent).with_suffix("").parts
        self.name = ".".join(part for part in parts if part != "__init__")
        self.tree = ast.parse(path.read_text())
        self.functions = {
            node.name: node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        }

    def names(self) -> Iterator[tuple[str, ast.AST]]:
        """Public classes, functions, methods and fields, with their nodes."""
        for node in self.tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                yield node.name, node
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield node.name, node
                for member in node.body:
                    if isinstance(member, ast.FunctionDef) and not member.name.startswith("_"):
                        yield f"{node.name}.{member.name}", member
                    elif _is_field(member):
                        yield f"{node.name}.{member.target.id}", member

    def problems(self) -> Iterator[Problem]:
        if not ast.get_docstring(self.tree):
            yield Problem(self.name, "the module has no docstring")
        for node in self.tree.body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                yield from self._function(node, node.name)
            elif isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                yield from self._class(node)

    def _class(self, node: ast.ClassDef) -> Iterator[Problem]:
        where, doc = f"{self.name}.{node.name}", ast.get_docstring(node) or ""
        if not doc:
            yield Problem(where, "the class has no docstring")
        entries = _entries(doc, "Attributes")
        for field in filter(_is_field, node.body):
            name = field.target.id
            kind = ast.unparse(field.annotation)
            if name not in entries:
                yield Problem(where, f"field {name} is not under Attributes")
            else:
                yield from _array(where, f"field {name}", kind, entries[name])
        methods = {method.name: method for method in node.body if isinstance(method, ast.FunctionDef)}
        yield from self._raises(
            where, doc, [methods[name] for name in ("__post_init__", "__init__") if name in methods]
        )
        if "__init__" in methods:
            own = ast.get_docstring(methods["__init__"]) or ""
            yield from self._arguments(methods["__init__"], where, f"{own}\n\n{doc}")
        known = {base.id for base in node.bases if isinstance(base, ast.Name)}
        for name, method in methods.items():
            inherited = known & {"LazyGroup", "Group"} or any("Group" in ast.unparse(base) for base in node.bases)
            if not name.startswith("_") and not inherited:
                yield from self._function(method, f"{node.name}.{name}")

    def _function(self, node: ast.FunctionDef, name: str) -> Iterator[Problem]:
        where, doc = f"{self.name}.{name}", ast.get_docstring(node) or ""
        if not doc:
            yield Problem(where, "no docstring")
            return
        if any("click" in ast.unparse(decorator) or "command(" in ast.unparse(decorator) for decorator in
               node.decorator_list):  # fmt: skip
            return  # the options have their own help
        yield from self._raises(where, doc, [node])
        yield from self._arguments(node, where, doc)
        returns = ast.unparse(node.returns) if node.returns else ""
        section = _section(doc, "Returns") or _section(doc, "Yields") or _summary(doc)
        yield from _array(where, "what it returns", returns, section)

    def _arguments(self, node: ast.FunctionDef, where: str, doc: str) -> Iterator[Problem]:
        arguments = [a for a in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs] if a.arg not in
                     ("self", "cls")]  # fmt: skip
        entries = _entries(doc, "Args")
        for argument in arguments:
            kind = ast.unparse(argument.annotation) if argument.annotation else ""
            if entries and argument.arg not in entries:
                yield Problem(where, f"argument {argument.arg} is not under Args")
            elif ARRAY.search(kind):
                yield from _array(where, f"argument {argument.arg}", kind, entries.get(argument.arg, _summary(doc)))
        for name in entries:
            if name not in [a.arg for a in arguments] and node.args.vararg is None and node.args.kwarg is None:
                yield Problem(where, f"Args names {name}, which is no argument")

    def _raises(self, where: str, doc: str, nodes: list[ast.FunctionDef]) -> Iterator[Problem]:
        raised: set[str] = set()
        for node in nodes:
            raised |= self._raised(node, {node.name})
        documented = set(_entries(doc, "Raises"))
        for error in sorted(raised - documented):
            yield Problem(where, f"raises {error}, which is not under Raises")

    def _raised(self, node: ast.FunctionDef, seen: set[str]) -> set[str]:
        """Errors that a function raises itself or through private functions and methods of its module."""
        found: set[str] = set()
        for inner in ast.walk(node):
            if isinstance(inner, ast.Raise) and inner.exc is not None:
                called = inner.exc.func if isinstance(inner.exc, ast.Call) else inner.exc
                name = called.id if isinstance(called, ast.Name) else getattr(called, "attr", "")
                found |= {name} & ERRORS
            if isinstance(inner, ast.Call):
                name = inner.func.id if isinstance(inner.func, ast.Name) else getattr(inner.func, "attr", "")
                if name.startswith("_") and name in self.functions and name not in seen:
                    seen.add(name)
                    found |= self._raised(self.functions[name], seen)
        return found


def _is_field(node: ast.AST) -> bool:
    """Whether this is a public annotated field of a class, no class variable."""
    return (
        isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and not node.target.id.startswith("_")
        and "ClassVar" not in ast.unparse(node.annotation)
    )


def _array(where: str, what: str, kind: str, text: str) -> Iterator[Problem]:
    """Problems of the words about one array."""
    if not ARRAY.search(kind) or kind.startswith("Callable") or re.search(r"\b[Ss]ee `[\w.]+`", text):
        return
    if not SHAPE.search(text):
        yield Problem(where, f"{what} is an array of no stated shape: {text[:80]!r}")
    unitless = not re.search(r"ArrayLike|Floats|ndarray|NDArray", kind) or CONVENTION.search(f"{what} {text}")
    if not unitless and not UNIT.search(SHAPE.sub("", text)):
        yield Problem(where, f"{what} is an array of no stated unit: {text[:80]!r}")


def _summary(doc: str) -> str:
    """What comes before the first section."""
    return re.split(r"^\w+:$", doc, maxsplit=1, flags=re.MULTILINE)[0]


def _section(doc: str, title: str) -> str:
    """The lines of a section, without their indentation."""
    match = re.search(rf"^{title}:\n((?:[ \t]+.*\n?|\n)*)", doc, flags=re.MULTILINE)
    return match.group(1) if match else ""


def _entries(doc: str, title: str) -> dict[str, str]:
    """Name to description of the entries of a section; `a, b: ...` describes both."""
    entries: dict[str, str] = {}
    names: list[str] = []
    for line in _section(doc, title).splitlines():
        head = re.match(r"    (\*{0,2}\w+(?:, \*{0,2}\w+)*):(.*)", line)
        if head:
            names = [name.strip("* ") for name in head.group(1).split(",")]
            entries |= dict.fromkeys(names, head.group(2).strip())
        else:
            entries |= {name: f"{entries[name]} {line.strip()}" for name in names}
    return entries
