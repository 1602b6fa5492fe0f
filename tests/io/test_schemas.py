"""The published schemas: sound, of everything that says `schema:`, and of one mind with readers and writers."""

from __future__ import annotations

import contextlib
import copy
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import optshape_graph
from optshape_graph import InputError
from optshape_graph.io import load_camera, load_schema, load_sensor, load_session, load_target, schema_names
from optshape_graph.io.documents import read_yaml
from tests.fuzz import readers
from tests.io.schema_support import complaint, validator

jsonschema = pytest.importorskip("jsonschema")

PACKAGE = Path(optshape_graph.__file__).parent


@pytest.mark.parametrize("name", schema_names())
def test_schemas_are_sound(name: str) -> None:
    schema = load_schema(name)
    jsonschema.Draft202012Validator.check_schema(schema)
    kind, _, version = name.rpartition("-")
    assert schema["$id"] == f"urn:optshape:{kind}:{version}"
    assert f'"optshape/{kind}/{version}"' in json.dumps(schema)
    assert load_schema(kind) == schema == load_schema(f"optshape/{kind}/{version}")


def test_there_is_a_schema_for_everything_that_says_so() -> None:
    said = {
        found
        for path in PACKAGE.rglob("*.py")
        for found in re.findall(r"optshape/([a-z]+(?:-[a-z]+)*/[0-9]+)\b", path.read_text())
    } | {"design-start/1", "detect/1", "estimate/1"}  # spelt with a constant
    assert {name.replace("/", "-") for name in said} == set(schema_names())


def test_what_several_schemas_define_is_the_same_in_all() -> None:
    defined: dict[str, Any] = {}
    for name in schema_names():
        for key, value in load_schema(name).get("$defs", {}).items():
            assert defined.setdefault(key, value) == value, f"{name}: {key}"


def test_lengths_and_angles_state_their_unit() -> None:
    def walk(node: Any, name: str) -> None:
        if isinstance(node, dict):
            for key, value in node.get("properties", {}).items():
                if re.search(r"_(m|mm|deg|rad|s|px|pct)$", key):
                    assert "description" in value or "$ref" in value, f"{name}: {key} has no description"
            for value in node.values():
                walk(value, name)
        elif isinstance(node, list):
            for value in node:
                walk(value, name)

    for name in schema_names():
        walk(load_schema(name), name)


def test_an_unknown_schema_is_refused() -> None:
    with pytest.raises(
        InputError,
        match="no schema 'poem'; expected one of: camera-1, camera-calibration-1, design-choice-1, design-scores-1",
    ):
        load_schema("poem")


@pytest.mark.parametrize("path", sorted((PACKAGE / "data").rglob("*.yaml")), ids=lambda path: path.stem)
def test_built_in_files_fit(path: Path) -> None:
    assert complaint(path) is None


# Readers and schemas are of one mind


def _session(path: Path) -> object:
    return load_session(path)


FORMS: dict[str, tuple[Callable[[Path], object], Callable[[Path], list[bytes]]]] = {
    "target": (load_target, readers.targets),
    "sensor": (load_sensor, readers.written(readers.save_sensor, readers.VLP16)),
    "camera": (load_camera, lambda _: [readers.camera_files(_)[0]]),
    "session": (_session, lambda _: [text.encode() for text in readers.SESSIONS]),
    "scene": (readers.load_scene, lambda _: [readers.SCENE.encode()]),
    "map": (readers.load_map, readers.maps),
    "design-start": (readers.read_start, readers.starts),
}

values = st.one_of(
    st.none(), st.booleans(), st.integers(-3, 200), st.floats(-200, 200), st.sampled_from([0, 0.0, 1.0, 90, 180, 1e9]),
    st.sampled_from(["", "a", "paper", "vlp16", "m", "0", "scan.pcd", "٣"]), st.just([]), st.just({}),
    st.lists(st.floats(-5, 5), max_size=6), st.lists(st.lists(st.integers(0, 1), max_size=4), max_size=4),
    st.dictionaries(st.sampled_from(["a", "7", "sensor"]), st.lists(st.floats(0, 1), max_size=3), max_size=2),
)  # fmt: skip


def places(document: Any, at: tuple[str | int, ...] = ()) -> list[tuple[str | int, ...]]:
    """Every key and index of a document, from the root."""
    items = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    return [place for key, value in items for place in ((*at, key), *places(value, (*at, key)))]


@st.composite
def damaged(draw: st.DrawFn, document: Any, names: list[str]) -> Any:
    """A document with a value replaced, left out or added, once or twice."""
    document = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 2))):
        known = places(document)
        if not known:
            break
        *way, last = draw(st.sampled_from(known))
        holder = document
        for key in way:
            holder = holder[key]
        change = draw(st.sampled_from(["replace", "remove", "add", "repeat"]))
        if change == "replace":
            old = holder[last]
            kin = old * draw(st.sampled_from([1, 1.0, 1.01, 2, -1])) if isinstance(old, int | float) else f"{old}"
            holder[last] = kin if draw(st.booleans()) else draw(values)
        elif change == "remove":
            del holder[last]
        elif isinstance(holder, dict):
            holder[draw(st.sampled_from([*names, "unknown"]))] = holder[last] if change == "repeat" else draw(values)
        else:
            holder.append(holder[last] if change == "repeat" else draw(values))
    return document


