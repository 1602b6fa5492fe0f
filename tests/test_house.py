"""The house: imports point down the layers only, and heavy libraries wait until they are needed."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "optshape_graph"

LAYERS = [
    "cli", "viz", "evaluation", "calibration", "mapping", "simulation", "design", "graph", "detection", "pose",
    "factors", "runs", "io",
]  # fmt: skip
"""From the top; below them are the nouns."""

FACE = {PACKAGE / "__init__.py", PACKAGE / "__main__.py"}
"""They stand before all layers: what they import from them is imported when it is used."""

HEAVY = [
    "open3d",
    "cvxpy",
    "matplotlib",
    "cv2",
    "rosbags",
    "distributed",
    "pyarrow",
    "ezc3d",
    "ezdxf",
    "scipy",
]


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, at its top or in its functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return {name for name in found if name.split(".")[0] == "optshape_graph"}


@pytest.mark.parametrize("layer", [*LAYERS, ""])
def test_imports_point_down(layer: str) -> None:
    files = (PACKAGE / layer).rglob("*.py") if layer else sorted(set(PACKAGE.glob("*.py")) - FACE)
    above = LAYERS[: LAYERS.index(layer)] if layer else LAYERS
    for path in files:
        for name in imported(path):
            parts = name.split(".")
            assert len(parts) < 2 or parts[1] not in above, f"{path.relative_to(PACKAGE)} imports {name}"


def test_what_is_compiled_knows_arrays_alone() -> None:
    """Nouns use it, too."""
    for path in (PACKAGE / "compiled").glob("*.py"):
        assert imported(path) <= {"optshape_graph._arrays", "optshape_graph.compiled.build"}


def test_factors_know_nothing_but_the_nouns() -> None:
    for path in (PACKAGE / "factors").glob("*.py"):
        for name in imported(path):
            parts = name.split(".")
            assert len(parts) < 2 or parts[1] == "factors" or parts[1] not in LAYERS, f"{path.name} imports {name}"


def arrows_of_pose() -> dict[str, set[str]]:
    """Each room of `pose`, and the others there that it imports: a folder is one room, its `__init__` the face."""
    pose, rooms = PACKAGE / "pose", {}
    for path in pose.rglob("*.py"):
        room = path.relative_to(pose).parts[0].removesuffix(".py")
        below = {name.split(".")[2] for name in imported(path) if name.startswith("optshape_graph.pose.")}
        rooms.setdefault(room, set()).update(below - {room})
    rooms.pop("__init__")
    return rooms


def test_pose_has_few_arrows() -> None:
    assert sum(map(len, arrows_of_pose().values())) <= 28


def test_pose_has_no_circles() -> None:
    below = arrows_of_pose()
    while below:
        ground = {name for name, others in below.items() if not others & below.keys()}
        assert ground, f"a circle among {sorted(below)}"
        below = {name: others for name, others in below.items() if name not in ground}


def test_top_level_factors_are_the_package_s_own() -> None:
    link = PACKAGE.parent / "factors"
    if link.is_symlink():
        assert link.resolve() == PACKAGE / "factors"
    else:  # a clone without symbolic links has the path as a file's text
        assert link.read_text().strip() == "optshape_graph/factors"


def test_import_loads_nothing_heavy() -> None:
    script = f"import sys, optshape_graph; print([m for m in {[*HEAVY, 'gtsam']} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_an_estimate_loads_nothing_heavy(tmp_path: Path) -> None:
    """`optshape estimate` of one scan: neither GTSAM nor any of the others."""
    from optshape_graph.io import load_sensor, load_target, write_scan
    from optshape_graph.simulation import pose_from_rpy, simulate_target

    scan = tmp_path / "scan.pcd"
    target, sensor = load_target("paper"), load_sensor("vlp32c")
    write_scan(scan, simulate_target(target, sensor, pose_from_rpy([5.0, 0.0, 0.0], [0.1, 0.2, 0.3]), rng=0))
    script = (
        "import sys; from optshape_graph.cli.main import cli; code = cli(sys.argv[1:], standalone_mode=False); "
        f"print([m for m in {[*HEAVY, 'gtsam']} if m in sys.modules]); sys.exit(code)"
    )
    estimate = [sys.executable, "-c", script, "estimate", str(scan), "--target", "paper", "--sensor", "vlp32c"]
    result = subprocess.run(estimate, capture_output=True, text=True, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("package", ["optshape_graph", "evaluation", "factors", "io"])
def test_lazy_faces_show_what_they_name(package: str) -> None:
    name = package if package == "optshape_graph" else f"optshape_graph.{package}"
    face = import_module(name)
    assert face.__file__ is not None
    tree = ast.parse(Path(face.__file__).read_text())
    [typed] = [node for node in tree.body if isinstance(node, ast.If)]
    seen = {alias.name: node.module for node in typed.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    homes = {one: f"{name}.{home}" for home, names in face._HOME.items() for one in names.split()}
    assert seen == homes
    assert set(homes) <= set(face.__all__) <= set(dir(face))
    for one in face.__all__:
        assert getattr(face, one) is not None
    with pytest.raises(AttributeError, match="no attribute 'estimate_pause'"):
        face.estimate_pause  # noqa: B018 - the look-up itself is what fails


def test_version_is_stated_once() -> None:
    import optshape_graph

    pyproject = (PACKAGE.parent / "pyproject.toml").read_text()
    assert 'dynamic = ["version"]' in pyproject
    assert optshape_graph.__version__ not in pyproject


def test_names_of_lazy_packages_are_no_modules_of_theirs() -> None:
    """Importing a module sets its name on the package: a function of that name would be hidden, as the order is."""
    lazy = [path for path in PACKAGE.rglob("__init__.py") if "lazy(__name__" in path.read_text()]
    assert len(lazy) >= 4
    for path in lazy:
        package = import_module(".".join(path.parent.relative_to(PACKAGE.parent).parts))
        modules = {other.stem for other in path.parent.iterdir() if other.suffix == ".py" or other.is_dir()}
        assert not modules & set(package.__all__), path
