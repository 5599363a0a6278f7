"""The gate's program: exit codes, what it says, its baseline; and how often its rule fails without
a reason.

The study itself is put in by hand here; `tests/test_check_mutations.py` runs whole ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from harness.evaluation.study.record import StudyRecord, read_record, record_text
from harness.experiment import load
from harness.experiment.digests import experiment_digests
from harness.experiment.load import load_experiment
from harness.experiment.schema import Experiment
from harness.programs.gate import check
from harness.programs.gate.verdict import compare_studies
from harness.runs import study as engine
from harness.vocabulary.files import write_text
from tests.support.synthetic_study import SetUp, Study, study_record
from tests.validation.gate_power import Change, Size, fails, share, study

EXPERIMENT = Path(__file__).resolve().parents[4] / "experiments" / "regression.yaml"
BOARDS = Study(boards=24, hole_free_boards=24, holes=6)


def record(*set_ups: SetUp) -> StudyRecord:
    return study_record(replace(BOARDS, set_ups=set_ups or (SetUp(),)))


class Program:
    """`harness.programs.gate.check` on a folder of its own, with a study that finds what it is
    told to."""

    def __init__(self, home: Path, found: Callable[[StudyRecord, int], None]) -> None:
        self.baseline = home / "baseline.json"
        self.home = home
        self._finds = found

    def __call__(self, found: StudyRecord, *arguments: str, code: int = 0) -> int:
        self._finds(found, code)
        return check.main(
            [str(EXPERIMENT), "--baseline", str(self.baseline), "--out", str(self.home), *arguments]
        )


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment(EXPERIMENT)


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, experiment: Experiment) -> Program:
    monkeypatch.setattr(
        load, "load_experiment", lambda path, overrides: experiment
    )  # half a second each time

    def finds(found: StudyRecord, code: int) -> None:
        def run_study(experiment, out, jobs, command):
            write_text(experiment.folder(out) / "study.json", record_text(found))
            return code

        monkeypatch.setattr(engine, "run_study", run_study)

    return Program(tmp_path, finds)


def test_without_a_baseline_nothing_runs_and_update_is_named(program, capsys):
    assert program(record()) == 2
    captured = capsys.readouterr()
    assert (
        "there is no such baseline" in captured.err
        and "--update" in captured.err
        and not captured.out
    )
    assert not list(program.home.rglob("study.json"))


def test_update_writes_the_baseline_and_says_what_changes(program, capsys):
    assert program(record(), "--update") == 0
    assert read_record(program.baseline).set_ups[0].frames_digest == "frames-a-1"
    assert program(record(SetUp(a50_mm=9, frames_digest="b")), "--update") == 0
    printed = capsys.readouterr().out
    assert "worse" in printed and " → " in printed and f"wrote {program.baseline}" in printed
    assert read_record(program.baseline).set_ups[0].frames_digest == "b-1"


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (json.dumps({"record_version": 0}), "is a record of version 0"),
        ('{"record_version": 1}', "is damaged: name: "),
        ("<<<<<<< HEAD", "is not JSON"),
    ],
)
def test_a_baseline_that_cannot_be_read_is_written_anew_by_update_alone(
    program, capsys, content, why
):
    program.baseline.write_text(content)
    assert program(record()) == 2
    error_text = capsys.readouterr().err
    assert (
        f"{program.baseline}: {why}" in error_text
        and "to do: write a new one with --update" in error_text
    )
    assert program.baseline.read_text() == content
    assert program(record(), "--update") == 0
    error_text = capsys.readouterr().out
    assert (
        "no comparison with the old baseline, which will be overwritten. " in error_text
        and why in error_text
    )
    assert (
        f"wrote {program.baseline}" in error_text
        and len(read_record(program.baseline).set_ups) == 1
    )
    assert program(record()) == 0


def test_the_first_line_says_that_the_baseline_is_older_and_since_what(program, experiment, capsys):
    stored = record()
    now = experiment_digests(experiment)

    def first_line(digests: object) -> str:
        provenance = {**stored.provenance, "versions": {"tofpod": "0.1.0"}, "digests": digests}
        write_text(program.baseline, record_text(replace(stored, provenance=provenance)))
        assert program(stored) == 0
        return capsys.readouterr().out.partition("\n")[0]

    older = f"{program.baseline} is older than the code (tofpod 0.1.0): "
    assert first_line({**now, "scenes/render": "0"}) == f"{older}since then changed: scenes/render"
    assert first_line(None) == f"{older}it does not state its code"
    assert "older" not in first_line(now)


def test_a_folder_is_no_baseline(program, capsys):
    program.baseline.mkdir()
    assert program(record(), "--update") == 2
    assert "is a folder" in capsys.readouterr().err


def test_a_study_with_failed_trials_is_no_baseline(program, capsys):
    assert program(record(), "--update") == 0
    assert program(record(SetUp(a50_mm=9)), "--update", code=1) == 2
    assert "trials failed" in capsys.readouterr().err
    assert (
        read_record(program.baseline).set_ups[0].inspected.hit.sum()
        == record().set_ups[0].inspected.hit.sum()
    )


def test_exit_codes(program, capsys):
    assert program(record(), "--update") == 0
    assert program(record()) == 0
    assert program(record(SetUp(a50_mm=4, frames_digest="b"))) == 0, "better"
    assert program(record(SetUp(a50_mm=9, frames_digest="b"))) == 1
    captured = capsys.readouterr()
    assert "1 of 1 set-ups is worse. 1 frame: a90 " in captured.out and "--update" in captured.err
    assert len(list(program.home.rglob("compare.html"))) == 1


def test_failed_trials_and_missing_set_ups_fail(program, capsys):
    before = record()
    assert program(record(SetUp(), SetUp(frames=5)), "--update") == 0
    assert program(record(SetUp(), SetUp(frames=5), SetUp(frames=9))) == 0, (
        "a further one is no fault"
    )
    assert program(before) == 1
    assert "missing, although in the baseline: 5 frames" in capsys.readouterr().err
    broken = replace(
        before, set_ups=(replace(before.set_ups[0], failed=1), *record(SetUp(frames=5)).set_ups)
    )
    assert program(broken, code=1) == 1
    assert "1 trials failed, 0 before" in capsys.readouterr().out


def test_another_measuring_stick_is_a_mistake_and_no_failure(program, capsys):
    assert program(record(), "--update") == 0
    assert program(replace(record(), hit_radius_mm=10.0)) == 2
    assert "within 15 mm there, within 10 mm here" in capsys.readouterr().err


def test_ctrl_c_is_passed_on(program):
    assert program(record(), "--update") == 0
    assert program(record(), code=130) == 130


def test_an_experiment_without_a_study_is_refused(tmp_path, capsys):
    assert (
        check.main(
            [str(EXPERIMENT.with_name("smoke.yaml")), "--baseline", str(tmp_path / "b.json")]
        )
        == 2
    )
    assert "has no `study`" in capsys.readouterr().err


def test_the_committed_baseline_is_of_the_committed_study():
    path = check.BASELINES / "regression.json"
    if not path.is_file():
        pytest.skip("no baseline is committed yet")
    baseline = read_record(path)
    assert all(row.mark == "as good" for row in compare_studies(baseline, baseline).rows)


# --- the rule, on whole studies drawn from a model (tests/validation/gate_power.py prints more of
# them) ---------------


def test_what_the_gate_sees_is_measured_on_studies_as_large_as_its_own(experiment):
    config = experiment.config
    size = Size()
    assert (config.study.boards, config.study.hole_free_boards) == (
        size.boards,
        size.hole_free_boards,
    )
    assert config.threshold.calibrate.boards == size.calibration_boards
    damages = [point.config.source.target.damage for point in experiment.points]
    assert {damage.per_board for damage in damages} == {size.holes}
    assert [damage.kind for damage in damages[::2]] == ["through", "blind"] and len(
        damages
    ) == size.set_ups


@pytest.mark.slow
def test_another_noise_seldom_fails_the_gate():
    """Of 150 checks with no cause no more than 6 (4 %) fail: were the rate 1 %, more would with
    probability 1e-3."""
    assert share(Size(set_ups=1), 150) <= 0.04


def test_the_gate_sees_what_it_is_for():
    """1.4 times the noise, a curve that is much flatter, and a threshold shifted either way. Of four
    sets of boards, the flatter curve is seen on three; on the other its p is 0.0011."""
    size = Size(set_ups=1)
    baseline = study(size, 2, 1)
    assert fails(baseline, study(size, 2, 2, Change(noise=1.4)))
    assert fails(baseline, study(size, 2, 2, Change(flatter=1.6)))
    assert fails(baseline, study(size, 2, 2, Change(bias=1.2)))
    assert fails(baseline, study(size, 2, 2, Change(bias=1 / 1.5)))


def test_a_check_that_could_not_fail_is_refused(capsys):
    """Before anything runs: with five boards even a loss on every one of them may be chance."""
    assert check.main([str(EXPERIMENT), "--set", "study.boards=5"]) == 2
    assert "at least 15 boards for 4 set-ups" in capsys.readouterr().err
