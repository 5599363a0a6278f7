"""The frame of all programs: what a call from the command line prepares."""

from __future__ import annotations

import argparse
import os
import sys

import pytest

from harness.vocabulary.program import Program, bytes_of

THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def seen_by_a_program(monkeypatch: pytest.MonkeyPatch, stated: str | None) -> list[str | None]:
    """Return the threads' variables during a call from the command line, where the user states
    this number of threads."""
    paths: list[str | None] = []

    def run(arguments: argparse.Namespace, command: str) -> int:
        paths.extend(os.environ.get(name) for name in THREADS)
        return 0

    for name in THREADS:
        monkeypatch.setenv(name, stated or "")
        if stated is None:
            monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "argv", ["tofpod"])
    monkeypatch.setattr("signal.signal", lambda number, handler: None)
    program = Program("looks", lambda parser: None, run, "Looks at its environment.", ())
    assert program() == 0
    return paths


def test_linear_algebra_takes_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seen_by_a_program(monkeypatch, stated=None) == ["1", "1"]


def test_a_stated_number_of_threads_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seen_by_a_program(monkeypatch, stated="3") == ["3", "3"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--coulor", "red"], "--coulor: there is no such option; did you mean --colour?"),
        (["--colour", "rde"], "--colour: 'rde' is none of its values; did you mean 'red'?"),
        (["--colour", "rde"], "  legal: red, green"),
        (["stray"], "stray: there is no such argument"),
        (["--number", "x"], "--number: invalid int value: 'x'"),
        (["--number"], "--number: expected one argument"),
        ([], "the following arguments are required: --number"),
    ],
)
def test_a_mistake_is_one_message(words: list[str], message: str, capsys) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--colour", choices=("red", "green"))
        parser.add_argument("--number", type=int, required=True)

    program = Program("paints", options, lambda parsed, command: 0, "Paints.", ())
    arguments = words if words[:1] in ([], ["--number"]) else ["--number", "1", *words]
    with pytest.raises(SystemExit, match="2"):
        program(arguments)
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.startswith("error: ")
    assert printed.endswith("to do: tofpod paints --help shows all options\n")
    assert "usage" not in printed and len(printed.splitlines()) <= 3


def test_a_mistyped_further_program_is_not_taken_for_arguments(capsys) -> None:
    nested = Program("gauge read", lambda parser: None, lambda parsed, command: 0, "Reads.", ())
    gauge = Program(
        "gauge",
        lambda parser: None,
        lambda parsed, command: 1,
        "Designs.",
        (),
        further={"read": nested},
    )
    assert gauge(["read"]) == 0
    assert gauge([]) == 1
    with pytest.raises(SystemExit, match="2"):
        gauge(["raed"])
    assert "raed: there is no such argument; did you mean read?" in capsys.readouterr().err


def test_an_argument_may_resemble_a_further_program() -> None:
    nested = Program("score rank", lambda parser: None, lambda parsed, command: 1, "Ranks.", ())
    score = Program(
        "score",
        lambda parser: parser.add_argument("maps"),
        lambda parsed, command: int(parsed.maps != "ranks"),
        "Scores.",
        (),
        further={"rank": nested},
    )
    assert score(["ranks"]) == 0
    assert score(["rank"]) == 1


@pytest.mark.parametrize(
    ("text", "count"),
    [("5GB", 5_000_000_000), ("5", 5_000_000_000), ("1.5 mb", 1_500_000), ("0kB", 0)],
)
def test_sizes_in_memory(text: str, count: int) -> None:
    assert bytes_of(text) == count


@pytest.mark.parametrize("text", ["", "GB", "-5GB", "5 gigs", "1e3GB", "nan", "5GBx", "５GB"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="not a size"):
        bytes_of(text)
