"""The named target ``thesis``, with every fact that its source leaves open as one field; and all kinds of targets.

Source: "Damage Detection and Location Using Time of Flight Depth Cameras" (Rutgers), Table I and the ruler readings of
its error script. Stated there: eleven holes of 1/16 to 1 in drilled in one row of a half-inch plywood sheet, about 2 in
apart from the 1/4 in hole on, strips of coloured tape, an Azure Kinect. Everything else below is not stated: a choice
with a reason, fixed before any claim was scored; `experiments/averaging.yaml` tries others that are plausible."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import INCH, MM
from scenes.target import custom
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.part import MeshTargetConfig

THICKNESS_MM = 12.7  # half an inch (stated)
DIAMETERS_IN = (1 / 16, 1 / 8, 3 / 16, 1 / 4, 5 / 16, 3 / 8, 7 / 16, 1 / 2, 5 / 8, 3 / 4, 1.0)  # stated, Table I
Degrees = Annotated[float, Field(ge=-70.0, le=70.0)]
NonNegativeMm = Annotated[float, Field(ge=0.0, le=5e3)]


def _open(default: Any, reason: str) -> Any:
    return Field(default=default, description=reason)


class ThesisTargetConfig(Config):
    """The open facts of the thesis' target. ``declare()`` gives the full declaration."""

    name: Literal["thesis"] = "thesis"
    hole_kind: Literal["through", "blind"] = _open("through", "'Drilled' in a thin sheet reads as drilled through.")
    blind_depth_mm: Annotated[float, Field(gt=0.0, lt=THICKNESS_MM)] = _open(9.5, "Three quarters of the thickness.")
    backing_distance_mm: NonNegativeMm | None = _open(
        20.0,
        "Only points with z < 1.1 m and a range < 1 m are kept, and the holes still show points at depth, so something "
        "stood close behind; a sheet leaning on a wall leaves centimetres. none: nothing behind.",
    )
    backing_albedo_850: custom.Albedo = _open(0.6, "Painted walls and wood lie near it. A guess.")
    hole_spacing_mm: Annotated[float, Field(ge=30.0, le=100.0)] = _open(
        50.8, "2 in by the ruler readings of holes 4 to 11; taken to be the same for 1 to 3."
    )
    board_width_mm: Annotated[float, Field(ge=100.0, le=5e3)] = _open(609.6, "24 in, a stock size; the row needs 20.")
    board_height_mm: Annotated[float, Field(ge=30.0, le=5e3)] = _open(114.3, "4.5 in: the row, and tape on both sides.")
    row_offset_y_mm: Annotated[float, Field(ge=-2e3, le=2e3)] = _open(0.0, "The row is centred.")
    distance_m: Annotated[float, Field(ge=0.3, le=5.0)] = _open(
        0.7, "The middle of 0.5 m, the camera's limit, and 0.95 m, where the board's end has a range of 1 m."
    )
    offset_x_mm: custom.Coordinate = _open(0.0, "A board is put before the camera's centre.")
    offset_y_mm: custom.Coordinate = _open(0.0, "A board is put before the camera's centre.")
    tilt_x_deg: Degrees = _open(3.0, "No sheet put up by hand is frontal; a frontal one would hide noise by rounding.")
    tilt_y_deg: Degrees = _open(4.0, "As tilt_x_deg.")
    roll_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = _open(0.0, "A board is set down level.")
    plywood_albedo_850: custom.Albedo = _open(0.6, "Pale wood: 0.5 to 0.7. No published value for plywood was found.")
    plywood_rgb: custom.Rgb = _open((0.55, 0.42, 0.28), "Pale wood. A guess.")
    grain_contrast: Annotated[float, Field(ge=0.0, le=0.3)] = _open(0.05, "Deviation over mean of the albedo. A guess.")
    grain_period_mm: Annotated[float, Field(ge=1.0, le=200.0)] = _open(8.0, "Dark lines of a softwood veneer. A guess.")
    grain_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = _open(1, "Which board out of all alike.")
    tape_length_mm: custom.Length = _open(40.0, "Four strips, one near each corner, clear of the row.")
    tape_width_mm: custom.Length = _open(12.0, "Half-inch tape.")
    tape_x_mm: NonNegativeMm = _open(200.0, "The strips' centres: +-x.")
    tape_y_mm: NonNegativeMm = _open(38.0, "The strips' centres: +-y.")
    tape_thickness_mm: Annotated[float, Field(ge=0.02, le=3.0)] = _open(0.15, "Vinyl tape is 0.13 to 0.18 mm thick.")
    tape_albedo_850: custom.Albedo = _open(0.6, "Red dyes are clear in the near infrared. A guess.")
    tape_rgb: custom.Rgb = _open((0.85, 0.08, 0.08), "Strips have red above mean + 2.6 deviations: redder than wood.")
    floor_below_lens_m: Annotated[float, Field(ge=0.05, le=10.0)] | None = _open(0.75, "A table's height, or none.")
    floor_albedo_850: custom.Albedo = _open(0.3, "A guess.")
    back_wall_distance_m: Annotated[float, Field(ge=0.1, le=20.0)] | None = _open(2.5, "A small laboratory, or none.")
    back_wall_albedo_850: custom.Albedo = _open(0.6, "A painted wall. A guess.")
    other_wavelengths: custom.OtherWavelengths = ()

    def declare(self) -> custom.TargetConfig:
        """Return the full declaration. Whether the parts fit together is checked when it is built."""
        middle = (len(DIAMETERS_IN) - 1) / 2
        room = {key: getattr(self, key) for key in custom.RoomConfig.model_fields if hasattr(self, key)}
        backing = None
        if self.backing_distance_mm is not None:
            backing = custom.BackingConfig(distance_mm=self.backing_distance_mm, albedo_850=self.backing_albedo_850)
        sizes = {"width_mm": self.board_width_mm, "height_mm": self.board_height_mm, "thickness_mm": THICKNESS_MM}
        strip: dict[str, Any] = {key: getattr(self, f"tape_{key}") for key in ("rgb", "albedo_850", "thickness_mm")}
        return custom.TargetConfig(
            board=custom.BoardConfig(**sizes, shape=custom.FlatConfig()),
            # hole 1 at -x ... hole 11 at +x, the row's middle hole on the board's middle
            holes=tuple(
                custom.HoleConfig(
                    id=number,
                    diameter_mm=round(diameter_in * INCH / MM, 6),
                    centre_mm=(round((number - 1 - middle) * self.hole_spacing_mm, 6), self.row_offset_y_mm),
                    kind=self.hole_kind,
                    depth_mm=self.blind_depth_mm if self.hole_kind == "blind" else None,
                )
                for number, diameter_in in enumerate(DIAMETERS_IN, start=1)
            ),
            tapes=tuple(
                custom.TapeConfig(
                    centre_mm=(side_x * self.tape_x_mm, side_y * self.tape_y_mm),
                    size_mm=(self.tape_length_mm, self.tape_width_mm),
                    **strip,
                )
                for side_y in (1, -1)
                for side_x in (-1, 1)
            ),
            material=custom.MaterialConfig(
                albedo_850=self.plywood_albedo_850,
                rgb=self.plywood_rgb,
                **{key: getattr(self, key) for key in ("grain_contrast", "grain_period_mm", "grain_seed")},
            ),
            backing=backing,
            room=custom.RoomConfig(**room) if room["floor_below_lens_m"] or room["back_wall_distance_m"] else None,
            pose=custom.PoseConfig(**{key: getattr(self, key) for key in custom.PoseConfig.model_fields}),
            other_wavelengths=self.other_wavelengths,
        )


_AnyTarget = ThesisTargetConfig | custom.TargetConfig | DrawnTargetConfig | MeshTargetConfig
AnyTargetConfig = Annotated[_AnyTarget, Field(discriminator="name")]
_KINDS = zip(("thesis", "custom", "drawn", "mesh"), get_args(_AnyTarget), strict=True)
TARGETS: dict[str, type[_AnyTarget]] = dict(_KINDS)
