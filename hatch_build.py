"""Hatch's hook: a wheel has the compiled library where there is a compiler, for its platform; else it is for all.

On Linux it is for every C library from 2.17 on (manylinux_2_17), where that is all that the library asks for.
"""

from __future__ import annotations

import re
import sysconfig
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CompiledLibrary(BuildHookInterface):
    """Compiles the library into the package."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name what was made."""
        place = Path(self.root) / "optshape_graph" / "compiled" / "build.py"
        spec = spec_from_file_location("build", place)
        build = module_from_spec(spec)
        spec.loader.exec_module(build)
        build.LIBRARY.unlink(missing_ok=True)
        self.app.display_info(build.compile_library())
        if build.LIBRARY.exists() and version != "editable":
            build_data["tag"] = f"py3-none-{platform_of(build.LIBRARY)}"
            build_data["pure_python"] = False
            build_data["artifacts"].append("optshape_graph/compiled/library.so")


def platform_of(library: Path) -> str:
    """Name the platform that a library of this machine runs on, as wheels do."""
    platform = re.sub(r"[-.]", "_", sysconfig.get_platform())
    asked = [int(minor) for minor in re.findall(rb"GLIBC_2\.(\d+)", library.read_bytes())]
    return re.sub("^linux", "manylinux_2_17", platform) if asked and max(asked) <= 17 else platform
