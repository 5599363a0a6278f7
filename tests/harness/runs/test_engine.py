"""The engine end to end on a tiny experiment: same numbers however it is run; nothing finished is
lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd
import pytest

from harness.experiment.load import load_experiment
from harness.runs import run, study
from harness.runs.jobs import Ended
from harness.runs.journal import Journal, record_text
from harness.runs.options import EngineOptions
from harness.runs.plan import plan_of
from harness.runs.tables import tables_of
from harness.trials.board import Board
from harness.trials.trial import run_trial
from harness.vocabulary.provenance import RESULTS_VERSION
from scenes.target.custom import TargetConfig
from scenes.target.truth import truth_of
from tests.support.declared_results import assert_declared
from tests.support.serial_run import records_of, run_serially, trial_keys
from tests.support.tiny_sweep import ROOT, TINY, results, sweep, sweep_command

if TYPE_CHECKING:
    from harness.vocabulary.geometry import Cloud
    from scenes.sensor.source import SimulatedUnit


def recorded(folder: Path, role: str) -> list[str]:
    """Keys of the trials of a role that are in the journal by now."""
    keys = [
        key
        for result in folder.glob("tiny/[0-9a-f]*/journal")
        for key in trial_keys(Journal(result))
    ]
    return [key for key in keys if key.startswith(role)]


def trials(folder: Path) -> pd.DataFrame:
    return pd.read_parquet(results(folder) / "trials.parquet")


@pytest.fixture
def finished(tiny_out: Path) -> Path:
    return tiny_out


def test_a_sweep_leaves_all_its_files(finished):
    names = {path.name for path in results(finished).iterdir()}
    assert names == {
        ".lock",
        "claims.csv",
        "experiment.yaml",
        "false_calls.csv",
        "false_calls.parquet",
        "journal",
        "noise.csv",
        "noise.parquet",
        "noise_by_frames.csv",
        "noise_by_frames.parquet",
        "probes.parquet",
        "provenance.json",
        "report.html",
        "runs.parquet",
        "set_ups.csv",
        "set_ups.parquet",
        "summary.csv",
        "trials.parquet",
        "written.json",
    }
    assert_declared(results(finished))
    latest = finished / "tiny" / "latest"
    assert latest.is_symlink() and latest.resolve() == results(finished).resolve()
    table = trials(finished)
    assert len(table) == 2 * 2 * 11  # numbers of frames, repeats, holes
    assert table.groupby("hole")["true_diameter_mm"].nunique().eq(1).all()
    # the 1 in hole, seven pixels wide in radius, cannot be missed; the 1/16 in hole is one pixel
    assert table[table.hole == "11"].detected.all()
    assert not table[table.hole == "1"].detected.any()
    summary = pd.read_csv(results(finished) / "summary.csv")
    assert {"rate", "rate_low", "rate_high", "n", "detected"} <= set(summary.columns)


def test_provenance_is_stored(finished):
    printed = json.loads((results(finished) / "provenance.json").read_text())
    assert printed["seed"] == 3
    assert printed["command"].startswith("tofpod sweep ")
    assert printed["versions"]["mitsuba"]
    assert set(printed) >= {"commit", "dirty", "machine", "failures", "seconds"}
    spent = printed["processor_seconds"]
    assert min(spent["imports"], spent["frames"], spent["detection"], spent["tables and page"]) > 0
    import pyarrow.parquet as pq

    inside = json.loads(pq.read_schema(results(finished) / "trials.parquet").metadata[b"tofpod"])
    assert inside["digest"] == printed["digest"]


def test_report_is_one_file_without_outside_links(finished):
    page = (results(finished) / "report.html").read_text()
    assert "<svg" in page
    for outside in ("http://", "https://", "<script src", "<link"):
        assert outside not in page.replace("http://www.w3.org", "").replace(
            "https://www.w3.org", ""
        )


def test_one_process_gives_the_same_numbers(finished, monkeypatch, tmp_path):
    experiment = load_experiment(finished.parent / "tiny.yaml")
    plan = plan_of(experiment, finished / ".cache" / "renders")
    outcome = run_serially(plan, tmp_path / "alone")
    alone = tables_of(records_of(tmp_path / "alone", outcome), experiment)
    pd.testing.assert_frame_equal(trials(finished), alone.holes, check_exact=True)


@pytest.mark.usefixtures("unsaved")
def test_a_finished_sweep_draws_no_pictures(finished, monkeypatch, tmp_path):
    """Where its page is as it was; otherwise they are drawn for it."""
    out = tmp_path / "out"
    shutil.copytree(finished, out, symlinks=True)
    drawn = []

    def watched(*arguments: Any) -> Any:
        drawn.append(arguments)
        return examples_of(*arguments)

    examples_of = study.examples_of
    monkeypatch.setattr(study, "examples_of", watched)
    experiment = load_experiment(finished.parent / "tiny.yaml")
    serial = EngineOptions(serial=True)
    page = results(out) / "report.html"
    page.unlink()
    assert study.run_study(experiment, out, serial, "again") == 0
    assert len(drawn) == 1
    again = page.read_text()
    assert study.run_study(experiment, out, serial, "again") == 0
    assert len(drawn) == 1
    assert page.read_text() == again


def test_a_page_without_a_picture_that_failed_is_written_again(finished, monkeypatch, tmp_path):
    """A run with failures keeps no record that all is written: what failed may succeed later."""

    def faulty(*arguments: Any) -> Any:
        raise OSError("no memory for a picture")

    out = tmp_path / "out"
    shutil.copytree(finished, out, symlinks=True)
    page = results(out) / "report.html"
    record = results(out) / "written.json"
    whole = page.read_text()
    page.unlink()
    experiment = load_experiment(finished.parent / "tiny.yaml")
    serial = EngineOptions(serial=True)
    record.unlink()
    with monkeypatch.context() as patch:
        patch.setattr(run, "pictures_of", faulty)
        assert study.run_study(experiment, out, serial, "again") == 1
    assert 'id="residual"' in whole
    assert 'id="residual"' not in page.read_text()
    assert not record.exists()
    assert study.run_study(experiment, out, serial, "again") == 0
    assert 'id="residual"' in page.read_text()
    assert record.exists()


def test_a_half_finished_sweep_resumes_to_the_same_numbers(finished, tmp_path):
    half = tmp_path / "half"
    shutil.copytree(finished, half)
    folder = results(half)
    (journal,) = (folder / "journal").iterdir()
    first, *lines = [
        line for line in journal.read_text().splitlines() if '"key":"thresholds-' not in line
    ]
    assert len(lines) == 4
    journal.write_text(f"{first}\n{lines[2]}\n{lines[1][:100]}")  # the last line is half written
    (folder / "trials.parquet").unlink()
    done = sweep(finished.parent / "tiny.yaml", half, "--serial")
    assert done.returncode == 0, done.stderr
    printed = json.loads((folder / "provenance.json").read_text())
    assert printed["trials"] == {"done": 3, "resumed": 1, "failed": 0}
    assert printed["renders"] == {"done": 0, "cached": 2, "failed": 0}
    pd.testing.assert_frame_equal(trials(finished), trials(half), check_exact=True)


@pytest.mark.slow  # a sweep in a process of its own; test_engine_run interrupts in process
def test_interrupted_sweep_keeps_what_is_finished_and_says_how_to_go_on(finished, tmp_path):
    """Ctrl-C after the first finished trial of many: exit 130, the journal whole, the command to
    resume told."""
    cut = tmp_path / "cut"
    shutil.copytree(finished / ".cache", cut / ".cache")
    command = sweep_command(
        finished.parent / "tiny.yaml", cut, "--set", "repeats=400", "--jobs", "1"
    )
    pipes = {"stderr": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}

    def hears_interrupts() -> None:  # also where the tests run in a shell's background
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    process = subprocess.Popen(
        command, cwd=ROOT, start_new_session=True, preexec_fn=hears_interrupts, **pipes
    )
    deadline = time.monotonic() + 900
    while not recorded(cut, ""):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130, errors
    assert "interrupted; finished trials are kept" in errors
    assert "--set repeats=400" in errors
    journal = Journal(next(cut.glob("tiny/[0-9a-f]*/journal")))
    assert len(journal) == len(trial_keys(journal)) > 0
    assert journal.damaged == []


@pytest.mark.slow
def test_workers_end_with_a_driver_that_is_killed(finished, tmp_path):
    """SIGKILL to the driver alone, in the middle of its trials: soon no process of the sweep is
    left."""
    cut = tmp_path / "killed"
    shutil.copytree(finished / ".cache", cut / ".cache")
    command = sweep_command(
        finished.parent / "tiny.yaml", cut, "--set", "repeats=400", "--jobs", "1"
    )
    marked = os.environ | {"TOFPOD_TEST_OF": str(cut)}
    process = subprocess.Popen(command, cwd=ROOT, env=marked, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 900
    while not recorded(cut, "hole_free"):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert len(processes_marked(str(cut))) > 1
    process.kill()
    process.wait()
    deadline = time.monotonic() + 300
    while processes_marked(str(cut)):
        assert time.monotonic() < deadline, "workers outlive their driver"
        time.sleep(0.1)


def processes_marked(mark: str) -> list[int]:
    """Living processes whose environment holds the mark."""
    result = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            environment = (folder / "environ").read_bytes()
            state = (folder / "stat").read_text().rsplit(")")[-1].split()[0]
        except OSError:
            continue
        if f"TOFPOD_TEST_OF={mark}".encode() in environment and state != "Z":
            result.append(int(folder.name))
    return result


def test_dry_run_counts_and_runs_nothing(finished, tmp_path):
    done = sweep(finished.parent / "tiny.yaml", finished, "--dry-run")
    assert done.returncode == 0
    assert "2 points, 1 set of frames" in done.stdout
    assert "renders: 2, 2 of them cached" in done.stdout
    fresh = tmp_path / "fresh"
    assert sweep(finished.parent / "tiny.yaml", fresh, "--dry-run").returncode == 0
    assert not fresh.exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--set", "repeats=0"], "repeats"),
        (["--set", "capture.framse=3"], "did you mean"),
        (["--set", "source.target.offset_x_mm=1500.0"], "the target is out of view"),
        (["--serial", "--scheduler", "tcp://x:1"], "ask for different engines"),
        (["--memory-limit", "0.1"], "0.5 GB or more"),
    ],
)
def test_mistakes_end_with_one_message_and_exit_2(finished, arguments, expected, tmp_path):
    done = sweep(finished.parent / "tiny.yaml", tmp_path / "wrong", *arguments)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert expected in done.stderr


def test_missing_file_and_unwritable_folder(finished, tmp_path):
    done = sweep(tmp_path / "none.yaml", tmp_path / "out")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    (tmp_path / "file").write_text("")
    done = sweep(finished.parent / "tiny.yaml", tmp_path / "file")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert "cannot be written" in done.stderr


def test_missing_llvm_is_one_message(finished, monkeypatch, tmp_path):
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "libLLVM.so"))
    done = sweep(finished.parent / "tiny.yaml", tmp_path / "out", "--jobs", "1")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "DRJIT_LIBLLVM_PATH" in done.stderr


def test_seeds_change_the_frames_but_not_the_render(finished):
    first = load_experiment(finished.parent / "tiny.yaml")
    second = load_experiment(finished.parent / "tiny.yaml", ["seed=4"])
    cache = finished / ".cache" / "renders"
    a = plan_of(first, cache)
    b = plan_of(second, cache)
    assert [job.path for job in a.renders] == [job.path for job in b.renders]
    assert first.digest != second.digest


def test_journal_holds_nan_as_none(tmp_path):
    journal = Journal(tmp_path)
    journal.write("key", Ended("done", record_text({"rows": [{"a": float("nan"), "b": 1.5}]})))
    entry = journal.read("key")
    assert entry is not None and entry.record == {"rows": [{"a": None, "b": 1.5}]}
    assert journal.read("other") is None


CAPTURE = """\
name: capture
source:
  kind: capture
  paths: [{path}]
