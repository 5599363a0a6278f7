"""The frame of every program: its parser, one message for a mistake, an exit code."""

from __future__ import annotations

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
    """``python -m <name>``: called, it parses arguments (None: the command line's) and runs."""

    name: str
    options: Options
    run: Run
    description: str
    epilog: str | None

    @property
    def command(self) -> str:
        """Its name as it was called: ``tofpod sweep`` or ``python -m harness.sweep``."""
        return self.name.replace("harness.", "tofpod " if Path(sys.argv[0]).name == "tofpod" else "python -m harness.")

    def parser(self) -> argparse.ArgumentParser:
        """Return a parser of its arguments."""
        parser = argparse.ArgumentParser(prog=self.command, description=self.description, epilog=self.epilog)
        self.options(parser)
        return parser

    def __call__(self, arguments: list[str] | None = None) -> int:
        """Run the program; returns what ``run`` returns, 2 on a mistake of the user, 130 after Ctrl-C."""
        given = sys.argv[1:] if arguments is None else arguments
        parsed = self.parser().parse_args(given)
        if arguments is None:
            # what batch systems and containers send first is to end as Ctrl-C does
            signal.signal(signal.SIGTERM, signal.default_int_handler)
        return exit_code_of(lambda: self.run(parsed, f"{self.command} {shlex.join(given)}".rstrip()))


def program(options: Options, description: str, epilog: str | None = None) -> Callable[[Run], Program]:
    """Return a decorator that makes a program of a function; the module's name is the program's name."""
    return lambda run: Program(f"harness.{Path(run.__code__.co_filename).stem}", options, run, description, epilog)


def whole_number(most: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from 1 to ``most``."""

    def parsed(text: str) -> int:
        if not (text.isascii() and text.isdigit()) or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {most}")
        return int(text)

    return parsed
