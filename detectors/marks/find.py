"""Finding the marks of one view, by whichever rule its settings name."""

from __future__ import annotations

import numpy as np

from detectors.marks.mark import MarkSet
from detectors.marks.settings import CodedMarks, ColourMarks, RedMarks
from harness.vocabulary.capture import Cloud


def find_marks(cloud: Cloud, inside: np.ndarray, config: RedMarks | ColourMarks | CodedMarks) -> MarkSet:
    """The marks among the pixels ``inside`` (h, w) bool of a cloud with colour.

    Never raises for what the picture shows: a set on which no registration can rest says so in its ``problem``.
    """
    raise NotImplementedError
