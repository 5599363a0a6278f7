"""A family of boards, drawn at random, on which a detection limit is measured.

Each board has so many holes or dents of random size, depth and place, its own grain, and stands before the camera in a
random pose. Every quantity of every board has a random stream of its own, named by the family's seed, the board's
purpose and its number. So a board is the same however many others there are, and what is changed for an axis changes
nothing else: at another distance, albedo, kind of hole or depth the boards keep their places, sizes and tilts, and
their results are paired.

Not modelled: damage that is not round, damage that is correlated (a row, a cluster), several kinds on one board.
"""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import product
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.target.checks import LEAST_WEB_MM, SHALLOWEST_BEND, WIDEST_BEND, off_tape_mm
from scenes.target.custom import (
    Albedo,
    BackingConfig,
    BoardConfig,
    DentConfig,
    FlatConfig,
    HoleConfig,
    MaterialConfig,
    PoseConfig,
    Rgb,
    RoomConfig,
    TapeConfig,
    TargetConfig,
    WavelengthConfig,
)
from scenes.target.face import OUTLINE_STEPS, backing_corners_board_m, face_grid_m, face_of, outline_board_m

Purpose = Literal["calibration", "hole_free", "damaged"]
"""Purpose of boards: to set a threshold, to count false calls, to be inspected; each has boards of its own."""
NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Limits of a pose's distance, jitter included."""
WIDEST_BACKING_MM = 1e4
"""Widest backing that a declaration allows."""
ATTEMPTS, TRIES = 50, 400
"""Boards begun anew, and places tried for each damage of one: with discs of the diameter ``apart_mm`` over 40 % of the
free area (the most that random placement reaches is 54.7 %) one attempt in three or more fills a board."""


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"the lower limit {limits[0]:g} is above the upper limit {limits[1]:g}")
    return limits


Diameter = Annotated[float, Field(ge=0.2, le=1e3)]
Diameters = Annotated[tuple[Diameter, Diameter], AfterValidator(_ascending)]
Depth = Annotated[float, Field(ge=0.04, le=500.0)]
Depths = Annotated[tuple[Depth, Depth], AfterValidator(_ascending)]


class DrawnThrough(Config):
    """Holes drilled through: number and sizes, as of every kind of drawn damage.

    The range of sizes is parted into ``per_board`` equal parts, and every board has one size from each, uniform within
    it: over all boards sizes are uniform, and each board covers the range evenly.
    """

    kind: Literal["through"]
    per_board: Annotated[int, Field(ge=1, le=100)]
    diameter_mm: Diameters
    sizes: Literal["uniform", "log"] = Field(
        default="uniform",
        description="uniform in the diameter, as MIL-HDBK-1823A advises for the sizes of targets, or in its logarithm",
    )

    def diameters_mm(self, rng: np.random.Generator) -> list[float]:
        """Draw a size from each part of the range, ascending."""
        low, high = self.diameter_mm
        quantiles = (np.arange(self.per_board) + rng.random(self.per_board)) / self.per_board
        sizes = low * (high / low) ** quantiles if self.sizes == "log" else low + (high - low) * quantiles
        drawn: list[float] = np.clip(sizes, low, high).tolist()
        return drawn

    def legal_depths_mm(self, diameter_mm: float, bend_per_mm: float) -> tuple[float, float] | None:
        """Return the declared depths that damage of this size can have on a face of this curvature.

        There is none if low > high; None for damage without a depth of its own.
        """
        return None


class DrawnBlind(DrawnThrough):
    """Holes with a flat bottom. Depths are uniform, one from each of ``per_board`` equal parts of their range, in
    random order: size and depth are independent."""

    kind: Literal["blind"]  # type: ignore[assignment]
    depth_mm: Depths

    def legal_depths_mm(self, diameter_mm: float, bend_per_mm: float) -> tuple[float, float]:
        """See `DrawnThrough`."""
        return self.depth_mm


