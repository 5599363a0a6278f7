"""A family of boards, drawn at random, on which a detection limit is measured.

Each board has a number of damages of random size, depth and place, its own grain, and a random
pose in front of the camera. Every quantity of every board has its own random stream, named by the
family's seed, the board's purpose and its number. So a board does not depend on the number of
other boards, and at another distance, albedo, kind of hole or depth the boards keep their places,
sizes and tilts: their results are paired.

Not modelled: damage that is correlated (a row, a cluster), several kinds on one board."""

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, Union, get_args

import numpy as np
from pydantic import AfterValidator, Field, TypeAdapter, create_model, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, invert
from harness.vocabulary.seeds import random_stream
from scenes.target import custom, flaws
from scenes.target.checks import LEAST_WEB_MM, SHALLOWEST_BEND, WIDEST_BEND, off_tape_mm
from scenes.target.truth import (
    OUTLINE_STEPS,
    backing_corners_board_m,
    face_grid_m,
    face_of,
    outline_board_m,
)

Purpose = Literal[
    "learning", "calibration", "hole_free", "damaged"
]  # purposes of boards; no two share boards
# limits of a pose's distance, jitter included
NEAREST_M = 0.1
FARTHEST_M = 10.0
WIDEST_BACKING_MM = 1e4  # largest backing in a declaration
ATTEMPTS = 50
TRIES = 400
"""Attempts to fill a board, and places tried for each damage: if discs ``apart_mm`` wide are to
cover 40 % of the free area (random placement reaches 54.7 % at most), one attempt in three or more
fills a board."""


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"the lower limit {limits[0]:g} is above the upper limit {limits[1]:g}")
    return limits


Diameter = Annotated[float, Field(ge=0.2, le=1e3)]
Depth = Annotated[float, Field(ge=0.04, le=500.0)]
Depths = Annotated[tuple[Depth, Depth], AfterValidator(_ascending)]
Jitter = Annotated[float, Field(ge=0.0, le=1e3)]


class _Drawn(Config):
    """Number and sizes of drawn damage. Each board has one size from each of ``per_board`` equal
    parts of the range."""

    per_board: Annotated[int, Field(ge=1, le=100)]
    sizes: Literal["uniform", "log"] = Field(
        default="uniform",
        description="uniform in the size, as MIL-HDBK-1823A advises, or in its logarithm",
    )
    size_of: ClassVar[str] = "diameter"

    @property
    def size_mm(self) -> tuple[float, float]:
        """Ends of the size that ``size_of`` names."""
        ends: tuple[float, float] = getattr(self, f"{self.size_of}_mm")
        return ends

    @property
    def depths_mm(self) -> tuple[float, float] | None:
        """Ends of the depths; None of what goes through the board."""
        return getattr(self, "depth_mm", None)

    @property
    def widest_mm(self) -> float:
        """Diameter of a circle in plan that holds the largest."""
        return self.size_mm[1]


class DrawnThrough(_Drawn):
    """Drilled through-holes. Each board has one diameter from each of ``per_board`` equal parts of
    the range."""

    kind: Literal["through"]
    diameter_mm: Annotated[tuple[Diameter, Diameter], AfterValidator(_ascending)]
    chamfer_mm: custom.Chamfer = 0.0

    @property
    def widest_mm(self) -> float:
        """Diameter of a circle in plan that holds the largest, its chamfer included."""
        return self.diameter_mm[1] + 2 * self.chamfer_mm


class DrawnDeep(DrawnThrough):
    """Blind holes with a flat bottom, or dents (spherical caps). Depths are uniform: one from each
    of ``per_board`` equal parts of their range, in random order. A dent's range is cut to the
    depths that its size allows: at most its radius, and on a bent face at least what its ball
    needs (`scenes.target.checks`)."""

    kind: Literal["blind", "dent"]  # type: ignore[assignment]
    depth_mm: Depths


