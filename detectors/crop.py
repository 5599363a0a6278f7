"""The pixels that belong to the target: in a box, in a polygon of the image, or on the nearest
large smooth surface.

Two surfaces are compared at their outlines: one is in front of the other, lies on it or is visible
through its hole, or they only meet. The surface with the best odds under a model of how people
photograph a target is proposed; if the odds are poor, the choice is reported as doubtful."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, NamedTuple, NoReturn, cast

import cv2
import numpy as np
from pydantic import Field, model_validator

from detectors.pixels.masks import (
    grown,
    holes_filled,
    inset,
    nearest_pixel,
    notches_filled,
    parts_with,
)
from detectors.surfaces.smooth_surfaces import LEAST_PX, Surfaces, raster, smooth_surfaces
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud

# --- which surface people photograph ---

CENTRE_SPREAD = 0.25
"""Standard deviation of the pixels' weights as a share of the picture's sides: people aim at the
target."""
GRAZING = 0.5
"""Cosine of the tilt (60 degrees) from which a surface counts for less: nobody inspects at a
grazing angle, and pixels that mix two surfaces look like a third surface at such an angle."""
LYING_WEIGHT = 0.10
"""Weight in the view of an object that is as likely the target as the surface under it."""
STANDING_WEIGHT = 0.02  # the same of an object as likely as a surface far behind it
OBSTACLE_AREA = 0.2
"""Area of an object that is as likely the target as the uncut surface behind it, as a share of
that surface's area."""
STEEPNESS = 2.0  # odds grow with this power of weights and areas
DOUBTFUL_BELOW = 0.8  # probability of a comparison below which the choice is called doubtful
CROWD = 4
"""The choice is also doubtful if this many other surfaces are at least half as large, as in a heap
of stones."""

# --- outlines ---

SURROUNDED = 0.7  # share of the outline of an object that is on the surface under it
BORDERING = 0.1  # share of the outline that is on a neighbour
STEP_PART = 0.3  # share of a border that is a step
ENCLOSED = 0.9  # share of a surface inside another's outline that is seen through it
CUT_OFF = 0.15
"""Share of the outline on the picture's edge from which a surface continues outside it, as walls
and floors do."""
NOTCHES_PX = (8, 16)
"""Radii of the discs that close notches of the outline: the edge's blur hides a strip of up to
about 8 pixels between a hole and the edge, and the hole opens to the outside. Wider gaps belong to
the part's shape."""
RIM_PX = 3
"""Width of the rim where target and background mix: a 5 x 5 window reaches 2 pixels, and the edge
crosses a third."""
MOST_SAMPLES = 20_000  # points from which a surface's plane and extent are computed


# --- candidates ---


