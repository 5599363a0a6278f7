"""The pixels that belong to the target: in a box, in a polygon of the image, or on the nearest
large smooth surface.

Two surfaces are compared at their outlines: one is in front of the other, lies on it or is visible
through its hole, or they only meet. The surface with the best odds under a model of how people
photograph a target is proposed; if the odds are poor, the choice is reported as doubtful."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, cast

import cv2
import numpy as np
from pydantic import Field, model_validator

from detectors.masks import grown, holes_filled, inset, nearest_pixel, notches_filled, parts_with
from detectors.surfaces.smooth_surfaces import Surfaces, raster, smooth_surfaces
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud

DOUBTFUL_BELOW = 0.8  # probability of a comparison below which the choice is called doubtful
# the choice is also doubtful if this many other surfaces are at least half as large, as in a heap
# of stones
CROWD = 4
CENTRE_SPREAD = 0.25
"""Standard deviation of the pixels' weights as a share of the picture's sides: people aim at the
target."""
LYING_WEIGHT = 0.10
STANDING_WEIGHT = 0.02
"""Weight in the view of an object that is as likely the target as the surface under it, or as one
far behind it."""
OBSTACLE_AREA = 0.2
"""Area of an object that is as likely the target as the uncut surface behind it, as a share of
that surface's area."""
GRAZING = 0.5
"""Cosine of the tilt (60 degrees) from which a surface counts for less: nobody inspects at a
grazing angle, and pixels that mix two surfaces look like a third surface at such an angle."""
STEEPNESS = 2.0  # odds grow with this power of weights and areas
SURROUNDED = 0.7
BORDERING = 0.1
STEP_PART = 0.3
"""Shares of the outline on the surface under an object, and on a neighbour; share of a border that
is a step."""
CUT_OFF = 0.15
"""Share of the outline on the picture's edge from which a surface continues outside it, as walls
and floors do."""
NOTCHES_PX = (8, 16)
"""Radii of the discs that close notches of the outline: the edge's blur hides a strip of up to
about 8 pixels between a hole and the edge, and the hole opens to the outside. Wider gaps belong to
the part's shape."""
ENCLOSED = 0.9
MOST_SAMPLES = 20_000


