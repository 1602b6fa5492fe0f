"""Exports of each vendor, written as its software writes them, and the positions that they were written from."""

import numpy as np

from optshape_graph.io.mocap import MocapRecording

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


def mat(path) -> None:
    from scipy.io import savemat

    data = np.concatenate([truth() * 1e3, np.ones((F, 4, 1))], axis=2).transpose(1, 2, 0)
    labeled = {"Count": 4.0, "Labels": np.array(NAMES, dtype=object)[None], "Data": data}
    take = {"File": "take.qtm", "StartFrame": 1.0, "Frames": float(F), "FrameRate": 200.0,
            "Trajectories": {"Labeled": labeled}}  # fmt: skip
    savemat(path, {"qtm_take_0001": take})


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
