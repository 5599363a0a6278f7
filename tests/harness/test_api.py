"""``import tofpod``: the examples of its docstrings, what it refuses, and the notebook."""

from __future__ import annotations

import doctest
import json
from pathlib import Path

import pytest

import tofpod
from harness import api
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import record_text
from harness.records.schema import write_table
from harness.tables.limits import LIMITS
from tests.support.synthetic_study import SetUp, Study, study_record

ROOT = Path(__file__).resolve().parents[2]


def test_the_examples_of_the_docstrings_hold(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = {
        example.name: example
        for example in doctest.DocTestFinder().find(api, "tofpod", module=api)
        if example.examples
    }
    flags = doctest.ELLIPSIS | doctest.IGNORE_EXCEPTION_DETAIL
    runner = doctest.DocTestRunner(optionflags=flags)
    shared = {}  # examples of functions go on from the module's
    for name in sorted(result, key=len):
        result[name].globs = shared
        runner.run(result[name], clear_globs=False)
    assert runner.summarize().failed == 0 and len(result) >= 7


def test_the_module_is_the_facade():
    assert all(getattr(tofpod, name) is getattr(api, name) for name in api.__all__)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: tofpod.target({"name": "custom", "board": {"width_mm": -1}}), "width_mm"),
        (lambda: tofpod.target({"name": "costum"}), "thesis, custom, drawn"),
        (lambda: tofpod.target("no_such_target"), "no such file"),
        (lambda: tofpod.render(tofpod.target("thesis"), "kinect_v3"), "kinect_v2"),
        (lambda: tofpod.render(tofpod.target("thesis"), "kinect_v2", bounce=1), "bounces"),
        (lambda: tofpod.frames(None, 0), "0 frames"),
        (lambda: tofpod.average(None, "maen"), "mean"),
        (lambda: tofpod.detect(None, "thesys"), "thesis"),
        (lambda: tofpod.table("no_such_folder", "limits"), "has no table"),
        (lambda: tofpod.limits("no_such_folder"), "cannot be read"),
        (lambda: tofpod.sweep("no_such_experiment"), "averaging"),
    ],
)
def test_bad_input_is_refused_as_programs_refuse_it(wrong, said):
    with pytest.raises(tofpod.UserError) as mistake:
        wrong()
    assert said in str(mistake.value)


def test_results_are_tables_and_limits(tmp_path):
    record = study_record(Study(boards=12, set_ups=(SetUp(), SetUp(frames=5, a50_mm=5.0))))
    (tmp_path / "study.json").write_text(record_text(record))
    write_table(tmp_path, LIMITS, LIMITS.frame([limit_of(set_up) for set_up in record.set_ups]))
    result = tofpod.limits(tmp_path)
    curves = tofpod.plot_pod(result).axes[0].get_lines()
    assert len([line for line in curves if len(line.get_xdata()) > 9]) == 2
    assert list(tofpod.table(tmp_path, "limits")["a90_mm"]) == [limit.a90_mm for limit in result]
    with pytest.raises(tofpod.UserError, match="limits"):
        tofpod.table(tmp_path, "limit")


@pytest.mark.slow  # a small study
@pytest.mark.parametrize(
    "notebook", sorted((ROOT / "docs").glob("*.ipynb")), ids=lambda path: path.stem
)
def test_a_notebook_runs(notebook, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cells = json.loads(notebook.read_text())["cells"]
    names = {}
    for number, cell in enumerate(cell for cell in cells if cell["cell_type"] == "code"):
        exec(
            compile("".join(cell["source"]), f"{notebook.name}, code cell {number}", "exec"), names
        )
    assert names["limits"] and all(limit.statement is not None for limit in names["limits"])
