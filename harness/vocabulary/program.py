"""The frame of all programs: the parser, one message for a user's mistake, exit codes, and types
of arguments."""

from __future__ import annotations

import argparse
import contextlib
import gc
import math
import os
import re
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from harness.vocabulary import system
from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.lengths import LEGAL, in_unit, states_unit
from harness.vocabulary.words import nearest

Options = Callable[[argparse.ArgumentParser], None]
Run = Callable[[argparse.Namespace, str], int]


class _Parser(argparse.ArgumentParser):
    """States a mistake in one message, without the list of all options, and with the nearest legal
    word."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            self.refuse(unknown[0])
        return parsed

    def refuse(self, word: str, further: Iterable[str] = ()) -> NoReturn:
        """Exit because of a word that is none of the options, nor of the ``further`` words."""
        is_option = word.startswith("-")
        options = [option for action in self._actions for option in action.option_strings]
        meant = nearest(word.partition("=")[0], options if is_option else further)
        problem = f"{word}: there is no such {'option' if is_option else 'argument'}"
        self.error(problem + (f"; did you mean {meant}?" if meant else ""))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        words = [str(choice) for choice in action.choices]
        meant = nearest(value, words)
        problem = f"{str(value)!r} is none of its values"
        problem += f"; did you mean {meant!r}?" if meant else ""
        raise argparse.ArgumentError(action, f"{problem}\n  legal: {', '.join(words)}")

    def error(self, message: str) -> NoReturn:
        problem = message.removeprefix("argument ")
        self.exit(2, f"error: {problem}\n  to do: {self.prog} --help shows all options\n")


class _HelpFormatter(argparse.HelpFormatter):
    """Wraps paragraphs, and leaves indented lines as they are, so that they can be copied."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = []
        for line in text.splitlines():
            is_copied = line.startswith(" ")
            paragraphs.append(line if is_copied else super()._fill_text(line, width, indent))
        return "\n".join(paragraphs)


@dataclass(frozen=True)
class Program:
    """A program, ``tofpod <name>``. A call parses the arguments (None: those of the command line)
    and runs it."""

    name: str
    """The words after ``tofpod``."""
    options: Options
    """Adds its arguments to a parser."""
    run: Run
    """Does its work; takes the parsed arguments and the whole command, and returns the exit code.
    """
    description: str
    examples: tuple[str, ...] = ()
    """Two whole commands, which its help shows and a test runs."""
    epilog: str | None = None
    further: Mapping[str, Program] = field(default_factory=dict)
    """Programs that a first word of the arguments names: ``tofpod gauge read``."""

    @property
    def command(self) -> str:
        """The words that call it: ``tofpod sweep``, or ``python -m harness.sweep`` where it was
        called so."""
        called_as_module = Path(sys.argv[0]).stem == self.name
        return f"python -m harness.{self.name}" if called_as_module else f"tofpod {self.name}"

    def parser(self) -> _Parser:
        """Return a parser of its arguments."""
        parts = [self.epilog] if self.epilog else []
        parts += ["examples:", *(f"  {example}" for example in self.examples)]
        parser = _Parser(
            prog=self.command,
            description=self.description,
            epilog="\n".join(parts),
            formatter_class=_HelpFormatter,
        )
        self.options(parser)
        return parser

    def chosen_by(self, words: list[str]) -> tuple[Program, list[str]]:
        """Return the program that the arguments name, this or a further one, and its arguments."""
        if words and words[0] in self.further:
            return self.further[words[0]], words[1:]
        if words and nearest(words[0], self.further) is not None:
            parser = self.parser()
            # where the program itself takes words, this may be one of them
            if all(action.option_strings for action in parser._actions):
                parser.refuse(words[0], self.further)
        return self, words

    def __call__(self, arguments: list[str] | None = None) -> int:
        """Run the program. Returns the result of ``run``, 2 after a user's mistake, or 130 after
        Ctrl-C."""
        words = sys.argv[1:] if arguments is None else arguments
        if arguments is None:
            system.end_as_by_interrupt()
            _limit_idle_threads()
        return exit_code_of(lambda: self._answer(words))

    def _answer(self, words: list[str]) -> int:
        """Run the program that the arguments name, or print its help."""
        program, arguments = self.chosen_by(words)
        parsed = program.parser().parse_args(arguments)
        command = f"{program.command} {shlex.join(arguments)}".rstrip()
        return program.run(parsed, command)


