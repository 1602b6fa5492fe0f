"""Tables of a report, made of a result's plain form."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optshape_graph.evaluation.verdicts import kind_of


@dataclass(frozen=True)
class Table:
    """A table of a report.

    Attributes:
        title: above it.
        columns: their headings, with units.
        rows: cells; numbers are set flush right.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables_of(document: Mapping[str, Any]) -> list[Table]:
    """Return the numbers of a result as tables."""
    kind = kind_of(document)
    if kind == "estimate":
        return [_poses("Scans", document["scans"], "scan")]
    if kind == "detect":
        found = [{**target, "scan": scan["scan"]} for scan in document["scans"] for target in scan.get("targets", ())]
        return [_poses("Targets found", found, "scan")]
    if kind == "map":
        rows = [{**one, "T_lidar_target": one["T_world_target"], "status": ""} for one in document["landmarks"]]
        return [_poses("Landmarks", rows, "id")]
    if kind == "mocap":
        return [_mocap_scans(document), _transform("T_lidar_mocap", document["T_lidar_mocap"], document["covariance"])]
    if kind == "camera-calibration":
        return [
            _camera_views(document),
            _transform("T_camera_lidar", document["T_camera_lidar"], document["covariance"]),
        ]
    if kind == "rig":
        pairs = document["transforms"]
        named = [_transform(f"T_{one['a']}_{one['b']}", one["T_a_b"], one["covariance"]) for one in pairs]
        return [_rig_sightings(document), *named]
    if kind == "sensor-calibration":
        return [_rings(document)]
    if kind == "simulation-evaluation":
        return [_simulated_cells(document)]
    if kind == "mocap-evaluation":
        return [_compared_scans(document)]
    return [_sizes(document)]


def _rig_sightings(document: Mapping[str, Any]) -> Table:
    rows = [
        (
            one["sensor"], one["target"], one["file"], "yes" if one["used"] else "no",
            "" if one["centre_error_m"] is None else _mm(one["centre_error_m"]), _number(one["turn_error_deg"]),
            one["reason"],
        )
        for one in document["sightings"]
    ]  # fmt: skip
    columns = ("sensor", "target", "file", "used", "centre mm", "turn deg", "why not")
    return Table("Sightings, each placement predicted by the others", columns, tuple(rows))


def _mocap_scans(document: Mapping[str, Any]) -> Table:
    rows = [(one["scan"], _mm(one["rmse_m"]), _mm(one["e_t_m"]), f"{one['e_r_deg']:.2f}") for one in document["scans"]]
    return Table("Scans, each in a frame fitted to the others", ("scan", "RMSE mm", "e_t mm", "e_r deg"), tuple(rows))


def _rings(document: Mapping[str, Any]) -> Table:
    keys = ("range_bias_mm", "range_bias_sd_mm")
    angles = ("elevation_off_deg", "elevation_sd_deg", "azimuth_off_deg", "azimuth_sd_deg")
    rows = [
        (
            str(ring["ring"]), *(f"{ring[key]:.1f}" for key in keys), *(f"{ring[key]:.3f}" for key in angles),
            _number(ring["before_mm"]), _number(ring["after_mm"]),
        )
        for ring in document["rings"]
    ]  # fmt: skip
    columns = ("ring", "range mm", "sd", "elevation deg", "sd", "azimuth deg", "sd", "before mm", "after mm")
    return Table("Rings against the given file, and off boards that took no part", columns, tuple(rows))


def _camera_views(document: Mapping[str, Any]) -> Table:
    keys = ("centre_error_mm", "plane_offset_mm", "normal_error_deg", "reprojection_px")
    rows = [
        (view["scan"], "yes" if view["used"] else "no", *(_number(view[key]) for key in keys), view["reason"])
        for view in document["views"]
    ]
    columns = ("view", "used", "centre mm", "plane mm", "normal deg", "vertices px", "why not")
    return Table("Views, each predicted by the others", columns, tuple(rows))


