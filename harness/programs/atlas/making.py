"""Makes shards of the atlas: runs the parts of a camera, and fits the laws that `tofpod ask`
needs. The trials of a part are kept in its journal, so that a shard resumes; no limits, tables or
pages of parts are made."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from detectors import detector_type
from harness.experiment.digests import experiment_digests
from harness.experiment.load import load_experiment, resolved_yaml
from harness.experiment.schema import Experiment
from harness.programs.atlas.age import LAW, sources_digest
from harness.programs.atlas.fitting import Sites, fitted
from harness.programs.atlas.limits import FailedSetUp, PlaneNoise
from harness.programs.atlas.parts import DEPTHS_MM, EXPERIMENT, Part
from harness.programs.atlas.shards import measured_noise, parts_of, sites_of
from harness.programs.atlas.stored import CameraLimits, KindLimits, SetUp
from harness.records.outputs import EXPERIMENT as EXPERIMENT_FILE
from harness.records.outputs import PROVENANCE
from harness.report.blocks import BILL
from harness.runs.bill import Bill, Metered
from harness.runs.estimate import progress_display
from harness.runs.jobs import JobEngine, Outcome
from harness.runs.journal import Journal
from harness.runs.plan import plan_of
from harness.runs.run import run_plan
from harness.runs.shards import locked
from harness.runs.tables import tables_of
from harness.vocabulary.code_digests import Digests, file_digests
from harness.vocabulary.errors import DiskFull, UserError
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.seeds import digest
from scenes.render.cache import in_use
from scenes.sensor.camera import guessed_precision, load_camera

DETECTOR = "matched"
"""The experiment's detector, whose code worker processes load."""
OF_A_PART = f"experiment {EXPERIMENT}"
KEPT = ("commit", "dirty", "versions")
"""What a shard keeps of a run's provenance."""


class Work(NamedTuple):
    """The amount of work of a camera."""

    parts: int
    """Number of parts."""
    renders: int
    """Number of views."""
    trials: int
    """Number of trials."""


class Planned:
    """The work on one camera: its noise, and an experiment for each part."""

    def __init__(self, names: Sequence[str]) -> None:
        """``names``: the camera and its twins."""
        self.names = tuple(names)
        self.noise: PlaneNoise = measured_noise(names[0])
        self.parts: list[Part] = parts_of(names[0], self.noise)
        self.experiments: list[Experiment] = [
            load_experiment(Path(EXPERIMENT), part.overrides) for part in self.parts
        ]

    @property
    def camera(self) -> str:
        """The camera that is simulated."""
        return self.names[0]

    @property
    def digests(self) -> Digests:
        """Digests of all that the shard hangs on: code, the camera's numbers, its experiments."""
        if not self.experiments:  # no part: only the camera's numbers decide
            return experiment_digests(
                load_experiment(Path(EXPERIMENT), [f"source.camera.name={self.camera}"])
            )
        parts = [experiment_digests(experiment) for experiment in self.experiments]
        digests = parts[0] | file_digests(LAW)
        digests[OF_A_PART] = digest([part[OF_A_PART] for part in parts])
        return digests

    def work(self, out: Path) -> Work:
        """Return the amount of work."""
        renders = 0
        trials = 0
        for experiment in self.experiments:
            plan = plan_of(experiment, renders_of(out))
            renders += len(plan.renders)
            for group in plan.groups:
                trials += sum(group.most_repeats(batch) for batch in group.batches)
        return Work(parts=len(self.parts), renders=renders, trials=trials)

    def made(
        self, out: Path, engine: JobEngine, command: str, *, retry_failed: bool = False
    ) -> CameraLimits:
        """Run all parts and return the shard. What a part cannot do is said in the shard."""
        digests = self.digests
        origin = record(command)
        problems: list[str] = []
        tables: list[tuple[Part, pd.DataFrame]] = []
        if not self.parts:
            problems.append("gives no depth of any board between the ends of its range")
        failed: list[FailedSetUp] = []
        for part, experiment in zip(self.parts, self.experiments, strict=True):
            try:
                holes, why = judged(experiment, out, engine, origin, retry_failed=retry_failed)
            except DiskFull:
                raise
            except UserError as error:
                holes, why = None, error.message
            if holes is not None:
                tables.append((part, holes))
            for frames in part.frames:
                if holes is None or frames not in set(holes["frames"]):
                    failed.append(FailedSetUp(part.distance_m, part.albedo, frames))
            if why:
                problems.append(f"at {part.distance_m:g} m, albedo {part.albedo:g}: {why}")
        config = load_experiment(Path(EXPERIMENT)).config
        about: dict[str, Any] = {name: origin[name] for name in KEPT}
        about |= {
            "digests": digests,
            "sources": sources_digest(),
            "detector": config.detector.name,
            "detector_version": int(detector_type(config.detector.name).version),
            "focal_px": float(load_camera(self.camera).nominal_lens.fx),
            "thickness_mm": float(config.source.to_data()["target"]["board"]["thickness_mm"]),
        }
        names = {name: Path(name).stem for name in self.names}
        return CameraLimits(
            camera=names[self.camera],
            titles={names[name]: load_camera(name).title for name in self.names},
            warning=guessed_precision(load_camera(self.camera)),
            about=about,
            problems=tuple(problems),
            failed=tuple(failed),
            noise=self.noise,
            kinds=limits_of(tables, self.noise),
        )