class DrawnDents(DrawnThrough):
    """Spherical caps. Depths as of blind holes, but of that part of the range which is legal for the dent's size: no
    deeper than its radius, and on a bent face no shallower than its ball allows (`scenes.target.checks`)."""

    kind: Literal["dent"]  # type: ignore[assignment]
    depth_mm: Depths

    def legal_depths_mm(self, diameter_mm: float, bend_per_mm: float) -> tuple[float, float]:
        """See `DrawnThrough`."""
        return max(self.depth_mm[0], shallowest_mm(diameter_mm, bend_per_mm)), min(self.depth_mm[1], diameter_mm / 2)


DrawnDamage = Annotated[DrawnThrough | DrawnBlind | DrawnDents, Field(discriminator="kind")]


def shallowest_mm(diameter_mm: float, bend_per_mm: float) -> float:
    """Return the depth of a dent whose ball's radius is `SHALLOWEST_BEND` of a face's radius of curvature; 0 on a flat
    face."""
    reach = diameter_mm / 2 * bend_per_mm / SHALLOWEST_BEND * (1 + 1e-9)
    if reach >= 1:
        return diameter_mm / 2
    return diameter_mm / 2 * reach / (1 + math.sqrt(1 - reach**2))


class DrawnMaterialConfig(Config):
    """Reflectance of the boards, as in MaterialConfig, but every board has a grain of its own."""

    albedo_850: Albedo = Field(default=0.6, description="pale wood: 0.5 to 0.7; no published value for plywood found")
    rgb: Rgb = (0.55, 0.42, 0.28)
    grain_contrast: Annotated[float, Field(ge=0.0, le=0.3)] = Field(default=0.05, description="a guess: moderate")
    grain_period_mm: Annotated[float, Field(ge=1.0, le=200.0)] = Field(
        default=8.0, description="between the dark lines of a peeled softwood veneer; a guess"
    )


