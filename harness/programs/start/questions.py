"""Questions that are answered by options, or else by lines of the standard input."""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from harness.vocabulary.errors import UserError

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Question(Generic[Answer]):
    """A question with the option that answers it too."""

    option: str
    """The option, such as ``--camera``."""
    text: str
    """The question in plain words, with examples."""
    read: Callable[[str], Answer]
    """Returns what the words mean. Raises UserError for a wrong answer."""
    default: str | None = None
    """The answer that an empty line gives; None where an answer is needed."""

    def answered(self, stated: str | None, *, asks: bool) -> Answer:
        """Return the answer: of the option if it is ``stated``, else of the user, who is asked
        again after a mistake; without asking, the default. Raises UserError if the input ends."""
        if stated is not None:
            return self.read(stated)
        if not asks and self.default is not None:
            return self.read(self.default)
        while True:
            hint = "" if self.default is None else f" [{self.default}]"
            print(f"{self.text}{hint}: ", end="", flush=True)
            line = sys.stdin.readline()
            if not line:
                print()
                raise UserError(
                    f"the input ended before {self.option} was stated; nothing was written",
                    fix="answer all questions, or state the answers as options",
                )
            words = line.strip() or self.default
            if words is None:
                continue
            try:
                return self.read(words)
            except UserError as mistake:
                print(mistake)