@dataclass(frozen=True, eq=False)
class Candidate:
    """A surface that may be the target."""

    mask: np.ndarray
    """(h, w) bool on the choice's ``grid``: its pixels."""
    filled: np.ndarray
    """(h, w) bool: its pixels and all that they enclose."""
    outline: np.ndarray
    """(h, w) bool: the filled ones without other candidates in front of it."""
    grid: Cloud

    @property
    def share(self) -> float:
        """Share of all pixels."""
        return float(self.mask.mean())

    @cached_property
    def depths_m(self) -> tuple[float, float, float]:
        """First, 50th and 99th percentile of z."""
        first, middle, last = np.quantile(self._sample_m[:, 2], (0.01, 0.5, 0.99)).tolist()
        return first, middle, last

    @property
    def tilt_deg(self) -> float:
        """Angle between the mean plane and the image plane."""
        return math.degrees(math.acos(self._facing))

    @cached_property
    def extent_m(self) -> tuple[float, float]:
        """Sides, longer first, of the smallest rectangle in the mean plane that holds 99 % of the
        surface."""
        centred_m, axes = self._plane
        plan = centred_m @ axes[:, 1:]
        _, _, turn_deg = cv2.minAreaRect(plan.astype(np.float32))
        turn = math.radians(float(turn_deg))
        cosine = math.cos(turn)
        sine = math.sin(turn)
        along = plan @ np.array([[cosine, -sine], [sine, cosine]])
        low, high = np.quantile(along, (0.005, 0.995), axis=0)
        short, long = sorted(((high - low) / 0.99).tolist())
        return long, short

    @cached_property
    def weight(self) -> float:
        """Share of the pixels, weighted by a Gaussian about the picture's centre and reduced at a
        grazing angle."""
        height, width = self.mask.shape
        rows = _centre_weights(height)
        columns = _centre_weights(width)
        weighted = float(rows @ self.mask @ columns / (rows.sum() * columns.sum()))
        return weighted * min(1.0, (self._facing / GRAZING) ** 2)

    @cached_property
    def cut_off(self) -> float:
        """Share of the outline on the picture's edge, or without a pixel grid on the border of the
        cloud."""
        kernel = np.ones((3, 3), np.uint8)
        inner = cv2.erode(self.filled.astype(np.uint8), kernel, borderValue=0) > 0
        outline = self.filled & ~inner
        if self.grid.organised:
            edge = np.ones(self.filled.shape, dtype=bool)
            edge[1:-1, 1:-1] = False
        else:
            edge = grown(~holes_filled(grown(self.grid.valid, 2)), 3)
        length = int(np.count_nonzero(outline))
        return int(np.count_nonzero(outline & edge)) / max(length, 1)

    def continues(self, neighbour: Candidate, apart_m: float) -> bool:
        """Return whether this flat surface and the other lie in one plane: 90 % of the points
        within ``apart_m``."""
        normal = self._plane[1][:, 0]
        middle = self._sample_m.mean(axis=0)
        for surface in (self, neighbour):
            off_m = np.abs((surface._sample_m - middle) @ normal)
            if np.quantile(off_m, 0.9) > apart_m:
                return False
        return True

    @property
    def _facing(self) -> float:
        """Cosine of the tilt."""
        return min(abs(float(self._plane[1][2, 0])), 1.0)

    @cached_property
    def _sample_m(self) -> np.ndarray:
        """An even sample (n, 3) of its points."""
        pixels = np.flatnonzero(self.mask)
        step = max(1, len(pixels) // MOST_SAMPLES)
        return self.grid.points_m.reshape(-1, 3)[pixels[::step]]

    @cached_property
    def _plane(self) -> tuple[np.ndarray, np.ndarray]:
        """The sample minus its mean, and its principal axes (3, 3), the normal first."""
        centred_m = self._sample_m - self._sample_m.mean(axis=0)
        _, axes = np.linalg.eigh(centred_m.T @ centred_m)
        return centred_m, axes


def _centre_weights(length: int) -> np.ndarray:
    """Return the weights (n,) of the pixels along an axis of the picture, highest in its middle."""
    position = (np.arange(length) + 0.5) / length - 0.5
    return np.exp(-0.5 * position**2 / CENTRE_SPREAD**2)


@dataclass(frozen=True)
class Choice:
    """The target among the candidates."""

    candidates: tuple[Candidate, ...]
    """The proposal first."""
    taken: int
    """Number, from 1, of the candidate that was taken."""
    mask: np.ndarray
    """(h, w) bool: valid pixels inside its outline."""
    grid: Cloud
    """The cloud, or its raster."""
    part: np.ndarray | None = None
    """(h, w) bool: valid pixels of the whole target, its rim and its faces included; None for a
    cloud without a pixel grid."""
    warnings: tuple[str, ...] = ()
    """Doubts about the choice."""


def described_text(candidate: Candidate) -> str:
    """Return distance, extent, share of the view and tilt as a text."""
    length_m, width_m = candidate.extent_m
    nearest_m, middle_m, farthest_m = candidate.depths_m
    share = f"{100 * candidate.share:.0f}"
    if candidate.share < 0.095:
        share = f"{100 * candidate.share:.2g}"
    return (
        f"{middle_m:.2f} m away ({nearest_m:.2f} to {farthest_m:.2f} m),"
        f" {length_m / MM:.0f} x {width_m / MM:.0f} mm, {share} % of the view,"
        f" tilted by {candidate.tilt_deg:.0f} degrees"
    )


def _size_text(candidate: Candidate) -> str:
    length_m, width_m = candidate.extent_m
    return f"{length_m / MM:.0f} x {width_m / MM:.0f} mm at {candidate.depths_m[1]:.2f} m"


# --- the comparison of candidates ---


class _Border(NamedTuple):
    """A border of a surface's outline on another surface."""

    part: float
    """Its share of the outline."""
    is_step: bool
    """True if the other surface lies behind it."""
    behind_m: float
    """Height of the step."""


class _OutlineComparison:
    """The surfaces of a cloud, compared by their outlines; they are numbered as in ``surfaces``."""

    def __init__(self, surfaces: Surfaces, grid: Cloud) -> None:
        self.surfaces = surfaces
        """The surfaces' pixels and outlines."""
        self.grid = grid
        """The cloud, or its raster."""
        self.numbers = range(len(surfaces.masks))
        """Numbers of all surfaces."""
        self.described: list[Candidate] = []
        """The surfaces as candidates, by number."""
        self.borders: list[dict[int, _Border]] = []
        """By number, the borders of the surface's outline on others, by their numbers."""
        for number in self.numbers:
            filled = surfaces.filled[number]
            self.described.append(Candidate(surfaces.masks[number], filled, filled, grid))
            self.borders.append(self._borders(number) if len(self.numbers) > 1 else {})

    def _borders(self, number: int) -> dict[int, _Border]:
        """Return the borders of this surface's outline on other surfaces, by their numbers."""
        surfaces = self.surfaces
        distance_px, nearest = nearest_pixel(surfaces.masks[number])
        around = (distance_px <= surfaces.reach_px + 3) & ~surfaces.filled[number]
        ring = np.flatnonzero(around)
        z_m = self.grid.points_m[..., 2].reshape(-1)
        seeds = nearest.reshape(-1)
        outline = len(np.unique(seeds[ring]))
        borders = {}
        for neighbour in self.numbers:
            pixels = ring[surfaces.masks[neighbour].reshape(-1)[ring]]
            part = len(np.unique(seeds[pixels])) / max(outline, 1)
            if neighbour == number or part < BORDERING:
                continue
            steps_m = z_m[pixels] - z_m[seeds[pixels]]
            behind_m = steps_m[steps_m > surfaces.contact_m]
            ahead = len(behind_m) / len(steps_m)
            back = float((steps_m < -surfaces.contact_m).mean())
            is_step = ahead >= STEP_PART and ahead > 2.0 * back
            height_m = float(np.median(behind_m)) if len(behind_m) else 0.0
            borders[neighbour] = _Border(part, is_step, height_m)
        return borders

    def encloses(self, outer: int, inner: int) -> bool:
        """Return whether a surface is seen through the outline of another."""
        inner_pixels = self.surfaces.masks[inner]
        enclosed = np.count_nonzero(inner_pixels & self.surfaces.filled[outer])
        return bool(enclosed >= ENCLOSED * np.count_nonzero(inner_pixels))

    def judged(self, number: int, rival: int) -> tuple[float, str]:
        """Return the probability that the surface rather than the other is the target, and the
        reason for a doubt."""
        if number == rival:
            return 1.0, ""
        in_front = self._in_front(number, rival)
        if in_front is not None:
            return in_front
        behind = self._in_front(rival, number)
        if behind is not None:
            probability, why = behind
            return 1.0 - probability, why
        # if the two only meet or are apart, weight, a frontal view and nearness decide
        this = self.described[number]
        that = self.described[rival]
        weight = this.weight / max(that.weight, 1e-9)
        cosine = math.cos(math.radians(this.tilt_deg))
        facing = cosine / max(math.cos(math.radians(that.tilt_deg)), 1e-2)
        nearness = that.depths_m[1] / max(this.depths_m[1], 1e-6)
        probability = _probability(weight**0.5 * facing**2 * nearness)
        first = _size_text(this)
        second = _size_text(that)
        why = f"a surface of {second} may be the target instead of that of {first}"
        return probability, why

    def _in_front(self, front: int, back: int) -> tuple[float, str] | None:
        """Return the probability that ``front`` rather than ``back`` is the target, and the reason
        for a doubt; None if it is not in front."""
        border = self.borders[front].get(back)
        if border is None or not border.is_step:
            return None
        this = self.described[front]
        that = self.described[back]
        covered = f"{100 * this.share:.2g} % of the view"
        if self.encloses(front, back):
            opening = that.mask.sum() / max(this.filled.sum(), 1)
            why = "a surface is seen through a large opening of another"
            return _probability(0.5 / max(opening, 1e-6)), why
        if border.part >= SURROUNDED and border.behind_m <= this.extent_m[1]:
            why = f"an object that covers {covered} lies on a larger surface or close to it"
            return _probability(this.weight / LYING_WEIGHT), why
        if that.cut_off < CUT_OFF:
            area_m2 = this.extent_m[0] * this.extent_m[1]
            ratio = area_m2 / max(that.extent_m[0] * that.extent_m[1], 1e-12)
            why = (
                f"an object that covers {covered} stands in front of a surface whose outline is"
                " whole"
            )
            return _probability(ratio / OBSTACLE_AREA), why
        why = f"the nearer surface covers only {covered}"
        return _probability(this.weight / STANDING_WEIGHT), why

    def outline(self, number: int) -> np.ndarray:
        """Return a surface's outline (h, w) with holes that the edge cuts, without what stands in
        front of it.

        That is a surface which is a better target, or too far away to lie on it, with all nearer
        pixels that join it (fingers of a hand); an object on it stays."""
        surfaces = self.surfaces
        filled = self.described[number].outline
        outline = filled.copy()
        # what stands between two pieces of a surface is no notch
        for piece in _large_pieces(filled):
            notchless = piece
            for radius_px in NOTCHES_PX:
                notchless = notches_filled(notchless, radius_px)
            outline |= notchless
        for neighbour in self.numbers:
            border = self.borders[neighbour].get(number)
            if border is None or not border.is_step or not self.encloses(number, neighbour):
                continue
            this = self.described[neighbour]
            probability, _ = self.judged(neighbour, number)
            if probability >= 0.5 or border.behind_m > this.extent_m[0]:
                nearest_m = this.depths_m[2] + border.behind_m / 2
                nearer = self.grid.points_m[..., 2] < nearest_m
                joined = surfaces.filled[neighbour] | (nearer & ~surfaces.masks[number])
                standing = parts_with(joined, surfaces.masks[neighbour])
                outline = outline & ~grown(standing, surfaces.reach_px)
        return outline


def _large_pieces(mask: np.ndarray) -> list[np.ndarray]:
    """Return the connected parts of a mask (h, w) that are large enough for a surface."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return [labels == 1 + number for number in np.flatnonzero(areas >= LEAST_PX)]


def _probability(odds_base: float) -> float:
    odds = max(odds_base, 1e-9) ** STEEPNESS
    return min(max(odds / (1.0 + odds), 1e-4), 1.0 - 1e-4)


def _candidates(surfaces: Surfaces, grid: Cloud) -> tuple[tuple[Candidate, ...], list[str]]:
    """Return the candidates, best odds first, and warnings about taking the first."""
    comparison = _OutlineComparison(surfaces, grid)
    numbers = comparison.numbers
    odds = []
    for number in numbers:
        probabilities = [comparison.judged(number, rival)[0] for rival in numbers]
        odds.append(sum(math.log(probability) for probability in probabilities))
    order = sorted(numbers, key=lambda number: (-odds[number], number))
    candidates = tuple(
        replace(comparison.described[number], outline=comparison.outline(number))
        for number in order
    )
    if not candidates:
        return (), []
    doubts = []
    close = []
    for rank, rival in enumerate(order[1:], start=2):
        probability, why = comparison.judged(order[0], rival)
        if probability < DOUBTFUL_BELOW:
            close.append(f"{why} (--target {rank} takes the other)")
    if close:
        doubts.append(f"it is doubtful which surface is the target: {'; '.join(close)}")
    doubts += _doubts_about_others(candidates, surfaces.contact_m)
    return candidates, doubts


def _doubts_about_others(candidates: tuple[Candidate, ...], contact_m: float) -> list[str]:
    """Return warnings about many large surfaces, and about some in the plane of the first."""
    first = candidates[0]
    doubts = []
    large = sum(2 * candidate.share >= first.share for candidate in candidates[1:])
    if large >= CROWD:
        doubts.append(
            f"{large} other surfaces are half as large as target 1 or larger: the scene may "
            "hold no target"
        )
    in_plane = [
        str(rank)
        for rank, candidate in enumerate(candidates[1:], start=2)
        if first.continues(candidate, contact_m)
    ]
    if in_plane:
        ranks = " and ".join(in_plane)
        lie = f"targets {ranks} lie" if len(in_plane) > 1 else f"target {ranks} lies"
        doubts.append(
            f"{lie} in the plane of target 1 and may belong to it: only target 1 is judged"
            " (--target takes another)"
        )
    return doubts


# --- settings ---


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
    """Takes pixels whose centre lies in a polygon of sensor positions [u, v] (even-odd rule)."""

    kind: Literal["polygon"] = "polygon"
    vertices_px: tuple[tuple[float, float], ...] = Field(min_length=3)


class AutoCrop(_Crop):
    """Takes the nearest large smooth surface.

    - ``crease_deg``, ``smooth_px``: neighbours are joined if tilt and noise explain their step in z
      and the surface bends by at most ``crease_deg`` over ``smooth_px``; then holes are filled, and
      ``inset_px`` is removed at the rim.
    - ``target``: number of another of the candidates that a run lists.

    A background so near that blur leaves no crease counts as target (13 mm behind the face, at 0.7
    m with a 5 x 5 window). A cloud without a grid is treated as a raster of its nearest points."""

    kind: Literal["auto"] = "auto"
    inset_px: int = Field(default=RIM_PX, ge=0, le=200)
    crease_deg: float = Field(default=35.0, gt=0, le=90)
    smooth_px: int = Field(default=9, ge=3, le=99)
    target: int | None = Field(default=None, ge=1, le=99)


AnyCrop = NoCrop | BoxCrop | PolygonCrop | AutoCrop
CropConfig = Annotated[AnyCrop, Field(discriminator="kind")]
"""A crop as the user writes it: ``kind: none | box | polygon | auto`` and the fields of that kind.
"""


# --- the crop of a cloud ---


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
    if not mask.any():
        _refuse_empty(cloud, config)
    return mask


def _refuse_empty(cloud: Cloud, config: AnyCrop) -> NoReturn:
    """Raise UserError because the crop leaves no point."""
    points_m = cloud.points_m[cloud.valid]
    x0, y0, z0 = points_m.min(axis=0) / MM
    x1, y1, z1 = points_m.max(axis=0) / MM
    extent = f"x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f}, z {z0:.0f} to {z1:.0f} mm"
    if isinstance(config, BoxCrop):
        unit = ""
        if z1 > 50_000 or z1 < 5:
            unit = "; the cloud's unit is probably not the metre"
        raise UserError(
            f"the crop box ({_box_text(config)} mm) holds none of the cloud's {len(points_m)}"
            f" points{unit}",
            legal=f"limits that contain points of the cloud: {extent}",
            fix="change crop.x_mm, crop.y_mm, crop.z_mm, or use crop.kind: auto",
        )
    region = cloud.region
    raise UserError(
        f"the crop ({config.kind}, inset {config.inset_px} px) leaves none of the cloud's"
        f" {len(points_m)} points",
        legal=f"a crop that contains points of the cloud: columns {region.col0} to"
        f" {region.col1 - 1}, rows {region.row0} to {region.row1 - 1}; {extent}",
        fix="change the crop or lower crop.inset_px",
    )


def _box_text(config: BoxCrop) -> str:
    limits = []
    for name, (low, high) in (("x", config.x_mm), ("y", config.y_mm), ("z", config.z_mm)):
        limits.append(f"{name} {low:g} to {high:g}")
    text = ", ".join(limits)
    if config.range_max_m is not None:
        text += f" mm and sqrt(x^2 + z^2) < {1e3 * config.range_max_m:g}"
    return text


def choice_of(cloud: Cloud, config: AutoCrop) -> Choice:
    """Return the automatic crop of a cloud with a valid point, and all candidates. UserError
    without ``target``. It is computed once for a cloud."""
    if config not in cloud.crops:
        cloud.crops[config] = _choice_of(cloud, config)
    return cast("Choice", cloud.crops[config])


def _choice_of(cloud: Cloud, config: AutoCrop) -> Choice:
    part = None
    if cloud.organised:
        surfaces = smooth_surfaces(cloud, config.crease_deg, config.smooth_px)
        candidates, doubts = _candidates(surfaces, cloud)
        taken = _taken(candidates, config.target)
        grid = cloud
        part = _inside(candidates, taken, cloud)
        mask = inset(part, config.inset_px)
    else:
        grid, rows, columns, spacings = raster(cloud.points_m[cloud.valid], cloud)
        smooth_px = max(3, 2 * round(config.smooth_px / spacings / 2) - 1)
        candidates, doubts = _candidates(smooth_surfaces(grid, config.crease_deg, smooth_px), grid)
        taken = _taken(candidates, config.target)
        # the cell of the rim, and all cells that may hold a point inset_px - 1 spacings farther
        # inside
        inset_px = math.ceil((config.inset_px - 1) / spacings) + 1 if config.inset_px else 0
        cells = inset(_inside(candidates, taken, grid), inset_px)
        mask = cloud.valid.copy()
        mask[mask] = cells[rows, columns]
    mask.flags.writeable = False
    return Choice(
        candidates=candidates,
        taken=taken,
        mask=mask,
        grid=grid,
        part=part,
        warnings=() if config.target else tuple(doubts),
    )


def _taken(candidates: tuple[Candidate, ...], target: int | None) -> int:
    """Return the number of the candidate to take: the target's, or the first. Raises UserError if
    there is no such target."""
    if target is None or target <= len(candidates):
        return target or 1
    legal = "none"
    if candidates:
        listed = [
            f"\n  --target {number}: {described_text(candidate)}"
            for number, candidate in enumerate(candidates, start=1)
        ]
        legal = f"1 to {len(candidates)}:{''.join(listed)}"
    raise UserError(
        f"--target {target}: there are {len(candidates)} large smooth surfaces",
        legal=legal,
        fix="choose one of these, or draw the outline with --crop polygon:u,v,u,v,u,v",
    )


def _inside(
    candidates: tuple[Candidate, ...],
    taken: int,
    grid: Cloud,
) -> np.ndarray:
    """Return (h, w) bool: the valid pixels inside the outline of the candidate that is taken."""
    if not candidates:
        return np.zeros(grid.valid.shape, bool)
    return candidates[taken - 1].outline & grid.valid


def _box(cloud: Cloud, config: BoxCrop) -> np.ndarray:
    x, y, z = np.moveaxis(cloud.points_m, -1, 0)
    inside = cloud.valid
    with np.errstate(invalid="ignore"):
        for values, (low, high) in ((x, config.x_mm), (y, config.y_mm), (z, config.z_mm)):
            inside = inside & (values > low * MM) & (values < high * MM)
        if config.range_max_m is not None:
            inside = inside & (np.hypot(x, z) < config.range_max_m)
    return inside


def _polygon(cloud: Cloud, config: PolygonCrop) -> np.ndarray:
    if not cloud.organised:
        problem = "a polygon in pixels cannot crop a cloud without a pixel grid"
        raise UserError(problem, legal="crop.kind none, box or auto")
    region = cloud.region
    v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1].astype(float)
    inside = np.zeros(u.shape, dtype=bool)
    corners = np.array(config.vertices_px)
    for (u0, v0), (u1, v1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if v0 == v1:
            continue
        crossing = u0 + (v - v0) / (v1 - v0) * (u1 - u0)
        inside ^= ((v0 <= v) != (v1 <= v)) & (u < crossing)
    return inside & cloud.valid
