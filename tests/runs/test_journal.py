"""The journal: what is finished survives whatever ends the process, and nothing else is taken for it."""

from __future__ import annotations

from pathlib import Path

import pytest

from optshape_graph import InputError
from optshape_graph.runs.journal import Journal

WHAT = {"command": "estimate", "version": 1}


def test_lines_come_back_in_the_order_of_the_tasks(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path, WHAT, 5) as journal:
        for task in (3, 0, 4):
            journal.add(task, {"value": task / 7})
        assert list(journal.todo()) == [1, 2]
    with Journal(path, WHAT, 5) as journal:
        assert journal.finished == 3
        assert [line["task"] for line in journal] == [0, 3, 4]
        assert journal[3]["value"] == 3 / 7
        journal.remove()
    assert not path.exists()


def test_half_a_line_is_cut_off_wherever_it_ends(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path, WHAT, 3) as journal:
        for task in range(3):
            journal.add(task, {"text": "x" * task})
    whole = path.read_bytes()
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        with Journal(path, WHAT, 3) as journal:
            for task in journal.todo():
                journal.add(task, {"text": "x" * task})
            assert [line["text"] for line in journal] == ["", "x", "xx"]
        assert path.read_bytes() == whole


def test_another_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path, WHAT, 3) as journal:
        journal.add(1, {"a": 1})
    for describe, count in ((WHAT | {"version": 2}, 3), (WHAT, 4)):
        with pytest.raises(InputError, match=r"a\.journal: holds what is finished of another run"):
            Journal(path, describe, count)


@pytest.mark.parametrize("stopped", [False, True])
def test_after_a_run_that_failed_a_corrected_one_begins_anew(tmp_path: Path, stopped: bool) -> None:
    path, error = tmp_path / "a.journal", (KeyboardInterrupt if stopped else InputError)("why")

    def ends(task: int) -> None:
        with Journal(path, WHAT, 3) as journal:
            assert journal.finished == task - 1
            journal.add(task, {"a": task})
            raise error

    for task in (1, 2):  # the same run goes on, also after it failed
        with pytest.raises(type(error)):
            ends(task)
    corrected = WHAT | {"version": 2}
    if stopped:  # what was being done well is not given up for a slip of the hand
        with pytest.raises(InputError, match="another run"):
            Journal(path, corrected, 3)
        return
    with Journal(path, corrected, 3) as journal:
        assert journal.finished == 0
        journal.add(0, {"a": 0})
    with Journal(path, corrected, 3) as journal:
        assert [line["task"] for line in journal] == [0]


def test_a_run_that_finished_nothing_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path, WHAT, 3):
        killed = path.read_bytes()
    assert not path.exists()
    path.write_bytes(killed)
    with Journal(path, WHAT | {"version": 2}, 3) as journal:  # nothing of the other run is lost
        journal.add(0, {"a": 1})
    with Journal(path, WHAT | {"version": 2}, 3) as journal:
        assert journal.finished == 1


def test_a_task_far_ahead_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path, WHAT, None) as journal:
        journal.add(0, {"a": 1})
    with path.open("a") as stream:
        stream.write('{"task": 99999999, "a": 1}\n')
    with pytest.raises(InputError, match="not a line of a journal"):
        Journal(path, WHAT, None)


@pytest.mark.parametrize("content", [b"hello\n", b'{"a": 1}\n', b"\x00\xff\n", b"[]\n", b"no line end"])
def test_another_file_is_left_as_it_is(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.journal"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.journal"):
        Journal(path, WHAT, 3)
    assert path.read_bytes() == content


def test_a_second_run_is_told(tmp_path: Path) -> None:
    with Journal(tmp_path / "a.journal", WHAT, 3), pytest.raises(InputError, match="in use: another run writes"):
        Journal(tmp_path / "a.journal", WHAT, 3)
    Journal(tmp_path / "a.journal", WHAT, 3).close()


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("")
    (tmp_path / "a.journal").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"):
        Journal(tmp_path / "a.journal", WHAT, 3)


def test_without_a_path_it_is_forgotten() -> None:
    with Journal(None, WHAT, 2) as journal:
        journal.add(1, {"a": 1})
        assert [line["a"] for line in journal] == [1]