Extents = Annotated[tuple[flaws.Extent, flaws.Extent], AfterValidator(_ascending)]
RANGES: dict[str, Any] = dict.fromkeys(("length_mm", "width_mm", "diameter_mm"), (Extents, ...))
RANGES["depth_mm"] = Annotated[tuple[flaws.Depth, flaws.Depth], AfterValidator(_ascending)], ...
RANGES["angle_deg"] = (
    Annotated[tuple[flaws.Angle, flaws.Angle], AfterValidator(_ascending)],
    (-90.0, 90.0),
)
"""Quantities that are ranges in a family of flaws: type and default."""


class DrawnFlaws(_Drawn):
    """A kind of damage of `scenes.target.flaws`. Each pair is a range. The size that ``size_of``
    names and the depth are drawn as those of holes, all other quantities uniformly and
    independently; a single number is not drawn."""

    kind: Any

    @property
    def widest_mm(self) -> float:
        """Diameter of a circle in plan that holds the largest."""
        if self.kind not in ("slot", "gouge"):
            return self.size_mm[1]
        long: Any = self
        return math.hypot(long.length_mm[1], long.width_mm[1] + 6 * long.wander_mm)

    def declare(
        self, facts: dict[str, Any], stream: Callable[[str], np.random.Generator]
    ) -> dict[str, Any]:
        """Return the declaration of a flaw: ``facts`` (id, place, size and depth) and what else is
        drawn for it."""
        own = {name for name in type(self).model_fields if name not in _Drawn.model_fields}
        held = {name: value for name in own if (value := getattr(self, name)) is not None} | facts
        number = facts["id"]
        for name, value in held.items():
            if isinstance(value, tuple) and name != "centre_mm":
                held[name] = float(
                    value[0] + (value[1] - value[0]) * stream(name).random(number)[-1]
                )
        seed = {"seed": int(stream("shapes").integers(2**32, size=number)[-1])}
        return held | (seed if self.kind in ("slot", "gouge", "corrosion") else {})


def _drawn_of(flaw: type[flaws.FlawConfig]) -> type[DrawnFlaws]:
    """Return the declaration of a family of a kind of flaw: that of a single flaw, with ranges in
    place of numbers."""
    fields: dict[str, Any] = {}
    for name, field in flaw.model_fields.items():
        # places and seeds are drawn; a chip's place determines the edge, and so its angle
        if name in ("id", "centre_mm", "seed") or (name, flaw) == ("angle_deg", flaws.ChipConfig):
            continue
        range_, default = RANGES.get(name, (field.annotation, field))
        fields[name] = (range_ | None, field) if field.default is None else (range_, default)
    name = f"Drawn{flaw.__name__}"
    made = create_model(
        name, __base__=DrawnFlaws, __doc__=flaw.__doc__, __module__=__name__, **fields
    )
    made.size_of = flaw.size_of
    globals()[name] = made  # under its name, or it could not be sent to another process
    return made


_flawed = tuple(map(_drawn_of, get_args(flaws.FlawConfig)))
if TYPE_CHECKING:
    AnyDrawn = DrawnThrough | DrawnDeep | DrawnFlaws
else:
    AnyDrawn = Annotated[Union[DrawnThrough, DrawnDeep, *_flawed], Field(discriminator="kind")]


