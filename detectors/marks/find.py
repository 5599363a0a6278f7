"""Finding the marks of one view, by whichever rule its settings name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from detectors.marks.backdrop import above_half, chromaticity, lightness, stand_out
from detectors.marks.blobs import Blob, find_blobs
from detectors.marks.coded import coded_marks
from detectors.marks.judge import Candidate, judged
from detectors.marks.mark import LEAST_MARKS, MarkSet, problem_of
from detectors.marks.patch import fit_patch, place_spot
from detectors.marks.settings import CodedMarks, ColourMarks, RedMarks
from harness.vocabulary.capture import Cloud

Feature = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
CLEAR_MARGIN = 2.0
"""Marks whose pixels pass the threshold by this factor have whole outlines; else lightness is tried too."""
LEAST_TARGET = 100
"""Pixels of the target below which its own colour is not known."""


def find_marks(cloud: Cloud, inside: np.ndarray, config: RedMarks | ColourMarks | CodedMarks) -> MarkSet:
    """The marks among the pixels ``inside`` (h, w) bool of a cloud with colour.

    Never raises for what the picture shows: a set on which no registration can rest says so in its ``problem``.
    """
    none = MarkSet((), np.zeros(0, dtype=np.int64))
    if cloud.rgb is None:
        return replace(none, problem="the capture has no colour, by which marks are found")
    if int(inside.sum()) < LEAST_TARGET:
        return replace(none, problem=f"{int(inside.sum())} pixels of the target, too few to know its colour")
    if isinstance(config, CodedMarks):
        return coded_marks(cloud, inside, config.dictionary)
    if isinstance(config, RedMarks):
        return _red_marks(cloud, inside, config.deviations)
    return _colour_marks(cloud, inside)


def _red_marks(cloud: Cloud, inside: np.ndarray, deviations: float) -> MarkSet:
    """Find marks by the thesis' rule: the red channel above the mean of the cropped cloud's by some of its standard
    deviations (MATLAB's, with n - 1)."""
    assert cloud.rgb is not None
    red = cloud.rgb[inside][:, 0].astype(np.float64)
    limit = red.mean() + deviations * red.std(ddof=1)
    coloured = np.zeros(inside.shape, dtype=bool)
    coloured[inside] = red > limit
    missing = ""
    if not coloured.any():
        missing = (
            f"no pixel's red exceeds {limit:.0f}, the target's mean {red.mean():.0f} and {deviations:g} standard"
            f" deviations of {red.std(ddof=1):.0f}"
        )
    return _marks(cloud, inside, coloured, missing)


def _colour_marks(cloud: Cloud, inside: np.ndarray) -> MarkSet:
    """Find marks by chromaticity; where that gives too few marks or hardly any contrast, by lightness if that does
    better: black and white have the light's own chromaticity, and black hardly any."""
    found, margin = _standing_out(cloud, inside, chromaticity)
    if len(found.trusted) >= LEAST_MARKS and margin >= CLEAR_MARGIN:
        return found
    lighter, lighter_margin = _standing_out(cloud, inside, lightness)
    if len(lighter.trusted) < LEAST_MARKS or (len(found.trusted) >= LEAST_MARKS and margin >= lighter_margin):
        return found
    return replace(lighter, notes=(*lighter.notes, "the marks were found by their lightness"))


def _standing_out(cloud: Cloud, inside: np.ndarray, feature: Feature) -> tuple[MarkSet, float]:
    """The marks by one feature of the colours, and the median margin of the trusted ones' pixels."""
    assert cloud.rgb is not None
    apart = stand_out(*feature(cloud.rgb[inside]), cloud.points_m[inside][:, :2])
    contrast, margin = np.zeros(inside.shape), np.zeros(inside.shape)
    contrast[inside], margin[inside] = apart.contrast, apart.margin
    coloured = above_half(margin > 1.0, contrast) if cloud.organised else margin > 1.0
    found = _marks(cloud, inside, coloured, "no other spots stand apart from the target's colour")
    # a hole through which another colour shows is no fiducial
    own = np.unique(np.concatenate([np.zeros(0, np.int64), *(mark.pixels for mark in found.marks)]))
    found = replace(found, points=own)
    pixels = [mark.pixels for mark in found.trusted]
    return found, float(np.median(margin.ravel()[np.concatenate(pixels)])) if pixels else 0.0


def _marks(cloud: Cloud, inside: np.ndarray, coloured: np.ndarray, missing: str) -> MarkSet:
    """Marks among coloured pixels; ``missing`` says why there are not more."""
    candidates = []
    for blob in find_blobs(cloud, inside, coloured):
        candidate = _candidate(cloud, blob, int(inside.sum()))
        if candidate is not None:
            candidates.append(candidate)
    marks, notes = judged(candidates)
    if not cloud.organised:
        notes += ("a cloud without a pixel grid does not tell whether a mark is cut",)
    return MarkSet(marks, np.flatnonzero(coloured), problem_of(marks, missing), notes)


def _candidate(cloud: Cloud, blob: Blob, target: int) -> Candidate | None:
    patch = fit_patch(cloud.points_m.reshape(-1, 3)[blob.surroundings])
    if patch is None:
        return None
    spot = place_spot(cloud, blob.pixels, blob.weights, blob.grid, patch)
    return Candidate(blob, spot, float((blob.weights > 0.5).sum()) / target)
