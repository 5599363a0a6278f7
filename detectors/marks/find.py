"""The marks of one view: coloured spots or codes that are found, judged, and put in doubt where they may be wrong.

A mark lies on the target's surface: what lies behind it is a hole through which something of another colour is seen.
Pieces of tape of one colour are alike: the median of its colour tells the odd one, if there are three.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.marks.backdrop import above_half, chromaticity, lightness, stand_out
from detectors.marks.blobs import Blob, find_blobs
from detectors.marks.coded import coded_marks
from detectors.marks.mark import LEAST_MARKS, CodedMarks, ColourMarks, Mark, MarkSet, RedMarks, problem_of
from detectors.marks.patch import Spot, fit_patch, place_spot
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM

Feature = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
CLEAR_MARGIN = 2.0
"""Marks whose pixels pass the threshold by this factor have whole outlines; else lightness is tried too."""
LEAST_TARGET = 100
"""Pixels of the target below which its own colour is not known."""
BEHIND_M = 2.0 * MM
"""A mark may seem to lie so far behind its surroundings: cameras range dark and bright surfaces differently, by a
millimetre or two. A hole seen through is deeper, but for the smallest ones, which the camera's blur fills."""
BEHIND_SIGMAS = 5.0
RAISED_SHARE = 0.25
"""A mark may stand before its surroundings by this part of its breadth: a tag on board, but no object."""
SAME_COLOUR = 0.35
"""Two spots have one colour where their contrasts to their surroundings differ by less than this part of them."""
WEAK_SHARE = 1 / 3
"""Share of the strongest colour's contrast to its surroundings: weaker spots beside such marks are stains, or what a
camera's compression makes of the light."""
UNLIKE_SHARE, UNLIKE_PIXELS = 0.3, 1.5
"""A mark's length, breadth or area is unlike the others' where it differs by more than this part of the median and so
many pixels more: a pixel at either end may be missed."""
LARGEST_SHARE = 0.15
"""Share of the target: a larger spot is no mark, but a part of the target of another colour."""


def find_marks(cloud: Cloud, inside: np.ndarray, config: RedMarks | ColourMarks | CodedMarks) -> MarkSet:
    """Find the marks among the pixels ``inside`` (h, w) bool of a cloud with colour.

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
        # the thesis' rule, by MATLAB's standard deviation with n - 1
        red = cloud.rgb[inside][:, 0].astype(np.float64)
        mean, spread = red.mean(), red.std(ddof=1)
        limit = mean + config.deviations * spread
        coloured = np.zeros(inside.shape, dtype=bool)
        coloured[inside] = red > limit
        missing = f"no pixel's red exceeds {limit:.0f}, the target's mean {mean:.0f} and {config.deviations:g} standard"
        missing += f" deviations of {spread:.0f}"
        return _marks(cloud, inside, coloured, "" if coloured.any() else missing)
    # by lightness where chromaticity gives too few marks or hardly any contrast, if that does better: black and white
    # have the light's own chromaticity, and black hardly any
    found, margin = _standing_out(cloud, inside, chromaticity)
    if len(found.trusted) >= LEAST_MARKS and margin >= CLEAR_MARGIN:
        return found
    lighter, lighter_margin = _standing_out(cloud, inside, lightness)
    if len(lighter.trusted) < LEAST_MARKS or (len(found.trusted) >= LEAST_MARKS and margin >= lighter_margin):
        return found
    return replace(lighter, notes=(*lighter.notes, "the marks were found by their lightness"))


def _standing_out(cloud: Cloud, inside: np.ndarray, feature: Feature) -> tuple[MarkSet, float]:
    """Find the marks by one feature of the colours, and the median margin of the trusted ones' pixels."""
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
    """Find marks among coloured pixels; ``missing`` says why there are not more."""
    candidates = []
    for blob in find_blobs(cloud, inside, coloured):
        patch = fit_patch(cloud.points_m.reshape(-1, 3)[blob.surroundings])
        if patch is not None:
            spot = place_spot(cloud, blob.pixels, blob.weights, blob.grid, patch)
            candidates.append(_Candidate(blob, spot, float((blob.weights > 0.5).sum()) / int(inside.sum())))
    marks, notes = _judged(candidates)
    if not cloud.organised:
        notes += ("a cloud without a pixel grid does not tell whether a mark is cut",)
    return MarkSet(marks, np.flatnonzero(coloured), problem_of(marks, missing), notes)


# ---------------------------------------------------------------- judging


