"""Decides which coloured spots are marks, and which marks are doubtful.

A mark lies on the target's surface: what lies behind it is a hole through which something of another colour is seen.
Pieces of tape of one colour are alike: which of them is the odd one, its colour's median tells, if there are three.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.marks.blobs import Blob
from detectors.marks.mark import LEAST_MARKS, Mark
from detectors.marks.patch import Spot
from harness.vocabulary.units import MM

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
"""Share of the target: a larger spot is no mark but a part of the target of another colour."""


@dataclass(frozen=True)
class Candidate:
    """A spot with its pixels, and its share of the target's."""

    blob: Blob
    spot: Spot
    share: float

    @property
    def behind(self) -> bool:
        """True if it lies behind the surface."""
        return self.spot.behind_m > max(BEHIND_M, BEHIND_SIGMAS * self.spot.behind_sigma_m)


def judged(candidates: Sequence[Candidate]) -> tuple[tuple[Mark, ...], tuple[str, ...]]:
    """The marks, in the order of their pixels, and notes on what was taken for none."""
    colours = []
    for group in _by_colour(candidates):
        # a colour most of whose area lies behind has no mark: holes too small to look deep share the colour of others
        behind = sum(c.spot.area_m2 for c in group if c.behind)
        if behind <= 0.5 * sum(c.spot.area_m2 for c in group):
            colours.append([c for c in group if not c.behind])
    colours = [group for group in colours if group]
    groups = [_marks_of(group) for group in colours]
    vivid = [float(np.linalg.norm(group[0].blob.contrast)) for group in colours]
    enough = [sum(not mark.doubt for mark in group) >= LEAST_MARKS for group in groups]
    least = WEAK_SHARE * max((v for v, many in zip(vivid, enough, strict=True) if many), default=0.0)
    marks = [
        replace(mark, doubt=mark.doubt or _doubt_of_colour(v < least, any(enough) and not many))
        for v, many, group in zip(vivid, enough, groups, strict=True)
        for mark in group
    ]
    marks.sort(key=lambda mark: int(mark.pixels[0]))
    holes = len(candidates) - len(marks)
    note = f"{holes} spots of another colour lie behind the surface: taken for holes, not for marks"
    return tuple(marks), (note,) if holes else ()


def _doubt_of_colour(weak: bool, alone: bool) -> str:
    if weak:
        return "its colour hardly stands apart beside the others'"
    return f"no {LEAST_MARKS} marks have its colour, as they have another" if alone else ""


def _by_colour(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Candidates in groups of one colour, each compared with the first of its group."""
    groups: list[list[Candidate]] = []
    for candidate in sorted(candidates, key=lambda c: (-c.spot.area_m2, int(c.blob.pixels[0]))):
        for group in groups:
            apart = np.linalg.norm(candidate.blob.contrast - group[0].blob.contrast)
            if apart < SAME_COLOUR * np.linalg.norm(group[0].blob.contrast):
                group.append(candidate)
                break
        else:
            groups.append([candidate])
    return groups


def _marks_of(group: Sequence[Candidate]) -> list[Mark]:
    """The marks of one colour, with their doubts."""
    whole = [c.spot for c in group if not c.blob.doubt]
    usual = _usual(whole) if len(whole) >= 3 else None
    return [
        Mark(
            centre_m=c.spot.centre_m,
            covariance_m2=c.spot.covariance_m2(c.blob.grid_covariance),
            normal=c.spot.normal,
            pixels=c.blob.pixels[c.blob.weights > 0.5],
            area_m2=c.spot.area_m2,
            doubt=_doubt(c, usual),
        )
        for c in group
    ]


def _sizes_m(spot: Spot) -> np.ndarray:
    """(3,) length, breadth, and the mean breadth over the length, which gaps lessen."""
    return np.array([spot.length_m, spot.breadth_m, spot.area_m2 / spot.length_m])


def _in_words(sizes_m: np.ndarray) -> str:
    length, breadth, mean_breadth = sizes_m
    return f"{length / MM:.0f} x {breadth / MM:.0f} mm, {100 * min(mean_breadth / breadth, 1.0):.0f} % filled"


def _usual(spots: Sequence[Spot]) -> np.ndarray:
    """(3,) sizes such that half of the spots' area is in larger ones: chips do not count much."""
    areas = np.array([spot.area_m2 for spot in spots])
    sizes = np.array([_sizes_m(spot) for spot in spots])
    order = np.argsort(sizes, axis=0, kind="stable")
    middle = (np.cumsum(areas[order], axis=0) >= areas.sum() / 2).argmax(axis=0)
    return np.array([sizes[order[row, axis], axis] for axis, row in enumerate(middle)])


def _doubt(candidate: Candidate, usual: np.ndarray | None) -> str:
    spot = candidate.spot
    if candidate.blob.doubt:
        return candidate.blob.doubt
    if candidate.share > LARGEST_SHARE:
        return f"{100 * candidate.share:.0f} % of the target: a part of it rather than a mark"
    if -spot.behind_m > max(RAISED_SHARE * spot.breadth_m, BEHIND_SIGMAS * spot.behind_sigma_m):
        return f"it stands {-spot.behind_m / MM:.0f} mm before the surface"
    if usual is None:
        return ""
    own = _sizes_m(spot)
    if np.any(np.abs(own - usual) > UNLIKE_SHARE * usual + UNLIKE_PIXELS * spot.pitch_m):
        return f"unlike the others: {_in_words(own)}, they {_in_words(usual)}"
    return ""
