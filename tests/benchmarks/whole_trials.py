"""Trials of a detection-limit study on one core: how many a second, where their time goes, how much memory they take.

The study is experiments/detection_limit.yaml, with its board so far away that the simulated region has some 30,000
pixels and with direct light only: the time of a trial does not depend on how its view was rendered.
"""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from clocks import Stage, StageClock, Times, in_turns, spent

from detectors import thesis
from detectors.average import AverageConfig, FrameSums, prefix_averages
from detectors.score_map import ScoreMapDetector
from harness.engine import trial
from harness.engine.plan import Group, RenderJob, plan_of
from harness.engine.setup import load_set_up
from harness.engine.trial import Role, TrialTask, run_trial
from harness.experiment.load import load_experiment
from harness.experiment.schema import CaptureConfig
from scenes.sensor.amcw import imager
from scenes.sensor.source import SimulatedUnit

ROOT = Path(__file__).resolve().parents[2]
STUDY = ROOT / "experiments" / "detection_limit.yaml"
FRAMES = 50
OVERRIDES = (
    "sweep={}",
    f"capture.frames={FRAMES}",
    "study.boards=1",
    "study.hole_free_boards=1",
    "source.target.distance_m=0.785",
    "source.render.bounces=0",
)
AT_ONCE = "exact" in CaptureConfig.model_fields
"""Whether averages can be drawn at once."""
ROLES: tuple[Role, ...] = ("damaged", "hole_free", "calibration")


def ways() -> dict[str, tuple[str, ...]]:
    """How averages are made: what the tables call it, and what an experiment says."""
    if not AT_ONCE:
        return {"frame by frame": ()}
    return {"frame by frame": ("capture.exact=true",), "drawn at once": ("capture.exact=false",)}


def group_of(cache: Path, *overrides: str) -> Group:
    """The study's one set-up, its views in the cache."""
    group = plan_of(load_experiment(STUDY, [*OVERRIDES, *overrides]), cache).groups[0]
    batches = [next(batch for batch in group.batches if batch.role == role) for role in ROLES]
    render([job for batch in batches for job in batch.renders])
    return group


def render(jobs: list[RenderJob]) -> None:
    """Put views into the cache, in another process: this one stays without Mitsuba, as workers do."""
    missing = [job for job in jobs if not job.path.exists()]
    if missing:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            list(pool.map(_render, missing))


def _render(job: RenderJob) -> None:
    from scenes.render.cache import cached_view
    from scenes.sensor.camera import camera_of

    cached_view(job.target, camera_of(job.camera).optics, job.config, job.folder)


@dataclass(frozen=True)
class Trials:
    """The trials of one group, by role; ``threshold`` as some of its hole-free boards set it."""

    group: Group
    threshold: float

    @classmethod
    def of(cls, group: Group, draws: int = 5) -> Trials:
        """With the highest quiet threshold of so many draws of one hole-free board."""
        quiet = [run_trial(task)["runs"][0]["quiet_threshold"] for task in tasks(group, "calibration", None, draws)]
        return cls(group, max(quiet))

    def tasks(self, role: Role, count: int) -> list[TrialTask]:
        """So many draws of noise on the first board of a role."""
        return tasks(self.group, role, None if role == "calibration" else self.threshold, count)

    @property
    def unit(self) -> SimulatedUnit:
        """The camera before the first damaged board."""
        return load_set_up(self.group.damaged.set_ups[0]).unit


def tasks(group: Group, role: Role, threshold: float | None, count: int) -> list[TrialTask]:
    """So many draws of noise on the first board of a role, judged at a threshold or setting it."""
    batch = next(batch for batch in group.batches if batch.role == role)
    thresholds = {} if threshold is None else {point.digest: threshold for point in group.points}
    # a calibration board has one trial; here it gets as many draws of noise as are asked for
    _, first = next(group.trials(batch, thresholds))
    return [replace(first, repeat=number) for number in range(count)]


# ---------------------------------------------------------------- rates


def trial_times(given: list[TrialTask]) -> Times:
    """Seconds of a trial, after three to warm up."""
    for task in given[:3]:
        run_trial(task)
    return Times.of([spent(partial(run_trial, task)) for task in given[3:]])


def frame_times(unit: SimulatedUnit, runs: int) -> dict[str, Times]:
    """Seconds of a frame: simulated alone, and simulated and averaged; each run is a capture of `FRAMES`."""
    capture = unit.capture(FRAMES, 1)

    def drawn() -> None:
        for _ in capture.frames():
            pass

    def averaged() -> None:
        prefix_averages(capture, [FRAMES], AverageConfig())

    return in_turns({"simulated": drawn, "simulated and averaged": averaged}, runs, FRAMES)


# ---------------------------------------------------------------- shares


def stages() -> list[Stage]:
    """What a trial's time is split into. "averages, other" is what drawing them spends outside of the stages before it:
    all of it where they are drawn at once."""
    return [
        Stage("draw noise", imager, "standard_normals"),
        Stage("expose", imager.AmcwImager, "phasors"),
        Stage("filter", imager.AmcwImager, "filter"),
        Stage("range and gates", imager.AmcwImager, "_decode"),
        Stage("average", FrameSums, "take"),
        Stage("average", FrameSums, "cloud"),
        Stage("averages, other", trial, "_clouds"),
        Stage("crop", thesis, "crop"),
        Stage("fit", thesis, "fit_surface"),
        Stage("scores", thesis.ThesisDetector, "analyse"),
        Stage("quiet threshold", ScoreMapDetector, "quiet_threshold"),
        Stage("find", ScoreMapDetector, "find"),
        Stage("measure", ScoreMapDetector, "measure"),
        Stage("judge", trial, "judge"),
        Stage("the study's rows", trial, "study_rows", whole=True),
    ]


def shares(given: list[TrialTask]) -> dict[str, float]:
    """Processor's seconds a trial by stage, in the order of `stages`; "trial, other" is what is left."""
    for task in given[:2]:
        run_trial(task)
    clock = StageClock()
    with clock.on(stages()):
        whole = [spent(partial(run_trial, task))[1] for task in given]
    found = {stage.label: clock.seconds[stage.label] / len(given) for stage in stages()}
    return found | {"trial, other": (sum(whole) - sum(clock.seconds.values())) / len(given)}


# ---------------------------------------------------------------- memory


def peak_mb(given: list[TrialTask]) -> float:
    """Resident memory at most, MB, of a fresh process that has run these trials; 0 where the system does not tell."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak_mb_after, given).result()


def _peak_mb_after(given: list[TrialTask]) -> float:
    for task in given:
        run_trial(task)
    # not getrusage: what a child is told there includes its parent's memory at the start
    high = [line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    return int(high[0]) * 1024 / 1e6 if high else 0.0
