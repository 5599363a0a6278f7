"""The keys of an experiment's YAML. Ranges of single fields are here; what concerns several together is in `checks`."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from detectors import detector_names, detector_type
from detectors.average import AverageConfig
from detectors.mapping.settings import MappingConfig
from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from scenes.perspectives import AnyViews
from scenes.render.settings import RenderConfig
from scenes.sensor.camera import CameraConfig
from scenes.target.declaration import AnyTargetConfig

MAX_FRAMES = 10_000
MAX_REPEATS = 100_000
MAX_BOARDS = 10_000
DEFAULT_RATE_PER_M2 = 1.0
"""False calls per square metre that a study's threshold is calibrated to."""

Repeats = Annotated[int, Field(ge=1, le=MAX_REPEATS)]
Frames = Annotated[int, Field(ge=1, le=MAX_FRAMES)]
Boards = Annotated[int, Field(ge=1, le=MAX_BOARDS)]
ListAsTuple = BeforeValidator(lambda values: tuple(values) if isinstance(values, list) else values)
"""Strict mode takes no list for a tuple, and within a mapping nothing has made a tuple of it yet."""
AxisValues = Annotated[tuple[Any, ...], Field(min_length=1, max_length=1000), ListAsTuple]
DottedPath = Annotated[str, Field(min_length=1, max_length=200)]
Label = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{1,80}$", description="one line of at most 80 characters")]
Reason = Annotated[str, Field(min_length=1, max_length=1000)]
StudyFrames = Annotated[tuple[Frames, ...], Field(min_length=1, max_length=100), ListAsTuple]
FileName = Annotated[str, Field(min_length=1, max_length=1000)]


class SimulatedSource(Config):
    """Frames come from a simulated camera that looks at a declared target, from one place or from several ``views``."""

    kind: Literal["simulated"]
    target: AnyTargetConfig
    camera: CameraConfig = CameraConfig()
    render: RenderConfig = RenderConfig()
    views: AnyViews | None = Field(None, discriminator="kind", description="none: the target's own pose only")


class CaptureSource(Config):
    """Frames come from a real capture; see `detectors.recordings.open_capture`. Paths count from the YAML's folder."""

    kind: Literal["capture"]
    paths: Annotated[tuple[FileName, ...], Field(min_length=1, max_length=100_000)] = Field(
        description="files or one folder of depth frames"
    )
    unit: str | None = Field(None, description="of stored depth, where the files do not say")
    intrinsics: FileName | None = Field(None, description="a file with the lens, or a camera's name")


class CaptureConfig(Config):
    """Number of frames that are averaged, and the kind of average."""

    frames: Frames
    average: AverageConfig = AverageConfig()
    exact: bool = Field(
        False,
        description="whether each simulated frame is drawn; false: a mean is drawn at once where that is equal in "
        "distribution, in a fraction of the time",
    )


class DetectorConfig(Config):
    """A detector by name; its settings are its own declaration, checked with the rest."""

    name: str = "thesis"
    settings: dict[str, Any] = Field(default_factory=dict)


class CalibrateConfig(Config):
    """A threshold from hole-free runs: the lowest k that gives no false cluster in so many ``repeats`` of the same
    set-up; or, in a study, the lowest whose rate of false calls on so many ``boards`` of their own is the one wanted
    (`harness.evaluation.pod.false_calls.threshold_for_rate`)."""

    repeats: Repeats | None = None
    boards: Boards | None = Field(None, description="of a study: boards of their own, never judged")
    false_calls_per_m2: Annotated[float, Field(gt=0, le=1e6)] | None = Field(
        None, description=f"of a study: the rate that is wanted; none: {DEFAULT_RATE_PER_M2:g}"
    )

    @model_validator(mode="before")
    @classmethod
    def _default_rate(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("boards") is None or data.get("false_calls_per_m2") is not None:
            return data
        return {**data, "false_calls_per_m2": DEFAULT_RATE_PER_M2}

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.repeats is None) == (self.boards is None):
            raise ValueError("give either `repeats` or, in a study, `boards`, and not both")
        if self.boards is None and self.false_calls_per_m2 is not None:
            raise ValueError("`false_calls_per_m2` needs `boards`, as repeats of one board say little about a rate")
        return self


