"""Declares the keys of an experiment's YAML, and its points with their digests.

This module holds the ranges of single fields; `checks` holds conditions on several fields. A
digest covers only content that can change a result: not the name, the number of repeats or the
other points. So a new value on an axis leaves all other points, their seeds and their finished
trials unchanged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from detectors import DETECTORS, detector_names, detector_type
from detectors.averages.average import AverageConfig
from detectors.averages.flat_field import FlatFieldConfig
from detectors.filters import (
    DepthFilterConfig,
    filter_names,
    filter_origin,
    filter_settings_type,
    load_filter,
)
from detectors.views.mapping.settings import MappingConfig
from harness.experiment.unknowns import UnknownConfig
from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.yaml_source import KeyPath, Source
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import file_digest, inside
from harness.vocabulary.path_names import UNKNOWNS
from harness.vocabulary.seeds import digest
from scenes.optics import RenderConfig
from scenes.perspectives import AnyViews
from scenes.sensor.camera import camera_of, lens_named, lens_names, load_camera
from scenes.sensor.common.config import CameraConfig
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import AnyTargetConfig

if TYPE_CHECKING:
    from detectors.recordings import Recording

MAX_FRAMES = 10_000
MAX_REPEATS = 100_000
MAX_BOARDS = 10_000
DEFAULT_RATE_PER_M2 = 1.0  # False calls per square metre that a study's threshold is calibrated to

Repeats = Annotated[int, Field(ge=1, le=MAX_REPEATS)]
Frames = Annotated[int, Field(ge=1, le=MAX_FRAMES)]
Boards = Annotated[int, Field(ge=1, le=MAX_BOARDS)]
ListAsTuple = BeforeValidator(lambda values: tuple(values) if isinstance(values, list) else values)
"""Strict mode rejects a list in place of a tuple; `Config` converts lists, but not those within a
mapping."""
AxisValues = Annotated[tuple[Any, ...], Field(min_length=1, max_length=1000), ListAsTuple]
DottedPath = Annotated[str, Field(min_length=1, max_length=200)]
Label = Annotated[
    str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,80}$", description="one line of at most 80 characters")
]
Reason = Annotated[str, Field(min_length=1, max_length=1000)]
FileName = Annotated[str, Field(min_length=1, max_length=1000)]
StudyFrames = Annotated[tuple[Frames, ...], Field(min_length=1, max_length=100), ListAsTuple]


class SimulatedSource(Config):
    """Frames of a simulated camera that views a declared target from one pose or from several
    ``views``."""

    kind: Literal["simulated"]
    target: AnyTargetConfig
    camera: CameraConfig = CameraConfig()
    render: RenderConfig = RenderConfig()
    views: AnyViews | None = Field(
        None, discriminator="kind", description="several poses; null: the target's own"
    )


class CaptureSource(Config):
    """Frames of a real capture; see `detectors.recordings.open_capture`. Paths are relative to the
    YAML's folder."""

    kind: Literal["capture"]
    paths: tuple[FileName, ...] = Field(
        min_length=1, max_length=100_000, description="files of depth frames, or a folder"
    )
    unit: str | None = Field(
        None, description="unit of the stored depth, if the files do not state it"
    )
    intrinsics: FileName | None = Field(
        None, description="a file of lens intrinsics, or a camera's name"
    )


class CaptureConfig(Config):
    """The number of averaged frames, and the method of averaging."""

    frames: Frames
    average: AverageConfig = AverageConfig()
    flat_field: FlatFieldConfig | None = Field(
        None,
        description="a plane captured first, whose fixed pattern is subtracted from every frame",
    )
    filter: DepthFilterConfig | None = Field(None, description="a filter from depth to depth")


class DetectorConfig(Config):
    """The detector by name, and its settings, which each detector declares."""

    name: str = "thesis"
    settings: dict[str, Any] = Field(default_factory=dict)


class CalibrateConfig(Config):
    """Calibration of the threshold on hole-free boards: the lowest k without a detection in
    ``repeats`` runs of the same set-up or, in a study, the lowest k that meets the rate of false
    calls on ``boards`` extra boards."""

    repeats: Repeats | None = None
    boards: Boards | None = Field(None, description="in a study: extra boards for calibration only")
    false_calls_per_m2: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        None,
        description=f"in a study: the rate of false calls to meet; null: {DEFAULT_RATE_PER_M2:g}",
    )

    @model_validator(mode="before")
    @classmethod
    def _default_rate(cls, data: Any) -> Any:
        needs = (
            isinstance(data, dict)
            and data.get("boards") is not None
            and data.get("false_calls_per_m2") is None
        )
        return {**data, "false_calls_per_m2": DEFAULT_RATE_PER_M2} if needs else data

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.repeats is None) == (self.boards is None):
            raise ValueError("give either `repeats` or, in a study, `boards`, and not both")
        if self.boards is None and self.false_calls_per_m2 is not None:
            raise ValueError(
                "`false_calls_per_m2` needs `boards`, since repeats of one board cannot show a rate"
            )
        return self


