"""Studies with unknowns through the engine: what is recorded, and the same numbers however run."""

from __future__ import annotations

import shutil

import pandas as pd
import pytest

from harness.evaluation.study.record import read_record
from harness.experiment.unknowns import UnknownConfig
from tests.support.tiny_sweep import STUDY, content, finished, results, sweep

UNKNOWN_YAML = """\
unknowns:
- {key: source.target.backing, values: [{distance_mm: 20.0}, null], reason: not seen}
- {key: source.camera.numbers.scatter.blur_px, range: [0.3, 0.6], reason: not published}
"""
TEXT = STUDY.replace("study: {boards: 4,", "study: {boards: 12,") + UNKNOWN_YAML


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("serial"), TEXT, "--serial")


def test_the_record_holds_what_each_board_had(serial):
    stated, _, drawn, _ = read_record(results(serial)).set_ups
    assert stated.drawn == ()
    backing, blur = drawn.drawn
    unknown = UnknownConfig(key=blur.key, range=(0.3, 0.6), reason="r")
    assert blur.level.tolist() == [unknown.drawn(3, "damaged", board) for board in range(12)]
    assert sorted(backing.level.tolist()) == [0.0] * 6 + [1.0] * 6
    assert blur.board.tolist() == list(range(12))
    assert blur.stated is not None and backing.stated["distance_mm"] == 20.0
    # the same holes in the same places, before the same number of boards
    assert drawn.inspected.x_mm.tolist() == stated.inspected.x_mm.tolist()
    assert drawn.calibration_runs == stated.calibration_runs == 5
    assert drawn.frames_digest != stated.frames_digest


def test_the_table_and_the_page_state_the_unknowns(serial):
    table = pd.read_csv(results(serial) / "unknowns.csv")
    assert len(table) == 2 * 4 and set(table["frames"]) == {1, 2}
    limits = pd.read_csv(results(serial) / "limits.csv")
    assert limits["unknowns"].tolist() == ["stated", "stated", "drawn", "drawn"]
    page = (results(serial) / "report.html").read_text()
    assert "What nobody has measured" in page and "tornado-1" in page


def test_shards_of_a_study_with_unknowns_join_to_the_same_bytes(serial, tmp_path):
    """Two parts in a common folder, which has the renders already."""
    (tmp_path / "tiny.yaml").write_text(TEXT)
    out = tmp_path / "out"
    shutil.copytree(results(serial).parents[1] / ".cache", out / ".cache")
    for number in (1, 2):
        done = sweep(tmp_path / "tiny.yaml", out, "--shard", f"{number}/2", "--serial")
        assert done.returncode == 0, done.stderr
    joined = sweep(tmp_path / "tiny.yaml", out, "--serial")
    assert joined.returncode == 0, joined.stderr
    assert content(results(out)) == content(results(serial))


def test_processes_and_a_second_run_give_the_same_numbers(serial, tmp_path):
    parallel = finished(tmp_path, TEXT, "--jobs", "2")
    assert content(results(parallel)) == content(results(serial))
    (results(parallel) / "written.json").unlink()
    again = sweep(tmp_path / "tiny.yaml", tmp_path / "out")
    assert again.returncode == 0
    assert content(results(parallel)) == content(results(serial))
