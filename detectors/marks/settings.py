"""Settings of the search for marks."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from harness.vocabulary.config import Config


class RedMarks(Config):
    """The thesis' rule: pixels whose red channel exceeds the cropped cloud's mean by so many standard deviations."""

    kind: Literal["red"] = "red"
    deviations: float = Field(default=2.6, gt=0, le=20)


class ColourMarks(Config):
    """Pixels whose chromaticity stands apart from the target's own, whatever the colour, in uneven light too;
    where that gives no three marks (black or white tape), pixels whose lightness does."""

    kind: Literal["colour"] = "colour"


class CodedMarks(Config):
    """Printed codes (ArUco, AprilTag), found in the cloud's colour by OpenCV.

    ``dictionary``: OpenCV's name of the set of codes that the tags were printed from.
    """

    kind: Literal["coded"] = "coded"
    dictionary: str = "DICT_6X6_50"

    @field_validator("dictionary")
    @classmethod
    def _known(cls, name: str) -> str:
        import cv2

        known = sorted(word for word in dir(cv2.aruco) if word.startswith("DICT_"))
        if name not in known:
            raise ValueError(f"OpenCV has no dictionary of codes '{name}'; it has {', '.join(known)}")
        return name


MarksConfig = Annotated[RedMarks | ColourMarks | CodedMarks, Field(discriminator="kind")]
