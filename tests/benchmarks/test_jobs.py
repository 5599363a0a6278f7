"""The table of whole experiments is added to, row by row."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tests.benchmarks import jobs


def test_a_row_replaces_that_of_the_same_experiment_and_keeps_the_others(tmp_path: Path):
    table = tmp_path / "jobs.csv"
    plate = jobs.Row(
        experiment="plate",
        before_s=None,
        before_renders_stored_s=None,
        before_all_stored_s=None,
        from_nothing_s=45.2,
        renders_stored_s=31.0,
        all_stored_s=2.5,
        wall_s=30.1,
    )
    averaging = replace(plate, experiment="averaging", before_s=46.6, from_nothing_s=31.0)
    for row in (plate, replace(averaging, from_nothing_s=99.0), averaging):
        jobs.store(table, row)
    assert jobs.stored_rows(table) == [averaging, plate]


def test_seconds_are_those_of_a_run():
    first = jobs.Spent(processor_s=45.24, wall_s=30.06)
    renders_stored = jobs.Spent(processor_s=31.0, wall_s=20.0)
    all_stored = jobs.Spent(processor_s=2.5, wall_s=2.4)
    now = jobs.Runs(first, renders_stored, all_stored)
    row = jobs.row_of("plate", None, now)
    assert row.before_s is None
    assert (row.from_nothing_s, row.renders_stored_s, row.all_stored_s) == (45.2, 31.0, 2.5)
    assert row.wall_s == 30.1
    row = jobs.row_of("plate", now, now)
    assert (row.before_s, row.before_renders_stored_s, row.before_all_stored_s) == (45.2, 31.0, 2.5)
