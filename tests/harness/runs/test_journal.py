"""The journal: few files for many trials, torn and altered lines left out, several writers, no
links."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from harness.runs.jobs import Ended
from harness.runs.journal import JOURNAL_VERSION, Journal
from harness.vocabulary.errors import UserError
from tests.support.serial_run import trial_keys


def done(number: int) -> Ended:
    return Ended("done", f'{{"runs":[{number}]}}')


def filled(folder: Path, count: int, first: int = 0) -> Journal:
    journal = Journal(folder)
    for number in range(first, first + count):
        journal.write(f"damaged-{number:05d}", done(number))
    return journal


def test_thousands_of_trials_are_in_few_files(tmp_path):
    for run in range(20):  # as many shards, or runs that were interrupted
        filled(tmp_path, 100, 100 * run)
    journal = Journal(tmp_path)
    assert len(journal) == 2_000 and journal.damaged == []
    assert len(list(tmp_path.iterdir())) == 20
    assert journal.read("damaged-01999") == done(1999)
    assert [key for key, _ in journal.entries()] == trial_keys(journal)


@pytest.mark.parametrize("keep", range(0, 400, 37))
def test_a_torn_end_costs_the_last_entry_only(tmp_path, keep):
    """Whatever a crash leaves of the file: entries before are whole, and a later run writes a file
    of its own."""
    filled(tmp_path, 3)
    (segment,) = tmp_path.iterdir()
    content = segment.read_bytes()
    segment.write_bytes(content[:keep])
    journal = Journal(tmp_path)
    assert len(journal) == max(content[:keep].count(b"\n") - 1, 0)
    assert len(trial_keys(journal)) == len(journal)
    journal.write("damaged-00007", done(7))
    assert Journal(tmp_path).read("damaged-00007") == done(7)
    assert segment.read_bytes() == content[:keep]


def test_an_altered_line_counts_as_not_there(tmp_path):
    filled(tmp_path, 5)
    (segment,) = tmp_path.iterdir()
    segment.write_bytes(segment.read_bytes().replace(b'{"runs":[2]}', b'{"runs":[9]}'))
    journal = Journal(tmp_path)
    assert trial_keys(journal) == [f"damaged-{number:05d}" for number in (0, 1, 3, 4)]
    assert len(journal.damaged) == 1 and journal.damaged[0].startswith(f"{segment}: byte ")


def test_a_later_entry_counts_unless_only_the_earlier_trial_is_done(tmp_path):
    for states, expected in (
        (("failed", "done"), "done"),
        (("done", "failed"), "done"),
        (("failed", "crashed"), "crashed"),
    ):
        folder = tmp_path / "-".join(states)
        for state in states:
            Journal(folder).write("a", done(1) if state == "done" else Ended(state))  # type: ignore[arg-type]
        assert Journal(folder).state("a") == expected


def test_several_processes_write_and_see_each_others_entries_when_they_look(tmp_path):
    first = Journal(tmp_path)
    second = Journal(tmp_path)
    first.write("a", done(1))
    assert second.read("a") == done(1)
    first.write("b", done(2))
    assert second.read("b") is None
    second.write("c", done(3))
    second.refresh()
    first.refresh()
    assert trial_keys(first) == trial_keys(second) == ["a", "b", "c"]
    assert len(list(tmp_path.iterdir())) == 2


def test_other_versions(tmp_path):
    filled(tmp_path / "old", 2)
    (segment,) = (tmp_path / "old").iterdir()
    text = segment.read_text()
    segment.write_text(
        text.replace(f"journal {JOURNAL_VERSION}", f"journal {JOURNAL_VERSION - 1}", 1)
    )
    (tmp_path / "old" / "00").mkdir()
    (tmp_path / "old" / "00" / "damaged-00000-0123456789abcdef.jsonl").write_text("of version 5")
    assert len(Journal(tmp_path / "old")) == 0
    segment.write_text(
        text.replace(f"journal {JOURNAL_VERSION}", f"journal {JOURNAL_VERSION + 1}", 1)
    )
    with pytest.raises(UserError, match="newer tofpod"):
        len(Journal(tmp_path / "old"))


def test_links_are_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("content")
    folder = tmp_path / "journal"
    folder.mkdir()
    (folder / "000001-01234567.jsonl").symlink_to(precious)
    os.mkfifo(folder / "000002-01234567.jsonl")
    for use in (lambda: len(Journal(folder)), lambda: Journal(folder).write("a", done(1))):
        with pytest.raises(UserError, match="not a regular file"):
            use()
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(UserError, match="is a link"):
        Journal(tmp_path / "link").write("a", done(1))
    assert precious.read_text() == "content"
