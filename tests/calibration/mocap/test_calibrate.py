"""The motion-capture graph: Jacobians, recovery of the truth, covariance, sessions from files."""

from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, H, M, S
from scipy.stats import chi2

from optshape_graph import InputError
from optshape_graph.calibration.mocap import calibrate_mocap
from optshape_graph.calibration.mocap.calibrate import calibrate_scans
from optshape_graph.calibration.mocap.comparison import MocapScan
from optshape_graph.calibration.mocap.graph import MarkerModel, marker_factor
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.io import load_sensor, load_session, load_target
from optshape_graph.pose import estimate_pose
from optshape_graph.simulation import NoiseModel, synthetic_session
from tests.pose.clouds import simulated


def make_scans(seed: int, n: int = 4, layout_sd: float = 0.015) -> tuple[list[MocapScan], np.ndarray, np.ndarray]:
    """Scans of a target with markers; the true T_lidar_mocap and layout."""
    rng = np.random.default_rng(seed)
    target, sensor = load_target("built"), load_sensor("vlp32c")
    T_lidar_mocap = gtsam.Pose3.Expmap(np.concatenate([rng.uniform(-1, 1, 3), rng.uniform(-3, 3, 3)])).matrix()
    layout = target.vertices + rng.normal(0, layout_sd, target.vertices.shape)
    scans = []
    for k in range(n):
        noise = replace(NoiseModel.of(sensor), ring_bias=0.0)
        scan, T = simulated(4.0 + 2 * k, (0, 0, 0) if k % 2 else (20, 30, 30), 100 * seed + k, target, noise=noise)
        in_lidar = layout @ T[:3, :3].T + T[:3, 3]
        in_mocap = (in_lidar - T_lidar_mocap[:3, 3]) @ T_lidar_mocap[:3, :3]
        scans.append(MocapScan(f"{k}", estimate_pose(scan, target), in_mocap + rng.normal(0, 3e-4, in_mocap.shape)))
    return scans, T_lidar_mocap, layout


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_marker_factor_jacobians(seed: int, with_scale: bool) -> None:
    """Against central differences along each tangent, at random poses: 1e-5 relative to the whitened size."""
    rng = np.random.default_rng(seed)
    markers = rng.normal(size=(4, 3))
    markers[1] = np.nan
    values = gtsam.Values()
    for key in (H(0), E(0)):
        values.insert(key, gtsam.Pose3.Expmap(rng.normal(size=6)))
    for k in (0, 2, 3):
        values.insert(M(k), rng.normal(size=3))
    if with_scale:
        values.insert(S(0), 1.1)
    factor = marker_factor(markers, 0, 1.0, with_scale)
    A, _ = factor.linearize(values).jacobian()
    ordering, column = list(factor.keys()), 0
    for key in ordering:
        dim = 6 if key in (H(0), E(0)) else 1 if key == S(0) else 3
        for j in range(dim):
            numbers = []
            for step in (1e-6, -1e-6):
                delta = gtsam.VectorValues()
                delta.insert(key, step * np.eye(dim)[j])
                numbers.append(factor.unwhitenedError(values.retract(delta)))
            numerical = (numbers[0] - numbers[1]) / 2e-6
            np.testing.assert_allclose(A[:, column + j], numerical, atol=1e-5)
        column += dim


def test_recovers_the_truth() -> None:
    """Normalised error of T_lidar_mocap over sessions: chi-square with 6 degrees of freedom, in its 99.9 % region."""
    for seed in range(4):
        scans, T, layout = make_scans(seed)
        result = calibrate_scans(scans)
        xi = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(result.T_lidar_mocap) @ T))
        assert xi @ np.linalg.solve(result.covariance, xi) < chi2.ppf(0.999, 6)
        off = (result.marker_layout - layout) / result.layout_sigma
        assert np.abs(off).max() < 4.5
        np.testing.assert_allclose(result.T_mocap_lidar @ result.T_lidar_mocap, np.eye(4), atol=1e-12)


