"""Input that was skipped or not used: counted by source and reason, and reported alike by every command."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

UNUSABLE = "unusable file"
"""Reason to skip a file that cannot be read, or is of another kind than expected."""


@dataclass
class PassedOver:
    """Counts of input that was not used.

    Attributes:
        skipped: number of items that could not be used, by source ("scans", "images", "messages of /points", ...) and
            by reason.
        fields: number of items that had a field which is not used, by source and by the field's name.
    """

    skipped: dict[str, Counter[str]] = field(default_factory=dict)
    fields: dict[str, Counter[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.skipped = {source: Counter(reasons) for source, reasons in self.skipped.items()}
        self.fields = {source: Counter(names) for source, names in self.fields.items()}

    def skip(self, source: str, reason: str, count: int = 1) -> None:
        """Count items that could not be used; `reason` is a few words without numbers."""
        if count:
            self.skipped.setdefault(source, Counter())[reason] += count

    def unused(self, source: str) -> Counter[str]:
        """Return the counter, by name, of a source's fields that are not used; the caller adds to it."""
        return self.fields.setdefault(source, Counter())

    def lines(self) -> list[str]:
        """Return a line for each reason, and one for the fields of each source."""
        said = [
            f"{count} {source} skipped: {reason}"
            for source, reasons in self.skipped.items()
            for reason, count in reasons.items()
        ]
        for source, names in self.fields.items():
            if names:
                counted = ", ".join(f"{name} ({count} times)" for name, count in names.items())
                said.append(f"fields of {source} that are not used: {counted}")
        return said

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form: `skipped` and `unused_fields`, by source."""
        return {
            "skipped": {source: dict(reasons) for source, reasons in self.skipped.items() if reasons},
            "unused_fields": {source: dict(names) for source, names in self.fields.items() if names},
        }
