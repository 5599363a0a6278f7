"""The choice of the target among a view's smooth surfaces: the nearest large one, and how sure that is.

Every two surfaces are compared by what is seen at their outlines: one stands before the other, lies on it, shows
through its hole, or they only meet. Each comparison gives odds that the one and not the other is the target; the
surface with the best odds is proposed, and where some of them are poor, the choice is called doubtful. The odds are a
model of how people take pictures of a target, not a measured rate; the constants below state it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from detectors.masks import grown, holes_filled, inset, nearest_pixel
from detectors.smooth_surfaces import Surfaces, raster, smooth_surfaces
from harness.vocabulary.capture import Cloud
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM

DOUBTFUL_BELOW = 0.8
"""Probability of a comparison below which the choice is called doubtful."""
CENTRE_SPREAD = 0.25
"""Standard deviation of the weight that pixels have, as a share of the picture's width and height. People aim at the
target."""
LYING_WEIGHT, STANDING_WEIGHT = 0.10, 0.02
"""Weight in the view at which a thing is as likely the target as the surface that it lies on, or stands far before."""
OBSTACLE_AREA = 0.2
"""Area, as a part of that of a target seen whole behind it, at which a thing before it is as likely the target."""
GRAZING = 0.5
"""Cosine of the tilt, 60 degrees, beyond which a surface counts for less: nobody inspects at a grazing angle, and the
pixels that mix two surfaces look like a third that is seen so."""
STEEPNESS = 2.0
"""Odds grow with this power of weights and areas."""
SURROUNDED = 0.7
"""Part of its outline inside the picture that must border on a surface for a thing to lie on it."""
BORDERING = 0.1
"""Part of an outline from which on two surfaces are neighbours."""
STEP_PART = 0.3
"""Part of a common border that must be a step: a board's foot meets the floor that its sides stand before."""
CUT_OFF = 0.15
"""Part of its outline on the edge of the picture from which on a surface goes on outside of it, as walls and floors."""
ENCLOSED = 0.9
MOST_SAMPLES = 20_000


@dataclass(frozen=True)
class Candidate:
    """A surface that may be the target.

    ``outline`` (h, w) bool on the choice's grid: its pixels and what they enclose, but for other candidates that stand
    before it. ``distance_m``, ``nearest_m``, ``farthest_m``: median, 1st and 99th percentile of z. ``extent_m``: sides
    of the smallest rectangle around it in its own mean plane, longer first. ``share``: part of all pixels that are its
    own. ``weight``: the same with pixels weighted towards the centre, less at a grazing angle. ``tilt_deg``: of its
    mean plane's normal to the viewing axis. ``cut_off``: part of its outline on the picture's edge.
    """

    outline: np.ndarray
    pixels: int
    distance_m: float
    nearest_m: float
    farthest_m: float
    extent_m: tuple[float, float]
    share: float
    weight: float
    tilt_deg: float
    cut_off: float


@dataclass(frozen=True)
class Choice:
    """``candidates``: the proposal first, then the others by their odds; ``taken``: the number, from 1, of the
    candidate that was taken. ``mask`` (h, w) bool: valid pixels of the cloud inside its outline. ``grid``: the cloud,
    or the raster that stands in for it, whose pixels the outlines count. ``warnings``: why the choice is doubtful."""

    candidates: tuple[Candidate, ...]
    taken: int
    mask: np.ndarray
    grid: Cloud
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Border:
    """A surface's border on another. ``part``: of its outline. ``ahead``, ``back``: the parts of this border at which
    the other lies behind, and before it, by more than `Surfaces.contact_m`. ``behind_m``: how far behind, the median of
    the former."""

    part: float
    ahead: float
    back: float
    behind_m: float

    @property
    def stands_before(self) -> bool:
        """True where the border is a step behind which the other lies."""
        return bool(self.ahead >= STEP_PART and self.ahead > 2.0 * self.back)


# ---------------------------------------------------------------- the choice


