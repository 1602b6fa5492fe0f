"""Exports of each vendor, written as its software writes them, against the positions they were written from."""

import contextlib

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from optshape_graph import InputError
from optshape_graph.io.mocap import MocapRecording, read_mocap

NAMES = ("corner0", "corner1", "corner2", "corner3")
F = 7


def truth() -> np.ndarray:
    """(F, 4, 3) metres with two gaps; nowhere zero."""
    positions = np.round(np.random.default_rng(0).uniform(0.1, 3, (F, 4, 3)), 6)
    positions[2, 1] = positions[5, 3] = np.nan
    positions[4] = positions[6, 0] = np.nan
    return positions


def same(recording: MocapRecording, rate: float, first: float = 0.0, tolerance: float = 1e-9) -> None:
    assert recording.markers == NAMES
    assert recording.rate == rate
    assert np.abs(recording.times - first - np.arange(F) / rate).max() < 1e-5  # times are printed to 1e-5 s
    assert np.array_equal(recording.seen, np.isfinite(truth()[:, :, 0]))
    assert np.nanmax(np.abs(recording.positions - truth())) < tolerance


def qualisys_tsv(gap: str, leading: int, header: bool, marker_order=NAMES) -> str:
    lines = [
        f"NO_OF_FRAMES\t{F}", "NO_OF_CAMERAS\t8", "NO_OF_MARKERS\t4", "FREQUENCY\t200", "NO_OF_ANALOG\t0",
        "ANALOG_FREQUENCY\t0", "DESCRIPTION\t--", "TIME_STAMP\t2023-05-06, 10:11:12.345\t1234.5", "DATA_INCLUDED\t3D",
        "MARKER_NAMES\t" + "\t".join(marker_order), "TRAJECTORY_TYPES\t" + "\t".join(["Measured"] * 4),
    ]  # fmt: skip
    if header:
        columns = ["Frame", "Time"][:leading] + [f"{name} {axis}" for name in marker_order for axis in "XYZ"]
        lines.append("\t".join(columns))
    for k, frame in enumerate(truth() * 1e3):
        cells = [str(k + 1), f"{k / 200:.5f}"][:leading]
        for position in frame:
            cells += [gap] * 3 if np.isnan(position).any() else [f"{x:.3f}" for x in position]
        lines.append("\t".join(cells))
    return "\r\n".join(lines) + "\r\n"


@pytest.mark.parametrize("gap", ["0.000", "", "NULL", "NaN"])
@pytest.mark.parametrize(("leading", "header"), [(0, False), (0, True), (2, False), (2, True), (1, True)])
def test_qualisys_tsv(tmp_path, gap, leading, header):
    (tmp_path / "a.tsv").write_bytes(qualisys_tsv(gap, leading, header).encode("cp1252"))
    same(read_mocap(tmp_path / "a.tsv"), 200.0)


def test_qualisys_6d_is_refused(tmp_path):
    (tmp_path / "a.tsv").write_text(qualisys_tsv("0", 2, True).replace("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D"))
    with pytest.raises(InputError, match="DATA_INCLUDED is 6D; export 3D"):
        read_mocap(tmp_path / "a.tsv")


def mat(path) -> None:
    from scipy.io import savemat

    data = np.concatenate([truth() * 1e3, np.ones((F, 4, 1))], axis=2).transpose(1, 2, 0)
    labeled = {"Count": 4.0, "Labels": np.array(NAMES, dtype=object)[None], "Data": data}
    take = {"File": "take.qtm", "StartFrame": 1.0, "Frames": float(F), "FrameRate": 200.0,
            "Trajectories": {"Labeled": labeled}}  # fmt: skip
    savemat(path, {"qtm_take_0001": take})


def test_qualisys_mat(tmp_path, monkeypatch):
    mat(tmp_path / "a.mat")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "numpy.py").write_text("raise SystemExit('code beside the data was run')")
    same(read_mocap(tmp_path / "a.mat"), 200.0)


def c3d(path, unit="mm", scale=1e3) -> None:
    import ezc3d

    content = ezc3d.c3d()
    content["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    content["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    content["parameters"]["POINT"]["LABELS"]["value"] = NAMES
    points = np.ones((4, 4, F))
    points[:3] = truth().transpose(2, 1, 0) * scale
    content["data"]["points"] = points
    content.write(str(path))


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("m", 1.0)])
def test_c3d(tmp_path, unit, scale):
    pytest.importorskip("ezc3d")
    c3d(tmp_path / "a.c3d", unit, scale)
    same(read_mocap(tmp_path / "a.c3d"), 100.0, tolerance=3e-7)  # float32


