"""What a dry run says: counts of what a sweep consists of."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.experiment.schema import Experiment
from harness.runs.estimate import dry_run
from harness.runs.jobs import Ended
from harness.runs.journal import Journal
from harness.runs.options import EngineOptions
from harness.runs.plan import plan_of
from harness.runs.shards import Shard

EXPERIMENTS = Path(__file__).resolve().parents[3] / "experiments"
STUDY = [
    "study.boards=3",
    "study.hole_free_boards=2",
    "threshold.calibrate.boards=20",
    "sweep={capture.frames: [1, 50]}",
    "unknowns=[]",
]


def lines(
    experiment: Experiment,
    out: Path,
    capsys: pytest.CaptureFixture[str],
    shard: Shard | None = None,
) -> list[str]:
    assert dry_run(experiment, out, EngineOptions(shard=shard or Shard())) == 0
    return capsys.readouterr().out.splitlines()


def test_the_dry_run_counts_and_writes_nothing(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "smoke.yaml", [])
    printed = lines(experiment, tmp_path / "out", capsys)
    assert not (tmp_path / "out").exists()
    assert printed[0] == "smoke: valid" and str(experiment.folder(tmp_path / "out")) in printed[-1]
    assert printed[2:4] == ["  renders: 3, 0 of them cached", "  trials: 12"]


def test_cached_renders_and_recorded_trials_are_told(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "smoke.yaml", [])
    first, *_ = plan_of(experiment, tmp_path / ".cache" / "renders").renders
    first.path.parent.mkdir(parents=True)
    first.path.touch()
    Journal(experiment.folder(tmp_path) / "journal").write(
        "damaged-1", Ended("done", '{"runs": []}')
    )
    printed = lines(experiment, tmp_path, capsys)
    assert printed[2] == "  renders: 3, 1 of them cached"
    assert "the journal holds 1 trial;" in printed[4]


def test_shards_share_the_trials(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "detection_limit.yaml", STUDY)
    counts = [
        int(lines(experiment, tmp_path, capsys, Shard(number, count))[3].rsplit(" ", 1)[-1])
        for number, count in ((1, 1), (1, 3), (2, 3), (3, 3))
    ]
    assert counts[0] == 25 and sum(count - 20 for count in counts[1:]) == 5
