"""Fiducial marks for a registration: their data, settings of the rules that find them, conditions
on a set of marks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM

LEAST_MARKS = 3
OFF_LINE_SIGMAS = 5.0
OFF_LINE_SHARE = 0.02
"""Marks count as lying on a line if their root mean square distance from it is below this many
standard deviations of a mark's position, or below this share of their spread along it: there, a
millimetre of error at a mark becomes 50 mm."""


class RedMarks(Config):
    """The thesis' rule: pixels whose red exceeds the cropped cloud's mean by this many standard
    ``deviations``."""

    kind: Literal["red"] = "red"
    deviations: float = Field(default=2.6, gt=0, le=20)


class ColourMarks(Config):
    """Pixels whose chromaticity, or, if that gives too few marks, whose lightness differs from the
    target's own."""

    kind: Literal["colour"] = "colour"


class CodedMarks(Config):
    """Printed codes (ArUco, AprilTag) in the cloud's colour image; ``dictionary`` is OpenCV's name
    of their set."""

    kind: Literal["coded"] = "coded"
    dictionary: str = "DICT_6X6_50"

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        import cv2

        dictionaries = sorted(word for word in dir(cv2.aruco) if word.startswith("DICT_"))
        if name not in dictionaries:
            raise ValueError(
                f"OpenCV has no dictionary of codes '{name}'; it has {', '.join(dictionaries)}"
            )
        return name


MarksConfig = Annotated[RedMarks | ColourMarks | CodedMarks, Field(discriminator="kind")]


@dataclass(frozen=True)
class Mark:
    """One mark in one view, camera frame."""

    centre_m: np.ndarray
    """(3,): its centroid on the surface."""
    covariance_m2: np.ndarray
    """(3, 3): of the centroid, without errors that all pixels of the mark share (a range offset,
    lens distortion)."""
    normal: np.ndarray
    """(3,): of the surface there, towards the camera."""
    pixels: np.ndarray
    """(n,): flat indices into the cloud's grid."""
    area_m2: float
    """Area on the surface."""
    code: int | None = None
    """Its printed code; None for a piece of tape."""
    doubt: str = ""
    """Why it is unreliable, else empty."""


@dataclass(frozen=True)
class MarkSet:
    """All marks of one view."""

    marks: tuple[Mark, ...]
    """The marks, in doubt or not."""
    points: np.ndarray
    """(n,): flat indices of all pixels of the fiducial colour in the crop, the thesis' fiducial
    cloud."""
    problem: str = ""
    """Why these marks do not suffice for a registration, with what is missing; else empty."""
    notes: tuple[str, ...] = ()
    """Further remarks."""

    @property
    def trusted(self) -> tuple[Mark, ...]:
        """The marks that are not in doubt."""
        return tuple(mark for mark in self.marks if not mark.doubt)


def problem_of(marks: Sequence[Mark], missing: str = "") -> str:
    """Return why these marks do not suffice for a registration, else "". ``missing``: why there
    are not more."""
    trusted = [mark for mark in marks if not mark.doubt]
    if len(trusted) >= LEAST_MARKS:
        return off_line_problem(trusted)
    counted = (
        f"{len(trusted)} {'mark' if len(trusted) == 1 else 'marks'} found, {LEAST_MARKS} needed"
    )
    doubts = ", ".join(sorted({mark.doubt for mark in marks if mark.doubt}))
    in_doubt = ""
    if doubts:
        in_doubt = f"{len(marks) - len(trusted)} more in doubt: {doubts}"
    return "; ".join(text for text in (counted, in_doubt, missing) if text)


def off_line_problem(marks: Sequence[Mark]) -> str:
    """Return a sentence, with the distance from the line, if the marks lie on a line; else ""."""
    centres = np.stack([mark.centre_m for mark in marks])
    centred = centres - centres.mean(axis=0)
    sizes = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(marks))
    worst = [np.linalg.eigvalsh(mark.covariance_m2)[-1] for mark in marks]
    error = float(np.sqrt(np.mean(worst)))
    if sizes[1] >= max(OFF_LINE_SIGMAS * error, OFF_LINE_SHARE * sizes[0]):
        return ""
    off = f"{sizes[1] / MM:.1f} mm off it"
    return (
        f"the {len(marks)} marks lie on a line, {off}, so rotation about it is undetermined: "
        "add a mark beside it"
    )
