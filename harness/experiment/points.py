"""One point of an experiment: everything that decides its numbers, and the digests that name them.

A digest covers content that can change a number and nothing else: not the name, the number of repeats, or what the
other points are. So adding a value to an axis leaves every other point, its seeds and its finished trials as they were.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from detectors import DETECTORS, detector_type
from harness.experiment.schema import CaptureSource, ExperimentConfig, SimulatedSource
from harness.vocabulary.declaration.yaml_source import Source
from harness.vocabulary.files import inside
from harness.vocabulary.seeds import digest
from scenes.sensor.camera import camera_digest, camera_of, lens_named, lens_names, load_camera
from scenes.target.drawn import DrawnTargetConfig

if TYPE_CHECKING:
    from detectors.recordings import Recording

MAIN = "main"
"""The only set-up of an experiment whose only axis, if any, is the number of frames."""

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
        """Return ``results/<name>/<digest>``, the folder of the results; UserError where a link leads out of it."""
        return inside(Path(results), self.config.name, self.digest)


def point_of(label: str, variant: str, values: Mapping[str, Any], config: ExperimentConfig) -> Point:
    """A point from its resolved declaration."""
    frames, render = _content_of(config.source)
    numbers = {key: value for key, value in config.to_data().items() if key not in NO_NUMBERS}
    offer = DETECTORS.offer(config.detector.name)
    detector: dict[str, Any] = {"detector_version": detector_version(config)}
    detector |= {} if offer.built_in else {"detector_from": offer.origin}
    return Point(
        label,
        variant,
        values,
        config,
        digest=digest({**numbers, "source": frames, **detector}),
        render_key=digest(render),
        frames_key=digest({"source": frames, "seed": config.seed}),
    )


def detector_version(config: ExperimentConfig) -> int:
    """The version of the experiment's detector."""
    kind = detector_type(config.detector.name)
    return int(kind(kind.settings_type.from_data(config.detector.settings)).version)


def _content_of(source: SimulatedSource | CaptureSource) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the content that decides a source's frames, seeds aside, and the content that decides its render.

    Frames: the full target (of a family of boards what they are drawn from) and the camera's numbers; of a recording
    the content of its files, the unit, and the lens where it is named. A render: the target, the lens, the emitter,
    the modulation and the window's margin.
    """
    if isinstance(source, CaptureSource):
        files = []
        for file in recording_of(source).files:
            stat = file.stat()
            files.append([file.name, _file_digest(file, stat.st_size, stat.st_mtime_ns)])
        camera_name = lens_names().get(source.intrinsics or "")
        named = load_camera(camera_name).lens.to_data() if camera_name else None
        recorded = {"kind": source.kind, "files": files, "unit": source.unit, "lens": named}
        return recorded, recorded
    drawn = isinstance(source.target, DrawnTargetConfig)
    target = source.target.to_data() if drawn else source.target.declare().to_data()
    camera, render = camera_of(source.camera), source.render.to_data()
    frames = {
        "kind": source.kind,
        "target": target,
        "camera": {**source.camera.to_data(), "facts": camera_digest(camera)},
        "render": render,
        **({} if source.views is None else {"views": source.views.to_data()}),
    }
    return frames, {"target": target, "optics": camera.optics.content(), "render": render}


@lru_cache(maxsize=1000)
def recording_of(source: CaptureSource) -> Recording:
    """The recording behind a source, its first frame read and checked. Raises UserError for every fault of its files.

    ``intrinsics`` may name a camera, whose nominal lens then counts.
    """
    from detectors.recordings import open_capture  # brings the readers of every format

    name = source.intrinsics
    lens = lens_named(name) if name and name in lens_names() else None
    file = Path(name) if name and lens is None else None
    return open_capture([Path(path) for path in source.paths], unit=source.unit, intrinsics=file, lens=lens)


@lru_cache(maxsize=100_000)
def _file_digest(path: Path, size: int, changed_ns: int) -> str:
    """Size and time of change are arguments so that a changed file is read again."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
