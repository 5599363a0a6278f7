"""The user's mistakes: one clear message and exit code 2. Any other exception is a bug and keeps
its traceback."""

import errno
import os
import sys
from collections.abc import Callable
from functools import partial

from harness.vocabulary import system

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""Error numbers of a place that takes no more: a full disk or device, a quota, a file's limit."""
CLOSED_PIPE = 141  # Exit code that a shell reports when SIGPIPE ends a program: 128 + 13


class UserError(Exception):
    """A user's mistake: ``message`` says what is wrong and where, ``legal`` what is allowed,
    ``fix`` what to do."""

    def __init__(self, message: str, *, legal: str | None = None, fix: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.legal = legal
        self.fix = fix

    def __reduce__(self) -> tuple[object, ...]:
        # Without this, exceptions with keyword arguments do not survive pickling between worker
        # processes.
        return partial(type(self), legal=self.legal, fix=self.fix), (self.message,)

    def __str__(self) -> str:
        lines = [self.message] + ([f"  legal: {self.legal}"] if self.legal else [])
        return "\n".join(lines + ([f"  to do: {self.fix}"] if self.fix else []))


class DiskFull(UserError):
    """The disk is full, so the program stops until the user has made room."""


def exit_code_of(program: Callable[[], int]) -> int:
    """Run a program's body and return its exit code. A UserError gives one message on stderr and
    code 2, as does a standard output that is full. Ctrl-C gives 130, and a closed output pipe
    (``| head``) silently gives 141. Further Ctrl-C are ignored during the shutdown."""
    system.replace_unknown_characters()
    with system.one_interrupt():
        return _exit_code_of(program)


def _exit_code_of(program: Callable[[], int]) -> int:
    try:
        code = program()
        sys.stdout.flush()
        return code
    except OSError as error:
        if system.is_closed_pipe(error) and _nobody_reads():
            return CLOSED_PIPE
        if error.errno not in FULL or not _is_output_full():
            raise
        reason = os.strerror(error.errno).lower()
        problem = f"the standard output cannot be written ({reason})"
        fix = "free some space, or send the output elsewhere; files of --out may be missing"
        print(f"error: {UserError(problem, fix=fix)}", file=sys.stderr)
        return 2
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _is_output_full() -> bool:
    """Return whether the standard output takes no more, not even a line's end. Then it goes
    nowhere, since Python would fail on it once more at the end."""
    try:
        output = sys.stdout.fileno()
    except (OSError, ValueError):
        return False
    try:
        sys.stdout.flush()
        os.write(output, b"\n")
    except OSError as error:
        if error.errno not in FULL:
            return False
        _send_nowhere(output)
        return True
    return False


def _send_nowhere(output: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, output)
    os.close(nowhere)


def _nobody_reads() -> bool:
    """Return whether the closed pipe is that of the standard output."""
    try:
        output = sys.stdout.fileno()
    except (OSError, ValueError):
        return False
    if not system.has_no_reader(output):
        return False
    _send_nowhere(output)
    return True
