"""What a calibration says about itself: findings in words, and whether it is to be trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from optshape_graph.io.results import Result

TRUSTED = "to be trusted"
WITH_CARE = "to be trusted, the warnings being read"
NOT_TRUSTED = "not to be trusted"

MOST_DOUBTED = 1 / 3
"""Share of the scans used that may be doubtful by chance, or by what one scan has of its own."""


@dataclass(frozen=True)
class Finding:
    """Something that the data show and that whoever uses the result has to know.

    Attributes:
        text: one line.
        grave: whether it forbids to trust the result.
    """

    text: str
    grave: bool


class Calibration(Result):
    """Base of the results of calibrations, which judge themselves.

    Attributes:
        findings: what is wrong, was mended, or has to be known before trusting the result.
    """

    findings: tuple[Finding, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings in words."""
        return tuple(finding.text for finding in self.findings)

    @property
    def trusted(self) -> bool:
        """Whether nothing forbids to trust the result."""
        return not any(finding.grave for finding in self.findings)

    @property
    def verdict(self) -> str:
        """TRUSTED, WITH_CARE where there are findings, or NOT_TRUSTED where one of them is grave."""
        if not self.trusted:
            return NOT_TRUSTED
        return WITH_CARE if self.findings else TRUSTED


def of_doubts(doubts: Sequence[str]) -> list[Finding]:
    """Judge scans whose returns do not fit the target as they should: one may be by chance, many are not.

    Args:
        doubts: of every scan used, "" where there is none.
    """
    doubted = [doubt for doubt in doubts if doubt]
    if MOST_DOUBTED * len(doubts) >= len(doubted):
        return []
    text = f"{len(doubted)} of {len(doubts)} scans do not fit the target as they should; the first: {doubted[0]}"
    return [Finding(text, 2 * len(doubted) > len(doubts))]