def propose(cloud: Cloud, crease_deg: float, smooth_px: int, inset_px: int, wanted: int | None) -> Choice:
    """Choose the target of a cloud with a valid point: the proposal, or candidate number ``wanted``.

    Raises UserError, with the candidates, where there is none of that number.
    """
    grid, spacings = cloud, 1.0
    if not cloud.organised:
        grid, rows, columns, spacings = raster(cloud.points_m[cloud.valid], cloud)
        smooth_px = max(3, 2 * round(smooth_px / spacings / 2) - 1)
        # the cell that holds the rim, and every cell that a point inset_px - 1 spacings farther in may lie in
        inset_px = math.ceil((inset_px - 1) / spacings) + 1 if inset_px else 0
    candidates, warnings = _candidates(smooth_surfaces(grid, crease_deg, smooth_px), grid, wanted)
    taken = wanted or 1
    if wanted is not None and wanted > len(candidates):
        known = "".join(f"\n  --target {n}: {described_text(each)}" for n, each in enumerate(candidates, start=1))
        raise UserError(
            f"--target {wanted}: there are {len(candidates)} large smooth surfaces",
            legal=f"1 to {len(candidates)}:{known}" if candidates else "none",
            fix="choose one of these, or draw the outline with --crop polygon:u,v,u,v,u,v",
        )
    mask = candidates[taken - 1].outline & grid.valid if candidates else np.zeros(grid.valid.shape, bool)
    mask = inset(mask, inset_px)
    if not cloud.organised:
        kept, mask = mask, cloud.valid.copy()
        mask[mask] = kept[rows, columns]
    return Choice(candidates, taken, mask, grid, warnings)


def described_text(candidate: Candidate) -> str:
    """Return distance, extent, share of the view and tilt in words."""
    long, short = (f"{side / MM:.0f}" for side in candidate.extent_m)
    depths = f"{candidate.nearest_m:.2f} to {candidate.farthest_m:.2f} m"
    share = f"{100 * candidate.share:.2g}" if candidate.share < 0.095 else f"{100 * candidate.share:.0f}"
    return (
        f"{candidate.distance_m:.2f} m away ({depths}), {long} x {short} mm, {share} % of the view, tilted by"
        f" {candidate.tilt_deg:.0f} degrees"
    )


def _candidates(surfaces: Surfaces, grid: Cloud, wanted: int | None) -> tuple[tuple[Candidate, ...], tuple[str, ...]]:
    """Return the candidates, best odds first, and what makes the first doubtful (nothing where the user chose)."""
    numbers = range(len(surfaces.own))
    described = [_described(surfaces, grid, number) for number in numbers]
    borders = [_borders(surfaces, grid, number) for number in numbers]

    def before(front: int, back: int) -> tuple[float, str] | None:
        """Return the probability that ``front`` is the target, and the reason for a doubt; None where it does not stand
        before ``back``."""
        ours = borders[front].get(back)
        if ours is None or not ours.stands_before:
            return None
        it, other = described[front], described[back]
        seen = f"covers {100 * it.share:.2g} % of the view"
        if encloses(front, back):
            opening = surfaces.own[back].sum() / max(surfaces.filled[front].sum(), 1)
            return _probability(0.5 / max(opening, 1e-6)), "a surface is seen through a large opening of another"
        if ours.part >= SURROUNDED and ours.behind_m <= it.extent_m[1]:
            why = f"a thing that {seen} lies on a larger surface, or is fixed before it"
            return _probability(it.weight / LYING_WEIGHT), why
        if other.cut_off < CUT_OFF:
            ratio = it.extent_m[0] * it.extent_m[1] / max(other.extent_m[0] * other.extent_m[1], 1e-12)
            why = f"a thing that {seen} stands before a surface that is seen whole"
            return _probability(ratio / OBSTACLE_AREA), why
        why = f"the nearer surface covers only {100 * it.share:.2g} % of the view"
        return _probability(it.weight / STANDING_WEIGHT), why

    def encloses(outer: int, inner: int) -> bool:
        own = surfaces.own[inner]
        return bool(np.count_nonzero(own & surfaces.filled[outer]) >= ENCLOSED * np.count_nonzero(own))

    def judged(i: int, j: int) -> tuple[float, str]:
        """Return the probability that surface i and not j is the target, and the reason for a doubt."""
        if i == j:
            return 1.0, ""
        ahead, behind = before(i, j), before(j, i)
        if ahead is not None:
            return ahead
        if behind is not None:
            return 1.0 - behind[0], behind[1]
        # of two that meet, or have nothing to do with one another, weight, a frontal view and nearness count
        it, other = described[i], described[j]
        ratio = it.weight / max(other.weight, 1e-9)
        facing = math.cos(math.radians(it.tilt_deg)) / max(math.cos(math.radians(other.tilt_deg)), 1e-2)
        near = other.distance_m / max(it.distance_m, 1e-6)
        return _probability(ratio**0.5 * facing**2 * near), "two surfaces are about as large and as near"

    def outline(number: int) -> np.ndarray:
        """Return the outline without what it encloses and what stands before it as a target of its own; a thing that
        lies on it stays."""
        found = described[number].outline
        for other in numbers:
            border = borders[other].get(number)
            own_target = border is not None and border.stands_before and table[other][number][0] >= 0.5
            if own_target and encloses(number, other):
                found = found & ~grown(surfaces.filled[other], surfaces.reach_px)
        return found

    table = [[judged(i, j) for j in numbers] for i in numbers]
    odds = [sum(math.log(probability) for probability, _ in row) for row in table]
    order = sorted(numbers, key=lambda number: (-odds[number], number))
    candidates = tuple(replace(described[number], outline=outline(number)) for number in order)
    against = [(place, *table[order[0]][other]) for place, other in enumerate(order[1:], start=2)]
    doubtful = [(place, why) for place, probability, why in against if probability < DOUBTFUL_BELOW]
    doubts = [f"{why} (--target {place} takes the other)" for place, why in doubtful]
    if wanted is not None or not doubts:
        return candidates, ()
    return candidates, (f"it is doubtful which surface is the target: {'; '.join(doubts)}",)