def renders_of(out: Path) -> Path:
    """Return the cache of renders of a folder of results."""
    return (out / ".cache" / "renders").absolute()


def judged(
    experiment: Experiment,
    out: Path,
    engine: JobEngine,
    origin: Mapping[str, Any],
    *,
    retry_failed: bool,
) -> tuple[pd.DataFrame | None, str]:
    """Run what the journal lacks of a part. Return its table of damages, None if no damage was
    judged, and why something is missing, if it is."""
    bill = Bill()
    bill.begin("plan")
    folder = experiment.folder(out)
    cache = renders_of(out)
    journal = Journal(folder / "journal")
    plan = plan_of(experiment, cache, folder.absolute())
    write_text(folder / EXPERIMENT_FILE.name, resolved_yaml(experiment))
    with in_use(cache), locked(folder), progress_display() as report:
        bill.begin("detection")
        metered = Metered(engine, bill)
        outcome = run_plan(plan, journal, metered, report, retry_failed=retry_failed)
    bill.begin("statistics")
    tables = tables_of(journal.records(outcome.finished), experiment)
    provenance = {
        "results_version": RESULTS_VERSION,
        **origin,
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        BILL: bill.rounded(),
        "renders": {"done": outcome.renders.done},
        "trials": {"done": outcome.trials.done},
    }
    if outcome.trials.done:  # a part that was there costs nothing, and tells nothing of the bill
        write_json(folder / PROVENANCE.name, provenance)
    return None if tables.holes.empty else tables.holes, _why(outcome)


def _why(outcome: Outcome) -> str:
    """Return why trials failed, in short; empty if all was done."""
    reasons = {failure.in_short for failure in outcome.failures if failure.state != "skipped"}
    return "; ".join(sorted(reasons)[:2])


def limits_of(
    tables: Sequence[tuple[Part, pd.DataFrame]], noise: PlaneNoise
) -> dict[str, KindLimits]:
    """Return the law of each kind of damage, from the damages of all parts. Thresholds of set-ups
    differ by the chance of their few boards; limits hold for the middle one."""
    thresholds = [
        holes.groupby("frames")["threshold"].first().to_numpy(float) for _, holes in tables
    ]
    typical = float(np.median(np.concatenate(thresholds))) if thresholds else 1.0
    kinds = {}
    for kind in DEPTHS_MM:
        sites: list[Sites] = []
        used: list[Part] = []
        for part, holes in tables:
            own = holes[holes["kind"] == kind]
            if not own.empty:
                sites.append(sites_of(own, part, len(used), noise, typical))
                used.append(part)
        if used:
            kinds[kind] = _limits_of_kind(kind, used, sites)
    return kinds


def _limits_of_kind(kind: str, parts: Sequence[Part], sites: Sequence[Sites]) -> KindLimits:
    """Return the law of a kind of damage, and how its set-ups depart from it."""
    joined = {name: np.concatenate([vars(part)[name] for part in sites]) for name in vars(sites[0])}
    depths_mm = DEPTHS_MM[kind]
    if depths_mm is None:
        backings_mm = [part.backing_mm for part in parts]
        depths_mm = (min(backings_mm), max(backings_mm))
    albedos = [part.albedo for part in parts]
    frames = [count for part in parts for count in part.frames]
    distances_m = [part.distance_m for part in parts]
    law, departures = fitted(
        Sites(**joined),
        {
            "distance_m": (min(distances_m), max(distances_m)),
            "frames": (float(min(frames)), float(max(frames))),
            "albedo": (min(albedos), max(albedos)),
            "depth_mm": depths_mm,
        },
    )
    set_ups = []
    for departure in departures:
        part = parts[departure.part]
        set_ups.append(
            SetUp(
                distance_m=part.distance_m,
                albedo=part.albedo,
                backing_mm=part.backing_mm,
                frames=departure.frames,
                sites=departure.sites,
                hits=departure.hits,
                expected=departure.expected,
                log_signal=departure.log_signal,
                deviation=departure.deviation,
            )
        )
    return KindLimits(law, tuple(set_ups))