@dataclass(frozen=True, eq=False)
class Candidate:
    """A surface that may be the target. ``own`` (h, w) bool on the choice's ``grid``: its pixels.
    ``filled``: the same with all that they enclose. ``outline``: the same without other candidates
    in front of it."""

    own: np.ndarray
    filled: np.ndarray
    outline: np.ndarray
    grid: Cloud

    @property
    def share(self) -> float:
        """Share of all pixels."""
        return float(self.own.mean())

    @cached_property
    def depths_m(self) -> tuple[float, float, float]:
        """First, 50th and 99th percentile of z."""
        near, middle, far = np.quantile(self._some[:, 2], (0.01, 0.5, 0.99)).tolist()
        return near, middle, far

    @property
    def tilt_deg(self) -> float:
        """Angle between the mean plane and the image plane."""
        return math.degrees(math.acos(self._facing))

    @cached_property
    def extent_m(self) -> tuple[float, float]:
        """Sides, longer first, of the smallest rectangle in the mean plane that holds 99 % of the
        surface."""
        plan = self._plane[0] @ self._plane[1][:, 1:]
        turn = math.radians(float(cv2.minAreaRect(plan.astype(np.float32))[2]))
        along = plan @ np.array(
            [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
        )
        low, high = np.quantile(along, (0.005, 0.995), axis=0)
        short, long = sorted(((high - low) / 0.99).tolist())
        return long, short

    @cached_property
    def weight(self) -> float:
        """Share of the pixels, weighted by a Gaussian about the picture's centre and reduced at a
        grazing angle."""
        row, column = (
            np.exp(-0.5 * ((np.arange(n) + 0.5) / n - 0.5) ** 2 / CENTRE_SPREAD**2)
            for n in self.own.shape
        )
        weighted = float(row @ self.own @ column / (row.sum() * column.sum()))
        return weighted * min(1.0, (self._facing / GRAZING) ** 2)

    @cached_property
    def cut_off(self) -> float:
        """Share of the outline on the picture's edge, or without a pixel grid on the border of the
        cloud."""
        outline = self.filled & ~(
            cv2.erode(self.filled.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
        )
        if self.grid.organised:
            edge = np.ones(self.filled.shape, dtype=bool)
            edge[1:-1, 1:-1] = False
        else:
            edge = grown(~holes_filled(grown(self.grid.valid, 2)), 3)
        return int(np.count_nonzero(outline & edge)) / max(int(np.count_nonzero(outline)), 1)

    def continues(self, other: Candidate, apart_m: float) -> bool:
        """Return whether this flat surface and the other lie in one plane: 90 % of the points
        within ``apart_m``."""
        normal = self._plane[1][:, 0]
        middle = self._some.mean(axis=0)
        off_m = [np.quantile(np.abs((each._some - middle) @ normal), 0.9) for each in (self, other)]
        return bool(max(off_m) <= apart_m)

    @property
    def _facing(self) -> float:
        return min(abs(float(self._plane[1][2, 0])), 1.0)

    @cached_property
    def _some(self) -> np.ndarray:
        """An even sample (n, 3) of its points."""
        places = np.flatnonzero(self.own)
        return np.asarray(
            self.grid.points_m.reshape(-1, 3)[places[:: max(1, len(places) // MOST_SAMPLES)]]
        )

    @cached_property
    def _plane(self) -> tuple[np.ndarray, np.ndarray]:
        """The sample minus its mean, and its principal axes (3, 3), the normal first."""
        centred = self._some - self._some.mean(axis=0)
        return centred, np.linalg.eigh(centred.T @ centred)[1]


@dataclass(frozen=True)
class Choice:
    """``candidates``: the proposal first. ``taken``: number, from 1, of the candidate that was
    taken. ``mask`` (h, w) bool: valid pixels inside its outline. ``grid``: the cloud, or its
    raster. ``warnings``: doubts about the choice."""

    candidates: tuple[Candidate, ...]
    taken: int
    mask: np.ndarray
    grid: Cloud
    warnings: tuple[str, ...] = ()


class _Border(NamedTuple):
    """Border on another surface: its share of the outline, whether it is a step, and its height in
    metres."""

    part: float
    is_step: bool
    behind_m: float


def described_text(candidate: Candidate) -> str:
    """Return distance, extent, share of the view and tilt as a text."""
    long, short = (f"{side / MM:.0f}" for side in candidate.extent_m)
    near, middle, far = candidate.depths_m
    share = (
        f"{100 * candidate.share:.2g}"
        if candidate.share < 0.095
        else f"{100 * candidate.share:.0f}"
    )
    size = f"{long} x {short} mm, {share} % of the view, tilted by {candidate.tilt_deg:.0f} degrees"
    return f"{middle:.2f} m away ({near:.2f} to {far:.2f} m), {size}"


def _candidates(surfaces: Surfaces, grid: Cloud) -> tuple[tuple[Candidate, ...], list[str]]:
    """Return the candidates, best odds first, and warnings about taking the first."""
    numbers = range(len(surfaces.own))
    outlines = zip(surfaces.own, surfaces.filled, strict=True)
    described = [Candidate(own, filled, filled, grid) for own, filled in outlines]
    borders = [_borders(surfaces, grid, number) if len(numbers) > 1 else {} for number in numbers]

    def encloses(outer: int, inner: int) -> bool:
        own = surfaces.own[inner]
        return bool(
            np.count_nonzero(own & surfaces.filled[outer]) >= ENCLOSED * np.count_nonzero(own)
        )

    def before(front: int, back: int) -> tuple[float, str] | None:
        """Return the probability that ``front`` is the target, and the reason for a doubt."""
        ours = borders[front].get(back)
        if ours is None or not ours.is_step:
            return None
        this = described[front]
        other = described[back]
        covered = f"{100 * this.share:.2g} % of the view"
        if encloses(front, back):
            opening = surfaces.own[back].sum() / max(surfaces.filled[front].sum(), 1)
            return _probability(
                0.5 / max(opening, 1e-6)
            ), "a surface is seen through a large opening of another"
        if ours.part >= SURROUNDED and ours.behind_m <= this.extent_m[1]:
            why = f"an object that covers {covered} lies on a larger surface or close to it"
            return _probability(this.weight / LYING_WEIGHT), why
        if other.cut_off < CUT_OFF:
            ratio = (
                this.extent_m[0]
                * this.extent_m[1]
                / max(other.extent_m[0] * other.extent_m[1], 1e-12)
            )
            why = f"an object that covers {covered} stands in front of a surface whose outline is whole"
            return _probability(ratio / OBSTACLE_AREA), why
        return _probability(
            this.weight / STANDING_WEIGHT
        ), f"the nearer surface covers only {covered}"

    def judged(i: int, j: int) -> tuple[float, str]:
        """Return the probability that surface i rather than j is the target, and the reason for a
        doubt."""
        if i == j:
            return 1.0, ""
        ahead = before(i, j)
        behind = before(j, i)
        if ahead is not None:
            return ahead
        if behind is not None:
            return 1.0 - behind[0], behind[1]
        # if the two only meet or are apart, weight, a frontal view and nearness decide
        this = described[i]
        other = described[j]
        ratio = this.weight / max(other.weight, 1e-9)
        facing = math.cos(math.radians(this.tilt_deg)) / max(
            math.cos(math.radians(other.tilt_deg)), 1e-2
        )
        near = other.depths_m[1] / max(this.depths_m[1], 1e-6)
        return _probability(
            ratio**0.5 * facing**2 * near
        ), "two surfaces are about as large and as near"

    table = [[judged(i, j) for j in numbers] for i in numbers]
    odds = [sum(math.log(probability) for probability, _ in row) for row in table]
    order = sorted(numbers, key=lambda number: (-odds[number], number))
    candidates = []
    for number in order:
        # The outline includes holes that the edge cuts. A surface in front of it that is a better
        # target, or too far away to lie on it, is left out with all nearer pixels that join it
        # (fingers of a hand);
        # an object on it stays.
        outline = described[number].outline
        for radius_px in NOTCHES_PX:
            outline = notches_filled(outline, radius_px)
        for other in numbers:
            border = borders[other].get(number)
            stands = border and (
                table[other][number][0] >= 0.5 or border.behind_m > described[other].extent_m[0]
            )
            if border and stands and border.is_step and encloses(number, other):
                nearer = grid.points_m[..., 2] < described[other].depths_m[2] + border.behind_m / 2
                joined = surfaces.filled[other] | (nearer & ~surfaces.own[number])
                outline = outline & ~grown(
                    parts_with(joined, surfaces.own[other]), surfaces.reach_px
                )
        candidates.append(replace(described[number], outline=outline))
    against = [(place, *table[order[0]][other]) for place, other in enumerate(order[1:], start=2)]
    close = [(place, why) for place, probability, why in against if probability < DOUBTFUL_BELOW]
    doubts = [f"{why} (--target {place} takes the other)" for place, why in close]
    doubts = [f"it is doubtful which surface is the target: {'; '.join(doubts)}"] if doubts else []
    if (alike := sum(2 * each.share >= candidates[0].share for each in candidates[1:])) >= CROWD:
        doubts.append(
            f"{alike} other surfaces are half as large as target 1 or larger: the scene may hold no target"
        )
    further = [
        str(n)
        for n, each in enumerate(candidates[1:], 2)
        if candidates[0].continues(each, surfaces.contact_m)
    ]
    if further:
        also = "targets {} lie" if len(further) > 1 else "target {} lies"
        part = f"{also.format(' and '.join(further))} in the plane of target 1 and may belong to it"
        doubts.append(f"{part}: only target 1 is judged (--target takes another)")
    return tuple(candidates), doubts


def _probability(odds_base: float) -> float:
    odds = max(odds_base, 1e-9) ** STEEPNESS
    return min(max(odds / (1.0 + odds), 1e-4), 1.0 - 1e-4)


def _borders(surfaces: Surfaces, grid: Cloud, number: int) -> dict[int, _Border]:
    """Return the borders of this surface's outline on other surfaces, by their numbers."""
    apart, nearest = nearest_pixel(surfaces.own[number])
    ring = np.flatnonzero((apart <= surfaces.reach_px + 3) & ~surfaces.filled[number])
    z = grid.points_m[..., 2].reshape(-1)
    seeds = nearest.reshape(-1)
    outline = len(np.unique(seeds[ring]))
    found = {}
    for other in range(len(surfaces.own)):
        there = ring[surfaces.own[other].reshape(-1)[ring]]
        part = len(np.unique(seeds[there])) / max(outline, 1)
        if other != number and part >= BORDERING:
            steps = z[there] - z[seeds[there]]
            behind = steps[steps > surfaces.contact_m]
            ahead = len(behind) / len(steps)
            back = float((steps < -surfaces.contact_m).mean())
            away = float(np.median(behind)) if len(behind) else 0.0
            found[other] = _Border(part, ahead >= STEP_PART and ahead > 2.0 * back, away)
    return found


RIM_PX = 3
"""Width of the rim where target and background mix: a 5 x 5 window reaches 2 pixels, and the edge
crosses a third."""


class _Crop(Config):
    """``inset_px``: number of pixels to remove along the target's outer rim, where pixels mix
    target and background. Holes inside the target do not grow; the edge of the image is not a rim.
    """

    inset_px: int = Field(default=0, ge=0, le=200)


class NoCrop(_Crop):
    """Takes every valid pixel."""

    kind: Literal["none"] = "none"


class BoxCrop(_Crop):
    """Takes points in an open box (default: the thesis') in the camera's frame. ``range_max_m``:
    of sqrt(x^2 + z^2)."""

    kind: Literal["box"] = "box"
    x_mm: tuple[float, float] = (-500.0, 400.0)
    y_mm: tuple[float, float] = (-300.0, 190.0)
    z_mm: tuple[float, float] = (0.0, 1100.0)
    range_max_m: float | None = Field(default=1.0, gt=0)

    @model_validator(mode="after")
    def _ordered(self) -> BoxCrop:
        for name in ("x_mm", "y_mm", "z_mm"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(
                    f"{name}: the lower limit {low:g} must be below the upper limit {high:g}"
                )
        return self


class PolygonCrop(_Crop):
    """Takes pixels whose centre lies inside a polygon of sensor positions [u, v] (even-odd rule)."""

    kind: Literal["polygon"] = "polygon"
    vertices_px: tuple[tuple[float, float], ...] = Field(min_length=3)


class AutoCrop(_Crop):
    """Takes the nearest large smooth surface, or number ``target`` of the candidates that a run
    lists.

    Neighbours are joined if tilt and noise explain their step in z and the surface bends by at
    most ``crease_deg`` over ``smooth_px``; then holes are filled, and ``inset_px`` is removed at
    the rim. A background so near that blur leaves no crease counts as target (13 mm behind the
    face, at 0.7 m with a 5 x 5 window). A cloud without a grid is treated as a raster of its
    nearest points."""

    kind: Literal["auto"] = "auto"
    inset_px: int = Field(default=RIM_PX, ge=0, le=200)
    crease_deg: float = Field(default=35.0, gt=0, le=90)
    smooth_px: int = Field(default=9, ge=3, le=99)
    target: int | None = Field(default=None, ge=1, le=99)


AnyCrop = NoCrop | BoxCrop | PolygonCrop | AutoCrop
CropConfig = Annotated[AnyCrop, Field(discriminator="kind")]
"""A crop as the user writes it: ``kind: none | box | polygon | auto`` and the fields of that kind.
"""


def crop(cloud: Cloud, config: AnyCrop) -> np.ndarray:
    """Return (h, w) bool: the valid pixels that belong to the target. Raises UserError if no pixel
    is left, with the cloud's extent, and for a polygon on a cloud without a grid."""
    valid = cloud.valid
    if not valid.any():
        raise UserError("the cloud has no valid point to crop", fix="check the capture")
    if isinstance(config, AutoCrop):
        mask = choice_of(cloud, config).mask
    elif isinstance(config, BoxCrop):
        mask = _box(cloud, config)
    elif isinstance(config, PolygonCrop):
        mask = _polygon(cloud, config)
    else:
        mask = valid
    if cloud.organised and not isinstance(config, AutoCrop):
        mask = inset(mask, config.inset_px)
    if mask.any():
        return mask
    points = cloud.points_m[valid]
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0) / MM, points.max(axis=0) / MM
    extent = f"x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f}, z {z0:.0f} to {z1:.0f} mm"
    if isinstance(config, BoxCrop):
        limits = zip("xyz", (config.x_mm, config.y_mm, config.z_mm), strict=True)
        asked = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in limits)
        asked += (
            ""
            if config.range_max_m is None
            else f" mm and sqrt(x^2 + z^2) < {1e3 * config.range_max_m:g}"
        )
        unit = "; the cloud's unit is probably not the metre" if z1 > 50_000 or z1 < 5 else ""
        what = f"the crop box ({asked} mm) holds none of the cloud's {len(points)} points{unit}"
        fix = "change crop.x_mm, crop.y_mm, crop.z_mm, or use crop.kind: auto"
        raise UserError(what, legal=f"limits that contain points of the cloud: {extent}", fix=fix)
    seen = cloud.region
    where = f"columns {seen.col0} to {seen.col1 - 1}, rows {seen.row0} to {seen.row1 - 1}"
    what = f"the crop ({config.kind}, inset {config.inset_px} px) leaves none of the cloud's {len(points)} points"
    legal = f"a crop that contains points of the cloud: {where}; {extent}"
    raise UserError(what, legal=legal, fix="change the crop or lower crop.inset_px")


def choice_of(cloud: Cloud, config: AutoCrop) -> Choice:
    """Return the automatic crop of a cloud with a valid point, and all candidates. UserError
    without ``target``. It is computed once for a cloud."""
    if config not in cloud.crops:
        cloud.crops[config] = _choice_of(cloud, config)
    return cast("Choice", cloud.crops[config])


def _choice_of(cloud: Cloud, config: AutoCrop) -> Choice:
    grid = cloud
    smooth_px = config.smooth_px
    inset_px = config.inset_px
    wanted = config.target
    if not cloud.organised:
        grid, rows, columns, spacings = raster(cloud.points_m[cloud.valid], cloud)
        smooth_px = max(3, 2 * round(smooth_px / spacings / 2) - 1)
        # the cell of the rim, and all cells that may hold a point inset_px - 1 spacings farther
        # inside
        inset_px = math.ceil((inset_px - 1) / spacings) + 1 if inset_px else 0
    candidates, doubts = _candidates(smooth_surfaces(grid, config.crease_deg, smooth_px), grid)
    if wanted is not None and wanted > len(candidates):
        known = "".join(
            f"\n  --target {n}: {described_text(each)}"
            for n, each in enumerate(candidates, start=1)
        )
        legal = f"1 to {len(candidates)}:{known}" if candidates else "none"
        fix = "choose one of these, or draw the outline with --crop polygon:u,v,u,v,u,v"
        raise UserError(
            f"--target {wanted}: there are {len(candidates)} large smooth surfaces",
            legal=legal,
            fix=fix,
        )
    taken = wanted or 1
    mask = (
        candidates[taken - 1].outline & grid.valid
        if candidates
        else np.zeros(grid.valid.shape, bool)
    )
    mask = inset(mask, inset_px)
    if not cloud.organised:
        kept = mask
        mask = cloud.valid.copy()
        mask[mask] = kept[rows, columns]
    mask.flags.writeable = False
    return Choice(candidates, taken, mask, grid, () if wanted else tuple(doubts))


def _box(cloud: Cloud, config: BoxCrop) -> np.ndarray:
    x, y, z = np.moveaxis(cloud.points_m, -1, 0)
    limits = [
        (v, low * MM, high * MM)
        for v, (low, high) in ((x, config.x_mm), (y, config.y_mm), (z, config.z_mm))
    ]
    with np.errstate(invalid="ignore"):
        inside = np.logical_and.reduce(
            [cloud.valid, *((v > low) & (v < high) for v, low, high in limits)]
        )
        if config.range_max_m is not None:
            inside &= np.hypot(x, z) < config.range_max_m
    return np.asarray(inside)


def _polygon(cloud: Cloud, config: PolygonCrop) -> np.ndarray:
    if not cloud.organised:
        what = "a polygon in pixels cannot crop a cloud without a pixel grid"
        raise UserError(what, legal="crop.kind none, box or auto")
    v, u = np.mgrid[
        cloud.region.row0 : cloud.region.row1, cloud.region.col0 : cloud.region.col1
    ].astype(float)
    inside = np.zeros(u.shape, dtype=bool)
    corners = np.array(config.vertices_px)
    for (u0, v0), (u1, v1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if v0 == v1:
            continue
        crossing = u0 + (v - v0) / (v1 - v0) * (u1 - u0)
        inside ^= ((v0 <= v) != (v1 <= v)) & (u < crossing)
    return inside & cloud.valid
