"""A report of a result: one HTML file with verdict, numbers, pictures, and what to do next.

It needs no network, and prints well. It is made of the result's plain form (`to_dict`, or its JSON file) and of
pictures.
"""

from __future__ import annotations

import base64
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from optshape_graph._arrays import Floats
from optshape_graph._version import __version__
from optshape_graph.evaluation.verdicts import Verdict, kind_of, verdict_of
from optshape_graph.io.files import write_atomically
from optshape_graph.names import markup
from optshape_graph.viz.report_tables import Table, tables_of
from optshape_graph.viz.style import BLUE, GREY, INK, PALE, VERMILLION

MOST_ROWS = 200
"""Rows of a table; further rows are counted."""

MOST_PICTURES = 60
"""Pictures of a report; further ones stay beside the result."""

KINDS = {".svg": "svg+xml", ".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg"}
"""Media types of pictures that a browser shows, by ending; others stay beside the report."""

CAPTIONS = {
    "fit": "returns, ends of rings, and the fitted template. Ends lie inside the edge, by up to one azimuth step.",
    "edges": "which edge each end of a ring was taken for; a line is where along the ring that edge may be.",
    "residuals": "distances of ring ends from their edges, with one standard deviation, and of returns from the plane.",
    "vertices": "ellipses of three standard deviations of each vertex.",
    "runner_up": "the pose, and the different one that explains the returns nearly as well.",
    "errors": "errors of every scan or view; means are dashed.",
    "placements": "where the target stood, seen from above.",
    "markers": "where each marker is from its vertex.",
    "map": "landmarks, the way each faces, and ellipses of three standard deviations, seen from above.",
    "scan": "the full scan, as the LiDAR sees it and from above, with the targets' outlines.",
}
"""Captions of pictures, by the end of their names."""

LEVELS = {"Good": "#009e73", "Usable with care": "#b07800", "Not usable": "#c03020"}

STYLE = """
body { font: 15px/1.45 system-ui, "DejaVu Sans", sans-serif; color: #222; max-width: 60em; margin: 2em auto;
  padding: 0 1em }
h1 { font-size: 1.5em; margin-bottom: .2em } h2 { font-size: 1.15em; margin: 1.6em 0 .4em; break-after: avoid }
.verdict { border-left: .5em solid; padding: .6em 1em; background: #f6f6f6; font-size: 1.1em; break-inside: avoid }
table { border-collapse: collapse; font-size: .85em; width: 100% }
th { text-align: left; border-bottom: 1.5px solid #222 } tr { break-inside: avoid }
th, td { padding: .2em .6em .2em 0; vertical-align: top } td { border-bottom: 1px solid #ddd; overflow-wrap: anywhere }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
figure { margin: 1em 0; break-inside: avoid } img, svg { max-width: 100%; max-height: 22cm }
figcaption, footer { color: #555; font-size: .85em } footer { margin-top: 2em }
pre { background: #f6f6f6; padding: .6em; white-space: pre-wrap; overflow-wrap: anywhere }
@page { size: A4; margin: 15mm }
@media print { body { margin: 0; max-width: none; font-size: 10.5pt } img, svg { max-height: 11cm }
  pre { margin-bottom: .3em } footer { margin-top: .3em; break-before: avoid } }
"""


def write_report(
    path: str | Path, document: Mapping[str, Any], pictures: Sequence[str | Path] = (), command: str = ""
) -> Verdict:
    """Write a result as a report, and return its verdict.

    Args:
        path: of the HTML file.
        document: the result's plain form.
        pictures: PNG or SVG files that show it.
        command: the command that makes the result again.

    Raises:
        InputError: a result of an unknown kind, or the file cannot be written.
    """
    verdict = verdict_of(document)
    write_atomically(Path(path), html_of(document, verdict, pictures, command).encode())
    return verdict


