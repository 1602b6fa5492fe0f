"""What rows of judged scans add up to, group by group."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from tests.statistics.judge import Row

FLIPPED_DEG = 45.0
"""Beyond this an estimate is of another mode."""

BINS = (0.0, 1.0, 2.0, 3.5, 5.0, 10.0, np.inf)
"""Of margins."""

BEYOND = float(chi2.ppf(0.999, 6))


def is_ok(row: Row) -> bool:
    """Whether an estimate says that it can be used."""
    return bool(row["status"] == "ok")


def is_flipped(row: Row) -> bool:
    """Whether it is of another mode."""
    return bool(row.get("turn_deg", 0.0) > FLIPPED_DEG)


def is_right(row: Row) -> bool:
    """Whether the truth is within the 99.9 % region of what an estimate says."""
    return "nees" in row and row["nees"] <= BEYOND


def summary(rows: Sequence[Row]) -> Row:
    """Count what the numbers of a group are made of."""
    ok = [row for row in rows if is_ok(row)]
    five = [row for row in rows if row["rings"] >= 5]
    return {
        "scans": len(rows),
        "ok": len(ok),
        "right": sum(map(is_right, ok)),
        "beyond": sum(not is_right(row) for row in ok),
        "flipped": sum(map(is_flipped, ok)),
        "nees": float(np.mean([row["nees"] for row in ok]) / 6) if ok else np.nan,
        "five": float(np.mean([is_ok(row) and is_right(row) for row in five])) if five else np.nan,
        "uncertified": sum(not row["certified"] for row in ok),
        "unlisted": sum(not row.get("listed", True) for row in rows),
        "ms": 1e3 * float(np.median([row["seconds"] for row in rows])),
    }


def agrees(line: Row) -> bool:
    """Whether the number of wrong choices in a bin is within 99 % of what its margins promise."""
    return bool(abs(line["wrong"] - line["promised"]) <= 2.58 * line["sd"] + 1)


def calibration(rows: Sequence[Row]) -> list[Row]:
    """Compare, by bins of the margin, how many choices are wrong with how many the margins promise."""
    judged = [row for row in rows if "margin" in row]
    lines = []
    for low, high in pairwise(BINS):
        inside = [row for row in judged if low <= max(row["margin"], 0.0) < high]
        wrong = sum(row["elsewhere"] for row in inside)
        promised = np.array([1 / (1 + np.exp(min(row["margin"], 700.0))) for row in inside])
        lines.append({"from": low, "to": high, "scans": len(inside), "wrong": wrong, "promised": float(promised.sum()),
                      "sd": float(np.sqrt((promised * (1 - promised)).sum()))})  # fmt: skip
    return lines


def print_report(by_group: dict[str, list[Row]]) -> None:
    """Print a line for each group, and the bins of all."""
    print(f"{'group':16s} scans   ok right beyond flip nees/dof  5 rings  uncert. unlisted   ms")
    groups = {**by_group, "all": [row for rows in by_group.values() for row in rows]}
    for name, rows in groups.items():
        s = summary(rows)
        print(f"{name:16s} {s['scans']:5d} {s['ok']:4d} {s['right']:5d} {s['beyond']:6d} {s['flipped']:4d} "
              f"{s['nees']:8.2f} {s['five']:8.3f} {s['uncertified']:8d} {s['unlisted']:8d} {s['ms']:5.0f}")  # fmt: skip
    for b in calibration(groups["all"]):
        print(f"margin {b['from']:4g} to {b['to']:4g}: {b['wrong']} wrong of {b['scans']}, promised "
              f"{b['promised']:.1f} +- {b['sd']:.1f}")  # fmt: skip
