"""The user's mistakes: one clear message and exit code 2. Any other exception is a bug and keeps its traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable


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
    """Run a program's body; a UserError becomes one message on stderr and exit code 2, Ctrl-C becomes 130."""
    try:
        return program()
    except UserError as mistake:
        print(f"error: {mistake}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
