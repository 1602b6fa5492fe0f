"""`optshape doctor`: what is installed, what works, and what to do about the rest."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import click

from optshape_graph.cli.console import say
from optshape_graph.cli.environment import CORE, PURPOSES, SYSTEM, Found
from optshape_graph.cli.options import JSON_FILE, example, force_option

PYTHON = ((3, 11), (3, 15))
"""The oldest Python that is supported, and the first that is not."""


@dataclass(frozen=True)
class Check:
    """One line of the report.

    Attributes:
        name: what was checked.
        status: "ok"; "absent": optional and not installed; "broken": installed, but not working; "advice".
        found: version, or what is wrong.
        purpose: what it is for.
        to_do: what helps; "": nothing needs to be done.
        core: whether nothing works without it.
    """

    name: str
    status: str
    found: str
    purpose: str
    to_do: str = ""
    core: bool = False


@click.command(epilog=example("optshape doctor --json doctor.json"))
@click.option("--json", "json_path", type=JSON_FILE, help="Write the report to this file.")
@force_option
def command(json_path: Path | None, force: bool) -> int:
    """Look at the installation: versions, system libraries, extras, and whether a known pose is found.

    Every line that is not `ok` says what to do. Exit status: 0 if the core works, whatever extras are absent; else 1.
    """
    import optshape_graph
    from optshape_graph.cli.outputs import Outputs
    from optshape_graph.io.documents import write_json

    Outputs(force=force).file("--json", json_path, "doctor")
    checks = [*_versions(), *_libraries(), _compiled(), _self_check(), *_advice()]
    working = not any(check.core and check.status != "ok" for check in checks)
    for check in checks:
        say(f"{check.status:<7} {check.name}: {check.found}; {check.purpose}")
        if check.to_do:
            say(f"        -> {check.to_do}")
    click.echo()
    say(_summary(checks, working))
    if json_path:
        document = {
            "schema": "optshape/doctor/1",
            "version": optshape_graph.__version__,
            "works": working,
            "checks": [asdict(check) for check in checks],
        }
        write_json(json_path, document)
    return 0 if working else 1


def _versions() -> list[Check]:
    """Check Python, the core's packages, and each extra."""
    import platform
    import sys

    from optshape_graph.cli.environment import DISTRIBUTION, import_all, requirements

    required = requirements()
    extras = {name: needs for name, needs in required.items() if name in PURPOSES}
    found = import_all(sorted({name for needs in (required[""], *extras.values()) for name in needs}))
    supported = PYTHON[0] <= sys.version_info[:2] < PYTHON[1]
    checks = [
        Check("Python", "ok" if supported else "broken", f"{platform.python_version()} at {sys.executable}",
              "3.11 to 3.14 are tested", "" if supported else "install Python 3.11 to 3.14", True)
    ]  # fmt: skip
    for name, wanted in sorted(required[""].items()):
        wrong = _wrong(name, wanted, found[name])
        to_do = f"pip install --force-reinstall '{name}{wanted}'" if wrong else ""
        checks.append(
            Check(name, "broken" if wrong else "ok", wrong or str(found[name].version), CORE.get(name, ""), to_do, True)
        )
    for extra in PURPOSES:
        if extra not in extras:
            continue
        needs = extras[extra]
        missing = [name for name in needs if found[name] == Found(None)]
        problems = [f"not installed: {', '.join(missing)}"] if missing else []
        problems += [
            wrong
            for name, wanted in needs.items()
            if name not in missing and (wrong := _wrong(name, wanted, found[name]))
        ]
        there = ", ".join(f"{name} {found[name].version}" for name in needs if found[name].version)
        status = "ok" if not problems else "absent" if missing else "broken"
        to_do = f"pip install '{DISTRIBUTION}[{extra}]'" if problems else ""
        checks.append(Check(f"extra {extra}", status, "; ".join(problems) or there, PURPOSES[extra], to_do))
    return checks


def _wrong(name: str, wanted: str, found: Found) -> str:
    """Return what is wrong with a package; "": nothing."""
    from optshape_graph.cli.environment import satisfies

    if found.version is None:
        return f"{name} is not installed" if not found.error else f"{name} cannot be imported ({found.error})"
    return "" if satisfies(found.version, wanted) else f"{name} {found.version}, where {wanted} is needed"


def _libraries() -> list[Check]:
    from optshape_graph.cli.environment import missing_libraries

    missing = missing_libraries()
    to_do = "as root, on Debian or Ubuntu: apt-get install " + " ".join(missing.values()) if missing else ""
    found = f"{', '.join(missing)} cannot be loaded" if missing else ", ".join(SYSTEM)
    return [Check("system libraries", "absent" if missing else "ok", found, "Open3D loads them (extra mesh)", to_do)]


def _compiled() -> Check:
    from optshape_graph.compiled import library
    from optshape_graph.compiled.build import compile_library

    to_do = f"with a C compiler: python {compile_library.__code__.co_filename}"
    there = library() is not None
    found = "loaded" if there else "not there, or made of other sources: NumPy alone"
    return Check("compiled library", "ok" if there else "absent", found, "poses faster", "" if there else to_do)


def _self_check() -> Check:
    """Estimate a known pose; any error is a finding."""
    import numpy as np

    purpose = "a target simulated 8 m away, estimated, and solved for again with GTSAM"
    to_do = "reinstall: pip install --force-reinstall optshape-graph; if that does not help, report this"
    try:
        from optshape_graph.evaluation.self_check import self_check

        result = self_check()
    except Exception as error:
        return Check("self-check", "broken", f"{type(error).__name__}: {error}", purpose, to_do, True)
    found = (
        f"{1e3 * result.error.e_t:.1f} mm and {np.degrees(result.error.e_r):.2f} deg off, "
        f"{result.status}, {'certified' if result.certified else 'not certified'}, {1e3 * result.seconds:.0f} ms"
    )
    return Check("self-check", "ok" if result.ok else "broken", found, purpose, "" if result.ok else to_do, True)


def _advice() -> list[Check]:
    import os

    if os.environ.get("OMP_NUM_THREADS") == "1":
        return []
    found = f"OMP_NUM_THREADS is {os.environ.get('OMP_NUM_THREADS', 'not set')}"
    purpose = "matrices are small here: threads of the linear algebra get into each other's way"
    return [Check("threads", "advice", found, purpose, "export OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1")]


def _summary(checks: list[Check], working: bool) -> str:
    if not working:
        names = ", ".join(check.name for check in checks if check.core and check.status != "ok")
        return f"The core does not work: {names}. What to do stands below each."
    wanting = [check.name.removeprefix("extra ") for check in checks
               if check.name.startswith("extra ") and check.status != "ok"]  # fmt: skip
    if not wanting:
        return "The core works, and every extra is there."
    return f"The core works. For all that is absent: pip install 'optshape-graph[{','.join(wanting)}]'"
