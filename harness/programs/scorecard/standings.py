"""Counts the blind figures of each camera that agree: values strictly within 25 % apart from wider
tolerances and from bounds."""

from collections.abc import Sequence
from dataclasses import dataclass

from harness.programs.scorecard.figures import Score
from harness.records.schema import Column, Table
from harness.vocabulary.path_names import camera_title


@dataclass(frozen=True)
class Standing:
    """Numbers of a camera's blind figures that agree."""

    camera: str
    """Name of the camera."""
    values: int
    """Number of published values."""
    strict: int
    """Number of them within 25 %."""
    by_tolerance: int
    """Number of them that pass only by the source's wider tolerance."""
    bounds: int
    """Number of published bounds."""
    bounds_hold: int
    """Number of bounds that hold."""


def standings(scores: Sequence[Score]) -> list[Standing]:
    """Return the standing of each camera with blind figures."""
    by_camera: dict[str, list[Score]] = {}
    for score in scores:
        if score.figure.use == "blind":
            by_camera.setdefault(score.figure.camera, []).append(score)
    rows = []
    for camera, blind in by_camera.items():
        values = [score for score in blind if score.strict is not None]
        bounds = [score for score in blind if score.strict is None]
        rows.append(
            Standing(
                camera=camera,
                values=len(values),
                strict=sum(score.strict is True for score in values),
                by_tolerance=sum(score.passes_by_tolerance for score in values),
                bounds=len(bounds),
                bounds_hold=sum(score.passes for score in bounds),
            )
        )
    return rows


STANDINGS = Table(
    "standings",
    "one row per camera with blind figures",
    (
        Column("", "camera", lambda row: camera_title(row.camera)),
        Column("", "blind values", "values"),
        Column("", "strict", "strict", "within 25 %"),
        Column("", "by a wider tolerance", "by_tolerance"),
        Column("", "blind bounds", "bounds"),
        Column("", "bounds that hold", "bounds_hold"),
    ),
    formats=(),
    kind="scores",
)
