"""Parts of a study: renders, frames and trials of boards of `experiments/detection_limit.yaml`, and
how the cost of trials grows.

Trials see a board of 30,000 pixels with direct light only, because the time of a trial does not
depend on how its view was rendered.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.measuring import ROOT, Work, median_s, processor_s
from tests.benchmarks.peers import noisy_board

STUDY = ROOT / "experiments" / "detection_limit.yaml"
OVERRIDES = (
    "sweep={}",
    "capture.frames=50",
    "study.hole_free_boards=1",
    "source.target.distance_m=0.785",
    "source.render.bounces=0",
    "threshold={k: 5.0}",
    "unknowns=[]",
)
"""A set-up of the study that needs no calibration, so far away that its board has 30,000 pixels."""
CAMERAS = ("azure_kinect_nfov", "kinect_v2", "realsense_l515")
"""The three of the thesis: two that modulate their light, and a scanner."""
DETECTORS: Mapping[str, Sequence[str]] = {
    "thesis": (),
    "local": ("detector={name: local, settings: {crop: {kind: auto, inset_px: 4}}}",),
}
"""Overrides by detector. Of those that learn nothing, as what `matched` has learned comes from
boards of its own."""


@dataclass(frozen=True)
class StepRow:
    """What a part of a study costs."""

    step: str
    """The part."""
    ms: float
    """Processor time, in milliseconds."""
    a_second: float
    """How many a second one core does."""


@dataclass(frozen=True)
class GrowthRow:
    """How a cost grows with a size."""

    size: str
    """What grows."""
    exponent: float
    """The cost grows as the size to this power: the slope of the logarithms."""
    smallest: float
    """The smallest size measured."""
    smallest_ms: float
    """Its processor time, in milliseconds."""
    largest: float
    """The largest size measured."""
    largest_ms: float
    """Its processor time, in milliseconds."""


def step_row(step: str, seconds: float) -> StepRow:
    """Return the row of a part that takes so many seconds of processor time."""
    return StepRow(step=step, ms=round(1e3 * seconds, 3), a_second=round(1 / seconds, 2))


def rendered_boards(runs: int) -> Iterator[StepRow]:
    """Render boards, meshes included, by the board's damage."""
    import drjit

    from harness.experiment.load import load_experiment
    from harness.runs.plan import plan_of
    from scenes.render.view import render_view
    from scenes.sensor.camera import camera_of
    from scenes.target.mesh import build_target

    plan = plan_of(load_experiment(STUDY, ["unknowns=[]"]), Path())
    jobs_by_damage: dict[str, list[Any]] = {}
    for group in plan.groups:
        for batch in group.batches:
            job = batch.renders[0]
            holes = job.target.holes
            damage = f"with {len(holes)} {holes[0].kind} holes" if holes else "without holes"
            jobs_by_damage.setdefault(damage, []).append(job)

    def render(job: Any) -> None:
        render_view(build_target(job.target), camera_of(job.camera).optics, job.config)

    for jobs in jobs_by_damage.values():
        render(jobs[0])  # compiles its kernels, on all cores
    drjit.set_thread_count(1)
    for damage, jobs in jobs_by_damage.items():
        chosen = jobs[:: max(1, len(jobs) // runs)][:runs]
        times_s = [processor_s(partial(render, job)) for job in chosen]
        yield step_row(f"render of a board {damage}", float(np.median(times_s)))


def trials_of(folder: Path, draws: int, *overrides: str, boards: int = 1) -> list[Any]:
    """Return ``draws`` trials of each of the study's damaged boards, with their views rendered into
    a folder."""
    from harness.experiment.load import load_experiment
    from harness.runs.plan import plan_of
    from scenes.render.cache import cached_view
    from scenes.sensor.camera import camera_of

    experiment = load_experiment(STUDY, [*OVERRIDES, f"study.boards={boards}", *overrides])
    group = plan_of(experiment, folder).groups[0]
    damaged = [batch for batch in group.batches if batch.role == "damaged"]
    for batch in damaged:
        for job in batch.renders:
            cached_view(job.target, camera_of(job.camera).optics, job.config, job.folder)
    firsts = [next(group.trials(batch, {}))[1] for batch in damaged]
    return [replace(trial, repeat=draw) for draw in range(draws) for trial in firsts]


def run_all(trials: Sequence[Any]) -> None:
    """Run trials."""
    from harness.trials.trial import run_trial

    for trial in trials:
        run_trial(trial)


def frames(runs: int) -> Iterator[StepRow]:
    """Draw frames of a board with eight holes, 50 at a time, by camera."""
    from harness.trials.board import load_board

    with tempfile.TemporaryDirectory() as folder:
        for camera in CAMERAS:
            trial = trials_of(Path(folder), 1, f"source.camera.name={camera}")[0]
            unit = load_board(trial.views[0]).unit

            def draw(unit: Any = unit) -> None:
                for _ in unit.capture(50, 1).frames():
                    pass

            seconds = median_s(draw, runs) / 50 * 30_000 / unit.region.area
            yield step_row(f"frame of 30,000 pixels, {unit.camera.title}", seconds)


def new_boards(runs: int) -> Iterator[StepRow]:
    """Judge new boards of which the views are rendered, by detector. A study draws each board once:
    what a process keeps of a board for its further trials does not count. Views are loaded, 50
    frames drawn, averaged, cropped and fitted; findings are sized and matched; rows are made."""
    with tempfile.TemporaryDirectory() as folder:
        for detector, overrides in DETECTORS.items():
            trials = trials_of(Path(folder), 1, *overrides, boards=2 * runs + 1)
            run_all(trials[:1])
            times_s = [processor_s(partial(run_all, [trial])) for trial in trials[1:]]
            yield step_row(f"new board with eight holes, `{detector}`", float(np.median(times_s)))


STEPS = (rendered_boards, frames, new_boards)
"""Parts, in the order of a study."""


def growth_row(size: str, works: Mapping[float, Work], runs: int) -> GrowthRow:
    """Return how the cost of works grows with their sizes."""
    times_s = {value: median_s(work, runs) for value, work in works.items()}
    slope = np.polyfit(np.log(list(times_s)), np.log(list(times_s.values())), 1)[0]
    smallest = min(times_s)
    largest = max(times_s)
    return GrowthRow(
        size=size,
        exponent=round(float(slope), 2),
        smallest=smallest,
        smallest_ms=round(1e3 * times_s[smallest], 1),
        largest=largest,
        largest_ms=round(1e3 * times_s[largest], 1),
    )


def growth(runs: int) -> Iterator[GrowthRow]:
    """Measure how the cost grows with pixels, frames, holes and boards."""
    by_pixels = {pixels: analysis_of(pixels) for pixels in (10_000, 40_000, 160_000)}
    yield growth_row("pixels, `thesis` without crop", by_pixels, runs)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)

        def trial_with(*overrides: str, boards: int = 1) -> Work:
            return partial(run_all, trials_of(folder, 1, *overrides, boards=boards))

        by_frames = {n: trial_with(f"capture.frames={n}") for n in (25, 50, 100, 200)}
        yield growth_row("frames, trials", by_frames, runs)
        damage = "{{kind: through, per_board: {}, diameter_mm: [4.0, 8.0]}}"
        by_holes = {n: trial_with(f"source.target.damage={damage.format(n)}") for n in (1, 2, 4, 8)}
        yield growth_row("holes, trials", by_holes, runs)
        by_boards = {n: trial_with(boards=n) for n in (1, 2, 4)}
        yield growth_row("boards, trials", by_boards, max(3, runs // 3))


def analysis_of(pixels: int) -> Work:
    """Return the work of analysing a cloud and finding damage in it, by `thesis`."""
    from detectors import load_detector
    from harness.vocabulary.geometry import Cloud, Region

    points_m = noisy_board(pixels)
    shape = points_m.shape[:2]
    cloud = Cloud(
        points_m,
        np.zeros(shape, np.uint8),
        np.ones(shape, np.uint8),
        np.full(shape, np.nan),
        Region(0, shape[0], 0, shape[1]),
        0.0,
        1,
    )
    detector = load_detector("thesis", {"crop": {"kind": "none"}})
    return lambda: detector.find(cloud, detector.analyse(cloud), 6.0)


def trials_a_second(trials: Sequence[Any]) -> float:
    """Return the trials a second of this process when it is warm, by the wall clock."""
    run_all(trials[:2])
    began = time.perf_counter()
    run_all(trials)
    return len(trials) / (time.perf_counter() - began)


def gain_of_a_second_process(runs: int) -> float:
    """Return how many times the trials of one process two do, by the wall clock."""
    context = multiprocessing.get_context("spawn")
    rates = []
    with tempfile.TemporaryDirectory() as folder:
        trials = trials_of(Path(folder), 20 * runs)
        for workers in (1, 2):
            with ProcessPoolExecutor(workers, mp_context=context) as pool:
                rates.append(sum(pool.map(trials_a_second, [trials] * workers)))
    return rates[1] / rates[0]