def html_of(document: Mapping[str, Any], verdict: Verdict, pictures: Sequence[str | Path], command: str) -> str:
    """Return the report as HTML."""
    kind = kind_of(document)
    title = f"{TITLES[kind]}: {verdict.level}"
    parts = [
        f"<h1>{markup(TITLES[kind])}</h1>",
        f'<p class="verdict" style="border-color:{LEVELS[verdict.level]}"><b>{markup(verdict.level)}:</b> '
        f"{markup(verdict.sentence)}.</p>",
    ]
    if verdict.advice:
        items = "".join(f"<li>{markup(one)}</li>" for one in verdict.advice)
        parts.append(f"<h2>What to do next</h2><ol>{items}</ol>")
    tables = tables_of(document)
    parts += [_table(table) for table in tables]
    places = _places(document)
    if len(places):
        parts.append(_figure(plan_view(places), "Seen from above: where the targets stood. Circles: range, m."))
    shown = [Path(picture) for picture in pictures if Path(picture).suffix.lower() in KINDS]
    for picture in shown[:MOST_PICTURES]:
        parts.append(_figure(_embedded(picture), caption_of(picture.stem)))
    if len(pictures) > len(shown[:MOST_PICTURES]):
        parts.append(f"<p>{len(pictures) - len(shown[:MOST_PICTURES])} more pictures are beside the result.</p>")
    if command:
        parts.append(f"<h2>To make this again</h2><pre>{markup(command)}</pre>")
    versions = f"optshape_graph {__version__}, Python {platform.python_version()}, NumPy {np.__version__}"
    parts.append(f"<footer>{markup(versions)}; {markup(document.get('schema'))}</footer>")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{markup(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{STYLE}</style></head>\n<body>\n'
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def caption_of(stem: str) -> str:
    """Return the caption of a picture, by the end of its name: the scan, and how to read the picture."""
    for kind, text in CAPTIONS.items():
        if stem == kind or stem.endswith(f"_{kind}"):
            of = stem[: -len(kind)].rstrip("_")
            return f"{of}: {text}" if of else text[0].upper() + text[1:]
    return stem.replace("_", " ")


def plan_view(places: Floats) -> str:
    """Return places (N, 3) in the LiDAR's frame, metres, from above, as SVG: x to the right, y up, circles of range."""
    reach = float(np.hypot(places[:, 0], places[:, 1]).max()) * 1.15 or 1.0
    step = next(size for size in (0.5, 1, 2, 5, 10, 20, 50, 100, 1e9) if reach / size <= 5)
    low = np.minimum(places[:, :2].min(axis=0), 0.0) - 0.12 * reach
    high = np.maximum(places[:, :2].max(axis=0), 0.0) + 0.12 * reach
    scale = 600.0 / max(float((high - low)[0]), 0.6 * float((high - low)[1]))
    width, height = (high - low) * scale

    def at(x: float, y: float) -> tuple[float, float]:
        return (x - low[0]) * scale, (high[1] - y) * scale

    cx, cy = at(0.0, 0.0)
    parts = []
    for k in range(1, int(reach / step) + 1):
        parts.append(f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="{k * step * scale:.1f}" fill="none" stroke="{PALE}"/>')
        parts.append(f'<text x="{cx + k * step * scale + 3:.1f}" y="{cy + 14:.1f}" fill="{GREY}">{k * step:g}</text>')
    parts.append(
        f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="5" fill="{INK}"/><text x="{cx + 8:.1f}" y="{cy + 16:.1f}">LiDAR</text>'
    )
    named: list[tuple[float, float, list[str]]] = []  # places so near to each other that they share one label
    for number, (x, y, _) in enumerate(places, 1):
        px, py = at(float(x), float(y))
        parts.append(f'<circle cx="{px:.1f}" cy="{py:.1f}" r="4" fill="{BLUE}"/>')
        near = next((names for qx, qy, names in named if abs(qx - px) < 24 and abs(qy - py) < 14), None)
        if near is None:
            named.append((px, py, [str(number)]))
        else:
            near.append(str(number))
    if len(places) <= 40:
        for px, py, names in named:
            parts.append(f'<text x="{px + 6:.1f}" y="{py - 6:.1f}" fill="{VERMILLION}">{", ".join(names)}</text>')
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" height="{height:.0f}" role="img" '
        f'font-family="sans-serif" font-size="12">{"".join(parts)}</svg>'
    )


def _places(document: Mapping[str, Any]) -> Floats:
    """Return the places (N, 3) of a result's targets in the LiDAR's frame; empty for results without places."""
    kind = kind_of(document)
    entries = document["scans"] if kind in ("estimate", "detect", "mocap") else ()
    if kind == "detect":
        entries = [target for scan in entries for target in scan.get("targets", ())]
    found = [entry["T_lidar_target"] for entry in entries if entry.get("T_lidar_target")]
    return np.array(found)[:, :3, 3] if found else np.zeros((0, 3))


def _table(table: Table) -> str:
    filled = [k for k in range(len(table.columns)) if not table.rows or any(row[k] for row in table.rows)]
    table = Table(
        table.title, tuple(table.columns[k] for k in filled), tuple(tuple(row[k] for k in filled) for row in table.rows)
    )
    numeric = [all(_is_number(row[k]) for row in table.rows) for k in range(len(table.columns))]
    classes = ['class="n"' if flag else "" for flag in numeric]
    head = "".join(f"<th {c}>{markup(text)}</th>" for c, text in zip(classes, table.columns, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td {c}>{markup(cell)}</td>" for c, cell in zip(classes, row, strict=True)) + "</tr>"
        for row in table.rows[:MOST_ROWS]
    )
    more = len(table.rows) - MOST_ROWS
    rest = f"<p>{more} more rows are in the result.</p>" if more > 0 else ""
    return f"<h2>{markup(table.title)}</h2><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{rest}"


def _is_number(cell: str) -> bool:
    try:
        float(cell or "0")
    except ValueError:
        return False
    return True


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{markup(caption)}</figcaption></figure>"


def _embedded(picture: Path) -> str:
    data = base64.b64encode(picture.read_bytes()).decode("ascii")
    return f'<img alt="{markup(picture.stem)}" src="data:image/{KINDS[picture.suffix.lower()]};base64,{data}">'


TITLES = {
    "estimate": "Poses of a target",
    "detect": "Targets in full scans",
    "mocap": "Calibration of a LiDAR to motion capture",
    "camera-calibration": "Calibration of a LiDAR to a camera",
    "rig": "Calibration of a rig",
    "sensor-calibration": "Calibration of a LiDAR's rings",
    "map": "Map of targets",
    "design-choice": "Choice of a target",
    "simulation-evaluation": "Estimates in simulation",
    "mocap-evaluation": "Estimates beside motion capture",
}
