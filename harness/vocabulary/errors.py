"""The user's mistakes: one clear message and exit code 2. Any other exception is a bug and keeps its traceback."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable

CLOSED_PIPE = 141
"""What a shell reports of a program that SIGPIPE ended: 128 + 13."""


class UserError(Exception):
    """A mistake that the user can mend.

    The message says what is wrong and where; ``legal`` what would be accepted; ``fix`` what to do next.
    """

    def __init__(self, message: str, *, legal: str | None = None, fix: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.legal = legal
        self.fix = fix

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions with keyword arguments do not survive pickling between worker processes otherwise.
        return (_rebuild, (self.message, self.legal, self.fix))

    def __str__(self) -> str:
        lines = [self.message]
        if self.legal:
            lines.append(f"  legal: {self.legal}")
        if self.fix:
            lines.append(f"  to do: {self.fix}")
        return "\n".join(lines)


def _rebuild(message: str, legal: str | None, fix: str | None) -> UserError:
    return UserError(message, legal=legal, fix=fix)


def exit_code_of(program: Callable[[], int]) -> int:
    """Run a program's body; a UserError becomes one message on stderr and exit code 2, Ctrl-C becomes 130, and output
    that nobody reads to its end (``| head``) ends it silently with 141."""
    try:
        code = program()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        if not _nobody_reads():
            raise
        return CLOSED_PIPE
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _nobody_reads() -> bool:
    """Whether it is the standard output whose pipe is closed; if so, what is still to be written goes nowhere, so that
    the interpreter does not complain when it ends."""
    try:
        output = sys.stdout.fileno()
    except (OSError, ValueError):
        return False
    poll = select.poll()
    poll.register(output, 0)
    if not any(event & select.POLLERR for _, event in poll.poll(0)):
        return False
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, output)
    os.close(nowhere)
    return True
