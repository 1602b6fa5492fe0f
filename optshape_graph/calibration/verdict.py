"""What a calibration says about itself: findings in words, and whether it is to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

TRUSTED = "to be trusted"
WITH_CARE = "to be trusted, the warnings being read"
NOT_TRUSTED = "not to be trusted"


@dataclass(frozen=True)
class Finding:
    """Something that the data show and that whoever uses the result has to know.

    Attributes:
        text: one line.
        grave: whether it forbids to trust the result.
    """

    text: str
    grave: bool


def verdict(findings: Sequence[Finding]) -> str:
    """Return TRUSTED, WITH_CARE where there are findings, or NOT_TRUSTED where one of them is grave."""
    if any(finding.grave for finding in findings):
        return NOT_TRUSTED
    return WITH_CARE if findings else TRUSTED
