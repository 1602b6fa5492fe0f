"""Facts about a file, as names and plain values."""

from __future__ import annotations

from typing import Any

Facts = dict[str, Any]
"""Plain values by name. `form` is always there; `numbers` has the same for programs, with units in the names."""


def span_text(start: float, end: float) -> str:
    """Return a span of stamps, in seconds, as text; with the date of its start where they count from 1970."""
    from datetime import UTC, datetime

    said = f"{start:.3f} to {end:.3f} s ({end - start:.3f} s)"
    if 1e8 < start < 1e11:
        said += f", from {datetime.fromtimestamp(start, UTC).isoformat(timespec='seconds')}"
    return said
