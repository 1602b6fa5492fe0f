"""Damaged files of every form, drawn at random: read, or refused with this package's error."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.readers import READERS
from tests.fuzz.test_corpus import NEEDS

Change = tuple[int, int, bytes]
"""Where, in thousandths of the file; how many bytes go; what comes."""

changes = st.lists(
    st.tuples(st.integers(0, 999), st.integers(0, 8), st.binary(max_size=6) | st.sampled_from([b"9" * 20, b"nan"])),
    min_size=1, max_size=4,
)  # fmt: skip


@cache
def prepared(name: str) -> tuple[Path, list[bytes]]:
    folder = Path(mkdtemp(prefix=f"damaged-{name}-"))
    (folder / "work").mkdir()
    READERS[name].furnish(folder / "work")
    return folder / "work", READERS[name].seeds(folder)


@pytest.mark.parametrize(
    "name", sorted(READERS.keys() - {"mocap-binary", "survey"})
)  # which have their own, a process each
@given(data=st.data(), changed=changes, kept=st.integers(1, 1000))
@settings(max_examples=60, suppress_health_check=list(HealthCheck))
def test_damaged_files_are_read_or_refused(name: str, data: st.DataObject, changed: list[Change], kept: int) -> None:
    for library in NEEDS.get(name, []):
        pytest.importorskip(library)
    work, seeds = prepared(name)
    content = bytearray(data.draw(st.sampled_from(seeds)))
    for where, gone, new in changed:
        at = 1 + where * (len(content) - 1) // 1000  # the first byte chooses the form
        content[at : at + gone] = new
    if kept < 500:
        del content[1 + len(content) * kept // 500 :]
    READERS[name].read(bytes(content), work)