class ThresholdConfig(Config):
    """The detector's threshold k, which is either given or calibrated."""

    k: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        None, description="in units of the detector's score"
    )
    calibrate: CalibrateConfig | None = None

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.k is None) == (self.calibrate is None):
            raise ValueError("give either `k` or `calibrate`, and not both")
        return self


class MatchingConfig(Config):
    """The rule by which a detection counts as a hit: it is matched one to one with the nearest
    damage within a radius on the face. The distance to long damage (slot, gouge, chip) is the
    distance to its centre line."""

    radius_mm: Annotated[float, Field(ge=0.5, le=1000)] = 15.0
    overlap: Annotated[float, Field(gt=0.0, le=1.0)] | None = Field(
        None,
        description="a detection also counts as a hit, wherever its centre is, "
        "if at least this share "
        "of its pixels is "
        "on the damage (outline grown by two pixels); further such detections are parts of "
        "it, not false calls",
    )


class ScanReference(Config):
    """An earlier capture of the same board, before it was damaged, in another pose."""

    kind: Literal["scan"]


class GoodPartsReference(Config):
    """Captures of other boards of the family without damage."""

    kind: Literal["good_parts"]
    parts: Annotated[int, Field(ge=1, le=50)]


class MeshReference(Config):
    """The drawing: the board without damage and without what differs between made parts."""

    kind: Literal["mesh"]


AnyReference = Annotated[
    ScanReference | GoodPartsReference | MeshReference, Field(discriminator="kind")
]


class ValuesVariation(Config):
    """A variation that sets one key to each of the values in turn."""

    path: DottedPath
    values: AxisValues
    reason: Reason
    frames: StudyFrames | None = Field(
        None, description="numbers of frames; null: as in sensitivity.frames"
    )


class LabelledVariation(Config):
    """A variation that changes several keys together, under one label."""

    label: Label
    set: Annotated[dict[DottedPath, Any], Field(min_length=1, max_length=50)]
    reason: Reason
    frames: StudyFrames | None = Field(
        None, description="numbers of frames; null: as in sensitivity.frames"
    )


class SensitivityConfig(Config):
    """Variations of the experiment, one at a time, each with a few numbers of frames and fewer
    repeats."""

    repeats: Repeats
    calibration_repeats: Repeats | None = Field(
        None, description="hole-free runs; null: as in threshold"
    )
    frames: StudyFrames
    vary: Annotated[
        tuple[ValuesVariation | LabelledVariation, ...], Field(min_length=1, max_length=500)
    ]


class PrecisionConfig(Config):
    """The largest width of the 95 % interval of a90 from end to end, in mm or in percent of a90."""

    a90_mm: Annotated[float, Field(gt=0, le=1000)] | None = None
    a90_percent: Annotated[float, Field(gt=0, le=100)] | None = None

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.a90_mm is None) == (self.a90_percent is None):
            raise ValueError("give either `a90_mm` or `a90_percent`, and not both")
        return self


class StudyConfig(Config):
    """A study of the probability of detection on random boards: ``boards`` have damage, and false
    calls are counted on ``hole_free_boards``. All set-ups inspect the same boards, each with
    ``repeats`` draws of noise. ``units`` are cameras with different fixed patterns: all of them
    inspect each damaged board, another one each hole-free board."""

    boards: Boards = Field(description="with a precision, the largest number of boards")
    precision: PrecisionConfig | None = Field(
        None,
        description=(
            "boards are added, with sizes about a50 and a90, until a90 is as precise; null: all "
            "boards, with sizes over the whole range"
        ),
    )
    hole_free_boards: Boards
    units: Annotated[int, Field(ge=2, le=1000)] | None = Field(
        None,
        description=(
            "number of units; null: only source.camera.unit_seed, so that limits hold for that "
            "unit alone"
        ),
    )
    one_unit_calibrates: bool = Field(
        False,
        description=(
            "source.camera.unit_seed sees all boards that teach detectors and set thresholds, "
            "as if one camera were calibrated for others; false: each has a unit of its own"
        ),
    )

    @model_validator(mode="after")
    def _has_other_units(self) -> Self:
        if self.one_unit_calibrates and self.units is None:
            raise ValueError("`one_unit_calibrates` needs `units`: there are no others")
        return self


