"""One point of an experiment: everything that decides its numbers, and the digests that name them.

A digest covers content that can change a number and nothing else: not the name, the number of repeats, or what the
other points are. So adding a value to an axis leaves every other point, its seeds and its finished trials as they were.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.experiment import recorded
from harness.experiment.schema import CaptureSource, ExperimentConfig, SimulatedSource
from harness.vocabulary.declaration.yaml_source import Source
from harness.vocabulary.files import inside
from harness.vocabulary.seeds import digest
from scenes.sensor.camera import camera_digest, camera_of
from scenes.target.declaration import AnyTargetConfig
from scenes.target.drawn import DrawnTargetConfig

MAIN = "main"
"""The one set-up of an experiment whose only axis, if any, is the number of frames."""

NO_NUMBERS = ("name", "title", "repeats", "study", "sweep", "switches", "sensitivity")
"""Keys that decide which trials are run, not what a trial gives."""


@dataclass(frozen=True)
class Point:
    """A resolved experiment without axes. ``values``: dotted path -> value, for the paths that make the point.

    ``variant`` is the label of its set-up ("main" where there is one only) or of a variation; ``label`` tells points
    apart in tables. ``axes``: resolved value of every axis but the number of frames, which is what tells set-ups apart.
    ``is_variation``: whether it belongs to the sensitivity study; ``reference`` is then the set-up to compare it with,
    the one with the same ``axes`` (empty where none has them), else the point's own set-up. ``digest`` names the
    point's numbers, ``frames_key`` those of its frames (source and seed), ``render_key`` those of its render.
    """

    label: str
    variant: str
    values: Mapping[str, Any]
    config: ExperimentConfig
    digest: str
    render_key: str
    frames_key: str
    axes: Mapping[str, Any] = field(default_factory=dict)
    is_variation: bool = False
    reference: str = MAIN


@dataclass(frozen=True)
class Experiment:
    """A valid experiment, unfolded. ``data`` is the resolved declaration as plain data, ``source`` what was read."""

    config: ExperimentConfig
    points: tuple[Point, ...]
    data: Mapping[str, Any]
    source: Source

    @property
    def digest(self) -> str:
        """Names the experiment's results: all points with their repeats, in order."""
        points = [[point.variant, point.label, point.digest, point.config.repeats] for point in self.points]
        return digest(points if self.config.study is None else [self.config.study.to_data(), *points])

    def folder(self, results: Path) -> Path:
        """Where the results go: ``results/<name>/<digest>``. Raises UserError where a link leads out of it."""
        return inside(Path(results), self.config.name, self.digest)


def point_of(
    label: str, variant: str, values: Mapping[str, Any], config: ExperimentConfig, detector: Mapping[str, Any]
) -> Point:
    """A point from its resolved declaration. ``detector``: what can change its numbers beside its settings."""
    source = source_content(config.source)
    numbers = {key: value for key, value in config.to_data().items() if key not in NO_NUMBERS}
    return Point(
        label,
        variant,
        values,
        config,
        digest=digest({**numbers, "source": source, **detector}),
        render_key=digest(render_content(config.source)),
        frames_key=digest({"source": source, "seed": config.seed}),
    )


def source_content(source: SimulatedSource | CaptureSource) -> dict[str, Any]:
    """What decides the frames of a source, seeds aside: the full target and the camera's numbers, or files' content."""
    if isinstance(source, SimulatedSource):
        camera = {**source.camera.to_data(), "facts": camera_digest(camera_of(source.camera))}
        return {
            "kind": source.kind,
            "target": target_content(source.target),
            "camera": camera,
            "render": source.render.to_data(),
            **({} if source.views is None else {"views": source.views.to_data()}),
        }
    return recorded.content_of(source)


def target_content(target: AnyTargetConfig) -> dict[str, Any]:
    """The full declaration of a target; of a family of boards what they are drawn from."""
    return target.to_data() if isinstance(target, DrawnTargetConfig) else target.declare().to_data()


def render_content(source: SimulatedSource | CaptureSource) -> dict[str, Any]:
    """What decides the noise-free render: the target, the lens, the emitter, the modulation and the window's margin."""
    if not isinstance(source, SimulatedSource):
        return source_content(source)
    return {
        "target": target_content(source.target),
        "optics": camera_of(source.camera).optics.content(),
        "render": source.render.to_data(),
    }