@pytest.mark.parametrize("kind", FORMS)
def test_what_a_schema_refuses_the_reader_refuses(tmp_path_factory: pytest.TempPathFactory, kind: str) -> None:
    folder = tmp_path_factory.mktemp("forms")
    readers.furnish(folder)
    read, seeds = FORMS[kind]
    good = []
    for number, seed in enumerate(seeds(folder)):
        (folder / f"good{number}.yaml").write_bytes(seed)
        good.append(read_yaml(folder / f"good{number}.yaml").value)
    names = sorted({str(place[-1]) for document in good for place in places(document)})
    check = validator(kind)
    file = folder / "damaged.json"
    counts = {"refused by both": 0, "by the reader alone": 0, "read": 0}

    @given(st.sampled_from(good).flatmap(lambda document: damaged(document, names)))
    @settings(max_examples=300, suppress_health_check=list(HealthCheck))
    def agree(document: Any) -> None:
        if kind == "camera" and not (isinstance(document, dict) and "schema" in document):
            return  # of another program, for all that the reader knows
        file.write_text(json.dumps(document))
        fits = check.is_valid(document)
        try:
            read(file)
        except InputError:
            counts["by the reader alone" if fits else "refused by both"] += 1
            return
        counts["read"] += 1
        assert fits, next(check.iter_errors(document)).message

    for document in good:
        assert check.is_valid(document)
        for place in places(document):  # truth values are numbers to Python, and to nobody else
            *way, last = place
            changed = copy.deepcopy(document)
            holder = changed
            for key in way:
                holder = holder[key]
            holder[last] = bool(holder[last])
            file.write_text(json.dumps(changed))
            if not check.is_valid(changed):
                with pytest.raises(InputError):
                    read(file)
    agree()
    assert min(counts["read"], counts["refused by both"]) > 0, counts


# What the writers write fits

lengths = st.floats(1e-3, 10)


@given(st.integers(3, 9), lengths.filter(lambda x: x > 0.05), st.booleans(), st.text(min_size=1, max_size=8))
@settings(max_examples=40)
def test_targets_that_are_written_fit(
    tmp_path_factory: pytest.TempPathFactory, n: int, radius: float, board: bool, name: str
) -> None:
    from optshape_graph.target import Chessboard, Tags, Target

    angles = 2 * np.pi * np.arange(n) / n
    shape = Target.from_polygon(radius * np.column_stack([np.cos(angles), np.sin(angles)])).vertices
    made = Target(shape, name, Chessboard((4, 5), radius / 9)) if board else Target(
        shape, name, None, Tags("4X4_50", radius / 9, {7: (0.1 * radius, 0.0)}, 0.3)
    )  # fmt: skip
    path = tmp_path_factory.mktemp("written") / "target.yaml"
    with contextlib.suppress(InputError):  # a name that YAML cannot hold
        readers.save_target(path, made)
        assert complaint(path) is None


@given(
    st.lists(st.floats(-89, 89), min_size=1, max_size=8, unique=True).map(sorted),
    st.none() | st.floats(1e-3, 3), lengths, lengths, st.none() | st.floats(20, 300), st.booleans(),
)  # fmt: skip
@settings(max_examples=40)
def test_sensors_that_are_written_fit(
    tmp_path_factory: pytest.TempPathFactory, elevations: list[float], step: float | None, noise: float,
    divergence: float, farthest: float | None, offsets: bool,
) -> None:  # fmt: skip
    from optshape_graph.sensor import SensorModel

    radians = np.radians(elevations)
    if (np.diff(radians) <= 0).any():
        return
    made = SensorModel(radians, "made", step, noise, noise, divergence, azimuth_offsets=radians if offsets else None,
                       max_range=np.inf if farthest is None else farthest)  # fmt: skip
    path = tmp_path_factory.mktemp("written") / "sensor.yaml"
    readers.save_sensor(path, made)
    assert complaint(path) is None


@given(st.sampled_from([("pinhole", 0), ("pinhole", 4), ("pinhole", 5), ("pinhole", 8), ("equidistant", 4)]), st.data())
@settings(max_examples=30)
def test_cameras_that_are_written_fit(
    tmp_path_factory: pytest.TempPathFactory, model: tuple[str, int], data: st.DataObject
) -> None:
    from optshape_graph.camera import CameraIntrinsics

    f, c = data.draw(st.floats(1, 1e5)), data.draw(st.floats(0.5, 99))
    D = data.draw(st.lists(st.floats(-2, 2), min_size=model[1], max_size=model[1]))
    K = np.array([[f, 0, c], [0, f, c], [0, 0, 1]])
    path = tmp_path_factory.mktemp("written") / "camera.yaml"
    readers.save_camera(path, CameraIntrinsics("c", model[0], 100, 100, K, np.array(D)))
    assert complaint(path) is None


def test_maps_and_starts_that_are_written_fit(tmp_path: Path) -> None:
    from optshape_graph.mapping import Map, save_map

    for name, seeds in (("map", readers.maps), ("start", readers.starts)):
        for seed in seeds(tmp_path):
            (tmp_path / f"{name}.json").write_bytes(seed)
            assert complaint(tmp_path / f"{name}.json") is None
    save_map(tmp_path / "empty.json", Map((), np.zeros((0, 0))))
    assert complaint(tmp_path / "empty.json") is None
    assert readers.load_map(tmp_path / "empty.json").landmarks == ()


def test_a_newer_form_is_refused_by_name(tmp_path: Path) -> None:
    for kind, (read, seeds) in FORMS.items():
        text = seeds(tmp_path)[0].decode().replace(f"optshape/{kind}/1", f"optshape/{kind}/2")
        path = tmp_path / (f"{kind}.json" if text.startswith("{") else f"{kind}.yaml")
        path.write_text(text)
        with pytest.raises(
            InputError, match=rf"'optshape/{kind}/2' is a newer form .* reads 'optshape/{kind}/1'"
        ) as error:
            read(path)
        assert str(path) in str(error.value)