class ExperimentConfig(Config):
    """An experiment and the axes over which it is swept."""

    name: str = Field(
        pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$",
        description="also the name of its results folder",
    )
    title: Annotated[str, Field(max_length=300)] = ""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = Field(1, description="seed of the noise")
    source: Annotated[SimulatedSource | CaptureSource, Field(discriminator="kind")]
    capture: CaptureConfig
    mapping: MappingConfig | None = Field(None, description="how several views become one cloud")
    compared_with: AnyReference | None = Field(
        None,
        description="in a study of single views: what each board is compared with, by the same "
        "camera and number of frames; null: a surface that is fitted to it",
    )
    detector: DetectorConfig = DetectorConfig()
    threshold: ThresholdConfig
    matching: MatchingConfig = MatchingConfig()
    study: StudyConfig | None = Field(
        None, description="needs a family of boards (target: {name: drawn})"
    )
    repeats: Repeats = Field(1, description="number of draws of the noise in each set-up")
    sweep: Annotated[dict[DottedPath, AxisValues], Field(max_length=20)] = Field(
        default_factory=dict
    )
    draws: Annotated[int, Field(ge=2, le=1000)] | None = Field(
        None,
        description=(
            "number of set-ups of the sweep to run, drawn at random without duplicates (null: "
            "all); with unknowns, the number of their draws, each with all set-ups of the sweep"
        ),
    )
    unknowns: Annotated[tuple[UnknownConfig, ...], Field(max_length=20)] = Field(
        (),
        description=(
            "facts that nobody has measured; a study draws them for each board, "
            "any other experiment for each of its draws"
        ),
    )
    switches: DottedPath | None = Field(
        None,
        description=(
            "path of a mapping of switches, which are on: none, each alone, all but each, and all"
        ),
    )
    sensitivity: SensitivityConfig | None = None

    @property
    def detector_settings(self) -> dict[str, Any]:
        """The detector's settings; with a reference, its surface is what that says."""
        if self.compared_with is None:
            return self.detector.settings
        return {**self.detector.settings, "surface": {"shape": "expected"}}

    @property
    def simulated(self) -> SimulatedSource:
        """The source, which must be a simulated camera. Raises UserError for a real capture."""
        if isinstance(self.source, CaptureSource):
            raise UserError(
                f"{self.name}: its source is a real capture, but a simulated camera is needed"
            )
        return self.source


DETECTOR_SETTINGS = ("detector", "settings")
FILTER_SETTINGS = ("capture", "filter", "settings")


def splices_of(data: Any) -> shape.Splices:
    """Return the paths of the settings of detector and filter, with their models; without those
    that are unknown."""
    splices: dict[KeyPath, type[Config]] = {}
    detector = shape.child(data, "detector")
    name = detector.get("name", "thesis") if isinstance(detector, dict) else "thesis"
    if isinstance(name, str) and name in detector_names():
        splices[DETECTOR_SETTINGS] = detector_type(name).settings_type
    filter_name = shape.get(data, (*FILTER_SETTINGS[:-1], "name"))
    if isinstance(filter_name, str) and filter_name in filter_names():
        splices[FILTER_SETTINGS] = filter_settings_type(filter_name)
    return splices


def declared_of(data: Any) -> shape.Declared:
    """Return the declaration for ``data``, including the settings of the detector that it names."""
    return shape.Declared(ExperimentConfig, data, splices_of(data))


STATED = "stated"
DRAWN = "drawn"
MAIN = "main"  # The set-up of an experiment without axes other than the number of frames
SHARED_BY_POINTS = (
    "name",
    "title",
    "repeats",
    "study",
    "sweep",
    "draws",
    "unknowns",
    "switches",
    "sensitivity",
)
"""Keys that determine which trials run, but not the result of any trial: no point has its own."""


@dataclass(frozen=True)
class Point:
    """A resolved experiment without axes. ``values`` maps dotted paths to the values that make the
    point. ``variant`` labels its set-up or variation, ``label`` the point. ``axes`` holds the
    values of all axes but the number of frames. ``reference`` is the set-up with the same ``axes``
    that a variation varies ("" for none), else the point's own. ``digest`` identifies the point's
    results, ``frames_key`` those of its frames. ``unknowns`` are drawn for each of its boards."""

    label: str
    variant: str
    values: Mapping[str, Any]
    config: ExperimentConfig
    digest: str
    frames_key: str
    axes: Mapping[str, Any] = field(default_factory=dict)
    is_variation: bool = False
    reference: str = MAIN
    unknowns: tuple[UnknownConfig, ...] = ()

    def with_unknowns(self, unknowns: tuple[UnknownConfig, ...], variant: str) -> Point:
        """Return the point whose boards differ in these unknowns, under another name."""
        drawn = []
        for unknown in unknowns:
            values = unknown.to_data()["values"]
            drawn.append([unknown.key, values, unknown.range])
        return replace(
            self,
            label=f"{self.label}, {UNKNOWNS}={DRAWN}",
            variant=variant,
            digest=digest([self.digest, drawn]),
            frames_key=digest([self.frames_key, drawn]),
            axes={**self.axes, UNKNOWNS: DRAWN},
            reference=variant,
            unknowns=unknowns,
        )


