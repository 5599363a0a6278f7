"""How marks are to be found."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from harness.vocabulary.config import Config


class RedMarks(Config):
    """The thesis' rule: pixels whose red channel exceeds the cropped cloud's mean by so many standard deviations."""

    kind: Literal["red"] = "red"
    deviations: float = Field(default=2.6, gt=0, le=20)


class ColourMarks(Config):
    """Pixels whose colour stands apart from the target's own, whatever the colour, in uneven light too."""

    kind: Literal["colour"] = "colour"


class CodedMarks(Config):
    """Printed codes (ArUco, AprilTag), found in the cloud's colour by OpenCV."""

    kind: Literal["coded"] = "coded"
    dictionary: str = "DICT_APRILTAG_36h11"


MarksConfig = Annotated[RedMarks | ColourMarks | CodedMarks, Field(discriminator="kind")]
