"""The frame of all programs: what a call from the command line prepares."""

from __future__ import annotations

import argparse
import os
import sys

import pytest

from harness.vocabulary.program import Program

THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def seen_by_a_program(monkeypatch: pytest.MonkeyPatch, stated: str | None) -> list[str | None]:
    """Return the threads' variables during a call from the command line, where the user states
    this number of threads."""
    seen: list[str | None] = []

    def run(arguments: argparse.Namespace, command: str) -> int:
        seen.extend(os.environ.get(name) for name in THREADS)
        return 0

    for name in THREADS:
        monkeypatch.setenv(name, stated or "")
        if stated is None:
            monkeypatch.delenv(name)
    monkeypatch.setattr(sys, "argv", ["tofpod"])
    monkeypatch.setattr("signal.signal", lambda number, handler: None)
    program = Program("looks", lambda parser: None, run, "Looks at its environment.", ())
    assert program() == 0
    return seen


def test_linear_algebra_takes_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seen_by_a_program(monkeypatch, stated=None) == ["1", "1"]


def test_a_stated_number_of_threads_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    assert seen_by_a_program(monkeypatch, stated="3") == ["3", "3"]
