"""Where the third-party recordings and published results are, and the mark of a test that needs them."""

from pathlib import Path

import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Beside the checkout; never part of it."""

needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the real recordings are not beside the checkout (../shared is absent)"
)
