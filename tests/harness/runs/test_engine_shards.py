"""Parts of a sweep, run by themselves and joined: the same bytes as in one go."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.programs.cluster import merge
from harness.runs.journal import Journal, record_text
from harness.runs.plan import SweepPlan, parts_of, plan_of
from harness.runs.shards import Shard, locked
from harness.vocabulary.errors import UserError
from tests.support.serial_run import run_serially, trial_count, trial_keys
from tests.support.tiny_sweep import TINY, content, results, sweep


@pytest.fixture
def home(study_out: Path) -> Path:
    """With a study of random boards and its run in one go."""
    return study_out.parent


def plan(home: Path) -> SweepPlan:
    return plan_of(load_experiment(home / "tiny.yaml"), home / "out" / ".cache" / "renders")


@pytest.mark.slow
def test_shards_on_machines_of_their_own_merge_to_the_same_bytes(home, tmp_path, capsys):
    """Two folders without a common file; merged, and the report written where no render is."""
    name = results(home / "out").name
    for number in (1, 2):
        shutil.copytree(home / "out" / ".cache", tmp_path / f"part{number}" / ".cache")
        done = sweep(home / "tiny.yaml", tmp_path / f"part{number}", "--shard", f"{number}/2")
        assert done.returncode == 0, done.stderr
        assert f"shard {number}/2: " in done.stdout
        assert not list((tmp_path / f"part{number}").glob("tiny/[0-9a-f]*/report.html"))
    parts = [str(tmp_path / f"part{number}" / "tiny" / name) for number in (1, 2)]
    into = tmp_path / "joined" / "tiny" / name
    assert merge.main([*parts, "--into", str(into)]) == 0
    assert f"--out {tmp_path / 'joined'}" in capsys.readouterr().out
    done = sweep(home / "tiny.yaml", tmp_path / "joined")
    assert done.returncode == 0, done.stderr
    assert content(into) == content(results(home / "out"))


def test_shards_with_a_common_folder_share_the_calibration(home, tmp_path):
    """One after the other: none runs what another has run, and together they are all."""
    study = plan(home)
    counts = [run_serially(study, tmp_path, shard=Shard(number, 3)).trials for number in (3, 1, 2)]
    assert [count.failed for count in counts] == [0, 0, 0]
    assert sum(count.done for count in counts) == trial_count(study)
    complete = run_serially(study, tmp_path)
    assert (complete.trials.done, complete.trials.found) == (0, trial_count(study))


def test_a_shard_takes_the_calibration_that_is_merged_into_its_folder(home, tmp_path):
    """The second shard of two without a common folder runs no calibrating trial, and judges by the
    same thresholds."""
    study = plan(home)
    first = run_serially(study, tmp_path / "part1", shard=Shard(1, 2))
    merge.merge_into(Journal(tmp_path / "part2"), Journal(tmp_path / "part1"), Counter())
    second = run_serially(study, tmp_path / "part2", shard=Shard(2, 2))
    assert second.thresholds == first.thresholds
    assert first.trials.done + second.trials.done == trial_count(study) and second.trials.found > 0


@pytest.mark.parametrize("count", [1, 2, 3, 7, 40])
def test_every_judged_trial_belongs_to_one_shard(home, count):
    study = plan(home)
    observed: list[tuple[int, int, int]] = []
    for number in range(1, count + 1):
        first, then = parts_of(study, Shard(number, count))
        for parts in then:
            observed += [
                (id(part.batch), part.group, repeat) for part in parts for repeat in part.repeats
            ]
        for group, parts in enumerate(first):
            assert bool(parts) == bool(then[group]), (
                "a shard calibrates what it judges, and nothing else"
            )
    assert len(observed) == len(set(observed))
    assert len(observed) == sum(g.most_repeats(b) for g in study.groups for b in g.then)


def test_a_shard_renders_only_what_it_needs(home):
    study = plan(home)
    first, then = parts_of(study, Shard(1, 4))
    _, all_then = parts_of(study, Shard(1, 1))
    own_rows = {path for parts in (*first, *then) for part in parts for path in part.batch.paths}
    judged = {path for parts in all_then for part in parts for path in part.batch.paths}
    assert judged - own_rows


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "a/b", "-1/3", "1/0", "1/3/5", "1/100001"])
def test_shards_that_are_no_part_are_refused(text):
    with pytest.raises(UserError, match="is not a part"):
        Shard.of(text)


def test_the_same_shard_twice_or_beside_a_whole_sweep_is_refused(tmp_path):
    with locked(tmp_path, Shard(1, 3)):
        with locked(tmp_path, Shard(2, 3)):
            pass
        for other_shard in (Shard(1, 3), Shard(1, 1)):
            with (
                pytest.raises(UserError, match="another sweep is running"),
                locked(tmp_path, other_shard),
            ):
                pass
    with locked(tmp_path):
        pass


# ---- merging
# ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def two(home, tmp_path) -> tuple[Path, Path]:
    """A finished folder, and where to merge into."""
    complete = results(home / "out")
    shutil.copytree(complete, tmp_path / "a" / "tiny" / complete.name)
    return tmp_path / "a" / "tiny" / complete.name, tmp_path / "b" / "tiny" / complete.name


def test_merging_twice_copies_once(two, capsys):
    other_folder, into = two
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    count = len(Journal(other_folder / "journal"))
    assert f"{count} trials copied, 0 were already there" in capsys.readouterr().out
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    assert f"0 trials copied, {count} were already there" in capsys.readouterr().out
    assert not [path for path in into.rglob("*.part*")]


def test_what_is_done_takes_the_place_of_what_is_not(two):
    from harness.runs.jobs import Ended

    other_folder, into = two
    keys = trial_keys(Journal(other_folder / "journal"))
    Journal(into / "journal").write(
        keys[0], Ended("crashed", why="its process was ended by SIGKILL")
    )
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    entry = Journal(into / "journal").read(keys[0])
    assert entry is not None and entry.state == "done"


def test_different_results_for_one_trial_are_told(two, capsys):
    from dataclasses import replace

    other_folder, into = two
    journal = Journal(other_folder / "journal")
    key = next(key for key in trial_keys(journal) if key.startswith("damaged"))
    entry = journal.read(key)
    assert entry is not None and entry.record is not None
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    slower = {
        **entry.record,
        "runs": [{**run, "seconds_detect": 9.0} for run in entry.record["runs"]],
    }
    journal.write(key, replace(entry, value=record_text(slower)))
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    changed = {**entry.record, "runs": [{**run, "detections": 99} for run in entry.record["runs"]]}
    journal.write(key, replace(entry, value=record_text(changed)))
    assert merge.main([str(other_folder), "--into", str(into)]) == 1
    assert "1 trials have different results" in capsys.readouterr().err


def test_mistakes_in_merging(two, tmp_path, capsys):
    other_folder, into = two
    (tmp_path / "empty").mkdir()
    stranger = tmp_path / "c" / "tiny" / "0123456789abcdef"
    shutil.copytree(other_folder, stranger)
    for arguments, printed in (
        ([str(tmp_path / "empty"), "--into", str(into)], "has no journal"),
        ([str(other_folder), "--into", str(other_folder)], "is the folder to merge into"),
        ([str(other_folder), str(stranger), "--into", str(into)], "different experiments"),
        (
            [str(other_folder), "--into", str(tmp_path / "elsewhere")],
            "must be in a folder of that name",
        ),
    ):
        assert merge.main(arguments) == 2
        assert printed in capsys.readouterr().err
    assert not into.exists()


def test_an_experiment_that_is_no_utf8_is_copied_as_it_is(two):
    """The sweep that reads it says what is wrong with it."""
    other_folder, into = two
    (other_folder / "experiment.yaml").write_bytes(b"# tofpod experiment 1\nname: \xff\n")
    assert merge.main([str(other_folder), "--into", str(into)]) == 0
    assert (into / "experiment.yaml").read_bytes() == (
        other_folder / "experiment.yaml"
    ).read_bytes()


def test_a_shard_of_the_thesis_target(tmp_path):
    """Not a study: repeats of one board are what is shared out."""
    (tmp_path / "tiny.yaml").write_text(TINY)
    tiny = plan_of(load_experiment(tmp_path / "tiny.yaml", ["repeats=5"]), tmp_path)
    split = [parts_of(tiny, Shard(number, 2))[1][0][0].repeats for number in (1, 2)]
    assert split == [range(2), range(2, 5)]
