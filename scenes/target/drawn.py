"""A family of boards, drawn at random: what a detection limit is measured on.

Each board has so many holes or dents of random size, depth and place, its own grain, and stands before the camera in a
random pose. Every quantity of every board has a random stream of its own, named by the family's seed, what the board
is for and its number. So a board is the same however many others there are, and what is changed for an axis changes
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
from pydantic import Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import invert
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.target.checks import LEAST_WEB_MM, WIDEST_BEND
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
from scenes.target.drawn_damage import DrawnDamage, damages_of, depth_problems
from scenes.target.face import face_of, face_points_board_m, outline_board_m
from scenes.target.places import free_half_mm, random_places_mm
from scenes.target.pose import T_camera_board_of
from scenes.target.surroundings import backing_corners_board_m

Purpose = Literal["calibration", "hole_free", "damaged"]
"""What boards are for: to set a threshold, to count false calls, to be inspected; each has boards of its own."""
NEAREST_M, FARTHEST_M = 0.1, 10.0
"""Of a pose's distance, jitter included."""
WIDEST_BACKING_MM = 1e4
"""What a declaration of a backing allows."""


class DrawnMaterialConfig(Config):
    """As MaterialConfig, but every board has a grain of its own."""

    albedo_850: Albedo = Field(default=0.6, description="pale wood: 0.5 to 0.7; no published value for plywood found")
    rgb: Rgb = (0.55, 0.42, 0.28)
    grain_contrast: Annotated[float, Field(ge=0.0, le=0.3)] = Field(default=0.05, description="a guess: moderate")
    grain_period_mm: Annotated[float, Field(ge=1.0, le=200.0)] = Field(
        default=8.0, description="between the dark lines of a peeled softwood veneer; a guess"
    )


def _default_board() -> BoardConfig:
    return BoardConfig(width_mm=304.8, height_mm=203.2, thickness_mm=12.7, shape=FlatConfig())