@pytest.mark.parametrize("form", ["c3d", "mat"])
def test_damaged_binaries_cost_an_error_not_the_process(tmp_path, form):
    if form == "c3d":
        pytest.importorskip("ezc3d")
        c3d(tmp_path / "good.c3d")
    else:
        mat(tmp_path / "good.mat")
    good = (tmp_path / f"good.{form}").read_bytes()
    rng = np.random.default_rng(11)
    for k in range(2):
        damaged = bytearray(good)
        for _ in range(30):
            damaged[rng.integers(2, 600)] = rng.integers(256)
        (tmp_path / f"{k}.{form}").write_bytes(damaged[: rng.integers(600, len(good))] if k % 2 else damaged)
        with contextlib.suppress(InputError):
            read_mocap(tmp_path / f"{k}.{form}")
    (tmp_path / f"text.{form}").write_text("not one")
    with pytest.raises(InputError, match=f"not a readable {form} file"):
        read_mocap(tmp_path / f"text.{form}")


def test_a_reader_that_crashes_is_said(tmp_path, monkeypatch):
    from optshape_graph.io import _isolated

    (tmp_path / "a.c3d").write_bytes(b"x")
    monkeypatch.setattr(_isolated.sys, "executable", "/bin/false")
    with pytest.raises(InputError, match=r"its reader crashed \(status 1\)"):
        read_mocap(tmp_path / "a.c3d")


def motive_csv(unit="Meters", scale=1.0, both=False) -> str:
    head = ["Format Version", "1.23", "Take Name", "Take 1", "Take Notes", "", "Capture Frame Rate", "240.000000",
            "Export Frame Rate", "120.000000", "Capture Start Time", "2023-05-06 10.11.12.345 AM",
            "Total Frames in Take", "14", "Total Exported Frames", str(F), "Rotation Type", "Quaternion",
            "Length Units", unit, "Coordinate Space", "Global"]  # fmt: skip
    blocks = [("Rigid Body", "board", ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"],
               ["X", "Y", "Z", "W", "X", "Y", "Z", ""])]  # fmt: skip
    if both:
        blocks += [("Rigid Body Marker", name, ["Position"] * 3 + ["Marker Quality"], ["X", "Y", "Z", ""])
                   for name in NAMES]  # fmt: skip
    blocks += [("Marker", name, ["Position"] * 3, ["X", "Y", "Z"]) for name in NAMES]
    rows = [head, [], ["", "Type"], ["", "Name"], ["", "ID"], ["", ""], ["Frame", "Time (Seconds)"]]
    for kind, name, properties, axes in blocks:
        for prop, axis in zip(properties, axes, strict=True):
            for row, cell in zip(rows[2:], (kind, name, "ABCDEF", prop, axis), strict=True):
                row.append(cell)
    for k, frame in enumerate(truth() * scale):
        row = [str(k), f"{k / 120:.6f}", *["0.1"] * 8]
        if both:
            row += ["9.9", "9.9", "9.9", "1.0"] * 4
        for position in frame:
            row += [""] * 3 if np.isnan(position).any() else [f"{x:.9f}" for x in position]
        rows.append(row)
    return "\n".join(",".join(row) for row in rows) + "\n"


@pytest.mark.parametrize(("unit", "scale"), [("Meters", 1.0), ("Millimeters", 1e3), ("Centimeters", 1e2)])
@pytest.mark.parametrize("both", [False, True])
def test_motive_csv(tmp_path, unit, scale, both):
    (tmp_path / "a.csv").write_text(motive_csv(unit, scale, both), encoding="utf-8-sig")
    same(read_mocap(tmp_path / "a.csv"), 120.0)


def vicon_csv(unit="mm", first=1) -> str:
    lines = [
        "Devices",
        "1000",
        ",,Plate - Force,,",
        "Frame,Sub Frame,Fx,Fy,Fz",
        ",,N,N,N",
        "1,0,0,0,0",
        "",
        "Trajectories",
        "100",
    ]
    lines.append(",," + ",".join(f"{name},," for name in NAMES))
    lines.append("Frame,Sub Frame," + ",".join(["X,Y,Z"] * 4))
    lines.append(",," + ",".join([unit] * 12))
    for k, frame in enumerate(truth() * 1e3):
        cells = [",," if np.isnan(position).any() else ",".join(f"{x:.6f}" for x in position) for position in frame]
        lines.append(f"{first + k},0," + ",".join(cells))
    return "\n".join([*lines, "", "Model Outputs", "100"]) + "\n"