class DrawnTargetConfig(Config):
    """A family of boards. ``drawn`` gives the full declaration of any board, ``declare`` that of the first damaged
    board. Limits named ``..._mm`` and ``..._deg`` of the pose are the ends of uniform distributions about 0."""

    name: Literal["drawn"] = "drawn"
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = Field(
        default=1, description="of the boards; an experiment's own seed draws the noise, and another keeps the boards"
    )
    damage: DrawnDamage
    board: BoardConfig = Field(
        default_factory=lambda: BoardConfig(width_mm=304.8, height_mm=203.2, thickness_mm=12.7, shape=FlatConfig()),
        description="the thesis' half an inch of plywood, of 12 x 8 in: its face has as many pixels as the thesis' "
        "board of 24 x 4.5 in, and less of it lies near the edge",
    )
    apart_mm: Annotated[float, Field(gt=0.0, le=1e4)] = Field(
        default=40.0,
        description="least distance of two centres in plan. More than twice a hit radius of 15 mm, so that no finding "
        "can count for either; 16 neighbouring pixels farther than the 5 x 5 window reaches, at 0.7 m",
    )
    edge_mm: Annotated[float, Field(ge=LEAST_WEB_MM, le=1e4)] = Field(
        default=15.0,
        description="least distance of a rim from the board's edge. A crop takes 3 or 4 pixels off the edge, 6 mm at "
        "0.7 m and 12 mm at 1.5 m: what lies there is missed for its place, not for its size",
    )
    tapes: Annotated[tuple[TapeConfig, ...], Field(max_length=100)] = Field(
        default=(), description="the same on all boards; none: one view needs no marks"
    )
    distance_m: Annotated[float, Field(ge=NEAREST_M, le=FARTHEST_M)] = Field(
        default=0.7, description="as the thesis' board"
    )
    distance_jitter_mm: Annotated[float, Field(ge=0.0, le=1e3)] = Field(
        default=10.0, description="ten of the camera's steps of 1 mm, so that a limit does not hang on one of them"
    )
    offset_mm: Annotated[float, Field(ge=0.0, le=5e3)] = Field(
        default=20.0, description="sideways and upwards: 14 pixels at 0.7 m, so that all parts of a pixel are met"
    )
    tilt_deg: Annotated[float, Field(ge=0.0, le=70.0)] = Field(
        default=8.0, description="about x and about y: as far off frontal as is plausible for a sheet put up by hand"
    )
    roll_deg: Annotated[float, Field(ge=0.0, le=90.0)] = Field(
        default=2.0, description="a board is set down level, by eye"
    )
    material: DrawnMaterialConfig = DrawnMaterialConfig()
    backing: BackingConfig | None = Field(
        default=BackingConfig(distance_mm=20.0),
        description="as behind the thesis' board. Without a size it fills every hole in every pose that can be drawn",
    )
    room: RoomConfig | None = Field(
        default=RoomConfig(floor_below_lens_m=0.75, back_wall_distance_m=2.5), description="as the thesis' board's"
    )
    other_wavelengths: Annotated[tuple[WavelengthConfig, ...], Field(max_length=20)] = Field(
        default=(), description="for cameras that do not work near 850 nm"
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        damage, board, bend_per_mm, problems = self.damage, self.board, self._bend_per_mm, []
        if isinstance(damage, DrawnBlind | DrawnDents) and damage.depth_mm[1] >= board.thickness_mm:
            problems.append(
                f"damage.depth_mm: {damage.depth_mm[1]:g} mm is not less than the board's thickness, "
                f"{board.thickness_mm:g} mm"
            )
        if isinstance(damage, DrawnDents):
            # Both limits of a depth grow with the diameter, so the ends of the sizes tell for all.
            for diameter_mm in sorted(set(damage.diameter_mm)):
                least_mm, most_mm = damage.legal_depths_mm(diameter_mm, bend_per_mm)
                if least_mm > most_mm:
                    problems.append(
                        f"damage.depth_mm: a dent {diameter_mm:g} mm wide on this face can be "
                        f"{shallowest_mm(diameter_mm, bend_per_mm):.3g} to {diameter_mm / 2:g} mm deep, not "
                        f"{damage.depth_mm[0]:g} to {damage.depth_mm[1]:g} mm"
                    )
        widest_mm = damage.diameter_mm[1]
        if widest_mm / 2 * bend_per_mm > WIDEST_BEND:
            problems.append(
                f"damage.diameter_mm: {widest_mm:g} mm is too wide for a face bent to a radius of "
                f"{1 / bend_per_mm:.3g} mm"
            )
        needed_mm = 2 * self._rim_mm * self._shrinkage + LEAST_WEB_MM
        if self.apart_mm < needed_mm:
            problems.append(
                f"apart_mm: {self.apart_mm:g} mm lets holes of {widest_mm:g} mm meet; it must be "
                f"{needed_mm:.4g} mm or more"
            )
        if self._free_half_mm.min() < 0:
            problems.append(
                f"board: {board.width_mm:g} x {board.height_mm:g} mm leaves no place for a centre that is "
                f"{self._margin_mm:.4g} mm off every edge"
            )
        jitter_m = self.distance_jitter_mm * MM
        if self.distance_m - jitter_m < NEAREST_M or self.distance_m + jitter_m > FARTHEST_M:
            problems.append(
                f"distance_jitter_mm: {self.distance_jitter_mm:g} mm leads from {self.distance_m:g} m beyond "
                f"{NEAREST_M:g} to {FARTHEST_M:g} m"
            )
        if problems:
            raise ValueError("; ".join(problems))
        return self

    @property
    def _bend_per_mm(self) -> float:
        return _tightest_per_mm(self.board)

    @property
    def _shrinkage(self) -> float:
        """Factor by which axes along a bent face's normals must start farther apart, in plan, so as not to meet within
        the board: parallel surfaces at a depth t shrink by 1 - t / radius of curvature."""
        return 1 / (1 - min(self.board.thickness_mm * self._bend_per_mm, 0.5))

    @property
    def _rim_mm(self) -> float:
        """Largest radius of a rim. A dent's on a face that bends away is up to sqrt 2 larger than on a flat one;
        allowed for with holes too, so that the kind of damage does not change its places."""
        return self.damage.diameter_mm[1] / 2 * (math.sqrt(2) if self._bend_per_mm > 0 else 1.0)

    @property
    def _margin_mm(self) -> float:
        """Least distance of centres from the edge: the same for all sizes, so that size and place are independent."""
        return (self.edge_mm + self._rim_mm) * self._shrinkage

    @property
    def _free_half_mm(self) -> np.ndarray:
        """Half the width and height (2,) of the rectangle in which centres may lie; negative where there is none."""
        return np.array([self.board.width_mm, self.board.height_mm]) / 2 - self._margin_mm

    # ---- boards -----------------------------------------------------------------------------------------------------

    def declare(self) -> TargetConfig:
        """Return the first damaged board, for programs that look at one target."""
        return self.drawn("damaged", 0)

    def drawn(self, purpose: Purpose, number: int) -> TargetConfig:
        """Return a board of the family, with its damage; ids count from 1 in the order of size.

        Boards that are to be hole-free have damage too: call ``hole_free()`` on the answer, and what was left out
        are unflawed sites, placed as damage is. Raises UserError where the board is too full for the damage.
        """

        def stream(quantity: str) -> np.random.Generator:
            return random_stream(self.seed, "drawn board", purpose, number, quantity)

        def within(quantity: str, limit: float, count: int) -> list[float]:
            drawn: list[float] = (limit * stream(quantity).uniform(-1.0, 1.0, count)).tolist()
            return drawn

        count, depths = self.damage.per_board, stream("depths")
        quantiles = depths.permutation((np.arange(count) + depths.random(count)) / count).tolist()
        # What is placed first has the freest choice: which size that is, is drawn too.
        places_mm = stream("order of places").permutation(self._places_mm(stream("places"))).tolist()
        holes: list[HoleConfig] = []
        dents: list[DentConfig] = []
        rows = zip(self.damage.diameters_mm(stream("diameters")), quantiles, places_mm, strict=True)
        for place, (size, quantile, (x, y)) in enumerate(rows, start=1):
            legal, depth = self.damage.legal_depths_mm(size, self._bend_per_mm), None
            if legal is not None:
                depth = float(min(legal[0] + (legal[1] - legal[0]) * quantile, legal[1]))
            if self.damage.kind == "dent":
                assert depth is not None
                dents.append(DentConfig(id=place, diameter_mm=size, depth_mm=depth, centre_mm=(x, y)))
            else:
                holes.append(
                    HoleConfig(id=place, diameter_mm=size, centre_mm=(x, y), kind=self.damage.kind, depth_mm=depth)
                )
        pose = (
            *within("distance", self.distance_jitter_mm, 1),
            *within("offset", self.offset_mm, 2),
            *within("tilt", self.tilt_deg, 2),
            *within("roll", self.roll_deg, 1),
        )
        config = TargetConfig(
            board=self.board,
            holes=tuple(holes),
            dents=tuple(dents),
            tapes=self.tapes,
            material=MaterialConfig(**self.material.model_dump(), grain_seed=int(stream("grain").integers(2**32))),
            backing=self.backing,
            room=self.room,
            pose=self._posed(*pose),
            other_wavelengths=self.other_wavelengths,
        )
        if self.backing is None or self.backing.size_mm is not None:
            return config
        # a backing that fills every hole: the face's shadow on it from the lens, in the extreme poses
        size_mm = _backing_size_mm(self, float(backing_corners_board_m(config, self.backing)[0, 2]))
        return config.model_copy(update={"backing": self.backing.model_copy(update={"size_mm": size_mm})})

    def extreme_poses(self) -> tuple[PoseConfig, ...]:
        """Return the corners of what poses can be drawn, with the rolls at which the board reaches farthest sideways
        and upwards: what is in view in all of these is in view in every pose."""
        diagonal_deg = math.degrees(math.atan2(self.board.height_mm, self.board.width_mm))
        rolls = [self.roll_deg, *(roll for roll in (diagonal_deg, 90 - diagonal_deg) if roll < self.roll_deg)]
        limits = (self.distance_jitter_mm, self.offset_mm, self.offset_mm, self.tilt_deg, self.tilt_deg)
        signed = [signed for roll in rolls for signed in _both_signs(roll)]
        return tuple(self._posed(*corner) for corner in product(*map(_both_signs, limits), signed))

    def _places_mm(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (per_board, 2) centres in plan by random sequential placement, uniform on what is free: apart from one
        another, off the board's edge and off any tape."""
        half, count, best = self._free_half_mm, self.damage.per_board, 0
        for _ in range(ATTEMPTS):
            places = np.empty((0, 2))
            while len(places) < count:
                tried = half * rng.uniform(-1.0, 1.0, (TRIES, 2))
                free = np.all([off_tape_mm(tape, tried) > self._rim_mm for tape in self.tapes], axis=0)
                free = free & (np.linalg.norm(tried[:, None] - places, axis=-1) >= self.apart_mm).all(axis=1)
                if not free.any():
                    break
                places = np.vstack([places, tried[np.argmax(free)]])
            best = max(best, len(places))
            if best == count:
                return places
        raise UserError(
            f"a board of {self.board.width_mm:g} x {self.board.height_mm:g} mm is too full for {count} damages whose "
            f"centres are {self.apart_mm:g} mm apart and {self._margin_mm:.4g} mm off its edge: {best} found a place "
            f"on the {2 * half[0]:g} x {2 * half[1]:g} mm that are left",
            legal=f"fewer than {best} damages on this board" if best > 1 else None,
            fix="lower damage.per_board, damage.diameter_mm, apart_mm or edge_mm, or declare a larger board",
        )

    def _posed(
        self, jitter_mm: float, x_mm: float, y_mm: float, tilt_x: float, tilt_y: float, roll: float
    ) -> PoseConfig:
        return PoseConfig(
            distance_m=self.distance_m + jitter_mm * MM,
            offset_x_mm=x_mm,
            offset_y_mm=y_mm,
            tilt_x_deg=tilt_x,
            tilt_y_deg=tilt_y,
            roll_deg=roll,
        )


@lru_cache(maxsize=256)
def _tightest_per_mm(board: BoardConfig) -> float:
    """Return a face's largest curvature; 0 where its shape does not reach, which `check_target` tells."""
    x_m, y_m = face_grid_m(board, steps=OUTLINE_STEPS)[..., :2].reshape(-1, 2).T
    tightest = float(np.abs(face_of(board).curvatures(x_m, y_m)).max()) * MM
    return tightest if math.isfinite(tightest) else 0.0


@lru_cache(maxsize=256)
def _backing_size_mm(family: DrawnTargetConfig, z_m: float) -> tuple[float, float]:
    """Return width and height of the face's shadows from the lens, in all extreme poses, on a plane at this board z."""
    outline, half_m = outline_board_m(family.board), np.zeros(2)
    for pose in family.extreme_poses():
        lens = invert(pose.T_camera_board)[:3, 3]
        steps = (z_m - lens[2]) / (outline[:, 2] - lens[2])
        half_m = np.maximum(half_m, np.abs(lens + steps[:, None] * (outline - lens))[:, :2].max(axis=0))
    width, height = np.minimum(2 * half_m / MM, WIDEST_BACKING_MM).tolist()
    return width, height


def _both_signs(limit: float) -> tuple[float, ...]:
    return (-limit, limit) if limit else (0.0,)