capture: {{frames: 7}}
detector:
  name: thesis
  settings: {{crop: {{kind: auto, inset_px: 8}}}}
threshold: {{k: 5.0}}
sweep:
  capture.frames: [1, 7]
"""


@pytest.mark.usefixtures("unpictured")
def test_a_real_capture_is_a_source_of_frames(shared_data, tmp_path):
    (tmp_path / "capture.yaml").write_text(CAPTURE.format(path=shared_data / "azure_drilled_board"))
    done = sweep(tmp_path / "capture.yaml", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "left out: " in done.stdout
    assert "00003.png" in done.stdout
    table = pd.read_csv(next((tmp_path / "out").glob("capture/[0-9a-f]*/summary.csv")))
    assert (
        list(table.frames_used) == [1, 6] and list(table.results_version) == [RESULTS_VERSION] * 2
    )
    assert len(list((tmp_path / "out").glob("capture/[0-9a-f]*/point-*/findings.csv"))) == 2


def test_a_target_without_damage_is_refused_before_anything_runs(tmp_path):
    custom = TINY.replace(
        "{name: thesis}", "{name: custom, board: {width_mm: 200, height_mm: 100, thickness_mm: 10}}"
    )
    (tmp_path / "tiny.yaml").write_text(custom)
    done = sweep(tmp_path / "tiny.yaml", tmp_path / "out")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False), done.stderr
    assert "the target has no damage" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_bug_in_one_trial_costs_that_trial_only(finished, monkeypatch, tmp_path):
    """A trial that raises becomes a failure with its traceback; the other trials end. Run without
    workers."""

    def faulty(task):
        if task.role == "damaged" and task.repeat == 1:
            raise ValueError("a bug of the detector")
        return run_trial(task)

    monkeypatch.setattr(run, "run_trial", faulty)
    experiment = load_experiment(finished.parent / "tiny.yaml")
    plan = plan_of(experiment, finished / ".cache" / "renders")
    outcome = run_serially(plan, tmp_path / "faulty")
    (failure,) = outcome.failures
    assert failure.what.startswith("damaged-00001-")
    assert "Traceback" in failure.why
    assert failure.why.rstrip().endswith("ValueError: a bug of the detector")
    assert outcome.trials.done == 3


def test_a_bug_in_every_trial_keeps_its_traceback_once(finished, monkeypatch, capsys, tmp_path):
    from harness.runs import study

    def faulty(task):
        raise ValueError("a bug of the detector")

    monkeypatch.setattr(run, "run_trial", faulty)
    out = tmp_path / "hopeless"
    shutil.copytree(finished / ".cache", out / ".cache")
    experiment = load_experiment(finished.parent / "tiny.yaml")
    assert (
        study.run_study(
            experiment, out, EngineOptions(serial=True), "python -m harness.sweep tiny.yaml"
        )
        == 1
    )
    error_text = capsys.readouterr().err
    assert error_text.count("Traceback (most recent call last)") == 1
    assert "ValueError: a bug of the detector" in error_text
    assert error_text.rstrip().endswith(
        "no trial of tiny succeeded; 4 failed, the first as above (detector 'thesis')"
    )
    assert not list(out.glob("tiny/[0-9a-f]*/report.html"))


def test_changed_code_is_not_served_old_trials(finished, monkeypatch):
    from harness.runs import plan

    experiment = load_experiment(finished.parent / "tiny.yaml")
    (group,) = plan_of(experiment, finished / ".cache" / "renders").groups
    (hole_free,) = group.first
    before = [key for key, _ in group.trials(hole_free, {})]
    monkeypatch.setattr(plan, "source_digest", lambda folders, packages: "other code")
    assert set(before).isdisjoint(key for key, _ in group.trials(hole_free, {}))


def test_matching_places_findings_on_a_curved_face():
    """The line of sight through a hole's centre meets a cylinder's face where the hole is."""
    data = {
        "name": "custom",
        "board": {
            "width_mm": 200,
            "height_mm": 100,
            "thickness_mm": 10,
            "shape": {"kind": "cylinder", "radius_mm": 130, "straight_along": "y"},
        },
        "holes": [{"id": 1, "kind": "through", "diameter_mm": 10, "centre_mm": [70, 0]}],
        "pose": {"distance_m": 0.6},
    }
    target = TargetConfig.from_data(data)
    T_camera_board = target.pose.T_camera_board
    (damage,) = truth_of(target, T_camera_board)
    unit = cast("SimulatedUnit", None)
    set_up = Board(unit, True, (damage,), target, T_camera_board)
    deeper = damage.centre_camera_m * 1.02  # along the line of sight, as the points of a hole are
    one = np.ones((1, 1))
    pixels = {1: np.array([0])}
    vars(set_up).update(
        {"outlines": pixels, "intact": one > 0, "seen_depth_m": {1: 0.0}, "on_face_m": one}
    )
    reference = set_up.labelled(cast("Cloud", SimpleNamespace(projection="central")))
    assert reference.on_board(deeper)[0] == pytest.approx(damage.centre_board_m[:2], abs=1e-5)