@pytest.mark.parametrize("first", [1, 501])
def test_vicon_csv(tmp_path, first):
    (tmp_path / "a.csv").write_text(vicon_csv(first=first))
    same(read_mocap(tmp_path / "a.csv"), 100.0, (first - 1) / 100)


def test_subjects_of_vicon_stay_in_the_names(tmp_path):
    (tmp_path / "a.csv").write_text(vicon_csv().replace("corner", "board:corner"))
    assert read_mocap(tmp_path / "a.csv").markers[0] == "board:corner0"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.csv", "frame,marker,x,y,z\n", "neither Motive's"),
        ("a.csv", motive_csv("Furlongs"), "unit of length 'Furlongs'"),
        ("a.csv", motive_csv().replace("120.000000", "fast"), "expected a number as Export Frame Rate"),
        ("a.csv", vicon_csv("kg"), "unit of length 'kg'"),
        ("a.tsv", qualisys_tsv("0", 2, True).replace("FREQUENCY\t200", "FREQUENCY\t0"), "rate 0.0 Hz"),
        ("a.tsv", "", "the file is empty"),
        ("a.mat", "no", "not a readable mat file"),
        ("a.xlsx", "", "motion capture is read from"),
    ],
)
def test_what_is_wrong_is_said(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=complaint) as error:
        read_mocap(tmp_path / name)
    assert name in str(error.value)


@pytest.mark.parametrize("name", ["a.csv", "v.csv", "a.tsv"])
@given(data=st.data())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_exports_are_read_or_refused(tmp_path_factory, name, data):
    folder = tmp_path_factory.mktemp("fuzz")
    text = {"a.csv": motive_csv(), "v.csv": vicon_csv(), "a.tsv": qualisys_tsv("0", 2, True)}[name]
    content = bytearray(text.encode())
    for _ in range(data.draw(st.integers(1, 10))):
        k = data.draw(st.integers(0, len(content) - 1))
        content[k : k + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=4))
        if not content:
            break
    (folder / name).write_bytes(content)
    with contextlib.suppress(InputError):
        read_mocap(folder / name)


def test_positions_between_frames_are_interpolated_and_gaps_stay_gaps():
    times = np.array([0.0, 0.01, 0.02, 0.03, 0.10, 0.11])
    positions = np.linspace([[0.0, 0, 0]], [[5.0, 0, 0]], 6)
    positions[2] = np.nan
    recording = MocapRecording(times, ("a",), positions, 100.0)
    wanted = np.array([-0.001, 0.0, 0.005, 0.01, 0.015, 0.02, 0.03, 0.05, 0.105, 0.11, 0.12])
    found = recording.at(wanted)[:, 0, 0]
    expected = [np.nan, 0.0, 0.5, 1.0, np.nan, np.nan, 3.0, np.nan, 4.5, 5.0, np.nan]
    assert np.allclose(found, expected, atol=1e-9, equal_nan=True)


def test_a_marker_that_is_not_there_is_named():
    recording = MocapRecording(np.zeros(1), ("a",), np.zeros((1, 1, 3)), 100.0)
    assert recording.select(["a"]).markers == ("a",)
    with pytest.raises(InputError, match="no marker 'b'; it has a"):
        recording.select(["b"])


@pytest.mark.parametrize("first", [0, 100])
def test_c3d_with_a_model_s_outputs(tmp_path, first):
    ezc3d = pytest.importorskip("ezc3d")
    content = ezc3d.c3d()
    point = content["parameters"]["POINT"]
    point["RATE"]["value"], point["UNITS"]["value"] = [100.0], ["mm"]
    point["LABELS"]["value"] = [*NAMES, "RKneeAngles", "corner1", "GroundForce"]  # an angle has a marker's label
    content.add_parameter("POINT", "ANGLES", ["RKneeAngles", "corner1"])
    content.add_parameter("POINT", "FORCES", ["GroundForce"])
    points = np.ones((4, 7, F))
    points[:3, :4] = truth().transpose(2, 1, 0) * 1e3
    points[:3, 4:] = 77.0  # degrees, newtons
    content["data"]["points"] = points
    content["header"]["points"]["first_frame"] = first
    content.write(str(tmp_path / "a.c3d"))
    recording = read_mocap(tmp_path / "a.c3d")
    assert recording.markers == NAMES
    assert np.nanmax(np.abs(recording.positions - truth())) < 3e-7  # float32
    assert recording.times == pytest.approx((first + np.arange(F)) / 100)