@dataclass(frozen=True)
class _Candidate:
    """A spot with its pixels, and its share of the target's."""

    blob: Blob
    spot: Spot
    share: float

    @property
    def behind(self) -> bool:
        """True where it lies behind the surface."""
        return self.spot.behind_m > max(BEHIND_M, BEHIND_SIGMAS * self.spot.behind_sigma_m)

    @property
    def sizes_m(self) -> np.ndarray:
        """Length, breadth, and the mean breadth over the length, which gaps lessen (3,)."""
        return np.array([self.spot.length_m, self.spot.breadth_m, self.spot.area_m2 / self.spot.length_m])

    def mark(self, usual_m: np.ndarray | None) -> Mark:
        """Return the mark, with its doubt; ``usual_m`` (3,): the sizes of its like."""
        spot, blob = self.spot, self.blob
        doubt = blob.doubt
        if doubt:
            pass
        elif self.share > LARGEST_SHARE:
            doubt = f"{100 * self.share:.0f} % of the target: a part of it rather than a mark"
        elif -spot.behind_m > max(RAISED_SHARE * spot.breadth_m, BEHIND_SIGMAS * spot.behind_sigma_m):
            doubt = f"it stands {-spot.behind_m / MM:.0f} mm before the surface"
        elif usual_m is not None:
            unlike = np.abs(self.sizes_m - usual_m) > UNLIKE_SHARE * usual_m + UNLIKE_PIXELS * spot.pitch_m
            doubt = f"unlike the others: {_in_words(self.sizes_m)}, they {_in_words(usual_m)}" if unlike.any() else ""
        pixels = blob.pixels[blob.weights > 0.5]
        covariance = spot.covariance_m2(blob.grid_covariance)
        return Mark(spot.centre_m, covariance, spot.normal, pixels, spot.area_m2, doubt=doubt)


def _in_words(sizes_m: np.ndarray) -> str:
    length, breadth, mean_breadth = sizes_m
    return f"{length / MM:.0f} x {breadth / MM:.0f} mm, {100 * min(mean_breadth / breadth, 1.0):.0f} % filled"


def _judged(candidates: Sequence[_Candidate]) -> tuple[tuple[Mark, ...], tuple[str, ...]]:
    """Return the marks, in the order of their pixels, and notes on what was taken for none."""
    # groups of one colour, each candidate compared with the first of its group
    colours: list[list[_Candidate]] = []
    for candidate in sorted(candidates, key=lambda c: (-c.spot.area_m2, int(c.blob.pixels[0]))):
        for group in colours:
            apart = np.linalg.norm(candidate.blob.contrast - group[0].blob.contrast)
            if apart < SAME_COLOUR * np.linalg.norm(group[0].blob.contrast):
                group.append(candidate)
                break
        else:
            colours.append([candidate])
    groups, vivid = [], []
    for colour in colours:
        # where most of a colour's area lies behind, holes too small to look deep share the colour of those that do
        behind = sum(c.spot.area_m2 for c in colour if c.behind)
        group = [] if behind > 0.5 * sum(c.spot.area_m2 for c in colour) else [c for c in colour if not c.behind]
        if group:
            whole = [c for c in group if not c.blob.doubt]
            usual_m = _usual_m(whole) if len(whole) >= 3 else None
            groups.append([c.mark(usual_m) for c in group])
            vivid.append(float(np.linalg.norm(group[0].blob.contrast)))
    enough = [sum(not mark.doubt for mark in group) >= LEAST_MARKS for group in groups]
    least = WEAK_SHARE * max((v for v, many in zip(vivid, enough, strict=True) if many), default=0.0)
    marks = []
    for v, many, found in zip(vivid, enough, groups, strict=True):
        doubt = f"no {LEAST_MARKS} marks have its colour, as they have another" if any(enough) and not many else ""
        doubt = "its colour hardly stands apart beside the others'" if v < least else doubt
        marks += [replace(mark, doubt=mark.doubt or doubt) for mark in found]
    marks.sort(key=lambda mark: int(mark.pixels[0]))
    holes = len(candidates) - len(marks)
    note = f"{holes} spots of another colour lie behind the surface: taken for holes, not for marks"
    return tuple(marks), (note,) if holes else ()


def _usual_m(candidates: Sequence[_Candidate]) -> np.ndarray:
    """Return sizes (3,) such that half of the spots' area is in larger ones: chips do not count much."""
    areas = np.array([c.spot.area_m2 for c in candidates])
    sizes = np.array([c.sizes_m for c in candidates])
    order = np.argsort(sizes, axis=0, kind="stable")
    middle = (np.cumsum(areas[order], axis=0) >= areas.sum() / 2).argmax(axis=0)
    return np.array([sizes[order[row, axis], axis] for axis, row in enumerate(middle)])
