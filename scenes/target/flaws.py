"""Damage other than drilled holes and ball dents: slots, gouges, pressed sheets, corrosion, chips,
protrusions.

Each is a depth over its own frame, which touches the face at the damage's centre: s runs along the
damage, t across it, and depth counts along the face's normal there, into the board. A kind gives
its depth on a grid of (s, t) whose border is the outline; `mesh.solids_of` cuts or adds the solid
between that grid and the face, and `truth.truth_of` measures outline, centre line and volume on
it. ``angle_deg`` turns s from board +x towards board +y. Sizes are those in the plane that touches
the face; they are exact to second order in size over radius of curvature.

Not modelled: burrs, spring-back, rust that stands on the face, another albedo of the exposed
material."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from pydantic import Field
from scipy.ndimage import gaussian_filter

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import random_stream

Coordinate = Annotated[float, Field(ge=-5e3, le=5e3)]
PlaceMm = tuple[Coordinate, Coordinate]
Extent = Annotated[float, Field(ge=0.05, le=2e3)]
Depth = Annotated[float, Field(gt=0.0, le=500.0)]
Angle = Annotated[float, Field(ge=-180.0, le=180.0)]
Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
# cells of an elongated damage's grid: volume within 0.1 %
ALONG = 96
ACROSS = 24
ROUND = 64  # cells along each side of a round damage's grid: volume within 0.1 %
# part of a chip's half-length that its grid spans: at the very tips it would have no width
CHIP_ARC = 0.998


@dataclass(frozen=True)
class Relief:
    """The depth of a damage over its own frame, on a grid whose border is the outline."""

    s_m: np.ndarray
    """(rows, columns): position along the damage."""
    t_m: np.ndarray
    """(rows, columns): position across it."""
    depth_m: np.ndarray
    """(rows, columns): negative where the damage stands out of the face, NaN through the board."""
    open_row: bool = False
    """True if the last row lies on the board's edge, beyond which a cutter goes on."""


class PlacedConfig(Config):
    """Keys that all damage shares. ``size_of`` names the size in plan that a limit states."""

    id: Annotated[int, Field(ge=1, le=9999)]
    centre_mm: PlaceMm
    size_of: ClassVar[str] = "diameter"

    @property
    def centre_m(self) -> tuple[float, float]:
        """Place in plan, metres."""
        return self.centre_mm[0] * MM, self.centre_mm[1] * MM

    @property
    def size_mm(self) -> float:
        """The size that ``size_of`` names."""
        return float(getattr(self, f"{self.size_of}_mm"))


class _FlawConfig(PlacedConfig):
    @property
    def sides_mm(self) -> tuple[float, float]:
        """Length and width."""
        length_mm = getattr(self, "length_mm", self.size_mm)
        return float(length_mm), float(getattr(self, "width_mm", length_mm))

    @property
    def turn_rad(self) -> float:
        """Angle of the length from board +x."""
        return float(np.deg2rad(getattr(self, "angle_deg", 0.0)))

    @property
    def reach_mm(self) -> float:
        """Radius of a circle about the centre that holds the outline."""
        relief = self.relief()
        return float(np.hypot(relief.s_m, relief.t_m).max()) / MM

    @abstractmethod
    def relief(self) -> Relief:
        """Return the depth over the damage's frame, negative where it stands out of the face."""


