"""Atomic writing: whole or not at all, with a clear message where a folder or a disk is in the
way."""

from __future__ import annotations

import errno
import os
import pickle

import pytest

from harness.vocabulary import files
from harness.vocabulary.errors import UserError, exit_code_of


def test_content_arrives_whole_and_leaves_nothing_else(tmp_path):
    files.write_text(tmp_path / "a" / "b.txt", "first")
    files.write_text(tmp_path / "a" / "b.txt", "second")
    assert (tmp_path / "a" / "b.txt").read_text() == "second"
    assert os.listdir(tmp_path / "a") == ["b.txt"]


def test_a_failed_write_keeps_the_old_content(tmp_path):
    path = tmp_path / "b.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), files.atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["b.txt"]


def test_a_full_disk_is_one_clear_message(tmp_path):
    with pytest.raises(UserError, match="disk is full"), files.atomic_path(tmp_path / "b.txt"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert os.listdir(tmp_path) == []


def test_a_file_in_place_of_the_folder_is_one_clear_message(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        files.write_text(tmp_path / "taken" / "b.txt", "x")


def test_user_errors_survive_pickling():
    error = pickle.loads(pickle.dumps(UserError("what", legal="this", fix="that")))
    assert str(error) == "what\n  legal: this\n  to do: that"


def test_exit_codes(capsys):
    def mistake() -> int:
        raise UserError("wrong thing", fix="mend it")

    assert exit_code_of(mistake) == 2
    assert capsys.readouterr().err == "error: wrong thing\n  to do: mend it\n"
    with pytest.raises(ZeroDivisionError):
        exit_code_of(lambda: 1 // 0)