def test_scale_is_found() -> None:
    scans, _, _ = make_scans(5, n=6)
    scans = [replace(scan, markers=scan.markers / 1.03) for scan in scans]
    result = calibrate_scans(scans, MarkerModel(with_scale=True))
    assert abs(result.scale - 1.03) < 4 * result.scale_sigma
    assert result.scale_sigma < 0.02


def test_bad_input() -> None:
    scans, _, _ = make_scans(1, n=2)
    with pytest.raises(InputError, match="at least two"):
        calibrate_scans(scans[:1])
    other = replace(scans[1], estimate=estimate_pose(simulated(6.0)[0], load_target("paper")))
    with pytest.raises(InputError, match="one target"):
        calibrate_scans([scans[0], other])


def test_session_from_files(tmp_path: Path) -> None:
    path = synthetic_session(tmp_path, load_target("built"), load_sensor("vlp32c"), distances=(4.0, 7.0), rng=3)
    seen = []
    result = calibrate_mocap(path, progress=lambda done, total: seen.append((done, total)))
    assert len(result.scans) == 4
    assert result.left_out == ()
    assert seen[-1] == (4, 4)
    assert result.leave_one_out[0].rmse_m < 0.05
    assert result.verdict == "to be trusted"


def test_scans_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    path = synthetic_session(tmp_path, load_target("built"), load_sensor("vlp32c"), distances=(4.0, 7.0), rng=3)
    lines = (tmp_path / "markers.csv").read_text().splitlines()
    kept = [line for line in lines if not line.startswith(("0,corner0", "0,corner1"))]
    (tmp_path / "markers.csv").write_text("\n".join(kept) + "\n")
    scans, left_out, _ = load_mocap_scans(load_session(path))
    assert len(scans) == 3
    assert left_out[0].scan.endswith("4m.pcd")
    assert "2 markers" in left_out[0].reason


def test_session_without_mocap(tmp_path: Path) -> None:
    path = synthetic_session(tmp_path, load_target("built"), load_sensor("vlp32c"), distances=(4.0,), rng=3)
    text = path.read_text()
    path.write_text(text[: text.index("mocap:")])
    with pytest.raises(InputError, match=r"mocap"):
        load_mocap_scans(load_session(path))


def test_extra_and_unnamed_markers_do_no_harm(tmp_path: Path) -> None:
    path = synthetic_session(tmp_path, load_target("built"), load_sensor("vlp32c"), distances=(4.0, 7.0), rng=3)
    expected = calibrate_mocap(path)
    lines = (tmp_path / "markers.csv").read_text().splitlines()
    extra = [f"{k},{name},{k},2,0.5" for k in range(4) for name in ("robot1", "")]
    (tmp_path / "markers.csv").write_text("\n".join([*lines, *extra]) + "\n")
    np.testing.assert_allclose(calibrate_mocap(path).T_lidar_mocap, expected.T_lidar_mocap, atol=1e-9)


def test_a_vendors_export_is_named_in_the_session(tmp_path: Path) -> None:
    path = synthetic_session(tmp_path, load_target("built"), load_sensor("vlp32c"), distances=(4.0, 7.0), rng=3)
    expected = calibrate_mocap(path)
    rows = [line.split(",") for line in (tmp_path / "markers.csv").read_text().splitlines()[1:]]
    header = "NO_OF_FRAMES\t4\nNO_OF_MARKERS\t4\nFREQUENCY\t100\nDATA_INCLUDED\t3D\n"
    names = "MARKER_NAMES\t" + "\t".join(row[1] for row in rows[:4])
    frames = ["\t".join(f"{1e3 * float(x):.3f}" for row in rows[k : k + 4] for x in row[2:]) for k in range(0, 16, 4)]
    (tmp_path / "markers.tsv").write_text(header + "\n".join([names, *frames]) + "\n")
    text = path.read_text().replace("markers.csv", "markers.tsv").replace(", units: m", "")
    path.write_text(text)
    assert "units" not in text
    np.testing.assert_allclose(calibrate_mocap(path).T_lidar_mocap, expected.T_lidar_mocap, atol=1e-5)