class _LongConfig(_FlawConfig):
    """A damage along a line. ``wander_mm``: deviation of the line from a straight one; ``seed``
    draws its waves."""

    length_mm: Extent
    width_mm: Extent
    angle_deg: Angle = 0.0
    wander_mm: Annotated[float, Field(ge=0.0, le=200.0)] = 0.0
    seed: Seed = 1

    def _grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return s and t (rows, columns) in metres, and the part of the half-width at which each
        row lies."""
        share = np.linspace(-0.5, 0.5, ALONG + 1)
        turns, weights = random_stream(self.seed, "centre line").uniform(size=(2, 3))
        waves = []
        for k in range(3):
            waves.append(weights[k] * np.sin(2 * np.pi * ((k + 1) * share + turns[k])))
        line = np.sum(waves, axis=0)
        deviation = max(float(line.std()), 1e-12)
        line_m = self.wander_mm * MM * (line - line.mean()) / deviation
        half_widths = np.linspace(-1.0, 1.0, ACROSS + 1)[:, None]
        across, s_m = np.broadcast_arrays(half_widths, share * self.length_mm * MM)
        t_m = line_m + across * self.width_mm * MM / 2
        return s_m, t_m, across


class SlotConfig(_LongConfig):
    """A slot or open crack of constant depth, with upright walls and blunt ends. Its limit is a
    width. ``wander_mm`` is the deviation of its centre line from a straight one; ``seed`` draws
    the line."""

    kind: Literal["slot"]
    size_of: ClassVar[str] = "width"
    depth_mm: Depth | None = Field(None, description="null: through the board")

    def relief(self) -> Relief:
        s_m, t_m, _ = self._grid()
        depth_m = np.nan if self.depth_mm is None else self.depth_mm * MM
        return Relief(s_m, t_m, np.full(s_m.shape, depth_m))


class GougeConfig(_LongConfig):
    """A scratch or gouge. Its section is a V or a parabola, and its floor rises to the face over
    ``run_out_mm`` at each end. Its limit is a length; assessments of pipes (ASME B31G, API 579)
    use its depth and its length. ``wander_mm`` and ``seed`` are those of a slot."""

    kind: Literal["gouge"]
    size_of: ClassVar[str] = "length"
    depth_mm: Depth
    section: Literal["v", "round"] = "v"
    run_out_mm: Annotated[float, Field(ge=0.1, le=1e3)] = 5.0

    def relief(self) -> Relief:
        s_m, t_m, across = self._grid()
        section = 1 - np.abs(across) if self.section == "v" else 1 - across**2
        run_out_m = min(self.run_out_mm, self.length_mm / 2) * MM
        to_end_m = self.length_mm * MM / 2 - np.abs(s_m)
        ramp = np.clip(to_end_m / run_out_m, 0.0, 1.0)
        return Relief(s_m, t_m, self.depth_mm * MM * section * ramp)


class RoundConfig(_FlawConfig):
    """A sheet that is pressed in (``pressed_dent``) or out (``pressed_bump``): front and back move
    alike, by a raised cosine of the distance from the centre, and may move further than the sheet
    is thick. A ``protrusion`` is an object on the face, such as weld spatter or a rivet's head: a
    paraboloid of height ``depth_mm``."""

    kind: Literal["pressed_dent", "pressed_bump", "protrusion"]
    diameter_mm: Extent
    depth_mm: Annotated[
        Depth, Field(description="depth; of a protrusion, its height above the face")
    ]

    @property
    def pressed(self) -> bool:
        """Return whether the sheet's back moves too."""
        return self.kind != "protrusion"

    def relief(self) -> Relief:
        s_m, t_m, ring = _disc(self.diameter_mm * MM / 2)
        height = (1 + np.cos(np.pi * ring)) / 2 if self.pressed else 1 - ring**2
        sign = 1.0 if self.kind == "pressed_dent" else -1.0
        return Relief(s_m, t_m, sign * self.depth_mm * MM * height)


class CorrosionConfig(_FlawConfig):
    """A corroded patch. Its outline is uneven: the radius varies by ``uneven`` (deviation over
    mean). Its floor is rough, with the deviation ``rough_mm`` and the correlation length
    ``grain_mm`` (Gaussian, cut at the face), and rises to the face over the outer tenth of the
    radius. ``seed`` draws both."""

    kind: Literal["corrosion"]
    diameter_mm: Annotated[
        Extent, Field(description="diameter of the circle that has the patch's area")
    ]
    depth_mm: Annotated[Depth, Field(description="mean depth")]
    rough_mm: Annotated[float, Field(ge=0.0, le=100.0)] = 0.2
    grain_mm: Annotated[float, Field(ge=0.1, le=200.0)] = 3.0
    uneven: Annotated[float, Field(ge=0.0, le=0.3)] = 0.12
    seed: Seed = 1

    def relief(self) -> Relief:
        rng = random_stream(self.seed, "corrosion")
        s, t, ring = _disc(1.0)
        turns = rng.uniform(0, 2 * np.pi, 4)
        weights = rng.uniform(0.3, 1.0, 4)
        spread = self.uneven / np.sqrt((weights**2).sum() / 2)

        def outline(angle: np.ndarray) -> np.ndarray:
            waves = [weights[k] * np.cos((k + 2) * angle + turns[k]) for k in range(4)]
            return 1 + spread * sum(waves)

        once_round = np.linspace(0, 2 * np.pi, 721)[:-1]
        mean_radius = np.sqrt(np.mean(outline(once_round) ** 2))
        radius_m = self.diameter_mm * MM / 2
        stretch_m = radius_m * outline(np.arctan2(t, s)) / mean_radius
        grain_cells = self.grain_mm / self.diameter_mm * ROUND
        noise = gaussian_filter(rng.standard_normal(s.shape), grain_cells / np.sqrt(2))
        # a patch narrower than its grain lies on one slope of it: only the mean depth is stated
        noise -= noise.mean()
        noise *= self.rough_mm * MM / max(float(noise.std()), 1e-12)
        ramp = np.clip((1 - ring) / 0.1, 0.0, 1.0)
        depth_m = np.maximum(self.depth_mm * MM + noise, 0.0) * ramp
        s_m = s * stretch_m
        t_m = t * stretch_m
        return Relief(s_m, t_m, depth_m * self.depth_mm * MM / _mean(s_m, t_m, depth_m))


