"""The frame of all programs: the parser, one message for a user's mistake, and exit codes."""

import argparse
import shlex
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from harness.vocabulary.errors import exit_code_of

Options = Callable[[argparse.ArgumentParser], None]
Run = Callable[[argparse.Namespace, str], int]


@dataclass(frozen=True)
class Program:
    """A program, ``python -m <name>``. A call parses the arguments (None: those of the command line) and runs it."""

    name: str
    options: Options
    run: Run
    description: str
    epilog: str | None

    @property
    def command(self) -> str:
        """The name by which it was called: ``tofpod sweep`` or ``python -m harness.sweep``."""
        return self.name.replace("harness.", "tofpod " if Path(sys.argv[0]).name == "tofpod" else "python -m harness.")

    def parser(self) -> argparse.ArgumentParser:
        """Return a parser of its arguments."""
        parser = argparse.ArgumentParser(prog=self.command, description=self.description, epilog=self.epilog)
        self.options(parser)
        return parser

    def __call__(self, arguments: list[str] | None = None) -> int:
        """Run the program. Returns the result of ``run``, 2 after a user's mistake, or 130 after Ctrl-C."""
        given = sys.argv[1:] if arguments is None else arguments
        parsed = self.parser().parse_args(given)
        if arguments is None:
            # batch systems and containers first send SIGTERM, which must end the program as Ctrl-C does
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        return exit_code_of(lambda: self.run(parsed, f"{self.command} {shlex.join(given)}".rstrip()))


def program(options: Options, description: str, epilog: str | None = None) -> Callable[[Run], Program]:
    """Return a decorator that turns a function into a program, which is named after the function's module."""
    return lambda run: Program(f"harness.{Path(run.__code__.co_filename).stem}", options, run, description, epilog)


def whole_number(most: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from 1 to ``most``."""

    def parsed(text: str) -> int:
        if not (text.isascii() and text.isdigit()) or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return parsed