class ThresholdConfig(Config):
    """A threshold k that is given, or calibrated: one of the two."""

    k: Annotated[float, Field(gt=0, le=1000)] | None = Field(None, description="in units of the detector's scale")
    calibrate: CalibrateConfig | None = None

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.k is None) == (self.calibrate is None):
            raise ValueError("give either `k` or `calibrate`, and not both")
        return self


class MatchingConfig(Config):
    """Rule by which a detection counts for a damage: the nearest centre within this radius on the face, one to one."""

    radius_mm: Annotated[float, Field(ge=0.5, le=1000)] = 15.0


class ValuesVariation(Config):
    """One key tried at other values, one at a time."""

    path: DottedPath
    values: AxisValues
    reason: Reason
    frames: StudyFrames | None = Field(None, description="none: as the study's")


class LabelledVariation(Config):
    """Several keys changed together, under one label."""

    label: Label
    set: Annotated[dict[DottedPath, Any], Field(min_length=1, max_length=50)]
    reason: Reason
    frames: StudyFrames | None = Field(None, description="none: as the study's")


class SensitivityConfig(Config):
    """One-at-a-time variations of the experiment, each run at a few numbers of frames with fewer repeats."""

    repeats: Repeats
    calibration_repeats: Repeats | None = Field(
        None, description="hole-free repeats of a variation; null: as threshold"
    )
    frames: StudyFrames
    vary: Annotated[tuple[ValuesVariation | LabelledVariation, ...], Field(min_length=1, max_length=500)]


class StudyConfig(Config):
    """A study of the probability of detection: the target is a family of boards, each one drawn at random.

    ``boards`` with damage, and ``hole_free_boards`` of their own on which false calls are counted. Every point of the
    experiment is judged on the same boards; ``repeats`` of the experiment draw the noise anew on each.
    """

    boards: Boards
    hole_free_boards: Boards


class ExperimentConfig(Config):
    """One complete experiment, and the axes over which it is swept."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")] = Field(
        description="letters, digits, - and _; it names a folder of results"
    )
    title: Annotated[str, Field(max_length=300)] = ""
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 1
    source: Annotated[SimulatedSource | CaptureSource, Field(discriminator="kind")]
    capture: CaptureConfig
    mapping: MappingConfig | None = Field(None, description="how several views become one cloud")
    detector: DetectorConfig = DetectorConfig()
    threshold: ThresholdConfig
    matching: MatchingConfig = MatchingConfig()
    study: StudyConfig | None = Field(None, description="needs a family of boards, such as target: {name: drawn}")
    repeats: Repeats = 1
    sweep: Annotated[dict[DottedPath, AxisValues], Field(max_length=20)] = Field(default_factory=dict)
    switches: DottedPath | None = Field(
        None, description="a mapping of switches: a set-up with none on, with each alone, with all but each, with all"
    )
    sensitivity: SensitivityConfig | None = None


DETECTOR_NAME = ("detector", "name")
DETECTOR_SETTINGS = ("detector", "settings")


def splices_of(data: Any) -> shape.Splices:
    """The model of the detector's settings where they stand in the data; nothing for a detector that does not exist."""
    detector = shape.child(data, "detector")
    name = detector.get("name", "thesis") if isinstance(detector, dict) else "thesis"
    if not isinstance(name, str) or name not in detector_names():
        return {}
    return {DETECTOR_SETTINGS: detector_type(name).settings_type}


def declared_of(data: Any) -> shape.Declared:
    """The declaration that ``data`` is meant to fill, the settings of the detector that it names included."""
    return shape.Declared(ExperimentConfig, data, splices_of(data))
