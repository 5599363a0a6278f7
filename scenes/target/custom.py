"""Declaration of a target: board, damage, tape, material, backing, room and pose.

Frames. ``board``: x across the face, y up, z out of the face towards the camera, origin on the
face's centre. ``camera``: OpenCV's (x right, y down, z forward), origin at the depth lens. At zero
tilt board +x, +y, +z are camera +x, -y, -z. Albedos are linear diffuse reflectances in 0..1, at
850 nm and for red, green and blue. Ranges of single fields are checked here; rules on several
fields (a hole that leaves the board) by `scenes.target.checks`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import file_digest
from harness.vocabulary.geometry import MM, rotation_xyz_deg
from harness.vocabulary.meshes import FileUnit, FrontAxis
from scenes.target.flaws import AnyFlawConfig, Coordinate, FlawConfig, PlacedConfig, PlaceMm

# range of wavelengths for which an albedo holds: wood and paint change by a per cent or two (a
# guess)
NEAR_NM = 20.0
Albedo = Annotated[float, Field(ge=0.0, le=1.0)]
Rgb = tuple[Albedo, Albedo, Albedo]
Length = Annotated[float, Field(ge=1.0, le=1e4)]
SizeMm = tuple[Length, Length]
Chamfer = Annotated[
    float,
    Field(
        ge=0.0,
        le=100.0,
        description="leg of the 45 degree chamfer at the mouth; 0: none",
    ),
]


class FlatConfig(Config):
    """A flat face."""

    kind: Literal["flat"] = "flat"


class _CurvedConfig(Config):
    radius_mm: Annotated[float, Field(ge=10.0, le=1e6)]
    bulge: Literal["towards", "away"] = Field(
        "towards", description="bulges towards the camera or away from it"
    )


class CylinderConfig(_CurvedConfig):
    """A face bent about one axis: z = +-(sqrt(R^2 - s^2) - R), where s runs across the straight
    direction."""

    kind: Literal["cylinder"]
    straight_along: Literal["x", "y"] = "y"


class SphereConfig(_CurvedConfig):
    """A face that is part of a sphere: z = +-(sqrt(R^2 - x^2 - y^2) - R)."""

    kind: Literal["sphere"]


class TermConfig(Config):
    """One term of a polynomial face: coefficient_mm * (2 x / width)^power_x * (2 y /
    height)^power_y."""

    power_x: Annotated[int, Field(ge=0, le=8)]
    power_y: Annotated[int, Field(ge=0, le=8)]
    coefficient_mm: Annotated[float, Field(ge=-1e3, le=1e3)]

    @model_validator(mode="after")
    def _not_constant(self) -> Self:
        if self.power_x + self.power_y == 0:
            raise ValueError("a constant term is not legal: the face's centre has z = 0")
        return self


class PolynomialConfig(Config):
    """A face whose height towards the camera is a polynomial in x and y, the sum of its terms."""

    kind: Literal["polynomial"]
    terms: Annotated[tuple[TermConfig, ...], Field(min_length=1, max_length=45)]


class CorrugatedConfig(Config):
    """A corrugated sheet: z = depth / 2 (cos(2 pi s / period) - 1), where s runs across the
    straight direction."""

    kind: Literal["corrugated"]
    period_mm: Annotated[float, Field(ge=5.0, le=1e3)] = 76.0
    depth_mm: Annotated[float, Field(gt=0.0, le=200.0)] = Field(
        18.0, description="height from valley to crest"
    )
    straight_along: Literal["x", "y"] = "y"


class PanelConfig(Config):
    """A panel like that of a car door. It is bent in both directions, and the face steps at a
    swage line along x: z = -x^2 / 2 R_x - y^2 / 2 R_y + swage / 2 (tanh((y - y0) / w) + tanh(y0 /
    w)). The default values are guesses."""

    kind: Literal["panel"]
    radius_x_mm: Annotated[float, Field(ge=50.0, le=1e6)] = 4000.0
    radius_y_mm: Annotated[float, Field(ge=50.0, le=1e6)] = 1500.0
    swage_mm: Annotated[float, Field(ge=-50.0, le=50.0)] = 4.0
    swage_y_mm: Annotated[float, Field(ge=-5e3, le=5e3)] = 40.0
    swage_width_mm: Annotated[float, Field(ge=1.0, le=1e3)] = 12.0


class CastingConfig(Config):
    """A shell like a casting: a round boss in the middle, a rib along y on either side and one
    along x above, all equally high. Across a rib or the boss z = high / 2 (tanh((s + half) /
    flank) - tanh((s - half) / flank)), which holds draft and fillets. The default values are
    guesses: slopes below 20 degrees, so that damage may lie on them, and fillets of 23 mm."""

    kind: Literal["casting"]
    high_mm: Annotated[float, Field(ge=-50.0, le=50.0)] = 4.0
    rib_width_mm: Annotated[float, Field(ge=1.0, le=1e3)] = 16.0
    ribs_x_mm: Annotated[float, Field(ge=0.0, le=5e3)] = 90.0
    rib_y_mm: Annotated[float, Field(ge=-5e3, le=5e3)] = 60.0
    boss_width_mm: Annotated[float, Field(ge=1.0, le=1e3)] = 50.0
    flank_mm: Annotated[float, Field(ge=1.0, le=1e3)] = 6.0


class RoughConfig(Config):
    """A face with random roughness, such as concrete, and a flat back. Heights are Gaussian. Their
    power spectrum in two dimensions is (k^2 + k_outer^2)^-(1 + H) with k_outer = 2 pi /
    ``outer_mm``, and ends at 2 pi / ``inner_mm``; between both, the surface is self-affine
    (Persson et al., J. Phys.: Condens. Matter 17 (2005) R1). Not modelled: pores, gravel."""

    kind: Literal["rough"]
    deviation_mm: Annotated[float, Field(gt=0.0, le=20.0)] = Field(
        0.3, description="standard deviation of the heights"
    )
    outer_mm: Annotated[float, Field(ge=2.0, le=1e3)] = 60.0
    inner_mm: Annotated[float, Field(ge=1.0, le=100.0)] = 6.0
    hurst: Annotated[float, Field(gt=0.0, le=1.0)] = Field(0.8, description="H, the Hurst exponent")
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = Field(
        1, description="a family of boards draws it for each board"
    )


class _FileConfig(Config):
    file: Annotated[str, Field(min_length=1, max_length=1000)]
    content: str = Field(
        "",
        max_length=32,
        description="the file's digest, filled in when the file is read",
    )

    @model_validator(mode="before")
    @classmethod
    def _digest_of_file(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("content"):
            return data
        path = Path(str(data.get("file", "")))
        if not path.is_file():
            return data
        return {**data, "content": file_digest(path)}


class MeshConfig(_FileConfig):
    """The front of a part from a mesh file (`scenes.target.part`). Its bounds give the board's
    sizes."""

    kind: Literal["mesh"]
    unit: FileUnit = "mm"
    front: FrontAxis = "+z"


DrawnShapeConfig = Annotated[
    FlatConfig
    | CylinderConfig
    | SphereConfig
    | PolynomialConfig
    | CorrugatedConfig
    | PanelConfig
    | CastingConfig,
    Field(discriminator="kind"),
]


class MadeConfig(Config):
    """A face as it was made, which differs from its drawing, each part in its own way: the sizes
    of the shape, and a smooth error of form (Legendre polynomials of degree 2 and 3 in both
    directions, with equal variances)."""

    kind: Literal["made"]
    shape: DrawnShapeConfig = Field(description="the drawing's")
    form_mm: Annotated[float, Field(ge=0.0, le=20.0)] = Field(
        0.3, description="standard deviation of the error of form"
    )
    sizes_percent: Annotated[float, Field(ge=0.0, le=20.0)] = Field(
        1.0, description="standard deviation of each size of the shape"
    )
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = Field(
        1, description="a family of boards draws it for each board"
    )


ShapeConfig = Annotated[
    FlatConfig
    | CylinderConfig
    | SphereConfig
    | PolynomialConfig
    | CorrugatedConfig
    | PanelConfig
    | CastingConfig
    | RoughConfig
    | MadeConfig
    | MeshConfig,
    Field(discriminator="kind", default_factory=FlatConfig),
]


class BoardConfig(Config):
    """A board. Its outline, seen along z, is a rectangle; its thickness along the face's normal is
    constant."""

    width_mm: Annotated[float, Field(ge=5.0, le=5e3)]
    height_mm: Annotated[float, Field(ge=5.0, le=5e3)]
    thickness_mm: Annotated[float, Field(ge=0.5, le=500.0)]
    shape: ShapeConfig

    @property
    def as_drawn(self) -> BoardConfig:
        """The board of the drawing, from which a made one differs."""
        if not isinstance(self.shape, MadeConfig):
            return self
        return self.model_copy(update={"shape": self.shape.shape})


class DamageConfig(PlacedConfig):
    """Keys that the declarations of holes and dents share."""

    diameter_mm: Annotated[float, Field(ge=0.2, le=1e3)]

    @property
    def radius_m(self) -> float:
        """Declared radius in metres: of the drill, or of a dent's rim on a flat face."""
        return self.diameter_mm * MM / 2

    @property
    def mouth_m(self) -> float:
        """Radius in metres of the opening in a flat face, a chamfer included."""
        return self.radius_m + getattr(self, "chamfer_mm", 0.0) * MM

    @property
    def reach_mm(self) -> float:
        """Radius of a circle about the centre that holds the outline."""
        return self.mouth_m / MM


