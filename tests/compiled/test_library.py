"""The compiled library against NumPy, its reference: the same to rounding, and the same estimates without it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from optshape_graph import compiled, factors, se3
from optshape_graph._arrays import Floats
from optshape_graph.compiled import build, library
from optshape_graph.detection import DetectionOptions, segments
from optshape_graph.detection.segments import order_scan
from optshape_graph.factors.measurement import TemplateMeasurement, refine_all
from optshape_graph.io import load_sensor, load_target
from optshape_graph.pose import association
from optshape_graph.pose.ends import Posterior, candidates, ring_ends, work_out
from optshape_graph.pose.evidence import Evidence, ends_of, measure
from optshape_graph.pose.modes import scan_log_likelihood
from optshape_graph.pose.options import PoseOptions
from optshape_graph.pose.sampling import Components, firings, mixture, rays
from optshape_graph.pose.sampling.mixture import Draws
from optshape_graph.se3 import exp, inverse, quaternion
from optshape_graph.simulation import NoiseModel, pose_from_rpy
from optshape_graph.simulation.reference import reference_sensor
from tests.detection.scenes import scan_of
from tests.pose.clouds import simulated
from tests.statistics.groups import GROUPS, draw

ROOT = Path(__file__).resolve().parents[2]

needs_library = pytest.mark.skipif(library() is None, reason="no library: no compiler here, or left out")


@pytest.fixture(scope="module")
def evidences() -> list[list[Evidence]]:
    """Scans of every group, and of the paper's sensor with noisy angles; together if targets have as many edges."""
    drawn = [draw(name, 90210, index)[:2] for name in GROUPS for index in range(4)]
    for level in (0, 1, 3, 4):
        for distance in (4.0, 8.0, 16.0):
            noise, sensor = NoiseModel.level(level), reference_sensor()
            scan, _ = simulated(distance, (10.0, -20.0, 15.0), level, sensor=sensor, noise=noise)
            drawn.append((scan, load_target("paper")))
    measured = [one for one in measure(*zip(*drawn, strict=True), PoseOptions()) if isinstance(one, Evidence)]
    assert len(measured) > 40
    assert any(one.problem.ring_shifts.any() for one in measured)

    def edges(evidence: Evidence) -> int:
        return len(evidence.problem.target)

    return [list(some) for _, some in groupby(sorted(measured, key=edges), edges)]


def assert_posteriors(found: Posterior, reference: Posterior, there: Floats) -> None:
    for name in vars(reference.geometry):
        a, b = getattr(found.geometry, name)[there], getattr(reference.geometry, name)[there]
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-13 * max(1.0, np.abs(b).max()))
    sd = np.sqrt(np.einsum("cii->ci", reference.joint))
    off = found.T_target_lidar[:, :3] - reference.T_target_lidar[:, :3]
    assert np.abs(off).max() < 1e-7
    assert np.abs((found.joint - reference.joint) / (sd[:, :, None] * sd[:, None])).max() < 1e-6
    assert np.abs(found.offset - reference.offset).max() < 1e-6
    for name in ("inset", "shift"):
        assert np.abs(getattr(found, name) - getattr(reference, name))[there].max() < 1e-7
    np.testing.assert_allclose(found.sigma[there], reference.sigma[there], rtol=1e-5)
    np.testing.assert_allclose(found.log_likelihood, reference.log_likelihood, rtol=1e-6, atol=1e-4)