@dataclass(frozen=True)
class Experiment:
    """A valid experiment with its points. ``data`` is the resolved declaration as plain data,
    ``source`` the input."""

    config: ExperimentConfig
    points: tuple[Point, ...]
    data: Mapping[str, Any]
    source: Source

    @property
    def digest(self) -> str:
        """The digest over all points with their repeats, in order, which names the experiment's
        results."""
        points = [
            [point.variant, point.label, point.digest, point.config.repeats]
            for point in self.points
        ]
        if self.config.study is None:
            return digest(points)
        study = self.config.study.to_data()
        if self.config.study.precision is None:
            del study["precision"]  # results of studies without a precision keep their folders
        return digest([study, *points])

    def at_stated_values(self) -> Experiment:
        """Return the experiment without the set-ups whose unknowns are drawn."""
        return replace(self, points=tuple(point for point in self.points if not point.unknowns))

    def folder(self, results: Path) -> Path:
        """Return the results folder, ``results/<name>/<digest>``. Raises UserError if a link leads
        out of it."""
        return inside(Path(results), self.config.name, self.digest)


def point_of(
    label: str, variant: str, values: Mapping[str, Any], config: ExperimentConfig
) -> Point:
    """Return the point for a resolved declaration, with its digests."""
    source = config.source
    if isinstance(source, CaptureSource):
        files = [[file.name, file_digest(file)] for file in recording_of(source).files]
        camera_name = lens_names().get(source.intrinsics) if source.intrinsics else None
        nominal_lens = load_camera(camera_name).lens.to_data() if camera_name else None
        frames = {"kind": source.kind, "files": files, "unit": source.unit, "lens": nominal_lens}
    else:
        # the full target, or the distribution of a family of boards, and the camera's numbers
        drawn = isinstance(source.target, DrawnTargetConfig)
        target = source.target.to_data() if drawn else source.target.declare().to_data()
        camera = camera_of(source.camera)
        work = source.render.to_data()
        frames = {"kind": source.kind, "target": target, "render": work}
        frames["camera"] = {
            **source.camera.to_data(),
            "name": camera.name,
            "facts": digest(camera.to_data()),
        }
        frames |= {} if source.views is None else {"views": source.views.to_data()}
    numbers = {key: value for key, value in config.to_data().items() if key not in SHARED_BY_POINTS}
    if config.compared_with is None:
        # points without one keep their digests
        del numbers["compared_with"]
    numbers |= {"source": frames, "detector_version": detector_version(config)}
    offer = DETECTORS.offer(config.detector.name)
    numbers |= {} if offer.built_in else {"detector_from": offer.origin}
    numbers["capture"] = _capture_numbers(config.capture)
    return Point(
        label,
        variant,
        values,
        config,
        digest(numbers),
        digest({"source": frames, "seed": config.seed}),
    )


def _capture_numbers(capture: CaptureConfig) -> dict[str, Any]:
    """Return what of the frames' way into the average decides numbers. Without a filter there is
    no key for one, so that results from before there were filters keep their digests."""
    numbers = capture.to_data()
    if capture.filter is None:
        del numbers["filter"]
        return numbers
    name = capture.filter.name
    version = load_filter(name, capture.filter.settings).version
    return {**numbers, "filter_version": version, "filter_from": filter_origin(name)}


def detector_version(config: ExperimentConfig) -> int:
    """Return the version of the experiment's detector."""
    kind = detector_type(config.detector.name)
    return int(kind(kind.settings_type.from_data(config.detector.settings)).version)


@lru_cache(maxsize=1000)
def recording_of(source: CaptureSource) -> Recording:
    """Open the recording of a source, and read and check its first frame. Raises UserError for
    faulty files."""
    from detectors.recordings import open_capture  # imports the readers of all formats

    name = source.intrinsics
    lens = lens_named(name) if name and name in lens_names() else None
    file = Path(name) if name and lens is None else None
    return open_capture(
        [Path(path) for path in source.paths], unit=source.unit, intrinsics=file, lens=lens
    )