class DrillConfig(Config):
    """The drill of all holes of a board. It replaces the diameter, kind, depth and chamfer of each
    hole."""

    diameter_mm: Annotated[float, Field(ge=0.2, le=1e3)]
    kind: Literal["through", "blind"] = "through"
    depth_mm: Annotated[float, Field(gt=0.0, le=500.0)] | None = Field(
        default=None, description="of blind holes only"
    )
    chamfer_mm: Chamfer = 0.0


class HoleConfig(DrillConfig, DamageConfig):
    """A drilled cylinder whose axis is the face's normal at its centre. A blind hole has a flat
    bottom."""

    @model_validator(mode="after")
    def _depth_where_blind(self) -> Self:
        if self.kind == "blind" and self.depth_mm is None:
            raise ValueError("a blind hole needs depth_mm")
        if self.kind == "through" and self.depth_mm is not None:
            raise ValueError("a through-hole takes no depth_mm; its depth is the board's thickness")
        return self


class DentConfig(DamageConfig):
    """A spherical cap with the rim diameter and depth that a ball would leave in a flat face."""

    kind: ClassVar[Literal["dent"]] = "dent"
    depth_mm: Annotated[float, Field(ge=0.04, le=500.0)]

    @property
    def ball_m(self) -> float:
        """Radius of the ball whose cap on a flat face has this rim and depth."""
        return (self.radius_m**2 + (self.depth_mm * MM) ** 2) / (2 * self.depth_mm * MM)