@needs_library
@pytest.mark.parametrize("sweeps", [2, 4])
def test_posteriors_are_those_of_numpy(
    evidences: list[list[Evidence]], sweeps: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In batches that are padded, each ring end's own labels, and half of them given."""
    for some in evidences:
        starts = association.enumerate_poses(
            [one.problem.edges for one in some], [one.plane for one in some], [one.problem.target for one in some]
        )
        ends, T = ends_of(some), np.concatenate(starts)
        scan = np.repeat(np.arange(len(some)), [len(one) for one in starts])
        labels = ends.take(scan).geometry(T).labels
        labels[:, ::2] = -1
        for given in (None, labels):
            found_scan, found = work_out(ends, scan, T, given, sweeps)
            for module in (candidates, ring_ends):
                monkeypatch.setattr(module, "library", lambda: None)
            reference_scan, reference = work_out(ends, scan, T, given, sweeps)
            monkeypatch.undo()
            np.testing.assert_array_equal(found_scan, reference_scan)
            np.testing.assert_array_equal(found.geometry.labels, reference.geometry.labels)
            near = reference.log_likelihood > reference.log_likelihood.max() - 200
            there = np.broadcast_to(ends.there[found_scan] if len(some) > 1 else ends.there, found.inset.shape)[near]
            index = np.flatnonzero(near)
            assert_posteriors(found.select(index), reference.select(index), there)


@needs_library
def test_starts_are_those_of_numpy(evidences: list[list[Evidence]], monkeypatch: pytest.MonkeyPatch) -> None:
    for some in evidences:
        arguments = (
            [one.problem.edges for one in some],
            [one.plane for one in some],
            [one.problem.target for one in some],
        )
        found = association.enumerate_poses(*arguments)
        monkeypatch.setattr(association, "library", lambda: None)
        reference = association.enumerate_poses(*arguments)
        monkeypatch.undo()
        for one, a, b in zip(some, found, reference, strict=True):
            symmetries = one.problem.target.symmetry_transforms
            if len(symmetries) == 1:
                np.testing.assert_allclose(a, b, atol=1e-9)
            equal = (symmetries @ b[:, None]).reshape(-1, 1, 16)  # those of a symmetric target are equally good
            assert np.abs(equal - a.reshape(-1, 16)).max(axis=2).min(axis=0).max() < 1e-9


@needs_library
def test_a_library_that_is_not_whole_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that was cut short would kill the process that loads it."""
    place, content = tmp_path / "library.so", build.LIBRARY.read_bytes()
    monkeypatch.setattr(compiled, "LIBRARY", place)
    assert library.__wrapped__() is None
    changed = bytearray(content)
    changed[len(content) // 2] ^= 1
    for damaged in (b"", b"ELF", content[:1000], content[: len(content) // 2], content[:-1], bytes(changed)):
        place.write_bytes(damaged)
        assert library.__wrapped__() is None
    place.write_bytes(content)
    assert library.__wrapped__() is not None


@needs_library
def test_a_library_of_other_sources_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "other.c").write_text("int other;")
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    assert library.__wrapped__() is None


def test_without_the_library_an_estimate_is_the_same(tmp_path: Path) -> None:
    scan, built = ROOT / "optshape_graph" / "data" / "demo" / "4m.pcd", ("--target", "built", "--sensor", "vlp32c")
    poses = []
    for said in ("on", "off"):
        path = tmp_path / f"{said}.json"
        command = [sys.executable, "-m", "optshape_graph", "estimate", scan, *built, "--json", path]
        environment = os.environ | {"OPTSHAPE_COMPILED": said, "PYTHONPATH": str(ROOT)}
        subprocess.run(command, check=True, capture_output=True, env=environment)
        [estimate] = json.loads(path.read_text())["scans"]
        poses.append(np.array(estimate["T_lidar_target"]))
    np.testing.assert_allclose(*poses, atol=1e-7)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no compiler")
def test_the_library_is_compiled_where_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPTSHAPE_COMPILED", raising=False)
    (tmp_path / "one.c").write_text("int one(void) { return 1; }")
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    monkeypatch.setattr(build, "LIBRARY", tmp_path / "library.so")
    assert build.compile_library().startswith("compiled")
    assert build.compile_library().endswith("is there")
    (tmp_path / "broken.c").write_text("this is no C")
    assert build.compile_library().startswith("NumPy alone: ")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert build.compile_library() == "no compiler: NumPy alone"
    monkeypatch.setenv("CC", "cc 'half")
    assert build.compile_library().startswith("NumPy alone: CC is ")
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".new"] == []


@needs_library
def test_densities_are_those_of_numpy(evidences: list[list[Evidence]], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of poses drawn about the first start, near and far, for scans with a beam and with none, on each kind of grid."""
    rng, kinds = np.random.default_rng(5), set()
    for evidence in [one for some in evidences for one in some]:
        target = evidence.problem.target
        arguments = [evidence.problem.edges], [evidence.plane], [target]
        first = inverse(association.enumerate_poses(*arguments)[0][0])
        xi = rng.normal(size=(300, 6)) * np.geomspace(1e-3, 0.3, 300)[:, None]
        T, offset = first @ exp(xi), rng.normal(size=300)
        components = Components(
            T[:5], rng.normal(size=(5, 7)) * 0.01, np.tile(np.eye(7) * 0.01, (5, 1, 1)), np.full(5, 0.2)
        )
        draws = Draws(T, offset, quaternion(T[:, None, :3, :3] @ target.symmetry_transforms[:, :3, :3]))
        density = scan_log_likelihood(evidence)
        found = density(T, offset), *mixture._log_components(components, draws)
        for module in (firings, rays, mixture):
            monkeypatch.setattr(module, "library", lambda: None)
        with np.errstate(divide="ignore"):
            reference = density(T, offset), *mixture._log_components(components, draws)
        monkeypatch.undo()
        kinds.add(evidence.problem.beam.ideal)
        likely = reference[0] > reference[0].max() - 300
        np.testing.assert_allclose(found[0][likely], reference[0][likely], rtol=1e-9, atol=1e-8)
        assert (found[0][~likely] < reference[0].max() - 250).all()
        np.testing.assert_allclose(found[1], reference[1], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found[2], reference[2], atol=1e-11)
    assert kinds == {True, False}


@needs_library
def test_tangent_vectors_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of turns from none to half a turn, about one transform and about one for each."""
    rng = np.random.default_rng(6)
    axis = rng.normal(size=(400, 3))
    angle = np.concatenate([[0.0, np.pi - 1e-9], np.geomspace(1e-12, 3.1, 398)])
    xi = np.hstack([axis * (angle / np.linalg.norm(axis, axis=1))[:, None], rng.normal(size=(400, 3))])
    A = exp(rng.normal(size=(400, 6)))
    found = se3.difference(A[0], A[0] @ exp(xi)), se3.difference(A, A @ exp(xi))
    monkeypatch.setattr(se3, "library", lambda: None)
    for one in found:
        np.testing.assert_allclose(one, xi, atol=1e-8)
        np.testing.assert_allclose(one[2:], xi[2:], atol=1e-12)
    np.testing.assert_allclose(se3.difference(A[0], A[0] @ exp(xi))[2:], found[0][2:], atol=1e-12)


@needs_library
def test_minima_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of full measurements and of ones that leave directions open, from near and from far."""
    rng = np.random.default_rng(7)
    measurements, starts = [], []
    for k, T in enumerate(exp(rng.normal(size=(60, 6)))):
        rows = rng.normal(size=(12 if k % 3 else 5, 12))
        constants = 1e-3 * rng.normal(size=len(rows)) - rows @ se3.vec(T)
        measurements.append(TemplateMeasurement.from_rows(rows, constants, T))
        starts.append(T @ exp(rng.normal(size=6) * (0.01, 0.3)[k % 2]))
    found = refine_all(measurements, np.array(starts))
    monkeypatch.setattr(factors.measurement, "library", lambda: None)
    reference = refine_all(measurements, np.array(starts))
    full = np.arange(60) % 3 > 0
    np.testing.assert_allclose(found[full], reference[full], atol=1e-7)
    for one, a, b in zip(measurements, found, reference, strict=True):  # where it is flat, any point of the minimum
        assert one.error(a) == pytest.approx(one.error(b), rel=1e-6, abs=1e-12)


@needs_library
def test_segments_are_those_of_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    for sensor in ("vlp16", "os1-64"):
        pose = pose_from_rpy([6.0, 0.5, 0.0], [0.1, -0.4, 0.3])
        scan = scan_of(load_sensor(sensor), [(load_target("paper"), pose)]).scan
        found = order_scan(scan, DetectionOptions())
        monkeypatch.setattr(segments, "library", lambda: None)
        np.testing.assert_array_equal(found.first, order_scan(scan, DetectionOptions()).first)
        monkeypatch.undo()
        assert len(found.first) > 16
