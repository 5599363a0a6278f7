"""Makes shards of the atlas: runs the parts of a camera, and keeps what `tofpod ask` needs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from harness.experiment.digests import experiment_digests
from harness.experiment.load import load_experiment
from harness.experiment.schema import Experiment
from harness.programs.atlas.age import sources_digest
from harness.programs.atlas.limits import Conditions, PlaneNoise, SetUp, damage_of
from harness.programs.atlas.parts import EXPERIMENT, Part
from harness.programs.atlas.shards import measured_noise, parts_of
from harness.programs.atlas.stored import CameraLimits
from harness.runs.options import EngineOptions
from harness.runs.plan import plan_of
from harness.runs.study import run_study
from harness.vocabulary.code_digests import Digests
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import record
from harness.vocabulary.seeds import digest
from scenes.sensor.camera import guessed_precision, load_camera

DAMAGE = "source.target.damage"
ALBEDO = "source.target.material.albedo_850"
OF_A_PART = f"experiment {EXPERIMENT}"
KEPT = ("commit", "dirty", "versions")
"""What a shard keeps of a run's provenance."""


class Planned:
    """The work on one camera: its noise, and an experiment for each part."""

    def __init__(self, names: Sequence[str]) -> None:
        """``names``: the camera and its twins."""
        self.names = tuple(names)
        self.noise: PlaneNoise = measured_noise(names[0])
        self.parts: list[Part] = parts_of(names[0], self.noise)
        if not self.parts:
            raise UserError(
                f"{names[0]}: gives no depth of any board between the ends of its range",
                fix="correct its file; tofpod characterise measures a camera",
            )
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
        parts = [experiment_digests(experiment) for experiment in self.experiments]
        digests = dict(parts[0])
        digests[OF_A_PART] = digest([part[OF_A_PART] for part in parts])
        return digests

    def work(self, out: Path) -> tuple[int, int, int]:
        """Return the numbers of set-ups, renders and trials."""
        set_ups = 0
        renders = 0
        trials = 0
        for experiment in self.experiments:
            plan = plan_of(experiment, out / ".cache" / "renders")
            set_ups += len(experiment.points)
            renders += len(plan.renders)
            for group in plan.groups:
                trials += sum(group.most_repeats(batch) for batch in group.batches)
        return set_ups, renders, trials

    def made(self, out: Path, options: EngineOptions, command: str) -> CameraLimits | None:
        """Run all parts and return the shard; None if a run was interrupted."""
        digests = self.digests
        set_ups: list[SetUp] = []
        checks: list[SetUp] = []
        for part, experiment in zip(self.parts, self.experiments, strict=True):
            try:
                code = run_study(experiment, out, options, command)
            except UserError as error:
                print(f"{part.camera} at {part.distance_m:g} m: left out: {error.message}")
                continue
            if code == 130:
                return None
            limits = pd.read_parquet(experiment.folder(out) / "limits.parquet")
            (checks if part.is_check else set_ups).extend(set_ups_of(limits, part))
        if not set_ups:
            raise UserError(f"{self.camera}: no part of it gave a limit")
        origin = record(command)
        config = self.experiments[0].config
        backing = config.source.to_data()["target"]["backing"]
        about: dict[str, Any] = {name: origin[name] for name in KEPT}
        about |= {
            "digests": digests,
            "sources": sources_digest(),
            "detector": config.detector.name,
            "detector_version": int(limits["detector_version"].iloc[0]),
            "focal_px": float(load_camera(self.camera).nominal_lens.fx),
            "contrast_mm": float(backing["distance_mm"]),
        }
        return self._shard(about, set_ups, checks)

    def _shard(
        self, about: Mapping[str, Any], set_ups: Sequence[SetUp], checks: Sequence[SetUp]
    ) -> CameraLimits:
        names = {name: Path(name).stem for name in self.names}
        return CameraLimits(
            camera=names[self.camera],
            titles={names[name]: load_camera(name).title for name in self.names},
            warning=guessed_precision(load_camera(self.camera)),
            about=about,
            noise=self.noise,
            set_ups=tuple(set_ups),
            checks=tuple(checks),
        )


def set_ups_of(limits: pd.DataFrame, part: Part) -> list[SetUp]:
    """Return the set-ups of a part from its table of limits."""
    set_ups = []
    for row in limits.to_dict("records"):
        kind, depth_mm = damage_of(row[DAMAGE])
        # an axis of one value is no column
        albedo = row[ALBEDO] if len(part.albedos) > 1 else part.albedos[0]
        conditions = Conditions(
            distance_m=part.distance_m,
            albedo=float(albedo),
            frames=int(row["frames"]),
            depth_mm=None if depth_mm != depth_mm else depth_mm,
        )
        set_ups.append(
            SetUp(
                kind=kind,
                conditions=conditions,
                a90_mm=float(row["a90_mm"]),
                low_mm=float(row["a90_low_mm"]),
                high_mm=float(row["a90_high_mm"]),
                smallest_mm=float(row["smallest_mm"]),
                largest_mm=float(row["largest_mm"]),
                is_at_most=bool(row["is_at_most"]),
                hits=int(row["hits"]),
            )
        )
    return set_ups
