"""How programs end: their own code, the user's mistake, Ctrl-C, a reader that leaves; a bug keeps
its traceback."""

from __future__ import annotations

import errno
import io
import subprocess
import sys
from pathlib import Path

import pytest

from harness.vocabulary.errors import UserError, exit_code_of

PROGRAM = """
import sys
from harness.vocabulary.errors import exit_code_of

def body():
    for i in range(%d):
        print("a line of some length", i)
    return 0

sys.exit(exit_code_of(body))
"""


def raising(error: BaseException) -> int:
    def body() -> int:
        raise error

    return exit_code_of(body)


def test_a_mistake_is_one_message_and_a_bug_keeps_its_traceback(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert exit_code_of(lambda: 3) == 3
    assert raising(UserError("x: is wrong", legal="right", fix="mend it")) == 2
    assert capsys.readouterr().err == "error: x: is wrong\n  legal: right\n  to do: mend it\n"
    assert raising(KeyboardInterrupt()) == 130
    with pytest.raises(ZeroDivisionError):
        raising(ZeroDivisionError())


@pytest.mark.parametrize("option", ("-c", "-uc"))
@pytest.mark.parametrize("lines", (3, 100_000))
def test_a_reader_that_leaves_ends_the_program_silently(lines: int, option: str) -> None:
    """Both where the last flush meets the closed pipe and where a print does."""
    program = subprocess.Popen(
        [sys.executable, option, PROGRAM % lines], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert program.stdout is not None and program.stderr is not None
    program.stdout.close()
    with program.stderr as stream:
        printed = stream.read()
    assert (program.wait(), printed) == (141, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("option", ("-c", "-uc"))
@pytest.mark.parametrize("lines", (3, 100_000))
def test_a_full_standard_output_is_one_message(lines: int, option: str) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, option, PROGRAM % lines], stdout=full, stderr=subprocess.PIPE
        )
    message = done.stderr.decode()
    assert done.returncode == 2
    assert message.startswith("error: the standard output cannot be written (no space left")
    assert len(message.splitlines()) == 2


def test_a_full_place_that_is_not_the_output_is_a_bug() -> None:
    for number in (errno.ENOSPC, errno.EFBIG, errno.EIO):
        with pytest.raises(OSError):
            raising(OSError(number, "full"))


def test_another_pipe_that_breaks_is_a_bug() -> None:
    with pytest.raises(BrokenPipeError):
        raising(BrokenPipeError("a worker's"))


def test_a_terminal_of_other_letters_shows_a_question_mark(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", terminal)

    def body() -> int:
        print("5.91 ± 0.08 – µm, ≥ 3 σ")
        return 0

    assert exit_code_of(body) == 0
    assert terminal.buffer.getvalue().decode("latin-1") == "5.91 ± 0.08 ? µm, ? 3 ?\n"  # type: ignore[attr-defined]
