"""Chooses the detector of `tofpod detect` by evidence on the capture itself: each candidate seeks
virtual holes at random places of the judged target, at thresholds with equal false calls.

The holes are as wide as the capture's blur and up to two and a half times wider, and so deep that
some are found and some are not. They lie far apart and away from what the candidates find without
them. Where tags, print or objects raise the number of false calls of one candidate above that of
another, its threshold is raised for the comparison until both expect as many. All candidates see
the same holes in the same residuals. Only the scores are computed again, the fitted surface and the
thresholds are those of the capture; a large target is represented by the part with most free
places. Deterministic.

Where two candidates find as many but for chance, the one whose model of the camera fits is taken:
`matched` for a camera's own pixels, `local`, which has none, for upsampled ones.

Not modelled: damage of other shapes, the fit's reaction to it, and false calls beyond the number
that each threshold promises."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol, cast, runtime_checkable

import cv2
import numpy as np

from detectors.findings.null import behind
from detectors.findings.tails import Tail, threshold_at
from detectors.findings.virtual_holes import (
    VirtualHoles,
    places_apart,
    squares_px,
    with_holes,
)
from detectors.interface import Detector, Evidence
from detectors.methods.part import part_of_cloud, part_of_evidence
from detectors.pixels.masks import grown
from detectors.pixels.noise import WIDEST_NATIVE_PX, reach_of_one, sigma_of
from harness.inspection.arguments import expected_text
from harness.inspection.judging import FALLBACK, analysed, threshold_of
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.seeds import random_stream

WANTED = 60
"""Holes sought: the shares found of 60 differ by chance by up to 0.1, less than the candidates."""
FEWEST = 12
"""With fewer holes nothing is decided: one more or less is 8 %."""
MOST_ROUNDS = 6  # most pictures in which holes are sought at once
PART_PX = 500
"""Longest side of the part of a target that is judged: 60 holes of 8 to 20 pixels lie 60 apart."""
WIDTHS = (1.0, 1.6, 2.5)
"""Widths of holes, in widths of the blur: wider ones are found by every detector, or are shape."""
LEAST_BLUR_PX = 3.0  # narrower holes than 3 pixels are chance: their places decide
DEPTHS = (2.0, 3.2, 5.0, 8.0, 13.0)
"""Depths of holes as wide as the blur, in deviations of the residuals; wider ones are shallower in
proportion, as their pixels average. Thresholds of 4 to 6 lie in the middle."""
APART = 3.0
"""Distance of holes, in half widths of the widest with its blur: their surroundings are free."""
CHANCE = 2.0
"""Deviations from equality that chance does not explain. With one deviation, another draw of the
holes' places made the real drilled plate's choice `thesis` instead of `local`, which finds 55
of its holes instead of 45."""
TELLING = (0.1, 0.9)
"""The best candidate finds a share between these, or the depths are changed by `DEEPER`."""
DEEPER = 2.5
TRIES = 3  # of depths
SEED = 1


@runtime_checkable
class Rescoring(Protocol):
    """A detector that scores other residuals from the same surface."""

    def rescored(self, cloud: Cloud, evidence: Evidence, residual_m: np.ndarray) -> Evidence:
        """Return the evidence for other residuals (h, w), metres, on the same pixels."""
        ...


@dataclass(frozen=True)
class Contender:
    """A detector that has judged the capture."""

    detector: Detector
    settings: dict[str, Any]
    """Its settings as plain data."""
    evidence: Evidence
    """To search, with what its threshold left out."""
    threshold: float
    """Units of its score."""
    origin: str
    """Where the threshold comes from, in words."""
    is_known: bool
    """Whether its number of false calls is known."""

    @property
    def expected(self) -> float:
        """Number of false calls expected at the threshold, with those at tags, print and objects;
        NaN if the capture did not set the threshold."""
        null = self.evidence.notes.get("own_null", {})
        return float(null.get("expected", np.nan))

    def with_calls(self, calls: float) -> Contender:
        """Return the candidate at the threshold at which so many false calls are expected, which
        are no more than at its own."""
        null = self.evidence.notes["own_null"]
        tails = {name: Tail.from_facts(facts) for name, facts in null["tails"].items()}
        return replace(self, threshold=threshold_at(tails, calls, self.threshold))


@dataclass(frozen=True)
class _Sought:
    """The holes that candidates found of the same ones."""

    hits: dict[str, np.ndarray]
    """By candidate (n,) bool: which of the holes it found."""
    widths_mm: tuple[float, float]
    """Smallest and largest."""
    depths_mm: tuple[float, float]


def candidate_of(
    arguments: argparse.Namespace,
    loaded: tuple[Detector, dict[str, Any]],
    cloud: Cloud,
    quiet: Callable[[Detector], tuple[float, str]],
) -> Contender:
    """Let a detector with its settings judge a cloud at the threshold of the arguments
    (`threshold_of`)."""
    detector, settings = loaded
    evidence = analysed(detector, cloud)
    threshold, origin, evidence = threshold_of(
        arguments, detector, cloud, evidence, partial(quiet, detector)
    )
    is_known = not origin.startswith(FALLBACK)
    return Contender(detector, settings, evidence, threshold, origin, is_known)


def chosen(candidates: Sequence[Contender], cloud: Cloud, calls: str) -> Contender:
    """Return the candidate that finds most virtual holes. Its evidence gets a note ``choice`` with
    the reason in words, the counts and the holes' sizes.

    A candidate whose number of false calls is unknown is not compared with others whose is known.
    The first is taken unseen where no holes can be put in. ``calls``: the rate of false calls in
    words, if their number is not known."""
    first = candidates[0]
    if len(candidates) == 1:
        return noted(first, "as only it has these settings")
    if not cloud.organised:
        return noted(first, "as holes cannot be implanted without a grid of pixels")
    with_known_rate = [candidate for candidate in candidates if candidate.is_known]
    compared = with_known_rate or list(candidates)
    if len(compared) == 1:
        return noted(compared[0], "as only its number of false calls is known")
    reach_px = cloud.noise_reach_px
    if reach_px == 0.0:
        # a map, or frames that do not show it: what residuals share, with contours of rounding
        reach_px = reach_of_one(first.evidence.residual_m, 0.0)
    # at as many expected false calls as the one that expects fewest, if these numbers are known
    fewest = float(np.min([candidate.expected for candidate in compared]))
    searching = compared
    if np.isfinite(fewest):
        searching = [candidate.with_calls(fewest) for candidate in compared]
        calls = expected_text(fewest)
    sought = _sought(searching, cloud, reach_px)
    if sought is None:
        return noted(first, "as the target has no place for implanted holes")
    preferred = sorted(compared, key=lambda c: _rank(c.detector.name, reach_px))
    best = preferred[0]
    for rival in preferred[1:]:
        if _is_better(sought.hits[rival.detector.name], sought.hits[best.detector.name]):
            best = rival
    facts = {
        "found": {name: int(hits.sum()) for name, hits in sought.hits.items()},
        "implanted": len(next(iter(sought.hits.values()))),
        "widths_mm": sought.widths_mm,
        "depths_mm": sought.depths_mm,
        "noise_reach_px": reach_px,
        "left_out": [c.detector.name for c in candidates if c not in compared],
    }
    pixels = "upsampled pixels" if reach_px > WIDEST_NATIVE_PX else "a camera's own pixels"
    return noted(best, _reason(best.detector.name, sought, calls, pixels), facts)


def noted(candidate: Contender, why: str, facts: Mapping[str, Any] | None = None) -> Contender:
    """Return the candidate with a note ``choice`` that says why it was chosen, with ``facts``."""
    name = candidate.detector.name
    choice = {"detector": name, "text": f"{name}, {why}", **(facts or {})}
    notes = {**candidate.evidence.notes, "choice": choice}
    return replace(candidate, evidence=replace(candidate.evidence, notes=notes))


def _rank(name: str, reach_px: float) -> int:
    """Return the place of a candidate among those that find as many holes."""
    order = ("matched", "local", "thesis")
    if reach_px > WIDEST_NATIVE_PX:
        order = ("local", "matched", "thesis")
    return order.index(name)


def _is_better(by_first: np.ndarray, by_second: np.ndarray) -> bool:
    """Return whether the first finds more of the holes (n,) than chance explains by `CHANCE`
    deviations: among holes that only one of them finds, each has half with a deviation of half the
    root of their number."""
    only_first = int((by_first & ~by_second).sum())
    only_second = int((by_second & ~by_first).sum())
    deviation = np.sqrt(only_first + only_second)
    return bool(only_first - only_second > CHANCE * deviation)


def _reason(name: str, sought: _Sought, calls: str, pixels: str) -> str:
    """Say what the chosen detector found of the holes, and the others. ``pixels``: their kind in
    words, which decides where chance explains that others found as many or more."""
    counts = {other: int(hits.sum()) for other, hits in sought.hits.items()}
    own_count = counts.pop(name)
    rivals = ", ".join(f"{other} {count}" for other, count in counts.items())
    narrow, wide = sought.widths_mm
    shallow, deep = sought.depths_mm
    sizes = f"{narrow:.2g} to {wide:.2g} mm wide and {shallow:.2g} to {deep:.2g} mm deep"
    holes = len(sought.hits[name])
    text = f"as it found {own_count} of {holes} implanted holes ({sizes}) at {calls}; {rivals}"
    if own_count <= max(counts.values()):
        text += f", by chance: {name} suits {pixels}"
    return text


def _sought(candidates: Sequence[Contender], cloud: Cloud, reach_px: float) -> _Sought | None:
    """Implant holes, and see which of them each candidate finds; None if there is no place for
    them. Depths are changed if the best finds hardly any or nearly all."""
    squares = squares_px(reach_px)
    blur_px = max(LEAST_BLUR_PX, squares[0])
    half_px = (max(WIDTHS) * blur_px + sum(squares)) / 2
    free = _free_places(candidates, cloud, half_px)
    rows, columns = _best_part(free)
    parts = [
        replace(candidate, evidence=part_of_evidence(candidate.evidence, rows, columns))
        for candidate in candidates
    ]
    part = part_of_cloud(cloud, rows, columns)
    stream = random_stream(SEED, "implants")
    pictures: list[np.ndarray] = []
    count = 0
    for _ in range(MOST_ROUNDS):
        centres = places_apart(free[rows, columns], WANTED - count, APART * half_px, stream)
        if not len(centres):
            break
        pictures.append(centres)
        count += len(centres)
    if count < FEWEST:
        return None
    residuals_m = parts[0].evidence.residual_m
    noise_m = sigma_of(residuals_m[np.isfinite(residuals_m)])
    pitch_mm = float(np.nanmedian(np.abs(np.diff(part.points_m[..., 0], axis=1)))) / MM
    scale = 1.0
    for _ in range(TRIES):
        rounds = _holes(pictures, blur_px, scale * noise_m, stream)
        hits_by_name = {}
        for candidate in parts:
            of_rounds = [_found(candidate, part, holes, squares) for holes in rounds]
            hits_by_name[candidate.detector.name] = np.concatenate(of_rounds)
        best_share = max(float(hits.mean()) for hits in hits_by_name.values())
        if TELLING[0] <= best_share <= TELLING[1]:
            break
        scale *= DEEPER if best_share < TELLING[0] else 1.0 / DEEPER
    widths_mm = np.concatenate([holes.widths_px for holes in rounds]) * pitch_mm
    depths_mm = np.concatenate([holes.depths_m for holes in rounds]) / MM
    return _Sought(
        hits=hits_by_name,
        widths_mm=(float(widths_mm.min()), float(widths_mm.max())),
        depths_mm=(float(depths_mm.min()), float(depths_mm.max())),
    )


def _free_places(candidates: Sequence[Contender], cloud: Cloud, half_px: float) -> np.ndarray:
    """Return (h, w) bool: pixels that all candidates judge, with all pixels within ``half_px``,
    and farther than twice this from what any of them finds."""
    judged = np.ones(cloud.valid.shape, bool)
    taken = np.zeros(cloud.valid.size, bool)
    for candidate in candidates:
        judged &= np.isfinite(candidate.evidence.score)
        findings = candidate.detector.find(cloud, candidate.evidence, candidate.threshold)
        for finding in findings:
            taken[finding.pixels] = True
    # single pixels without return are a part of every capture
    closed = cv2.morphologyEx(judged.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    padded = np.pad(closed == 0, 1, constant_values=True)
    near_rim = grown(padded, int(np.ceil(half_px)))[1:-1, 1:-1]
    near_findings = grown(taken.reshape(judged.shape), int(np.ceil(2 * half_px)))
    return np.asarray(judged & ~near_rim & ~near_findings)


def _best_part(free: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the square of `PART_PX` with most free pixels (h, w)."""
    height = min(PART_PX, free.shape[0])
    width = min(PART_PX, free.shape[1])
    sums = cv2.integral(free.astype(np.uint8))
    counts = (sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width]) + sums[
        :-height, :-width
    ]
    top, left = np.unravel_index(int(counts.argmax()), counts.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def _holes(
    pictures: Sequence[np.ndarray],
    blur_px: float,
    noise_m: float,
    stream: np.random.Generator,
) -> list[VirtualHoles]:
    """Return holes at the places (n, 2) of each picture: all widths and depths in turn, in random
    order."""
    sizes = [(width, depth) for depth in DEPTHS for width in WIDTHS]
    count = sum(len(centres) for centres in pictures)
    order = stream.permutation(np.arange(count) % len(sizes))
    rounds = []
    done = 0
    for centres in pictures:
        taken = np.array([sizes[n] for n in order[done : done + len(centres)]])
        done += len(centres)
        holes = VirtualHoles(
            rows=centres[:, 0],
            columns=centres[:, 1],
            widths_px=taken[:, 0] * blur_px,
            depths_m=taken[:, 1] / taken[:, 0] * noise_m,
        )
        rounds.append(holes)
    return rounds


def _found(
    candidate: Contender,
    cloud: Cloud,
    holes: VirtualHoles,
    squares: tuple[float, ...],
) -> np.ndarray:
    """Return (n,) bool: which of the holes a candidate finds, by a finding behind the surface with
    a pixel inside the hole."""
    detector = cast("Rescoring", candidate.detector)
    residual_m = with_holes(candidate.evidence.residual_m, holes, squares)
    evidence = detector.rescored(cloud, candidate.evidence, residual_m)
    is_behind = behind(evidence).reshape(-1)
    is_called = np.zeros(cloud.valid.size, bool)
    for finding in candidate.detector.find(cloud, evidence, candidate.threshold):
        is_called[finding.pixels] = is_behind[finding.pixels]
    picture = is_called.reshape(cloud.valid.shape)
    hits = []
    for row, column, width_px in zip(holes.rows, holes.columns, holes.widths_px, strict=True):
        half = int(width_px / 2)
        rows = slice(max(row - half, 0), row + half + 1)
        columns = slice(max(column - half, 0), column + half + 1)
        hits.append(bool(picture[rows, columns].any()))
    return np.array(hits)
