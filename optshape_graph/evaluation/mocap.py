"""Table II: estimates on recordings against motion capture, over several sessions."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph.calibration.mocap.comparison import MocapScan, ScanError, in_sample, leave_one_out
from optshape_graph.calibration.mocap.result import LeftOut
from optshape_graph.calibration.mocap.session import load_mocap_scans
from optshape_graph.errors import InputError
from optshape_graph.evaluation.harness import Progress, Row
from optshape_graph.evaluation.metrics import quantisation_error
from optshape_graph.evaluation.published import TABLE_2, PublishedRow
from optshape_graph.io.documents import read_json
from optshape_graph.io.sessions import Session, load_session

_LOG = logging.getLogger(__name__)

ERRORS = ("rmse_m", "e_t_m", "e_r_deg")

PROTOCOLS = ("", "in_sample_", "reference_", "published_")
"""Prefixes of columns of errors: ours, leave-one-out; ours, in-sample; another method's, leave-one-out; the paper's."""


def find_sessions(folder: str | Path, *, allow_outside: bool = False) -> list[Session]:
    """Load the sessions with motion capture in a folder: its own session.yaml, and those of folders in it.

    Args:
        folder: the folder.
        allow_outside: see `load_session`.

    Raises:
        InputError: there is none, or one cannot be read.
    """
    folder = Path(folder)
    paths = sorted([*folder.glob("session.yaml"), *folder.glob("*/session.yaml")])
    found = [load_session(path, allow_outside=allow_outside) for path in paths]
    sessions = [session for session in found if session.mocap is not None]
    if not sessions:
        raise InputError(f"{folder}: expected session.yaml with 'mocap', in it or in a folder of it; found none")
    return sessions


def load_reference(path: str | Path) -> dict[str, Floats]:
    """Read another method's estimates: (4, 4) T_lidar_target of each scan, called "session folder/scan".

    Raises:
        InputError: not a JSON mapping of scans to mappings with a rigid `T_lidar_target_paper`.
    """
    poses = {}
    for name, node in read_json(path).entries().items():
        entry = node.entries()
        if "T_lidar_target_paper" not in entry:
            node.fail("the key 'T_lidar_target_paper' is missing")
        T = entry["T_lidar_target_paper"].numbers(4, 4)
        if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6 or np.linalg.det(T[:3, :3]) < 0:
            entry["T_lidar_target_paper"].expected("a rigid transform")
        poses[name] = T
    return poses


def evaluate_mocap(
    sessions: Sequence[Session], reference: Mapping[str, Floats] | None = None, progress: Progress | None = None
) -> tuple[list[Row], list[LeftOut]]:
    """Compare the estimates of every scan with its markers.

    Args:
        sessions: each with motion capture; the LiDAR's and the motion capture's frames are tied within a session only.
        reference: T_lidar_target (4, 4) of another method for the session's own template, by "session folder/scan";
            they are compared in the same way.
        progress: called with the number of scans done, and their total.

    Returns:
        A row for every scan: `session`, `scan`, `n_points`, `distance_m` of the estimated target origin, `e_q_m`; the
        errors `rmse_m`, `e_t_m`, `e_r_deg` in a frame tied by the session's other scans, two of them in percent of the
        distance too; with `in_sample_` before, the errors in a frame tied by all scans; with `reference_`, those of
        the other method's estimate; with `published_`, those of the paper's Table II for that recording. Missing values
        are None. And the scans left out, with reasons: a session needs two usable scans.

    Raises:
        InputError: a session that cannot be evaluated, or a scan without an estimate in `reference`.
    """
    rows: list[Row] = []
    left_out: list[LeftOut] = []
    done, total = 0, sum(len(session.views) for session in sessions)
    for session in sessions:
        name = session.path.resolve().parent.name

        def advance(scans: int, _: int, before: int = done) -> None:
            if progress is not None:
                progress(before + scans, total)

        scans, missing, checked = load_mocap_scans(session, progress=advance)
        for finding in checked.findings:
            _LOG.warning("%s: %s", name, finding.text)
        done += len(session.views)
        left_out += [LeftOut(f"{name}/{item.scan}", item.reason) for item in missing]
        if len(scans) < 2:
            left_out += [LeftOut(f"{name}/{scan.name}", "no other scan of the session can be used") for scan in scans]
            continue
        rows += _rows(name, scans, reference)
    return rows, left_out


def mean_errors(rows: Sequence[Row], prefix: str = "") -> Row | None:
    """Return the means of the errors with a prefix; None if a row lacks them."""
    if not rows or any(row.get(prefix + name) is None for row in rows for name in ERRORS):
        return None
    return {name: float(np.mean([row[prefix + name] for row in rows])) for name in ERRORS}


def _rows(session: str, scans: Sequence[MocapScan], reference: Mapping[str, Floats] | None) -> Iterable[Row]:
    others: Sequence[ScanError | None] = [None] * len(scans)
    if reference is not None:
        others = leave_one_out([_with_pose(scan, reference, f"{session}/{scan.name}") for scan in scans])
    for scan, own, inside, other in zip(scans, leave_one_out(scans), in_sample(scans), others, strict=True):
        estimate = scan.estimate
        distance = float(np.linalg.norm(estimate.T_lidar_target[:3, 3]))
        yield {
            "session": session,
            "scan": scan.name,
            "n_points": estimate.n_returns,
            "distance_m": distance,
            "e_q_m": quantisation_error(estimate.edge_points.azimuth_step, distance),
            **_columns(own, ""),
            "rmse_pct": 100.0 * own.rmse_m / distance,
            "e_t_pct": 100.0 * own.e_t_m / distance,
            **_columns(inside, "in_sample_"),
            **_columns(other, "reference_"),
            **_columns(_published(estimate.n_returns, distance), "published_"),
        }


def _with_pose(scan: MocapScan, reference: Mapping[str, Floats], name: str) -> MocapScan:
    """Return the scan with another method's estimate in place of ours."""
    if name not in reference:
        raise InputError(f"the reference has no estimate of '{name}'; it has: {', '.join(reference)}")
    return replace(scan, estimate=replace(scan.estimate, T_lidar_target=reference[name]))


def _columns(errors: ScanError | PublishedRow | None, prefix: str) -> Row:
    return {prefix + name: None if errors is None else getattr(errors, name) for name in ERRORS}


def _published(n_points: int, distance: float) -> PublishedRow | None:
    """Return the paper's row for a recording, by its number of returns and its distance within 10 cm."""
    same = [row for row in TABLE_2 if row.n_points == n_points and abs(row.distance_m - distance) < 0.1]
    return same[0] if same else None