def _probability(odds_base: float) -> float:
    odds = max(odds_base, 1e-9) ** STEEPNESS
    return min(max(odds / (1.0 + odds), 1e-4), 1.0 - 1e-4)


# ---------------------------------------------------------------- one surface


def _described(surfaces: Surfaces, grid: Cloud, number: int) -> Candidate:
    own, filled = surfaces.own[number], surfaces.filled[number]
    places = np.flatnonzero(own)
    some = grid.points_m.reshape(-1, 3)[places[:: max(1, len(places) // MOST_SAMPLES)]]
    near, median, far = np.quantile(some[:, 2], (0.01, 0.5, 0.99)).tolist()
    centred = some - some.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    facing = min(abs(float(axes[2, 0])), 1.0)
    # the smallest rectangle around it in its own plane, without the outermost hundredth
    plan = centred @ axes[:, 1:]
    turn = math.radians(float(cv2.minAreaRect(plan.astype(np.float32))[2]))
    along = plan @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    low, high = np.quantile(along, (0.005, 0.995), axis=0)
    short, long = sorted(((high - low) / 0.99).tolist())
    # pixels weighted by a Gaussian about the picture's centre
    row, column = (np.exp(-0.5 * ((np.arange(n) + 0.5) / n - 0.5) ** 2 / CENTRE_SPREAD**2) for n in own.shape)
    weight = float(row @ own @ column / (row.sum() * column.sum()))
    # the picture's edge; without a pixel grid, what no point lies beyond
    outline = filled & ~(cv2.erode(filled.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0)
    if grid.organised:
        edge = np.ones(filled.shape, dtype=bool)
        edge[1:-1, 1:-1] = False
    else:
        edge = grown(~holes_filled(grown(grid.valid, 2)), 3)
    return Candidate(
        outline=filled,
        pixels=len(places),
        distance_m=median,
        nearest_m=near,
        farthest_m=far,
        extent_m=(long, short),
        share=len(places) / own.size,
        weight=weight * min(1.0, (facing / GRAZING) ** 2),
        tilt_deg=math.degrees(math.acos(facing)),
        cut_off=int(np.count_nonzero(outline & edge)) / max(int(np.count_nonzero(outline)), 1),
    )


def _borders(surfaces: Surfaces, grid: Cloud, number: int) -> dict[int, Border]:
    """Return the surfaces beyond this one's outline, by number."""
    filled, own = surfaces.filled[number], surfaces.own[number]
    apart, nearest = nearest_pixel(own)
    ring = np.flatnonzero((apart <= surfaces.reach_px + 3) & ~filled)
    z, seeds = grid.points_m[..., 2].reshape(-1), nearest.reshape(-1)
    outline = len(np.unique(seeds[ring]))
    found = {}
    for other in range(len(surfaces.own)):
        there = ring[surfaces.own[other].reshape(-1)[ring]]
        part = len(np.unique(seeds[there])) / max(outline, 1)
        if other != number and part >= BORDERING:
            steps = z[there] - z[seeds[there]]
            behind = steps[steps > surfaces.contact_m]
            away = float(np.median(behind)) if len(behind) else 0.0
            back = float((steps < -surfaces.contact_m).mean())
            found[other] = Border(part, len(behind) / len(steps), back, away)
    return found
