"""Locks are plain files, never reached through a link, and hold one thing of many."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import one_at_a_time, opened_lock
from harness.vocabulary.system import lock

HOLDS = (
    "import sys, time; from pathlib import Path; from harness.vocabulary.files import "
    "one_at_a_time\n"
    "with one_at_a_time(Path(sys.argv[1]), int(sys.argv[2])): print('held', flush=True); "
    "sys.stdin.read()"
)
ASKS = (
    "import sys; from pathlib import Path; from harness.vocabulary.files import one_at_a_time\n"
    "with one_at_a_time(Path(sys.argv[1]), int(sys.argv[2])): print('held', flush=True)"
)


def test_a_link_a_pipe_and_a_folder_are_no_locks(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("content")
    (tmp_path / "link").symlink_to(precious)
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "folder", "pipe"):
        with pytest.raises(UserError, match="not a regular file"):
            opened_lock(tmp_path / name)
    assert precious.read_text() == "content"


def test_a_lock_is_busy_for_others_until_it_is_closed(tmp_path: Path) -> None:
    with opened_lock(tmp_path / "lock") as ours, opened_lock(tmp_path / "lock") as theirs:
        assert (
            lock(ours, shared=True, wait=False) == lock(theirs, shared=True, wait=False) == "held"
        )
        assert lock(theirs, shared=False, wait=False) == "busy"
    with opened_lock(tmp_path / "lock") as theirs:
        assert lock(theirs, shared=False, wait=False) == "held"


def test_a_number_is_held_by_a_single_process_and_others_are_free(tmp_path: Path) -> None:
    path = str(tmp_path / "numbers")

    def process(code: str, number: int) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-c", code, path, str(number)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    with process(HOLDS, 7) as holder, process(ASKS, 8) as asking:
        assert holder.stdout is not None and asking.stdout is not None and holder.stdin is not None
        assert holder.stdout.readline() == "held\n"
        assert asking.stdout.readline() == "held\n"
        with process(ASKS, 7) as waiting:
            with pytest.raises(subprocess.TimeoutExpired):
                waiting.wait(timeout=1.0)
            holder.stdin.close()
            assert waiting.stdout is not None and waiting.stdout.readline() == "held\n"
    with one_at_a_time(Path(path), 7):
        pass