class DrawnTargetConfig(Config):
    """A family of boards. ``drawn`` gives the full declaration of any of them, ``declare`` that of the first damaged
    one. Limits named ``..._mm`` and ``..._deg`` of the pose are the ends of uniform distributions about 0."""

    name: Literal["drawn"] = "drawn"
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = Field(
        default=1, description="of the boards; an experiment's own seed draws the noise, and another keeps the boards"
    )
    damage: DrawnDamage
    board: BoardConfig = Field(
        default_factory=_default_board,
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

    # ---- what fits together -----------------------------------------------------------------------------------------

    @model_validator(mode="after")
    def _fits(self) -> Self:
        problems = depth_problems(self.damage, self.board.thickness_mm, self._bend_per_mm) + self._bend_problems()
        needed_mm = 2 * self._rim_mm * self._shrinkage + LEAST_WEB_MM
        if self.apart_mm < needed_mm:
            problems.append(
                f"apart_mm: {self.apart_mm:g} mm lets holes of {self.damage.diameter_mm[1]:g} mm meet; it must be "
                f"{needed_mm:.4g} mm or more"
            )
        if free_half_mm(self.board, self._margin_mm).min() < 0:
            problems.append(
                f"board: {self.board.width_mm:g} x {self.board.height_mm:g} mm leaves no place for a centre that is "
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

    def _bend_problems(self) -> list[str]:
        widest_mm = self.damage.diameter_mm[1]
        if widest_mm / 2 * self._bend_per_mm > WIDEST_BEND:
            radius_mm = 1 / self._bend_per_mm
            return [
                f"damage.diameter_mm: {widest_mm:g} mm is too wide for a face bent to a radius of {radius_mm:.3g} mm"
            ]
        return []

    @property
    def _bend_per_mm(self) -> float:
        return _tightest_per_mm(self.board)

    @property
    def _shrinkage(self) -> float:
        """How much wider apart, in plan, axes along a bent face's normals must start so as not to meet within the
        board: parallel surfaces at a depth t shrink by 1 - t / radius of curvature."""
        return 1 / (1 - min(self.board.thickness_mm * self._bend_per_mm, 0.5))

    @property
    def _rim_mm(self) -> float:
        """The largest radius of a rim. A dent's on a face that bends away is up to sqrt 2 larger than on a flat one;
        allowed for with holes too, so that the kind of damage does not change its places."""
        return self.damage.diameter_mm[1] / 2 * (math.sqrt(2) if self._bend_per_mm > 0 else 1.0)

    @property
    def _margin_mm(self) -> float:
        """Of centres from the edge: the same for all sizes, so that size and place are independent."""
        return (self.edge_mm + self._rim_mm) * self._shrinkage

    # ---- boards -----------------------------------------------------------------------------------------------------

    def declare(self) -> TargetConfig:
        """The first damaged board: what programs see that look at one target."""
        return self.drawn("damaged", 0)

    def drawn(self, purpose: Purpose, number: int) -> TargetConfig:
        """One board of the family, with its damage; ids count from 1 in the order of size.

        Boards that are to be hole-free have damage too: call ``hole_free()`` on the answer, and what was left out
        are unflawed sites, placed as damage is. Raises UserError where the board is too full for the damage.
        """
        holes, dents = self._damages(purpose, number)
        grain_seed = int(self._stream(purpose, number, "grain").integers(2**32))
        config = TargetConfig(
            board=self.board,
            holes=holes,
            dents=dents,
            tapes=self.tapes,
            material=MaterialConfig(**self.material.model_dump(), grain_seed=grain_seed),
            backing=self.backing,
            room=self.room,
            pose=self._pose(purpose, number),
            other_wavelengths=self.other_wavelengths,
        )
        return self._filled(config)

    def extreme_poses(self) -> tuple[PoseConfig, ...]:
        """The corners of what poses can be drawn, with the rolls at which the board reaches farthest sideways and
        upwards: what is in view in all of these is in view in every pose."""
        diagonal_deg = math.degrees(math.atan2(self.board.height_mm, self.board.width_mm))
        rolls = [self.roll_deg, *(one for one in (diagonal_deg, 90 - diagonal_deg) if one < self.roll_deg)]
        corners = product(
            _both_signs(self.distance_jitter_mm),
            _both_signs(self.offset_mm),
            _both_signs(self.offset_mm),
            _both_signs(self.tilt_deg),
            _both_signs(self.tilt_deg),
            [signed for roll in rolls for signed in _both_signs(roll)],
        )
        return tuple(self._posed(*corner) for corner in corners)

    def _stream(self, purpose: Purpose, number: int, quantity: str) -> np.random.Generator:
        return random_stream(self.seed, "drawn board", purpose, number, quantity)

    def _damages(self, purpose: Purpose, number: int) -> tuple[tuple[HoleConfig, ...], tuple[DentConfig, ...]]:
        count, depths = self.damage.per_board, self._stream(purpose, number, "depths")
        diameters = self.damage.diameters_mm(self._stream(purpose, number, "diameters"))
        quantiles = depths.permutation((np.arange(count) + depths.random(count)) / count).tolist()
        # What is placed first has the freest choice: which size that is, is drawn too.
        places = self._stream(purpose, number, "order of places").permutation(self._places_mm(purpose, number))
        return damages_of(self.damage, diameters, quantiles, places, self._bend_per_mm)

    def _places_mm(self, purpose: Purpose, number: int) -> np.ndarray:
        return random_places_mm(
            self.board,
            self.tapes,
            self.damage.per_board,
            apart_mm=self.apart_mm,
            margin_mm=self._margin_mm,
            rim_mm=self._rim_mm,
            rng=self._stream(purpose, number, "places"),
        )

    def _pose(self, purpose: Purpose, number: int) -> PoseConfig:
        def within(quantity: str, limit: float, count: int) -> list[float]:
            drawn: list[float] = (limit * self._stream(purpose, number, quantity).uniform(-1.0, 1.0, count)).tolist()
            return drawn

        jitter, offsets = within("distance", self.distance_jitter_mm, 1), within("offset", self.offset_mm, 2)
        return self._posed(*jitter, *offsets, *within("tilt", self.tilt_deg, 2), *within("roll", self.roll_deg, 1))

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

    def _filled(self, config: TargetConfig) -> TargetConfig:
        """With a backing that fills every hole: the face's shadow on it from the lens, in the extreme poses."""
        backing = config.backing
        if backing is None or backing.size_mm is not None:
            return config
        size_mm = _backing_size_mm(self, float(backing_corners_board_m(config, backing)[0, 2]))
        return config.model_copy(update={"backing": backing.model_copy(update={"size_mm": size_mm})})


@lru_cache(maxsize=256)
def _tightest_per_mm(board: BoardConfig) -> float:
    """A face's largest curvature; 0 where its shape does not reach, which `check_target` tells."""
    x_m, y_m = face_points_board_m(board)[:, :2].T
    tightest = float(np.abs(face_of(board).curvatures(x_m, y_m)).max()) * MM
    return tightest if math.isfinite(tightest) else 0.0


@lru_cache(maxsize=256)
def _backing_size_mm(family: DrawnTargetConfig, z_m: float) -> tuple[float, float]:
    """Width and height of the face's shadows from the lens, in all extreme poses, on a plane at this board z."""
    outline, half_m = outline_board_m(family.board), np.zeros(2)
    for pose in family.extreme_poses():
        lens = invert(T_camera_board_of(pose))[:3, 3]
        steps = (z_m - lens[2]) / (outline[:, 2] - lens[2])
        half_m = np.maximum(half_m, np.abs(lens + steps[:, None] * (outline - lens))[:, :2].max(axis=0))
    width, height = np.minimum(2 * half_m / MM, WIDEST_BACKING_MM).tolist()
    return width, height


def _both_signs(limit: float) -> tuple[float, ...]:
    return (-limit, limit) if limit else (0.0,)
