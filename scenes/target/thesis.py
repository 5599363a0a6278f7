"""The target named ``thesis``, with a field for every fact that its source leaves open; and all
kinds of targets.

Source: "Damage Detection and Location Using Time of Flight Depth Cameras" (Rutgers), Table I and
the ruler readings of its error script. They state eleven holes of 1/16 to 1 in, drilled in one row
of a half-inch plywood sheet and about 2 in apart from the 1/4 in hole on, strips of coloured tape,
and an Azure Kinect. Every other value is a choice with a reason, made before any claim was scored;
`experiments/averaging.yaml` tries other plausible values."""

from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import INCH, MM
from scenes.target import custom
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.part import MeshTargetConfig

THICKNESS_MM = 12.7  # half an inch (stated)
# stated, Table I
DIAMETERS_IN = (
    1 / 16,
    1 / 8,
    3 / 16,
    1 / 4,
    5 / 16,
    3 / 8,
    7 / 16,
    1 / 2,
    5 / 8,
    3 / 4,
    1.0,
)
Degrees = Annotated[float, Field(ge=-70.0, le=70.0)]
NonNegativeMm = Annotated[float, Field(ge=0.0, le=5e3)]


def _open(default: Any, reason: str) -> Any:
    return Field(default=default, description=reason)


class ThesisTargetConfig(Config):
    """The thesis' target. The thesis states the holes' diameters and the board's thickness; each
    key is a fact that it leaves open, and the meaning gives the reason for the default.
    ``declare()`` returns the full declaration."""

    name: Literal["thesis"] = "thesis"
    hole_kind: Literal["through", "blind"] = _open(
        "through", "'Drilled' in a thin sheet means drilled through."
    )
    blind_depth_mm: Annotated[float, Field(gt=0.0, lt=THICKNESS_MM)] = _open(
        9.5, "Three quarters of the thickness."
    )
    backing_distance_mm: NonNegativeMm | None = _open(
        20.0,
        "Distance of a surface behind the board; null: nothing. The thesis keeps points with "
        "z < 1.1 m and range < 1 m and still shows points in the holes, so something stood close "
        "behind, as when a sheet leans on a wall.",
    )
    backing_albedo_850: custom.Albedo = _open(0.6, "A guess; typical of painted walls and wood.")
    hole_spacing_mm: Annotated[float, Field(ge=30.0, le=100.0)] = _open(
        50.8,
        "2 in, from the ruler readings of holes 4 to 11; "
        "holes 1 to 3 are assumed to be as far apart.",
    )
    board_width_mm: Annotated[float, Field(ge=100.0, le=5e3)] = _open(
        609.6, "24 in, a stock size; the row takes 20."
    )
    board_height_mm: Annotated[float, Field(ge=30.0, le=5e3)] = _open(
        114.3, "4.5 in: room for the row and the tape."
    )
    row_offset_y_mm: Annotated[float, Field(ge=-2e3, le=2e3)] = _open(0.0, "The row is centred.")
    distance_m: Annotated[float, Field(ge=0.3, le=5.0)] = _open(
        0.7,
        "About midway from the camera's minimum (0.5 m) to 0.95 m, "
        "where the board's ends have a range of 1 m.",
    )
    offset_x_mm: custom.Coordinate = _open(0.0, "The board is centred in front of the camera.")
    offset_y_mm: custom.Coordinate = _open(0.0, "The board is centred in front of the camera.")
    tilt_x_deg: Degrees = _open(
        3.0, "No sheet set up by hand is frontal; zero tilt would let rounding hide noise."
    )
    tilt_y_deg: Degrees = _open(4.0, "As tilt_x_deg.")
    roll_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = _open(0.0, "The board stands level.")
    plywood_albedo_850: custom.Albedo = _open(
        0.6, "Pale wood: 0.5 to 0.7. No published value for plywood was found."
    )
    plywood_rgb: custom.Rgb = _open((0.55, 0.42, 0.28), "A guess: pale wood.")
    grain_contrast: Annotated[float, Field(ge=0.0, le=0.3)] = _open(
        0.05, "A guess: deviation of albedo over its mean."
    )
    grain_period_mm: Annotated[float, Field(ge=1.0, le=200.0)] = _open(
        8.0, "A guess: dark lines of a softwood veneer."
    )
    grain_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = _open(
        1, "Seed of the grain: which of many alike boards."
    )
    tape_length_mm: custom.Length = _open(
        40.0, "Four strips, one near each corner, clear of the row."
    )
    tape_width_mm: custom.Length = _open(12.0, "Half-inch tape.")
    tape_x_mm: NonNegativeMm = _open(200.0, "The strips' centres are at plus and minus this x.")
    tape_y_mm: NonNegativeMm = _open(38.0, "The strips' centres are at plus and minus this y.")
    tape_thickness_mm: Annotated[float, Field(ge=0.02, le=3.0)] = _open(
        0.15, "Vinyl tape is 0.13 to 0.18 mm thick."
    )
    tape_albedo_850: custom.Albedo = _open(
        0.6, "A guess: red dyes absorb little in the near infrared."
    )
    tape_rgb: custom.Rgb = _open(
        (0.85, 0.08, 0.08), "The thesis finds strips by red above mean + 2.6 deviations."
    )
    floor_below_lens_m: Annotated[float, Field(ge=0.05, le=10.0)] | None = _open(
        0.75, "A table; null: no floor."
    )
    floor_albedo_850: custom.Albedo = _open(0.3, "A guess.")
    back_wall_distance_m: Annotated[float, Field(ge=0.1, le=20.0)] | None = _open(
        2.5, "A small room; null: no wall."
    )
    back_wall_albedo_850: custom.Albedo = _open(0.6, "A guess: a painted wall.")
    other_wavelengths: custom.OtherWavelengths = ()

    def declare(self) -> custom.TargetConfig:
        """Return the full declaration. That the parts fit together is checked when it is built."""
        board = custom.BoardConfig(
            width_mm=self.board_width_mm,
            height_mm=self.board_height_mm,
            thickness_mm=THICKNESS_MM,
            shape=custom.FlatConfig(),
        )
        material = custom.MaterialConfig(
            albedo_850=self.plywood_albedo_850,
            rgb=self.plywood_rgb,
            grain_contrast=self.grain_contrast,
            grain_period_mm=self.grain_period_mm,
            grain_seed=self.grain_seed,
        )
        backing = None
        if self.backing_distance_mm is not None:
            backing = custom.BackingConfig(
                distance_mm=self.backing_distance_mm,
                albedo_850=self.backing_albedo_850,
            )
        room = None
        if self.floor_below_lens_m or self.back_wall_distance_m:
            room = custom.RoomConfig(
                floor_below_lens_m=self.floor_below_lens_m,
                floor_albedo_850=self.floor_albedo_850,
                back_wall_distance_m=self.back_wall_distance_m,
                back_wall_albedo_850=self.back_wall_albedo_850,
            )
        pose = custom.PoseConfig(
            distance_m=self.distance_m,
            offset_x_mm=self.offset_x_mm,
            offset_y_mm=self.offset_y_mm,
            tilt_x_deg=self.tilt_x_deg,
            tilt_y_deg=self.tilt_y_deg,
            roll_deg=self.roll_deg,
        )
        return custom.TargetConfig(
            board=board,
            holes=self._holes(),
            tapes=self._tapes(),
            material=material,
            backing=backing,
            room=room,
            pose=pose,
            other_wavelengths=self.other_wavelengths,
        )

    def _holes(self) -> tuple[custom.HoleConfig, ...]:
        """Return hole 1 at -x ... hole 11 at +x, the row's middle hole on the board's middle."""
        middle = (len(DIAMETERS_IN) - 1) / 2
        holes = []
        for index, diameter_in in enumerate(DIAMETERS_IN):
            x_mm = round((index - middle) * self.hole_spacing_mm, 6)
            hole = custom.HoleConfig(
                id=index + 1,
                diameter_mm=round(diameter_in * INCH / MM, 6),
                centre_mm=(x_mm, self.row_offset_y_mm),
                kind=self.hole_kind,
                depth_mm=self.blind_depth_mm if self.hole_kind == "blind" else None,
            )
            holes.append(hole)
        return tuple(holes)

    def _tapes(self) -> tuple[custom.TapeConfig, ...]:
        """Return the strips: upper left, upper right, lower left, lower right."""
        tapes = []
        for side_y in (1, -1):
            for side_x in (-1, 1):
                tape = custom.TapeConfig(
                    centre_mm=(side_x * self.tape_x_mm, side_y * self.tape_y_mm),
                    size_mm=(self.tape_length_mm, self.tape_width_mm),
                    rgb=self.tape_rgb,
                    albedo_850=self.tape_albedo_850,
                    thickness_mm=self.tape_thickness_mm,
                )
                tapes.append(tape)
        return tuple(tapes)


_AnyTarget = ThesisTargetConfig | custom.TargetConfig | DrawnTargetConfig | MeshTargetConfig
AnyTargetConfig = Annotated[_AnyTarget, Field(discriminator="name")]
_KINDS = zip(("thesis", "custom", "drawn", "mesh"), get_args(_AnyTarget), strict=True)
TARGETS: dict[str, type[_AnyTarget]] = dict(_KINDS)
