"""The table of whole jobs: rows are added one by one, and what is stored serves other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from tests.benchmarks import jobs, whole_jobs
from tests.benchmarks.jobs import Row, Runs, Spent

PLATE = Row(
    job="plate",
    measured="2026-11-30",
    code="12345678",
    before_measured="",
    before_s=None,
    before_renders_stored_s=None,
    before_all_stored_s=None,
    from_nothing_s=45.2,
    renders_stored_s=31.0,
    all_stored_s=2.5,
    wall_s=30.1,
)
NOW = Runs(
    Spent(processor_s=45.24, wall_s=30.06),
    Spent(processor_s=31.0, wall_s=20.0),
    Spent(processor_s=2.5, wall_s=2.4),
)


def test_a_row_replaces_that_of_the_same_job_and_keeps_the_others(tmp_path: Path):
    table = tmp_path / "other.csv"
    averaging = replace(PLATE, job="averaging", before_s=46.6, from_nothing_s=31.0)
    for row in (PLATE, replace(averaging, from_nothing_s=99.0), averaging):
        jobs.store(table, row)
    assert jobs.stored_rows(table, Row) == [averaging, PLATE]


def test_a_table_begins_with_the_quoted_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(jobs, "QUOTED", tmp_path)
    (tmp_path / "jobs.csv").write_text("job,from_nothing_s,wall_s\nplate,45.2,30.1\n")
    (row,) = jobs.stored_rows(tmp_path / "costs" / "jobs.csv", Row)
    assert (row.job, row.code, row.from_nothing_s, row.before_s) == ("plate", "", 45.2, None)


def test_seconds_are_those_of_a_run():
    row = jobs.row_of("plate", None, NOW, None)
    assert (row.before_s, row.before_measured) == (None, "")
    assert (row.from_nothing_s, row.renders_stored_s, row.all_stored_s) == (45.2, 31.0, 2.5)
    assert (row.wall_s, row.code) == (30.1, jobs.code_digest())
    once = jobs.row_of("tofpod ask", None, Runs(Spent(2.0, 3.0)), None)
    assert (once.from_nothing_s, once.renders_stored_s, once.all_stored_s) == (2.0, None, None)


def test_what_the_other_code_took_stays_until_it_is_measured_again():
    row = jobs.row_of("plate", NOW, NOW, None)
    assert (row.before_s, row.before_renders_stored_s, row.before_all_stored_s) == (45.2, 31.0, 2.5)
    old = replace(row, before_s=153.4, before_measured="2026-11-28")
    kept = jobs.row_of("plate", None, NOW, old)
    assert (kept.before_s, kept.before_measured) == (153.4, "2026-11-28")
    assert jobs.row_of("plate", NOW, NOW, old).before_s == 45.2


def test_a_job_is_measured_once_by_each_code():
    plate, smoke = whole_jobs.jobs_named(["plate", "smoke"])
    of_this_code = replace(PLATE, code=jobs.code_digest())
    assert jobs.left_to_measure([plate, smoke], [PLATE], again=False) == [plate, smoke]
    assert jobs.left_to_measure([plate, smoke], [of_this_code], again=False) == [smoke]
    assert jobs.left_to_measure([plate, smoke], [of_this_code], again=True) == [plate, smoke]


def test_a_job_without_trials_runs_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """One with trials runs three times; the second time, only its renders are there."""
    found = []

    def pretended(checkout: Path, words: list[str]) -> Spent:
        found.append(sorted(path.name for path in (tmp_path / "now").glob("*")))
        for folder in (".cache", "smoke"):
            (tmp_path / "now" / folder).mkdir(parents=True, exist_ok=True)
        return Spent(1.0, 1.0)

    monkeypatch.setattr(jobs, "run", pretended)
    smoke, ask = whole_jobs.jobs_named(["smoke", "ask"])
    runs = jobs.runs_of(smoke, tmp_path, jobs.folders_in(tmp_path), once=False)
    assert runs.all_stored is not None
    assert found == [[], [".cache"], [".cache", "smoke"]]
    found.clear()
    runs = jobs.runs_of(smoke, tmp_path, jobs.folders_in(tmp_path), once=True)
    assert runs.renders_stored is None
    assert found == [[]]
    found.clear()
    assert jobs.runs_of(ask, tmp_path, jobs.folders_in(tmp_path), once=False).renders_stored is None
    assert found == [[]]


def test_results_are_moved_in_place_of_earlier_ones(tmp_path: Path):
    made = tmp_path / "now"
    kept = tmp_path / "results"
    for folder, text in ((made, "new"), (kept, "old")):
        (folder / "smoke" / text).mkdir(parents=True)
        (folder / "smoke" / "latest").symlink_to(text)
        (folder / "smoke" / "table.csv").write_text(text)
    (kept / "plate").mkdir()
    whole_jobs.keep_results(made, kept)
    assert not made.exists()
    assert (kept / "smoke" / "table.csv").read_text() == "new"
    assert (kept / "smoke" / "latest").readlink() == Path("new")
    assert (kept / "smoke" / "old").exists() and (kept / "plate").exists()


def test_jobs_are_named_as_users_do():
    every = whole_jobs.jobs_named([])
    assert [job.name for job in whole_jobs.jobs_named(["check", "precise"])] == [
        "tofpod check",
        "precise",
    ]
    assert whole_jobs.TRAINED_ON not in {job.name for job in every}
    with pytest.raises(SystemExit, match=r"'plat' is no job; these are: anatomy, .*tofpod atlas"):
        whole_jobs.jobs_named(["plat"])