class ChipConfig(_FlawConfig):
    """Material missing at the board's edge (a chip, a spall): a quarter of an ellipsoid about a
    point of the edge. ``angle_deg`` names the edge: 0 top, 90 left, 180 bottom, -90 right. Its
    limit is a length."""

    kind: Literal["chip"]
    size_of: ClassVar[str] = "length"
    length_mm: Annotated[Extent, Field(description="length along the edge")]
    width_mm: Annotated[Extent, Field(description="width from the edge inwards")]
    depth_mm: Depth
    angle_deg: Literal[0, 90, 180, -90]

    def relief(self) -> Relief:
        along = CHIP_ARC * np.sin(np.linspace(-1, 1, ALONG + 1) * np.pi / 2)
        u, inwards = np.meshgrid(along, np.linspace(1, 0, ACROSS + 1))
        v = np.sin(inwards * np.pi / 2)
        s_m = u * self.length_mm * MM / 2
        t_m = -v * np.sqrt(1 - u**2) * self.width_mm * MM
        height = np.sqrt((1 - u**2) * np.maximum(1 - v**2, 0.0))
        return Relief(s_m, t_m, self.depth_mm * MM * height, open_row=True)


FlawConfig = SlotConfig | GougeConfig | RoundConfig | CorrosionConfig | ChipConfig
AnyFlawConfig = Annotated[FlawConfig, Field(discriminator="kind")]


def _disc(radius_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return s and t of a square grid mapped onto a disc, border on the rim, and each point's
    share of the radius."""
    ticks = np.linspace(-1, 1, ROUND + 1)
    u, v = np.meshgrid(ticks, ticks)
    s = u * np.sqrt(1 - v**2 / 2)
    t = v * np.sqrt(1 - u**2 / 2)
    return radius_m * s, radius_m * t, np.minimum(np.hypot(s, t), 1.0)


def _mean(
    s: np.ndarray,
    t: np.ndarray,
    values: np.ndarray,
) -> float:
    """Return the mean of a grid's values over its area."""
    # twice the area of a cell is the product of its diagonals
    falling_s = s[1:, 1:] - s[:-1, :-1]
    rising_s = s[1:, :-1] - s[:-1, 1:]
    falling_t = t[1:, 1:] - t[:-1, :-1]
    rising_t = t[1:, :-1] - t[:-1, 1:]
    areas = np.abs(falling_s * rising_t - rising_s * falling_t)
    ends_of_falling = values[1:, 1:] + values[:-1, :-1]
    middles = (ends_of_falling + values[1:, :-1] + values[:-1, 1:]) / 4
    return float((areas * middles).sum() / areas.sum())


def turned(angle_rad: float) -> np.ndarray:
    """Return the 2x2 matrix that turns from x towards y."""
    cosine = np.cos(angle_rad)
    sine = np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def border(grid: np.ndarray) -> np.ndarray:
    """Return the border (n, ...) of a grid (rows, columns, ...), once round, from its first corner
    along the row."""
    sides = [
        grid[0, :-1],
        grid[:-1, -1],
        grid[-1, :0:-1],
        grid[:0:-1, 0],
    ]
    return np.concatenate(sides)


def closed_grid(
    upper: np.ndarray,
    lower: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and outward triangles (m, 3) of the solid between two grids (rows,
    columns, 3) of points, columns running with x and rows with y as seen from above, closed by
    walls between their borders."""
    rows, columns = upper.shape[:2]
    grid = np.arange(rows * columns).reshape(rows, columns)
    below = grid.size
    a = grid[:-1, :-1].ravel()
    b = grid[:-1, 1:].ravel()
    c = grid[1:, 1:].ravel()
    d = grid[1:, :-1].ravel()
    half_cells = np.column_stack([a, b, c])
    other_half_cells = np.column_stack([a, c, d])
    top = np.concatenate([half_cells, other_half_cells])
    bottom = top[:, ::-1] + below
    rim = border(grid)
    after = np.roll(rim, -1)
    wall = np.column_stack([rim + below, after + below, after])
    other_wall = np.column_stack([rim + below, after, rim])
    vertices = np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])
    return vertices, np.concatenate([top, bottom, wall, other_wall])


def volume_m3(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the volume that closed, outward triangles enclose."""
    centred = vertices - vertices.mean(axis=0)
    a = centred[faces[:, 0]]
    b = centred[faces[:, 1]]
    c = centred[faces[:, 2]]
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def outside_m(outline_m: np.ndarray, places_m: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of places (n, 2) from a closed polygon (k, 2), negative inside."""
    outline = outline_m.astype(np.float32)
    inside_m = [cv2.pointPolygonTest(outline, point, True) for point in places_m.tolist()]
    return -np.array(inside_m)


def from_line_m(line_m: np.ndarray, places_m: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of places (n, 2) from a line of straight pieces (k, 2), or from one
    point (1, 2)."""
    if len(line_m) == 1:
        return np.asarray(np.linalg.norm(places_m - line_m[0], axis=-1))
    piece = np.diff(line_m, axis=0)
    from_start = places_m[:, None] - line_m[:-1]
    square = np.maximum((piece**2).sum(axis=1), 1e-30)
    # the share of the piece at which its point closest to the place lies
    projected = (from_start * piece).sum(axis=-1) / square
    share = np.clip(projected, 0.0, 1.0)
    to_piece = from_start - share[..., None] * piece
    return np.asarray(np.linalg.norm(to_piece, axis=-1).min(axis=1))