AnyDamage = HoleConfig | DentConfig | FlawConfig


class TapeConfig(Config):
    """A strip of tape on the face. Its size and place are those in plan; its angle counts from
    board +x towards +y."""

    centre_mm: PlaceMm
    size_mm: SizeMm
    angle_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0
    rgb: Rgb = (0.85, 0.08, 0.08)
    albedo_850: Albedo = 0.6
    thickness_mm: Annotated[float, Field(ge=0.02, le=3.0)] = 0.15


class GlossConfig(Config):
    """A Phong lobe beside diffuse reflection: the part ``share`` of the reflected light goes into
    a lobe about the mirror direction, (exponent + 2) / (2 pi) cos^exponent of the angle from it
    (Lafortune and Willems 1994). The model is reciprocal and never reflects more than the albedo.
    It lacks the growth at grazing angles (Fresnel)."""

    share: Albedo
    exponent: float = Field(
        ge=1.0,
        le=500.0,
        description="width of the lobe at half height: 7: 50, 180: 10 degrees",
    )


class TextureConfig(_FileConfig):
    """An image on the face in place of the grain. It is stretched over the board's width and
    height, its first row at the top. Its brightness in linear light (decoded from sRGB) scales the
    albedo at 850 nm and all colours alike, so that their means are those declared. A pattern that
    looks different at 850 nm is not modelled."""


class ReflectanceConfig(Config):
    """Reflectance of a board: diffuse, with a grain along x or a ``texture``, which scale 850 nm
    and all colours alike. ``gloss`` acts at the camera's wavelength, on the face and in holes, but
    not on tape."""

    albedo_850: Albedo = Field(
        0.6, description="pale wood has 0.5 to 0.7; no published value for plywood was found"
    )
    rgb: Rgb = (0.55, 0.42, 0.28)
    grain_contrast: float = Field(
        0.05,
        ge=0.0,
        le=0.3,
        description="standard deviation of the albedo over its mean",
    )
    grain_period_mm: Annotated[float, Field(ge=1.0, le=200.0)] = Field(
        8.0, description="distance between dark lines"
    )
    gloss: GlossConfig | None = None
    texture: TextureConfig | None = None


class MaterialConfig(ReflectanceConfig):
    """Reflectance of one board; ``grain_seed`` tells it from boards of the same material."""

    grain_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1