class DrawnTargetConfig(Config):
    """A family of random boards. Offsets, tilts, roll and jitter of the pose are drawn uniformly
    between plus and minus the given value. ``drawn`` returns the full declaration of a board,
    ``declare`` that of the first damaged one."""

    name: Literal["drawn"] = "drawn"
    seed: flaws.Seed = Field(
        1, description="draws the boards; the experiment's own seed draws the noise"
    )
    damage: AnyDrawn
    board: custom.BoardConfig = Field(
        custom.BoardConfig(
            width_mm=304.8, height_mm=203.2, thickness_mm=12.7, shape=custom.FlatConfig()
        ),
        description="default: plywood of 12 x 8 in, as many pixels as the thesis' 24 x 4.5 in but fewer at the edge",
    )
    apart_mm: Annotated[float, Field(gt=0.0, le=1e4)] = Field(
        40.0,
        description="least distance of two centres; above two hit radii, no detection counts for two damages",
    )
    edge_mm: Annotated[float, Field(ge=LEAST_WEB_MM, le=1e4)] = Field(
        15.0,
        description="least distance of a damage's rim from the board's edge; a crop removes 6 to 12 mm there",
    )
    tapes: Annotated[tuple[custom.TapeConfig, ...], Field(max_length=100)] = Field(
        (), description="on all boards"
    )
    distance_m: Annotated[float, Field(ge=NEAREST_M, le=FARTHEST_M)] = 0.7
    distance_jitter_mm: Jitter = Field(
        default=10.0, description="keeps a limit from depending on one step of range"
    )
    offset_mm: Annotated[float, Field(ge=0.0, le=5e3)] = Field(
        20.0, description="offset to the sides and up or down"
    )
    tilt_deg: Annotated[float, Field(ge=0.0, le=70.0)] = Field(
        8.0, description="tilt about x and y, as set up by hand"
    )
    roll_deg: Annotated[float, Field(ge=0.0, le=90.0)] = Field(
        2.0, description="roll, as set up by eye"
    )
    material: custom.ReflectanceConfig = Field(
        custom.ReflectanceConfig(), description="each board has its own grain"
    )
    backing: custom.BackingConfig | None = Field(
        default=custom.BackingConfig(distance_mm=20.0),
        description="without size_mm it fills all holes in all poses",
    )
    room: custom.RoomConfig | None = custom.RoomConfig(
        floor_below_lens_m=0.75, back_wall_distance_m=2.5
    )
    other_wavelengths: custom.OtherWavelengths = ()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        damage = self.damage
        board = self.board
        bend_per_mm = _tightest_per_mm(self.board)
        problems = []
        thick = board.thickness_mm
        widest_mm = damage.size_mm[1]
        jitter_mm = self.distance_jitter_mm
        declared = damage.depths_mm or (0.0, 0.0)
        if declared[1] >= thick and damage.kind not in (
            "pressed_dent",
            "pressed_bump",
            "protrusion",
        ):
            deep = f"{declared[1]:g} mm is not less than the board's thickness, {thick:g} mm"
            problems.append(f"damage.depth_mm: {deep}")
        # Both limits of a dent's depth grow with the diameter, so checking the smallest and
        # largest size suffices.
        dents = isinstance(damage, DrawnDeep) and damage.kind == "dent"
        for diameter_mm in sorted(set(damage.size_mm)) if dents else []:
            least_mm, most_mm = _dent_depths_mm(diameter_mm, bend_per_mm)
            if max(declared[0], least_mm) > min(declared[1], most_mm):
                can = f"a dent {diameter_mm:g} mm wide on this face can be {least_mm:.3g} to {most_mm:g} mm deep"
                problems.append(
                    f"damage.depth_mm: {can}, not {declared[0]:g} to {declared[1]:g} mm"
                )
        if isinstance(damage, DrawnDeep) and dents and damage.chamfer_mm > 0:
            problems.append("damage.chamfer_mm: dents are not drilled and have no chamfer")
        if not isinstance(damage, DrawnFlaws) and widest_mm / 2 * bend_per_mm > WIDEST_BEND:
            wide = f"{widest_mm:g} mm is too wide for a face bent to a radius of {1 / bend_per_mm:.3g} mm"
            problems.append(f"damage.diameter_mm: {wide}")
        rim_mm, shrinkage, margin_mm = self._room_mm()
        needed_mm = 2 * rim_mm * shrinkage + LEAST_WEB_MM
        if self.apart_mm < needed_mm:
            what = "damage" if isinstance(damage, DrawnFlaws) else "holes"
            meet = f"{self.apart_mm:g} mm lets {what} of {damage.widest_mm:g} mm meet"
            problems.append(f"apart_mm: {meet}; it must be {needed_mm:.4g} mm or more")
        if min(board.width_mm, board.height_mm) / 2 < margin_mm:
            off = f"no place for a centre that is {margin_mm:.4g} mm off every edge"
            problems.append(f"board: {board.width_mm:g} x {board.height_mm:g} mm leaves {off}")
        if (
            not NEAREST_M
            <= self.distance_m - jitter_mm * MM
            <= self.distance_m + jitter_mm * MM
            <= FARTHEST_M
        ):
            limits = f"{NEAREST_M:g} to {FARTHEST_M:g} m"
            problems.append(
                f"distance_jitter_mm: {jitter_mm:g} mm leads from {self.distance_m:g} m beyond {limits}"
            )
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def _room_mm(self) -> tuple[float, float, float]:
        """Return the largest radius of a rim; the factor by which axes along a bent face's normals
        start farther apart in plan, so that they do not meet within the board (parallel surfaces
        at a depth t shrink by 1 - t / radius of curvature); and the least distance of centres from
        the edge, the same for all sizes. A dent's rim on a face that bends away is up to sqrt 2
        larger than on a flat one; holes get the same room, so that they have the dents' places."""
        bend_per_mm = _tightest_per_mm(self.board)
        round_on_bent = bend_per_mm > 0 and not isinstance(self.damage, DrawnFlaws)
        rim_mm = self.damage.widest_mm / 2 * (math.sqrt(2) if round_on_bent else 1.0)
        shrinkage = 1 / (1 - min(self.board.thickness_mm * bend_per_mm, 0.5))
        return rim_mm, shrinkage, (self.edge_mm + rim_mm) * shrinkage

    def declare(self) -> custom.TargetConfig:
        """Return the first damaged board, for programs that look at one target."""
        return self.drawn("damaged", 0)

    def drawn(self, purpose: Purpose, number: int) -> custom.TargetConfig:
        """Return a board of the family with its damage, ids from 1 in the order of size; of a
        hole-free one call ``hole_free()``: the damages left out are unflawed sites. Raises
        UserError if the board is too full."""

        def stream(quantity: str) -> np.random.Generator:
            return random_stream(self.seed, "drawn board", purpose, number, quantity)

        def within(quantity: str, limit: float, count: int) -> list[Any]:
            return (limit * stream(quantity).uniform(-1.0, 1.0, count)).tolist()

        damage = self.damage
        count = self.damage.per_board
        depths = stream("depths")
        made: list[custom.AnyDamage] = []
        (low, high), parts = (
            damage.size_mm,
            (np.arange(count) + stream("diameters").random(count)) / count,
        )
        sizes = low * (high / low) ** parts if damage.sizes == "log" else low + (high - low) * parts
        quantiles = depths.permutation((np.arange(count) + depths.random(count)) / count).tolist()
        # What is placed first has the freest choice: which size that is, is drawn too.
        places = self._edge_places_mm if damage.kind == "chip" else self._places_mm
        places_mm = stream("order of places").permutation(places(stream("places"))).tolist()
        for size, quantile, (x, y, *edge) in zip(
            np.clip(sizes, low, high).tolist(), quantiles, places_mm, strict=True
        ):
            facts: dict[str, Any] = {
                "id": len(made) + 1,
                f"{damage.size_of}_mm": size,
                "centre_mm": (x, y),
            }
            if damage.depths_mm is not None:
                least, most = damage.depths_mm
                if damage.kind == "dent":
                    legal = _dent_depths_mm(size, _tightest_per_mm(self.board))
                    least = max(least, legal[0])
                    most = min(most, legal[1])
                facts["depth_mm"] = float(min(least + (most - least) * quantile, most))
            if isinstance(damage, DrawnFlaws):
                facts |= {"angle_deg": round(edge[0])} if edge else {}
                made.append(
                    TypeAdapter(flaws.AnyFlawConfig).validate_python(damage.declare(facts, stream))
                )
            elif damage.kind == "dent":
                made.append(custom.DentConfig(**facts))
            else:
                made.append(
                    custom.HoleConfig(**facts, kind=damage.kind, chamfer_mm=damage.chamfer_mm)
                )
        common: dict[str, Any] = {
            key: getattr(self, key) for key in ("tapes", "backing", "room", "other_wavelengths")
        }
        kinds = "dents" if damage.kind == "dent" else "holes"
        common["flaws" if isinstance(damage, DrawnFlaws) else kinds] = tuple(made)
        pose = (
            within("offset", self.offset_mm, 2)
            + within("tilt", self.tilt_deg, 2)
            + within("roll", self.roll_deg, 1)
        )
        board = self.board
        if isinstance(board.shape, custom.RoughConfig):
            own = {"seed": int(stream("roughness").integers(2**32))}
            board = board.model_copy(update={"shape": board.shape.model_copy(update=own)})
        material = custom.MaterialConfig(
            **self.material.model_dump(), grain_seed=int(stream("grain").integers(2**32))
        )
        placed = self._posed(*within("distance", self.distance_jitter_mm, 1), *pose)
        config = custom.TargetConfig(board=board, material=material, pose=placed, **common)
        if self.backing is None or self.backing.size_mm is not None:
            return config
        # a backing that fills every hole: the face's shadow on it from the lens, in the extreme
        # poses
        size_mm = _backing_size_mm(self, float(backing_corners_board_m(config, self.backing)[0, 2]))
        return config.model_copy(
            update={"backing": self.backing.model_copy(update={"size_mm": size_mm})}
        )

    def extreme_poses(self) -> tuple[custom.PoseConfig, ...]:
        """Return the corners of what poses can be drawn, with the rolls at which the board reaches
        farthest sideways and upwards: a point in view in all of these is in view in every pose."""
        diagonal_deg = math.degrees(math.atan2(self.board.height_mm, self.board.width_mm))
        rolls = [
            self.roll_deg,
            *(roll for roll in (diagonal_deg, 90 - diagonal_deg) if roll < self.roll_deg),
        ]
        limits = (
            self.distance_jitter_mm,
            self.offset_mm,
            self.offset_mm,
            self.tilt_deg,
            self.tilt_deg,
        )
        signed = ((-limit, limit) if limit else (0.0,) for limit in limits)
        both_rolls = dict.fromkeys(sign * roll for roll in rolls for sign in (-1, 1))
        return tuple(self._posed(*corner) for corner in product(*signed, both_rolls))

    def _places_mm(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (per_board, 2) centres in plan by random sequential placement, uniform on what is
        free."""
        board, count, best, (rim_mm, _, margin_mm) = (
            self.board,
            self.damage.per_board,
            0,
            self._room_mm(),
        )
        half = np.array([board.width_mm, board.height_mm]) / 2 - margin_mm
        for _ in range(ATTEMPTS):
            places = np.empty((0, 2))
            while len(places) < count:
                tried = half * rng.uniform(-1.0, 1.0, (TRIES, 2))
                free = np.all([off_tape_mm(tape, tried) > rim_mm for tape in self.tapes], axis=0)
                if isinstance(board.shape, custom.MeshConfig):  # what is not in front has no place
                    ring = np.exp(2j * np.pi * np.arange(16) / 16) * rim_mm
                    x = tried[:, :1] + ring.real
                    y = tried[:, 1:] + ring.imag
                    free = free & np.isfinite(face_of(board).height_m(x * MM, y * MM)).all(axis=1)
                free = free & (
                    np.linalg.norm(tried[:, None] - places, axis=-1) >= self.apart_mm
                ).all(axis=1)
                if not free.any():
                    break
                places = np.vstack([places, tried[np.argmax(free)]])
            best = max(best, len(places))
            if best == count:
                return places
        full = f"a board of {board.width_mm:g} x {board.height_mm:g} mm is too small for {count} damages with centres "
        full += f"{self.apart_mm:g} mm apart and {margin_mm:.4g} mm from its edge: only {best} fit on the "
        full += f"{2 * half[0]:g} x {2 * half[1]:g} mm that are left"
        fix = "lower damage.per_board, damage.diameter_mm, apart_mm or edge_mm, or declare a larger board"
        raise UserError(
            full, legal=f"fewer than {best} damages on this board" if best > 1 else None, fix=fix
        )

    def _edge_places_mm(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (per_board, 3): points on the board's edges in plan, apart and off corners, with
        the edge's angle."""
        half = np.array([self.board.width_mm, self.board.height_mm]) / 2
        corner_mm = self.damage.widest_mm / 2 + LEAST_WEB_MM
        places = np.empty((0, 3))
        for _ in range(ATTEMPTS * TRIES):
            if len(places) == self.damage.per_board:
                return places
            turn = int(rng.choice([0, 90, 180, -90], p=np.tile(half / half.sum() / 2, 2)))
            outward = np.round([-math.sin(math.radians(turn)), math.cos(math.radians(turn))])
            along = rng.uniform(-1, 1) * (half[0 if turn in (0, 180) else 1] - corner_mm)
            place = np.array([*(outward * half + along * np.abs(outward[::-1])), turn])
            if (
                not len(places)
                or np.linalg.norm(places[:, :2] - place[:2], axis=1).min() >= self.apart_mm
            ):
                places = np.vstack([places, place])
        fix = "lower damage.per_board, damage.length_mm or apart_mm, or declare a larger board"
        raise UserError(
            f"the board's edges are too short for {self.damage.per_board} chips", fix=fix
        )

    def _posed(self, jitter_mm: float, *others: float) -> custom.PoseConfig:
        """Return the pose at a jitter of the distance, with offsets x and y, tilts x and y and a
        roll."""
        names = ("offset_x_mm", "offset_y_mm", "tilt_x_deg", "tilt_y_deg", "roll_deg")
        return custom.PoseConfig(
            distance_m=self.distance_m + jitter_mm * MM, **dict(zip(names, others, strict=True))
        )


def _dent_depths_mm(diameter_mm: float, bend_per_mm: float) -> tuple[float, float]:
    """Return the ends of a dent's depth: of a ball of `SHALLOWEST_BEND` radii of curvature, and
    the dent's radius."""
    reach = diameter_mm / 2 * bend_per_mm / SHALLOWEST_BEND * (1 + 1e-9)
    least = 1.0 if reach >= 1 else reach / (1 + math.sqrt(1 - reach**2))
    return diameter_mm / 2 * least, diameter_mm / 2


@lru_cache(maxsize=256)
def _tightest_per_mm(board: custom.BoardConfig) -> float:
    """Return a face's largest curvature; 0 for a rough face or a mesh, and where its shape does
    not reach."""
    if face_of(board).rough or isinstance(board.shape, custom.MeshConfig):
        return 0.0
    x_m, y_m = face_grid_m(board, steps=OUTLINE_STEPS)[..., :2].reshape(-1, 2).T
    tightest = float(np.abs(face_of(board).curvatures(x_m, y_m)).max()) * MM
    return tightest if math.isfinite(tightest) else 0.0


@lru_cache(maxsize=256)
def _backing_size_mm(family: DrawnTargetConfig, z_m: float) -> tuple[float, float]:
    """Return width and height of the face's shadows from the lens, in all extreme poses, on a
    plane at this board z."""
    outline = outline_board_m(family.board)
    half_m = np.zeros(2)
    for pose in family.extreme_poses():
        lens = invert(pose.T_camera_board)[:3, 3]
        steps = (z_m - lens[2]) / (outline[:, 2] - lens[2])
        half_m = np.maximum(
            half_m, np.abs(lens + steps[:, None] * (outline - lens))[:, :2].max(axis=0)
        )
    width, height = np.minimum(2 * half_m / MM, WIDEST_BACKING_MM).tolist()
    return width, height
