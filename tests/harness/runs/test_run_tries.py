"""How often work is begun whose process dies."""

from collections import Counter
from pathlib import Path

from harness.experiment.load import load_experiment
from harness.runs.jobs import Ended, Job, Stage
from harness.runs.journal import Journal
from harness.runs.plan import plan_of
from harness.runs.run import run_plan
from tests.support.tiny_sweep import TINY


class DyingEngine:
    """An engine in which the process of every job dies. It counts how often a job was begun."""

    def __init__(self) -> None:
        self.begun: Counter[tuple[Stage, str]] = Counter()
        self._running: list[Job] = []

    def __enter__(self) -> "DyingEngine":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def room(self, stage: Stage) -> int:
        return 1 - len(self._running)

    def submit(self, job: Job) -> None:
        self.begun[job.stage, job.name] += 1
        self._running.append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        jobs, self._running = self._running, []
        return [(job, Ended("crashed", why="killed by SIGSEGV")) for job in jobs]


def test_a_render_whose_process_always_dies_is_begun_twice_and_its_trials_are_skipped(
    tmp_path: Path,
):
    (tmp_path / "tiny.yaml").write_text(TINY)
    plan = plan_of(load_experiment(tmp_path / "tiny.yaml"), tmp_path / "renders")
    engine = DyingEngine()
    outcome = run_plan(plan, Journal(tmp_path / "journal"), engine, lambda _: None)
    hole_free_view = plan.groups[0].first[0].renders[0].path.name
    assert engine.begun == {("renders", hole_free_view): 2}, "without thresholds nothing is judged"
    assert outcome.finished == []
    assert outcome.renders.failed == 1
    assert {failure.state for failure in outcome.failures} == {"crashed", "skipped", "failed"}