class BackingConfig(Config):
    """A plane behind the board, parallel to the board frame's x and y."""

    distance_mm: float = Field(
        ge=0.0,
        le=5e3,
        description="distance behind the deepest point of the board's back",
    )
    albedo_850: Albedo = 0.6
    rgb: Rgb = (0.55, 0.55, 0.55)
    size_mm: SizeMm | None = Field(
        None, description="null: what the board hides from the lens at zero tilt"
    )


class RoomConfig(Config):
    """Floor and back wall, from which light reaches the board (multipath). In the camera's frame,
    the floor is parallel to the optical axis and the wall is perpendicular to it. A key that is
    null leaves that surface out."""

    floor_below_lens_m: Annotated[float, Field(ge=0.05, le=10.0)] | None = None
    floor_albedo_850: Albedo = 0.3
    floor_rgb: Rgb = (0.3, 0.3, 0.3)
    back_wall_distance_m: Annotated[float, Field(ge=0.1, le=20.0)] | None = None
    back_wall_albedo_850: Albedo = 0.6
    back_wall_rgb: Rgb = (0.6, 0.6, 0.6)
    width_m: float = Field(
        4.0,
        ge=0.5,
        le=40.0,
        description="width of floor and wall, centred on the optical axis",
    )
    height_m: float = Field(
        2.5,
        ge=0.5,
        le=20.0,
        description="height of the wall above the floor",
    )


class WavelengthConfig(Config):
    """Albedos at a wavelength other than 850 nm: one for each kind of surface that the target has.
    ``as_at_850`` gives the ``board`` the albedo that its material has at 850 nm."""

    wavelength_nm: Annotated[float, Field(ge=300.0, le=2000.0)]
    board: Albedo | Literal["as_at_850"]
    tape: Albedo | None = None
    backing: Albedo | None = None
    floor: Albedo | None = None
    back_wall: Albedo | None = None


_OTHER = Field(max_length=20, description="albedos for cameras that do not work near 850 nm")
OtherWavelengths = Annotated[tuple[WavelengthConfig, ...], _OTHER]


