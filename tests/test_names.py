"""Names from data, in each of the places that they go to."""

from __future__ import annotations

import subprocess
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

from hypothesis import given
from hypothesis import strategies as st

from optshape_graph.names import LONGEST_FILE_NAME, file_name, markup, shell_word, shown

HOSTILE = [
    "../../evil", "front; touch x", "$(touch x)", "`touch x`", "a\nb", "\x1b[31mred\x1b[0m", "<script>", "a'b\"c", "",
    "\u202egnp", "-rf", ".hidden", "a" * 1000, "\ud800",
]  # fmt: skip


@given(st.text() | st.sampled_from(HOSTILE))
def test_shown_is_one_printable_line(text: str) -> None:
    assert shown(text).isprintable()
    assert shown("range 3 m ± 2 mm") == "range 3 m ± 2 mm"


@given(st.text() | st.sampled_from(HOSTILE))
def test_file_names_stay_in_their_folder(text: str) -> None:
    name = file_name(text)
    assert 0 < len(name) <= LONGEST_FILE_NAME
    assert (Path("/folder") / name).resolve().parent == Path("/folder")
    assert not name.startswith(".")
    assert file_name("paper@0.5") == "paper@0.5"


def test_shell_words_are_one_word(tmp_path: Path) -> None:
    for text in HOSTILE:
        said = subprocess.run(
            ["sh", "-c", f"printf '%s.' {shell_word(text)}"], capture_output=True, text=True, cwd=tmp_path, check=True
        )
        assert said.stdout == shown(text) + "."
    assert not list(tmp_path.iterdir())
    assert shell_word("velodyne") == "velodyne"


@given(st.text() | st.sampled_from(HOSTILE))
def test_markup_is_text_only(text: str) -> None:
    element = ElementTree.fromstring(f'<a name="{markup(text)}">{markup(text)}</a>')
    assert (element.get("name"), element.text or "") == (shown(text), shown(text))
    found: list[str] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            found.append(tag)

    Parser().feed(f"<td>{markup(text)}</td>")
    assert found == ["td"]