def _simulated_cells(document: Mapping[str, Any]) -> Table:
    rows = []
    for cell in document["cells"]:
        counts = (cell["ok"], cell["doubtful"] + cell["ambiguous"], cell["failed"])
        errors = (_mm_or_none(cell[f"e_t_m_{part}"]) for part in ("median", "p95"))
        turns = (_number(cell[f"e_r_deg_{part}"]) for part in ("median", "p95"))
        name = (cell["method"], cell["noise"], cell["orientation"], f"{cell['range_m']:g}")
        rows.append((*name, *map(str, counts), *errors, *turns, _number(cell["nees_per_dof"])))
    columns = ("method", "noise", "orientation", "range m", "ok", "not sure", "failed", "e_t mm", "95 %", "e_r deg",
               "95 %", "NEES / dof")  # fmt: skip
    return Table("Cells: medians, and the 95th percentiles", columns, tuple(rows))


def _compared_scans(document: Mapping[str, Any]) -> Table:
    prefixes = {"": "ours", "reference_": "reference", "published_": "paper"}
    shown = [prefix for prefix in prefixes if any(row[f"{prefix}rmse_m"] is not None for row in document["scans"])]
    rows = []
    for row in document["scans"]:
        errors = [
            cell
            for prefix in shown
            for cell in (_mm_or_none(row[f"{prefix}rmse_m"]), _mm_or_none(row[f"{prefix}e_t_m"]),
                         _number(row[f"{prefix}e_r_deg"]))
        ]  # fmt: skip
        rows.append((f"{row['session']}/{row['scan']}", f"{row['distance_m']:.2f}", str(row["n_points"]), *errors))
    columns = [f"{prefixes[prefix]} {text}" for prefix in shown for text in ("RMSE mm", "e_t mm", "e_r deg")]
    return Table(
        "Scans, each in a frame fitted to the others of its session",
        ("scan", "range m", "returns", *columns),
        tuple(rows),
    )


def _sizes(document: Mapping[str, Any]) -> Table:
    rows = [
        (
            f"{one['area_m2']:.3f}", f"{one['bound_e_r_95_deg']:.2f}", _number(one["e_r_95_deg"]),
            _mm(one["bound_e_t_95_m"]), _mm_or_none(one["e_t_95_m"]),
            f"{one['ok']} / {one['ambiguous']} / {one['failed']}", "yes" if one["does_it"] else "no",
        )
        for one in [document["chosen"], *document["smaller"]]
    ]  # fmt: skip
    columns = ("area m²", "bound deg", "e_r deg", "bound mm", "e_t mm", "ok / ambiguous / failed", "does it")
    return Table("Sizes, 95 of 100 scans", columns, tuple(rows))


def _poses(title: str, entries: Sequence[Mapping[str, Any]], name: str) -> Table:
    rows: list[tuple[str, ...]] = []
    for number, entry in enumerate(entries, 1):
        T, covariance = entry.get("T_lidar_target"), entry.get("covariance")
        said = str(entry.get("reason", "") or "")
        if T is None or covariance is None:
            rows.append((str(number), str(entry[name]), str(entry.get("status", "")), "", "", "", "", "", said))
            continue
        sd = np.sqrt(np.diag(np.array(covariance)))
        place = [f"{row[3]:.3f}" for row in T[:3]]
        size = (_mm(sd[3:].max()), f"{np.degrees(sd[:3].max()):.2f}")
        rows.append((str(number), str(entry[name]), str(entry.get("status", "")), *place, *size, said))
    columns = ("no.", name, "status", "x m", "y m", "z m", "sd mm", "sd deg", "reason")
    return Table(title, columns, tuple(rows))


def _transform(name: str, T: Any, covariance: Any) -> Table:
    sd = np.sqrt(np.diag(np.array(covariance)))
    rows = [tuple(f"{value:.6f}" for value in row) for row in T]
    note = (
        f"sd {', '.join(f'{v:.3f}' for v in np.degrees(sd[:3]))} deg, {', '.join(f'{1e3 * v:.1f}' for v in sd[3:])} mm"
    )
    return Table(f"{name} ({note})", ("", " ", "  ", "   "), tuple(rows))


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f}"


def _mm_or_none(metres: float | None) -> str:
    return "" if metres is None else _mm(metres)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
