"""A family of boards, drawn at random, on which a detection limit is measured.

Each board has a number of damages of random size, depth and place, its own grain, and a random
pose in front of the camera. Every quantity of every board has its own random stream, named by the
family's seed, the board's purpose and its number. So a board does not depend on the number of
other boards, and at another distance, albedo, kind of hole or depth the boards keep their places,
sizes and tilts: their results are paired.

Not modelled: damage that is correlated (a row, a cluster), several kinds on one board."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import product
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Self,
    Union,
    get_args,
)

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

# purposes of boards; no two share boards
Purpose = Literal["learning", "calibration", "hole_free", "damaged", "good_part"]
# limits of a pose's distance, jitter included
NEAREST_M = 0.1
FARTHEST_M = 10.0
WIDEST_BACKING_MM = 1e4  # largest backing in a declaration
# If discs ``apart_mm`` wide are to cover 40 % of the free area (random placement reaches 54.7 % at
# most), one attempt in three or more fills a board.
ATTEMPTS = 50  # to fill a board
TRIES = 400  # places tried for each damage
Stream = Callable[[str], np.random.Generator]  # the random numbers of a quantity, by its name


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
        size_mm: tuple[float, float] = getattr(self, f"{self.size_of}_mm")
        return size_mm

    @property
    def depths_mm(self) -> tuple[float, float] | None:
        """Ends of the depths; None of what goes through the board."""
        return getattr(self, "depth_mm", None)

    @property
    def limit_of(self) -> str:
        """The name of the size that a limit is of: ``size_of``, or depth if only depths vary."""
        low_mm, high_mm = self.size_mm
        shallowest_mm, deepest_mm = self.depths_mm or (0.0, 0.0)
        if low_mm == high_mm and shallowest_mm < deepest_mm:
            return "depth"
        return self.size_of

    @property
    def limit_range_mm(self) -> tuple[float, float]:
        """Ends of the size that ``limit_of`` names."""
        if self.limit_of == "depth" and self.depths_mm is not None:
            return self.depths_mm
        return self.size_mm

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
FlawDepths = Annotated[tuple[flaws.Depth, flaws.Depth], AfterValidator(_ascending)]
Angles = Annotated[tuple[flaws.Angle, flaws.Angle], AfterValidator(_ascending)]
# quantities that are ranges in a family of flaws: type and default (...: none)
RANGES: dict[str, Any] = {
    "length_mm": (Extents, ...),
    "width_mm": (Extents, ...),
    "diameter_mm": (Extents, ...),
    "depth_mm": (FlawDepths, ...),
    "angle_deg": (Angles, (-90.0, 90.0)),
}


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

    def declare(self, facts: dict[str, Any], stream: Stream) -> dict[str, Any]:
        """Return the declaration of a flaw: ``facts`` (id, place, size and depth) and what else is
        drawn for it."""
        number = facts["id"]
        declared: dict[str, Any] = {}
        for name in type(self).model_fields:
            value = getattr(self, name)
            if name in _Drawn.model_fields or value is None:
                continue
            if isinstance(value, tuple) and name not in facts:
                low, high = value
                value = float(low + (high - low) * stream(name).random(number)[-1])
            declared[name] = value
        declared.update(facts)
        if self.kind in ("slot", "gouge", "corrosion"):
            declared["seed"] = int(stream("shapes").integers(2**32, size=number)[-1])
        return declared


def _drawn_of(flaw: type[flaws.FlawConfig]) -> type[DrawnFlaws]:
    """Return the declaration of a family of a kind of flaw: that of a single flaw, with ranges in
    place of numbers."""
    fields: dict[str, Any] = {}
    for name, field in flaw.model_fields.items():
        # places and seeds are drawn; a chip's place determines the edge, and so its angle
        if name in ("id", "centre_mm", "seed") or (name, flaw) == ("angle_deg", flaws.ChipConfig):
            continue
        range_, default = RANGES.get(name, (field.annotation, field))
        if field.default is None:
            range_ = range_ | None
            default = field
        fields[name] = (range_, default)
    family = create_model(
        f"Drawn{flaw.__name__}",
        __base__=DrawnFlaws,
        __doc__=flaw.__doc__,
        __module__=__name__,
        **fields,
    )
    family.size_of = flaw.size_of
    # under its name, or it could not be sent to another process
    globals()[family.__name__] = family
    return family


_flawed = tuple(map(_drawn_of, get_args(flaws.FlawConfig)))
if TYPE_CHECKING:
    AnyDrawn = DrawnThrough | DrawnDeep | DrawnFlaws
else:
    AnyDrawn = Annotated[Union[DrawnThrough, DrawnDeep, *_flawed], Field(discriminator="kind")]


class _Room(NamedTuple):
    """The room that damage needs on a board, the same for all sizes."""

    rim_mm: float
    """Largest radius of a rim."""
    shrinkage: float
    """Factor by which axes along a bent face's normals start farther apart in plan, so that they
    do not meet within the board: parallel surfaces at a depth t shrink by 1 - t / radius of
    curvature."""
    margin_mm: float
    """Least distance of centres from the edge."""


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
            width_mm=304.8,
            height_mm=203.2,
            thickness_mm=12.7,
            shape=custom.FlatConfig(),
        ),
        description="default: plywood of 12 x 8 in, as many pixels as the thesis' 24 x 4.5 in "
        "but fewer at the edge",
    )
    apart_mm: Annotated[float, Field(gt=0.0, le=1e4)] = Field(
        40.0,
        description="least distance of two centres; above two hit radii, no detection counts "
        "for two damages",
    )
    edge_mm: Annotated[float, Field(ge=LEAST_WEB_MM, le=1e4)] = Field(
        15.0,
        description="least distance of a damage's rim from the board's edge; "
        "a crop removes 6 to 12 mm there",
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
        problems = self._size_problems() + self._place_problems()
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def _size_problems(self) -> list[str]:
        """Find sizes and depths that no board of the family can have."""
        damage = self.damage
        bend_per_mm = _tightest_per_mm(self.board)
        thickness_mm = self.board.thickness_mm
        depths_mm = damage.depths_mm or (0.0, 0.0)
        problems = []
        moves_face = damage.kind in ("pressed_dent", "pressed_bump", "protrusion")
        if depths_mm[1] >= thickness_mm and not moves_face:
            problems.append(
                f"damage.depth_mm: {depths_mm[1]:g} mm is not less than the board's thickness, "
                f"{thickness_mm:g} mm"
            )
        if isinstance(damage, DrawnDeep) and damage.kind == "dent":
            # Both limits of a dent's depth grow with the diameter, so checking the smallest and
            # largest size suffices.
            for diameter_mm in sorted(set(damage.size_mm)):
                least_mm, most_mm = _dent_depths_mm(diameter_mm, bend_per_mm)
                if max(depths_mm[0], least_mm) > min(depths_mm[1], most_mm):
                    problems.append(
                        f"damage.depth_mm: a dent {diameter_mm:g} mm wide on this face can be "
                        f"{least_mm:.3g} to {most_mm:g} mm deep, "
                        f"not {depths_mm[0]:g} to {depths_mm[1]:g} mm"
                    )
            if damage.chamfer_mm > 0:
                problems.append("damage.chamfer_mm: dents are not drilled and have no chamfer")
        widest_mm = damage.size_mm[1]
        if not isinstance(damage, DrawnFlaws) and widest_mm / 2 * bend_per_mm > WIDEST_BEND:
            problems.append(
                f"damage.diameter_mm: {widest_mm:g} mm is too wide for a face bent to a radius of "
                f"{1 / bend_per_mm:.3g} mm"
            )
        return problems

    def _place_problems(self) -> list[str]:
        """Find distances that leave no room for damage, or for the board before the camera."""
        board = self.board
        room = self._room()
        problems = []
        needed_mm = 2 * room.rim_mm * room.shrinkage + LEAST_WEB_MM
        if self.apart_mm < needed_mm:
            damage = "damage" if isinstance(self.damage, DrawnFlaws) else "holes"
            problems.append(
                f"apart_mm: {self.apart_mm:g} mm lets {damage} of {self.damage.widest_mm:g} "
                "mm meet; "
                f"it must be {needed_mm:.4g} mm or more"
            )
        if min(board.width_mm, board.height_mm) / 2 < room.margin_mm:
            problems.append(
                f"board: {board.width_mm:g} x {board.height_mm:g} mm leaves no place for a centre "
                f"that is {room.margin_mm:.4g} mm off every edge"
            )
        nearest_m = self.distance_m - self.distance_jitter_mm * MM
        farthest_m = self.distance_m + self.distance_jitter_mm * MM
        if not NEAREST_M <= nearest_m <= farthest_m <= FARTHEST_M:
            problems.append(
                f"distance_jitter_mm: {self.distance_jitter_mm:g} mm leads from "
                f"{self.distance_m:g} m beyond {NEAREST_M:g} to {FARTHEST_M:g} m"
            )
        return problems

    def _room(self) -> _Room:
        """Return the room that damage needs.

        A dent's rim on a face that bends away is up to sqrt 2 larger than on a flat one; holes get
        the same room, so that they have the dents' places."""
        bend_per_mm = _tightest_per_mm(self.board)
        rim_mm = self.damage.widest_mm / 2
        if bend_per_mm > 0 and not isinstance(self.damage, DrawnFlaws):
            rim_mm *= math.sqrt(2)
        shrinkage = 1 / (1 - min(self.board.thickness_mm * bend_per_mm, 0.5))
        margin_mm = (self.edge_mm + rim_mm) * shrinkage
        return _Room(rim_mm, shrinkage, margin_mm)

    def declare(self) -> custom.TargetConfig:
        """Return the first damaged board, for programs that look at one target."""
        return self.drawn("damaged", 0)

    def drawn(
        self, purpose: Purpose, number: int, chosen_mm: tuple[float, ...] | None = None
    ) -> custom.TargetConfig:
        """Return a board of the family with its damage, ids from 1 in the order of size; of a
        hole-free one call ``hole_free()``: the damages left out are unflawed sites. Raises
        UserError if the board is too full.

        ``chosen_mm``: ascending sizes (``damage.limit_of``), which replace those that would be
        drawn; all else of the board is as without."""
        stream = self._stream(purpose, number)
        damages = self._damages(stream, chosen_mm)
        field = "flaws"
        if not isinstance(self.damage, DrawnFlaws):
            field = "dents" if self.damage.kind == "dent" else "holes"
        damages_by_kind: dict[str, Any] = {field: damages}
        config = custom.TargetConfig(
            board=self._board(stream),
            tapes=self.tapes,
            material=custom.MaterialConfig(
                **self.material.model_dump(),
                grain_seed=int(stream("grain").integers(2**32)),
            ),
            backing=self.backing,
            room=self.room,
            pose=self._pose(stream),
            other_wavelengths=self.other_wavelengths,
            **damages_by_kind,
        )
        if self.backing is None or self.backing.size_mm is not None:
            return config
        # a backing that fills every hole: the face's shadow on it from the lens, in the extreme
        # poses
        backing_z_m = float(backing_corners_board_m(config, self.backing)[0, 2])
        # its material casts no shadow; where it is unknown, each board has another
        unpainted = self.model_copy(
            update={"material": custom.ReflectanceConfig(), "backing": None}
        )
        size_mm = _backing_size_mm(unpainted, backing_z_m)
        backing = self.backing.model_copy(update={"size_mm": size_mm})
        return config.model_copy(update={"backing": backing})

    def _damages(
        self, stream: Stream, chosen_mm: tuple[float, ...] | None
    ) -> tuple[custom.AnyDamage, ...]:
        """Draw the damage of a board, in the order of size; its sizes are given or drawn."""
        damage = self.damage
        count = damage.per_board
        size_parts = (np.arange(count) + stream("diameters").random(count)) / count
        low, high = damage.size_mm
        sizes_mm = low + (high - low) * size_parts
        if damage.sizes == "log":
            sizes_mm = low * (high / low) ** size_parts
        if chosen_mm is not None and damage.limit_of == damage.size_of:
            sizes_mm = np.array(chosen_mm)
        depth_stream = stream("depths")
        depth_parts = (np.arange(count) + depth_stream.random(count)) / count
        depth_parts = depth_stream.permutation(depth_parts)
        if chosen_mm is not None and damage.limit_of == "depth":
            # all have one size, and so one range of depths
            shallowest_mm, deepest_mm = self._depths_mm(low)
            depth_parts = (np.array(chosen_mm) - shallowest_mm) / (deepest_mm - shallowest_mm)
            depth_parts = np.clip(depth_parts, 0.0, 1.0)
        place_stream = stream("places")
        places_mm = self._edge_places_mm if damage.kind == "chip" else self._places_mm
        # What is placed first has the freest choice: which size that is, is drawn too.
        centres_mm = stream("order of places").permutation(places_mm(place_stream)).tolist()
        damages = []
        for index, size_mm in enumerate(np.clip(sizes_mm, low, high).tolist()):
            x_mm, y_mm, *edge_deg = centres_mm[index]
            facts: dict[str, Any] = {
                "id": index + 1,
                f"{damage.size_of}_mm": size_mm,
                "centre_mm": (x_mm, y_mm),
            }
            if damage.depths_mm is not None:
                facts["depth_mm"] = self._depth_mm(size_mm, float(depth_parts[index]))
            if edge_deg:
                facts["angle_deg"] = round(edge_deg[0])
            damages.append(self._damage(facts, stream))
        return tuple(damages)

    def _depths_mm(self, size_mm: float) -> tuple[float, float]:
        """Return the range of depths that a damage of this size can have."""
        least_mm, most_mm = self.damage.depths_mm or (0.0, 0.0)
        if self.damage.kind == "dent":
            legal_mm = _dent_depths_mm(size_mm, _tightest_per_mm(self.board))
            least_mm = max(least_mm, legal_mm[0])
            most_mm = min(most_mm, legal_mm[1])
        return least_mm, most_mm

    def _depth_mm(self, size_mm: float, part: float) -> float:
        """Return the depth at a part, 0..1, of the range that a damage of this size can have."""
        least_mm, most_mm = self._depths_mm(size_mm)
        return float(min(least_mm + (most_mm - least_mm) * part, most_mm))

    def _damage(self, facts: dict[str, Any], stream: Stream) -> custom.AnyDamage:
        """Return the declaration of a damage with its id, place, size and depth."""
        damage = self.damage
        if isinstance(damage, DrawnFlaws):
            declared = damage.declare(facts, stream)
            flaw: custom.AnyDamage = TypeAdapter(flaws.AnyFlawConfig).validate_python(declared)
            return flaw
        if damage.kind == "dent":
            return custom.DentConfig(**facts)
        return custom.HoleConfig(**facts, kind=damage.kind, chamfer_mm=damage.chamfer_mm)

    def _board(self, stream: Stream) -> custom.BoardConfig:
        """Return the board; each has roughness, or an error of form, of its own."""
        shape = self.board.shape
        if not isinstance(shape, custom.RoughConfig | custom.MadeConfig):
            return self.board
        seed = int(stream("roughness").integers(2**32))
        drawn_shape = shape.model_copy(update={"seed": seed})
        return self.board.model_copy(update={"shape": drawn_shape})

    def earlier_pose(self, purpose: Purpose, number: int) -> custom.PoseConfig:
        """Return the pose in which a board was recorded before it was damaged."""
        return self._pose(self._stream(purpose, number, "earlier "))

    def _stream(self, purpose: Purpose, number: int, prefix: str = "") -> Stream:
        """Return the random numbers of a board's quantities, whose names begin with ``prefix``."""

        def stream(quantity: str) -> np.random.Generator:
            name = f"{prefix}{quantity}"
            return random_stream(self.seed, "drawn board", purpose, number, name)

        return stream

    def _pose(self, stream: Stream) -> custom.PoseConfig:
        """Draw the pose."""

        def within(
            quantity: str,
            limit: float,
            count: int,
        ) -> list[float]:
            values: list[float] = (limit * stream(quantity).uniform(-1.0, 1.0, count)).tolist()
            return values

        (jitter_mm,) = within("distance", self.distance_jitter_mm, 1)
        offset_mm = within("offset", self.offset_mm, 2)
        tilt_deg = within("tilt", self.tilt_deg, 2)
        (roll_deg,) = within("roll", self.roll_deg, 1)
        return self._posed(jitter_mm, offset_mm, tilt_deg, roll_deg)

    def extreme_poses(self) -> tuple[custom.PoseConfig, ...]:
        """Return the corners of what poses can be drawn, with the rolls at which the board reaches
        farthest sideways and upwards: a point in view in all of these is in view in every pose."""
        diagonal_deg = math.degrees(math.atan2(self.board.height_mm, self.board.width_mm))
        rolls_deg = [self.roll_deg]
        for roll_deg in (diagonal_deg, 90 - diagonal_deg):
            if roll_deg < self.roll_deg:
                rolls_deg.append(roll_deg)
        signed_rolls_deg = [sign * roll_deg for roll_deg in rolls_deg for sign in (-1, 1)]
        corners = product(
            _ends(self.distance_jitter_mm),
            product(_ends(self.offset_mm), repeat=2),
            product(_ends(self.tilt_deg), repeat=2),
            dict.fromkeys(signed_rolls_deg),  # one of each
        )
        return tuple(self._posed(*corner) for corner in corners)

    def _posed(
        self,
        jitter_mm: float,
        offset_mm: Sequence[float],
        tilt_deg: Sequence[float],
        roll_deg: float,
    ) -> custom.PoseConfig:
        """Return the pose at a jitter of the distance, with offset and tilt in x and y, and a
        roll."""
        return custom.PoseConfig(
            distance_m=self.distance_m + jitter_mm * MM,
            offset_x_mm=offset_mm[0],
            offset_y_mm=offset_mm[1],
            tilt_x_deg=tilt_deg[0],
            tilt_y_deg=tilt_deg[1],
            roll_deg=roll_deg,
        )

    def _places_mm(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (per_board, 2) centres in plan by random sequential placement, uniform on what is
        free."""
        board = self.board
        count = self.damage.per_board
        room = self._room()
        half_mm = np.array([board.width_mm, board.height_mm]) / 2 - room.margin_mm
        fullest = 0
        for _ in range(ATTEMPTS):
            places_mm = np.empty((0, 2))
            while len(places_mm) < count:
                tried_mm = half_mm * rng.uniform(-1.0, 1.0, (TRIES, 2))
                free = self._off_tapes_on_front(tried_mm, room.rim_mm)
                apart_mm = np.linalg.norm(tried_mm[:, None] - places_mm, axis=-1)
                free &= (apart_mm >= self.apart_mm).all(axis=1)
                if not free.any():
                    break
                places_mm = np.vstack([places_mm, tried_mm[np.argmax(free)]])
            if len(places_mm) == count:
                return places_mm
            fullest = max(fullest, len(places_mm))
        raise UserError(
            f"a board of {board.width_mm:g} x {board.height_mm:g} mm is too small for {count} "
            f"damages with centres {self.apart_mm:g} mm apart and {room.margin_mm:.4g} mm "
            "from its "
            f"edge: only {fullest} fit on the {2 * half_mm[0]:g} x {2 * half_mm[1]:g} mm that are "
            "left",
            legal=f"fewer than {fullest} damages on this board" if fullest > 1 else None,
            fix="lower damage.per_board, damage.diameter_mm, apart_mm or edge_mm, "
            "or declare a larger board",
        )

    def _off_tapes_on_front(
        self,
        places_mm: np.ndarray,
        rim_mm: float,
    ) -> np.ndarray:
        """Return at which places (n, 2) a rim lies beside all tapes and, of a part from a mesh, on
        its front."""
        free = np.ones(len(places_mm), bool)
        for tape in self.tapes:
            free &= off_tape_mm(tape, places_mm) > rim_mm
        if isinstance(self.board.shape, custom.MeshConfig):
            ring = np.exp(2j * np.pi * np.arange(16) / 16) * rim_mm
            x_mm = places_mm[:, :1] + ring.real
            y_mm = places_mm[:, 1:] + ring.imag
            height_m = face_of(self.board).height_m(x_mm * MM, y_mm * MM)
            free &= np.isfinite(height_m).all(axis=1)
        return free

    def _edge_places_mm(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (per_board, 3): points on the board's edges in plan, apart and off corners, with
        the edge's angle."""
        half_mm = np.array([self.board.width_mm, self.board.height_mm]) / 2
        corner_mm = self.damage.widest_mm / 2 + LEAST_WEB_MM
        chips = np.empty((0, 3))
        for _ in range(ATTEMPTS * TRIES):
            if len(chips) == self.damage.per_board:
                return chips
            share = half_mm / half_mm.sum() / 2
            turn_deg = int(rng.choice([0, 90, 180, -90], p=np.tile(share, 2)))
            turn_rad = math.radians(turn_deg)
            outward = np.round([-math.sin(turn_rad), math.cos(turn_rad)])
            half_edge_mm = half_mm[0] if turn_deg in (0, 180) else half_mm[1]
            along_mm = rng.uniform(-1, 1) * (half_edge_mm - corner_mm)
            centre_mm = outward * half_mm + along_mm * np.abs(outward[::-1])
            apart_mm = np.linalg.norm(chips[:, :2] - centre_mm, axis=1)
            if (apart_mm >= self.apart_mm).all():
                chips = np.vstack([chips, np.append(centre_mm, turn_deg)])
        raise UserError(
            f"the board's edges are too short for {self.damage.per_board} chips",
            fix="lower damage.per_board, damage.length_mm or apart_mm, or declare a larger board",
        )


def _ends(limit: float) -> tuple[float, ...]:
    """Return the ends of what is drawn between plus and minus a limit; 0 alone if that is 0."""
    return (-limit, limit) if limit else (0.0,)


def _dent_depths_mm(diameter_mm: float, bend_per_mm: float) -> tuple[float, float]:
    """Return the ends of a dent's depth: of a ball of `SHALLOWEST_BEND` radii of curvature, and
    the dent's radius."""
    radius_mm = diameter_mm / 2
    reach = radius_mm * bend_per_mm / SHALLOWEST_BEND * (1 + 1e-9)
    least = 1.0 if reach >= 1 else reach / (1 + math.sqrt(1 - reach**2))
    return radius_mm * least, radius_mm


@lru_cache(maxsize=256)
def _tightest_per_mm(board: custom.BoardConfig) -> float:
    """Return a face's largest curvature; 0 for a rough face or a mesh, and where its shape does
    not reach."""
    if face_of(board).rough or isinstance(board.shape, custom.MeshConfig):
        return 0.0
    x_m, y_m = face_grid_m(board, steps=OUTLINE_STEPS)[..., :2].reshape(-1, 2).T
    curvatures = face_of(board).curvatures(x_m, y_m)
    tightest_per_mm = float(np.abs(curvatures).max()) * MM
    return tightest_per_mm if math.isfinite(tightest_per_mm) else 0.0


@lru_cache(maxsize=256)
def _backing_size_mm(family: DrawnTargetConfig, z_m: float) -> tuple[float, float]:
    """Return width and height of the face's shadows from the lens, in all extreme poses, on a
    plane at this board z."""
    outline = outline_board_m(family.board)
    half_m = np.zeros(2)
    for pose in family.extreme_poses():
        lens = invert(pose.T_camera_board)[:3, 3]
        steps = (z_m - lens[2]) / (outline[:, 2] - lens[2])
        shadow = lens + steps[:, None] * (outline - lens)
        half_m = np.maximum(half_m, np.abs(shadow)[:, :2].max(axis=0))
    width, height = np.minimum(2 * half_m / MM, WIDEST_BACKING_MM).tolist()
    return width, height