def _limit_idle_threads() -> None:
    """Let the linear algebra library use one thread, unless the user states another number.

    Its idle threads wait busily: with two, ``tofpod detect`` of 17 frames of 1280x720 takes 42
    processor seconds instead of 8, and no program gains time by them. The library reads these
    variables when NumPy is loaded, which programs do later."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Import modules without looking for garbage, of which they leave none, and leave them out of
    all later searches. This saves a tenth of the processor time of imports, and a third of what
    reading the project's sources takes afterwards."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        # what is frozen is never freed, garbage of earlier runs in this process included
        if not gc.get_freeze_count():
            gc.freeze()
        if was_enabled:
            gc.enable()


def program(
    options: Options,
    description: str,
    *examples: str,
    epilog: str | None = None,
    further: Mapping[str, Program] | None = None,
) -> Callable[[Run], Program]:
    """Return a decorator that turns a function into a program, which is named after the function's
    module."""

    def decorated(run: Run) -> Program:
        name = Path(run.__code__.co_filename).stem
        return Program(
            name=name,
            options=options,
            run=run,
            description=description,
            examples=examples,
            epilog=epilog,
            further=further or {},
        )

    return decorated


def whole_number(largest: int) -> Callable[[str], int]:
    """Return a parser of whole numbers from 1 to ``largest``."""

    def parsed(text: str) -> int:
        if not (text.isascii() and text.isdigit()) or not 1 <= int(text) <= largest:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to {largest}")
        return int(text)

    return parsed


def length(unit: str, *, least: float = 0.0) -> Callable[[str], float]:
    """Return a parser of lengths in ``unit``, above ``least``, for argparse. A bare number is in
    ``unit``."""

    def parsed(text: str) -> float:
        value = in_unit(text, unit)
        if value is None or not least < value < math.inf:
            raise argparse.ArgumentTypeError(f"{text!r} is not a length, {LEGAL}")
        return value

    return parsed


def span(unit: str) -> Callable[[str], tuple[float, float]]:
    """Return a parser of FROM:TO, two lengths in ``unit``, for argparse. A unit after the second
    only is that of both."""

    def parsed(text: str) -> tuple[float, float]:
        low_text, colon, high_text = text.partition(":")
        if not states_unit(low_text) and states_unit(high_text):
            low_text += re.sub(r"[^a-z]|e(?=[-+\d])", "", high_text)
        low = in_unit(low_text, unit)
        high = in_unit(high_text, unit)
        if not colon or low is None or high is None:
            raise argparse.ArgumentTypeError(f"{text!r} is not FROM:TO, such as 2:10 or 2:10mm")
        return low, high

    return parsed


BYTES = {"kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}
"""Units of sizes in memory: powers of ten, as disks are sold."""


def bytes_of(text: str) -> int:
    """Return a number of bytes from ``5GB`` or ``500 MB``, for argparse; a bare number is in GB."""
    match = re.fullmatch(r"([0-9]{1,12}(?:\.[0-9]{1,6})?) ?([A-Za-z]{1,3})?", text.strip())
    factors = {unit.lower(): factor for unit, factor in BYTES.items()}
    if match is None or (match[2] or "GB").lower() not in factors:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size, such as 500MB, 5GB or 1.5TB")
    return round(float(match[1]) * factors[(match[2] or "GB").lower()])


def length_m(option: str, text: str) -> float:
    """Convert a length that must state its unit to metres. Raises UserError that names the
    option."""
    value = in_unit(text, "m") if states_unit(text) else None
    if value is None or not 0 < value < math.inf:
        raise UserError(f"{option} {text}: is not a length with a unit", legal=LEGAL)
    return value
