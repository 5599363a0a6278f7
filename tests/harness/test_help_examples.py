"""Every program's help ends with two examples: they are understood, name what exists, and those
that take no more than seconds run."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from detectors import detector_names
from harness.__main__ import MODULES, PROGRAMS, main
from harness.experiment.load import load_experiment
from harness.vocabulary.program import Program
from scenes.sensor.camera import camera_names

RUN = ("ask", "ls", "pod", "start", "target")
"""Programs whose examples take seconds at most; test_documents runs others on small inputs."""


def programs() -> Iterator[tuple[str, Program]]:
    """Yield every program that a user can call, with its words after ``tofpod``."""
    for entry in PROGRAMS:
        program = importlib.import_module(entry.module).main
        yield entry.name, program
        for word, nested in program.further.items():
            yield f"{entry.name} {word}", nested


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with what the examples that run need."""
    rng = np.random.default_rng(4)
    size = rng.uniform(1, 9, 80)
    hits = rng.random(80) < 1 / (1 + np.exp(-2 * (size - 4)))
    table = pd.DataFrame({"length": size, "length_mm": size, "found": hits.astype(int)})
    table["depth"] = 0.2 * size + rng.normal(0, 0.1, 80)
    table.to_csv(tmp_path / "inspections.csv", index=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(("name", "program"), [*programs()], ids=[name for name, _ in programs()])
def test_the_help_ends_with_two_examples_that_are_understood(name: str, program: Program) -> None:
    first, second = program.examples
    assert first != second
    help_text = program.parser().format_help()
    assert help_text.endswith(f"examples:\n  {first}\n  {second}\n")
    for example in program.examples:
        words = shlex.split(example)
        arguments = words[1 + len(name.split()) :]
        assert words == ["tofpod", *name.split(), *arguments]
        parsed = vars(program.parser().parse_args(arguments))
        experiment = parsed.get("experiment")
        if experiment is not None:
            load_experiment(experiment, parsed.get("overrides") or ())
        names = parsed.get("camera") or parsed.get("like") or ()
        assert {names} - {()} if isinstance(names, str) else set(names) <= {*camera_names()}
        detector = parsed.get("detector")
        assert detector in (None, "auto", *detector_names())


@pytest.mark.parametrize("name", RUN)
def test_an_example_runs(name: str, home: Path, unsaved: None) -> None:
    program = importlib.import_module(MODULES[name]).main
    for example in program.examples:
        assert main(shlex.split(example)[1:]) == 0, example
        for file in re.findall(r"(?:--out|--truth) (\S+)", example):
            assert (home / file).exists()