class PoseConfig(Config):
    """Pose of the board: the face's centre in the camera's axes, and rotations about the board's
    own x, then y, z."""

    distance_m: Annotated[float, Field(ge=0.1, le=10.0)] = Field(
        0.7, description="depth of the face's centre"
    )
    offset_x_mm: Coordinate = 0.0
    offset_y_mm: Coordinate = 0.0
    tilt_x_deg: Annotated[float, Field(ge=-70.0, le=70.0)] = 0.0
    tilt_y_deg: Annotated[float, Field(ge=-70.0, le=70.0)] = 0.0
    roll_deg: Annotated[float, Field(ge=-180.0, le=180.0)] = 0.0

    @property
    def T_camera_board(self) -> np.ndarray:
        """The 4x4 matrix that maps board to camera. Positive ``tilt_x_deg`` brings the upper edge
        nearer, positive ``tilt_y_deg`` the -x edge, and positive ``roll_deg`` lifts the +x edge.
        """
        T_camera_board = np.eye(4)
        turned = rotation_xyz_deg(self.tilt_x_deg, self.tilt_y_deg, self.roll_deg)
        T_camera_board[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turned
        T_camera_board[:3, 3] = self.offset_x_mm * MM, self.offset_y_mm * MM, self.distance_m
        return T_camera_board


class SetUpConfig(Config):
    """Surroundings of a board, and its pose; without ``backing`` or ``room``, nothing is there."""

    name: str
    flaws: Annotated[
        tuple[AnyFlawConfig, ...],
        Field(max_length=500, description="damage of all kinds but holes and dents"),
    ] = ()
    material: MaterialConfig = MaterialConfig()
    backing: BackingConfig | None = None
    room: RoomConfig | None = None
    pose: PoseConfig = PoseConfig()
    other_wavelengths: OtherWavelengths = ()


class TargetConfig(SetUpConfig):
    """A target declared in full: the board, its damage, tapes, surroundings and pose."""

    name: Literal["custom"] = "custom"
    board: BoardConfig
    drill: DrillConfig | None = Field(
        None, description="one drill for all holes, so that an axis can vary it"
    )
    holes: Annotated[tuple[HoleConfig, ...], Field(max_length=500)] = ()
    dents: Annotated[tuple[DentConfig, ...], Field(max_length=500)] = ()
    tapes: Annotated[tuple[TapeConfig, ...], Field(max_length=100)] = ()

    @model_validator(mode="before")
    @classmethod
    def _one_drill(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        drill = data.get("drill")
        holes = data.get("holes")
        if not isinstance(drill, dict) or not isinstance(holes, list | tuple):
            return data
        drilled = {
            "kind": "through",
            "depth_mm": None,
            "chamfer_mm": 0.0,
            **drill,
        }
        drilled_holes = [{**hole, **drilled} if isinstance(hole, dict) else hole for hole in holes]
        return {**data, "holes": drilled_holes}

    @model_validator(mode="after")
    def _ids_once(self) -> Self:
        ids = [damage.id for damage in self.damages]
        repeated = sorted({number for number in ids if ids.count(number) > 1})
        if repeated:
            listed = ", ".join(str(number) for number in repeated)
            raise ValueError(f"ids of damage must differ; given more than once: {listed}")
        return self

    @property
    def damages(self) -> tuple[AnyDamage, ...]:
        """Holes, then dents, then all other kinds."""
        return self.holes + self.dents + self.flaws

    def declare(self) -> TargetConfig:
        """Return itself: every kind of target answers ``declare()`` with the full declaration."""
        return self

    def hole_free(self) -> TargetConfig:
        """Return the same set-up without any damage; a threshold is calibrated on it."""
        return self.model_copy(update={"drill": None, "holes": (), "dents": (), "flaws": ()})

    def at_wavelength(self, wavelength_nm: float) -> TargetConfig:
        """Return the declaration with the nearest albedos to that wavelength as its
        ``albedo_850``, and no others. Raises UserError if the declaration has none for it, or
        lacks the albedo of one of its surfaces."""
        albedos = self._nearest_albedos(wavelength_nm)
        if albedos is None:
            return self.model_copy(update={"other_wavelengths": ()})
        room = self.room
        surfaces: dict[str, Any] = {"tape": self.tapes, "backing": self.backing}
        if room is not None:
            surfaces["floor"] = room.floor_below_lens_m
            surfaces["back_wall"] = room.back_wall_distance_m
        lacking = [
            name for name, surface in surfaces.items() if surface and getattr(albedos, name) is None
        ]
        if lacking:
            raise UserError(
                f"other_wavelengths: at {albedos.wavelength_nm:g} nm there is no albedo for "
                f"{', '.join(lacking)}",
                legal="an albedo for every surface that the target has",
            )
        changed: dict[str, Any] = {"other_wavelengths": ()}
        if albedos.board != "as_at_850":
            changed["material"] = _with_albedo(self.material, albedos.board)
        changed["tapes"] = tuple(_with_albedo(tape, albedos.tape) for tape in self.tapes)
        if self.backing is not None:
            changed["backing"] = _with_albedo(self.backing, albedos.backing)
        if room is not None:
            room_albedos = {
                "floor_albedo_850": albedos.floor,
                "back_wall_albedo_850": albedos.back_wall,
            }
            stated = {name: value for name, value in room_albedos.items() if value is not None}
            changed["room"] = room.model_copy(update=stated)
        return self.model_copy(update=changed)

    def _nearest_albedos(self, wavelength_nm: float) -> WavelengthConfig | None:
        """Return the nearest albedos; None for those at 850 nm. Raises UserError if none are near
        enough."""

        def off_nm(albedos: WavelengthConfig) -> float:
            return abs(albedos.wavelength_nm - wavelength_nm)

        close_bands = [albedos for albedos in self.other_wavelengths if off_nm(albedos) <= NEAR_NM]
        nearest = min(
            close_bands,
            key=off_nm,
            default=None,
        )
        limit_nm = NEAR_NM if nearest is None else off_nm(nearest)
        if abs(wavelength_nm - 850.0) <= limit_nm:
            return None
        if nearest is None:
            declared = {850.0, *(albedos.wavelength_nm for albedos in self.other_wavelengths)}
            listed = ", ".join(f"{nm:g}" for nm in sorted(declared))
            raise UserError(
                f"the target has no albedo at {wavelength_nm:g} nm",
                legal=f"a camera within {NEAR_NM:g} nm of {listed} nm",
                fix=f"declare other_wavelengths: [{{wavelength_nm: {wavelength_nm:g}, board: ..., "
                "tape: ..., ...}]",
            )
        return nearest


def _with_albedo(surface: Any, albedo_850: float | None) -> Any:
    return surface.model_copy(update={"albedo_850": albedo_850})
