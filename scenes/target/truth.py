"""The target in closed form: the face as a height field, the planes around it, and the damage:
place and volume."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.polynomial import legendre, polynomial
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from harness.vocabulary.geometry import MM, rotate_vectors, transform_points
from harness.vocabulary.seeds import random_stream
from scenes.target import custom
from scenes.target.flaws import FlawConfig, border, closed_grid, outside_m, volume_m3
from scenes.target.part import front_derivatives, part_of

OUTLINE_STEPS = 64  # points along each side of the outline
LINE_STEP = 8  # columns of a flaw's grid between two points of its centre line
# reach of a floor without a back wall: beyond it, light returns under 1 % of the board's at 0.7 m
OPEN_FLOOR_M = 3.0
# of a face's derivatives in x and y
ORDERS = (
    (0, 0),  # z
    (1, 0),  # dz/dx
    (0, 1),  # dz/dy
    (2, 0),  # d2z/dx2
    (1, 1),  # d2z/dxdy
    (0, 2),  # d2z/dy2
)
_UNIT_CORNERS = np.array(
    [
        (-0.5, -0.5),
        (0.5, -0.5),
        (0.5, 0.5),
        (-0.5, 0.5),
    ]
)


Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]
Derivatives = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, ...]]
"""Give z, or z and its derivatives (`ORDERS`), above x and y, each of their shape; NaN beyond the
face's reach."""


@dataclass(frozen=True)
class Face:
    """A smooth height field with z(0, 0) = 0. Arguments of the methods broadcast."""

    derivatives: Derivatives
    """Gives z and its derivatives."""
    rough: bool = False
    """True if slope and curvature at one place do not describe the places around it."""
    height: Heights | None = None
    """Gives z alone, if that is much quicker."""

    def _derived(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, ...]:
        return self.derivatives(*_broadcast(x_m, y_m))

    def height_m(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return z of the face; NaN where the shape does not reach."""
        if self.height is not None:
            return self.height(*_broadcast(x_m, y_m))
        return self._derived(x_m, y_m)[0]

    def slope(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 2): dz/dx and dz/dy."""
        return np.stack(self._derived(x_m, y_m)[1:3], axis=-1)

    def bend(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): d2z/dx2, d2z/dxdy and d2z/dy2 in 1/m."""
        return np.stack(self._derived(x_m, y_m)[3:], axis=-1)

    def point(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): the face's points above plan positions."""
        x, y = _broadcast(x_m, y_m)
        return np.stack([x, y, self.height_m(x, y)], axis=-1)

    def normal(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): unit normals out of the face."""
        slope = self.slope(x_m, y_m)
        upward = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        return upward / np.linalg.norm(
            upward,
            axis=-1,
            keepdims=True,
        )

    def axis(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 3): the direction from which a damage's depth counts: the normal, or z for
        a rough face."""
        normal = self.normal(x_m, y_m)
        if self.rough:
            return np.broadcast_to([0.0, 0.0, 1.0], normal.shape).copy()
        return normal

    def curvatures(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return (..., 2): principal curvatures in 1/m, positive where the face bulges to the
        camera, larger first. From mean and Gaussian curvature of a Monge patch (do Carmo,
        Differential Geometry, section 3-3, example 5)."""
        _, fx, fy, fxx, fxy, fyy = self._derived(x_m, y_m)
        metric = 1 + fx**2 + fy**2
        bent = (1 + fx**2) * fyy - 2 * fx * fy * fxy + (1 + fy**2) * fxx
        mean = bent / (2 * metric**1.5)
        gaussian = (fxx * fyy - fxy**2) / metric**2
        spread = np.sqrt(np.maximum(mean**2 - gaussian, 0.0))
        return np.stack([spread - mean, -spread - mean], axis=-1)


def _broadcast(x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, ...]:
    return np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))


@lru_cache(maxsize=64)
def face_of(board: custom.BoardConfig) -> Face:
    """Return the face that a board's declaration describes."""
    shape = board.shape
    size_m = (board.width_mm * MM, board.height_mm * MM)
    if isinstance(shape, custom.MadeConfig):
        return _made_face(board, shape, size_m)
    if isinstance(shape, custom.RoughConfig):
        return _rough_face(shape, size_m)
    if isinstance(shape, custom.MeshConfig):
        return Face(partial(front_derivatives, shape))
    if isinstance(shape, custom.CorrugatedConfig):
        return _corrugated_face(shape)
    if isinstance(shape, custom.PanelConfig):
        return _panel_face(shape)
    if isinstance(shape, custom.CastingConfig):
        return _casting_face(shape)
    if isinstance(shape, custom.CylinderConfig | custom.SphereConfig):
        return _round_face(shape)
    if isinstance(shape, custom.PolynomialConfig):
        return _polynomial_face(shape, size_m)
    return Face(_flat)


def _flat(x: np.ndarray, _: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.zeros(x.shape) for _ in ORDERS)


def _corrugated_face(shape: custom.CorrugatedConfig) -> Face:
    """Return the face with z = depth / 2 (cos(wave s) - 1), s across the straight direction."""
    wave = 2 * np.pi / (shape.period_mm * MM)
    high_m = shape.depth_mm * MM / 2

    def corrugated(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        none = np.zeros(x.shape)
        phase = (x if shape.straight_along == "y" else y) * wave
        height = high_m * (np.cos(phase) - 1)
        slope = -high_m * wave * np.sin(phase)
        bend = -high_m * wave**2 * np.cos(phase)
        if shape.straight_along == "y":
            return height, slope, none, bend, none, none
        return height, none, slope, none, none, bend

    return Face(corrugated)


def _panel_face(shape: custom.PanelConfig) -> Face:
    """Return a face bent in both directions with a step along x (`scenes.target.custom`)."""
    bend_x = -1 / (shape.radius_x_mm * MM)
    bend_y = -1 / (shape.radius_y_mm * MM)
    high_m = shape.swage_mm * MM / 2
    y0_m = shape.swage_y_mm * MM
    width_m = shape.swage_width_mm * MM

    def panel(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        step = np.tanh((y - y0_m) / width_m)
        bowl = (bend_x * x**2 + bend_y * y**2) / 2
        return (
            bowl + high_m * (step + np.tanh(y0_m / width_m)),
            bend_x * x,
            bend_y * y + high_m / width_m * (1 - step**2),
            np.full(x.shape, bend_x),
            np.zeros(x.shape),
            bend_y - 2 * high_m / width_m**2 * step * (1 - step**2),
        )

    return Face(panel)


def _casting_face(shape: custom.CastingConfig) -> Face:
    """Return an even face with ribs and a boss (`scenes.target.custom`). Where they cross, none
    stands out above the other: z = high (1 - product of (1 - share of each))."""
    flank_m = shape.flank_mm * MM
    high_m = shape.high_mm * MM

    def casting(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        none = np.zeros(x.shape)
        left: tuple[np.ndarray, ...] = (1.0 + none, none, none, none, none, none)
        for middle_mm in (-shape.ribs_x_mm, shape.ribs_x_mm):
            share, slope, bend = _ridge(x - middle_mm * MM, shape.rib_width_mm * MM, flank_m)
            left = _product(left, (1.0 - share, -slope, none, -bend, none, none))
        share, slope, bend = _ridge(y - shape.rib_y_mm * MM, shape.rib_width_mm * MM, flank_m)
        left = _product(left, (1.0 - share, none, -slope, none, none, -bend))
        # 1 nm keeps the middle of the boss, where its slope is 0, from 0 / 0
        radius = np.sqrt(x**2 + y**2 + 1e-18)
        share, slope, bend = _ridge(radius, shape.boss_width_mm * MM, flank_m)
        across = slope / radius
        boss = (
            1.0 - share,
            -across * x,
            -across * y,
            -((bend - across) * (x / radius) ** 2 + across),
            -(bend - across) * x * y / radius**2,
            -((bend - across) * (y / radius) ** 2 + across),
        )
        left = _product(left, boss)
        return (high_m * (1.0 - left[0]), *(-high_m * derivative for derivative in left[1:]))

    top_m = float(casting(np.zeros(1), np.zeros(1))[0][0])

    def from_middle(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        height, *derivatives = casting(x, y)
        return (height - top_m, *derivatives)

    return Face(from_middle)


def _ridge(s: np.ndarray, width_m: float, flank_m: float) -> tuple[np.ndarray, ...]:
    """Return the share of its height that a ridge has at distances ``s`` from its middle, and the
    first and second derivatives."""
    rising = np.tanh((s + width_m / 2) / flank_m)
    falling = np.tanh((s - width_m / 2) / flank_m)
    share = (rising - falling) / 2
    slope = (falling**2 - rising**2) / (2 * flank_m)
    bend = (falling * (1 - falling**2) - rising * (1 - rising**2)) / flank_m**2
    return share, slope, bend


def _product(a: tuple[np.ndarray, ...], b: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the product of two functions of x and y with its derivatives, in `ORDERS`."""
    return (
        a[0] * b[0],
        a[1] * b[0] + a[0] * b[1],
        a[2] * b[0] + a[0] * b[2],
        a[3] * b[0] + 2 * a[1] * b[1] + a[0] * b[3],
        a[4] * b[0] + a[1] * b[2] + a[2] * b[1] + a[0] * b[4],
        a[5] * b[0] + 2 * a[2] * b[2] + a[0] * b[5],
    )


FORM_ORDERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Degrees in x and y of the Legendre polynomials of an error of form: lower ones move a part."""


def _made_face(
    board: custom.BoardConfig, shape: custom.MadeConfig, size_m: tuple[float, float]
) -> Face:
    """Return the drawing's face with other sizes and an error of form, both drawn by the seed."""
    sizes = {}
    for name, value in shape.shape:
        if name.endswith("_mm") and isinstance(value, float):
            spread = random_stream(shape.seed, "made", name).standard_normal()
            sizes[name] = value * (1.0 + shape.sizes_percent / 100 * spread)
    varied = shape.shape.model_copy(update=sizes)
    drawn = face_of(board.model_copy(update={"shape": varied}))
    numbers = random_stream(shape.seed, "made", "form").standard_normal(len(FORM_ORDERS))
    terms = np.zeros((4, 4))
    for (order_x, order_y), number in zip(FORM_ORDERS, numbers, strict=True):
        in_x = _legendre(order_x, size_m[0])
        in_y = _legendre(order_y, size_m[1])
        amplitude_m = shape.form_mm * MM * number / math.sqrt(len(FORM_ORDERS))
        terms[: order_x + 1, : order_y + 1] += amplitude_m * np.outer(in_x, in_y)
    terms[0, 0] = 0.0
    form = _polynomial(terms)

    def made(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        pairs = zip(drawn.derivatives(x, y), form.derivatives(x, y), strict=True)
        return tuple(of_drawn + of_form for of_drawn, of_form in pairs)

    return Face(made)


def _legendre(order: int, side_m: float) -> np.ndarray:
    """Return the coefficients (order + 1,) of a Legendre polynomial over a side, of mean square
    1."""
    coefficients = legendre.leg2poly([0.0] * order + [1.0])
    powers = np.arange(order + 1)
    return np.asarray(coefficients * math.sqrt(2 * order + 1) / (side_m / 2) ** powers)


def _round_face(shape: custom.CylinderConfig | custom.SphereConfig) -> Face:
    """Return the face with z = +-(sqrt(R^2 - x^2 - y^2) - R), of a cylinder without the direction
    along which it is straight."""
    straight = shape.straight_along if isinstance(shape, custom.CylinderConfig) else ""
    radius_m = shape.radius_mm * MM
    sign = 1.0 if shape.bulge == "towards" else -1.0
    bent_x = float(straight != "x")
    bent_y = float(straight != "y")

    def round_(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        square = radius_m**2 - bent_x * np.square(x) - bent_y * np.square(y)
        root = np.sqrt(np.where(square > 0, square, np.nan))
        return (
            sign * (root - radius_m),
            -sign * (bent_x * x / root),
            -sign * (bent_y * y / root),
            -sign * (bent_x * (1 / root + x**2 / root**3)),
            -sign * (bent_x * bent_y * x * y / root**3),
            -sign * (bent_y * (1 / root + y**2 / root**3)),
        )

    return Face(round_)


def _polynomial_face(
    shape: custom.PolynomialConfig,
    size_m: tuple[float, float],
) -> Face:
    """Return the face whose height is the sum of the declared terms."""
    half_x = size_m[0] / 2
    half_y = size_m[1] / 2
    highest_x = max(term.power_x for term in shape.terms)
    highest_y = max(term.power_y for term in shape.terms)
    coefficients = np.zeros((highest_x + 1, highest_y + 1))
    for term in shape.terms:
        scale = MM / half_x**term.power_x / half_y**term.power_y
        coefficients[term.power_x, term.power_y] += term.coefficient_mm * scale
    return _polynomial(coefficients)


def _polynomial(coefficients: np.ndarray) -> Face:
    """Return the face whose height is a polynomial: coefficients (a, b) of x^a y^b, metres."""
    if not coefficients.any():
        return Face(_flat)
    derived = []
    for order_x, order_y in ORDERS:
        in_x = polynomial.polyder(coefficients, order_x, axis=0)
        derived.append(polynomial.polyder(in_x, order_y, axis=1))

    def sum_of_terms(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(np.asarray(polynomial.polyval2d(x, y, terms)) for terms in derived)

    return Face(sum_of_terms)


# beyond the board; knots of the spline to the shortest wavelength
ROUGH_MARGIN_M = 0.02
ROUGH_STEPS = 4


def _rough_face(shape: custom.RoughConfig, size_m: tuple[float, float]) -> Face:
    """Return a bicubic spline through heights drawn from the declared spectrum on a grid."""
    from scipy.interpolate import RectBivariateSpline

    step_m = shape.inner_mm * MM / ROUGH_STEPS
    middles = [math.ceil((side / 2 + ROUGH_MARGIN_M) / step_m) for side in size_m]
    counts = [2 * middle + 1 for middle in middles]
    waves = [2 * np.pi * np.fft.fftfreq(count, step_m) for count in counts]
    k = np.hypot(*np.meshgrid(*waves, indexing="ij"))
    outer = 2 * np.pi / (shape.outer_mm * MM)
    inner = 2 * np.pi / (shape.inner_mm * MM)
    spectrum = (k**2 + outer**2) ** (-(1 + shape.hurst) / 2)
    amplitude = np.where((k > 0) & (k <= inner), spectrum, 0.0)
    noise = random_stream(shape.seed, "rough face").standard_normal(counts)
    heights = np.fft.ifft2(np.fft.fft2(noise) * amplitude).real
    heights *= shape.deviation_mm * MM / heights.std()
    heights -= heights[middles[0], middles[1]]
    knots = [step_m * (np.arange(count) - count // 2) for count in counts]
    spline = RectBivariateSpline(knots[0], knots[1], heights)

    def rough(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        return tuple(
            spline.ev(
                x,
                y,
                dx=dx,
                dy=dy,
            )
            for dx, dy in ORDERS
        )

    return Face(
        rough,
        rough=True,
        height=spline.ev,
    )


def outline_board_m(board: custom.BoardConfig) -> np.ndarray:
    """Return (n, 3): the rim of the undamaged face, counter-clockwise seen from the camera, board
    frame; of a part from a mesh the convex hull of its plan, in the plane of its foremost point.
    """
    if isinstance(board.shape, custom.MeshConfig):
        plan = part_of(board.shape)[0][:, :2]
        rim = plan[ConvexHull(plan).vertices]
        return np.column_stack([rim, np.zeros(len(rim))])
    half_x = board.width_mm * MM / 2
    half_y = board.height_mm * MM / 2
    side = np.linspace(-1, 1, OUTLINE_STEPS, endpoint=False)
    end = np.ones(OUTLINE_STEPS)
    x = np.concatenate([side, end, -side, -end])
    y = np.concatenate([-end, side, end, -side])
    return face_of(board).point(half_x * x, half_y * y)


@lru_cache(maxsize=100)
def face_grid_m(
    board: custom.BoardConfig,
    depth_m: float = 0.0,
    steps: int = 32,
) -> np.ndarray:
    """Return (n, n, 3): the face, rim included, moved along its normals by ``depth_m`` into the
    board; board frame."""
    face = face_of(board)
    shares = np.linspace(-0.5, 0.5, steps + 1)
    x, y = np.meshgrid(shares * board.width_mm * MM, shares * board.height_mm * MM)
    points = face.point(x, y)
    if depth_m:
        points = points - depth_m * face.normal(x, y)
    if isinstance(board.shape, custom.MeshConfig):  # where its front is not, its bounds count
        bounds = np.dstack([x, y, np.full(x.shape, -depth_m)])
        points = np.where(np.isnan(points[..., 2:]), bounds, points)
    return points


def backing_corners_board_m(
    config: custom.TargetConfig,
    backing: custom.BackingConfig,
) -> np.ndarray:
    """Return the backing's corners in the board's frame; it faces the board."""
    deepest_m = -float(face_grid_m(config.board, config.board.thickness_mm * MM)[..., 2].min())
    z_m = deepest_m + backing.distance_mm * MM
    size_m = np.array(backing.size_mm or (config.board.width_mm, config.board.height_mm)) * MM
    if backing.size_mm is None:
        size_m = size_m * (config.pose.distance_m + z_m) / config.pose.distance_m
    return np.column_stack([_UNIT_CORNERS * size_m, np.full(4, -z_m)])


def planes_of(config: custom.TargetConfig) -> Iterator[tuple[str, np.ndarray, float, custom.Rgb]]:
    """Yield backing, floor and back wall, as declared: name, corners (4, 3) in the camera's frame,
    albedo at 850 nm and rgb. The floor reaches to the back wall, which stands on it or, without a
    floor, is centred on the axis."""
    backing = config.backing
    room = config.room
    if backing is not None:
        on_board = backing_corners_board_m(config, backing)
        corners = transform_points(config.pose.T_camera_board, on_board)
        yield "backing", corners, backing.albedo_850, backing.rgb
    if room is None:
        return
    floor_m = room.floor_below_lens_m
    wall_m = room.back_wall_distance_m
    across_m = room.width_m * _UNIT_CORNERS[:, 0]
    up = _UNIT_CORNERS[:, 1] + 0.5
    if floor_m is not None:
        z_m = (wall_m or OPEN_FLOOR_M) * up
        corners = np.column_stack([across_m, np.full(4, floor_m), z_m])
        yield "floor", corners, room.floor_albedo_850, room.floor_rgb
    if wall_m is not None:
        foot_m = room.height_m / 2 if floor_m is None else floor_m
        y_m = foot_m - room.height_m * up
        corners = np.column_stack([across_m, y_m, np.full(4, wall_m)])
        yield "back_wall", corners, room.back_wall_albedo_850, room.back_wall_rgb


@dataclass(frozen=True)
class Damage:
    """A hole, a dent or another damage: its true place and size."""

    id: int
    """Its number in the declaration."""
    kind: str
    """Its kind: "through", "blind", "dent" or a kind of `scenes.target.flaws`."""
    diameter_m: float
    """Diameter of the drill, of a dent's rim on this face (by equal area), or of other kinds the
    size in plan that ``size_of`` names."""
    depth_m: float
    """Depth along the axis; for corrosion the mean, for ``raised`` damage its height, for
    through-damage the board's thickness."""
    volume_m3: float
    """Volume of holes and dents: exact on a flat face, to second order in diameter over radius of
    curvature on a curved one; of other kinds as `scenes.target.flaws` meshes them, of a pressed
    sheet on its front."""
    centre_board_m: np.ndarray
    """(3,): centre on the undamaged face."""
    axis_board: np.ndarray
    """(3,): the face's unit normal there, out of the board."""
    centre_camera_m: np.ndarray
    """(3,): the same centre in the camera's frame."""
    axis_camera: np.ndarray
    """(3,): the same axis in the camera's frame."""
    size_of: str = "diameter"
    """The size in plan that a limit states."""
    raised: bool = False
    """True if it stands out of the face."""
    outline_board_m: np.ndarray | None = None
    """(n, 2): outline in plan of kinds with an outline of their own."""
    line_board_m: np.ndarray | None = None
    """(k, 2): centre line in plan of kinds that have a length."""
    length_m: float = float("nan")
    """Length of kinds with an outline of their own."""
    width_m: float = float("nan")
    """Their width."""
    angle_rad: float = 0.0
    """Angle of the length from board +x."""

    @property
    def reach_m(self) -> float:
        """Radius in plan of a circle about the centre that holds the outline."""
        if self.outline_board_m is None:
            return self.diameter_m / 2
        return float(np.linalg.norm(self.outline_board_m - self.centre_board_m[:2], axis=1).max())

    def within(
        self,
        x_m: np.ndarray,
        y_m: np.ndarray,
        margin_m: float = 0.0,
    ) -> np.ndarray:
        """Return which places in plan lie inside the outline, or within ``margin_m`` of it; shaped
        like ``x_m``."""
        centre_x, centre_y, _ = self.centre_board_m
        apart_m = np.sqrt((x_m - centre_x) ** 2 + (y_m - centre_y) ** 2)
        with np.errstate(invalid="ignore"):
            inside = np.asarray(apart_m < self.reach_m + margin_m)
        if self.outline_board_m is not None:
            places_m = np.column_stack([x_m[inside], y_m[inside]])
            inside[inside] = outside_m(self.outline_board_m, places_m) <= margin_m
        return inside

    @property
    def line_m(self) -> np.ndarray:
        """Centre line (k, 2) in plan; of round damage the centre (1, 2)."""
        return self.centre_board_m[None, :2] if self.line_board_m is None else self.line_board_m

    def to_row(self) -> dict[str, Any]:
        """Return plain data in millimetres, one flat row for JSON or a table."""
        row: dict[str, Any] = {
            "id": self.id,
            "kind": self.kind,
            "diameter_mm": self.diameter_m / MM,
            "depth_mm": self.depth_m / MM,
            "volume_mm3": self.volume_m3 / MM**3,
        }
        if self.outline_board_m is not None:
            row["length_mm"] = self.length_m / MM
            row["width_mm"] = self.width_m / MM
            row["raised"] = self.raised
            row["angle_deg"] = math.degrees(self.angle_rad)
            row["size_of"] = self.size_of
        poses = {
            "board": (self.centre_board_m, self.axis_board),
            "camera": (self.centre_camera_m, self.axis_camera),
        }
        for frame, (centre_m, axis) in poses.items():
            for name, value_m in zip("xyz", centre_m.tolist(), strict=True):
                row[f"{name}_{frame}_mm"] = value_m / MM
            for name, value in zip("xyz", axis.tolist(), strict=True):
                row[f"axis_{name}_{frame}"] = value
        return row


def truth_of(
    config: custom.TargetConfig,
    T_camera_board: np.ndarray,
) -> tuple[Damage, ...]:
    """Return the truth of a declaration: holes, dents, then other kinds, in the order of their
    declaration."""
    face = face_of(config.board)
    thickness_m = config.board.thickness_mm * MM
    truth = []
    for item in config.damages:
        centre = face.point(*item.centre_m)
        axis = face.axis(*item.centre_m)
        if isinstance(item, FlawConfig):
            measures = _flaw_measures(item, face, thickness_m)
        elif isinstance(item, custom.DentConfig):
            measures = _dent_measures(item, face)
        else:
            measures = _hole_measures(item, face, thickness_m)
        truth.append(
            Damage(
                id=item.id,
                kind=item.kind,
                centre_board_m=centre,
                axis_board=axis,
                centre_camera_m=transform_points(T_camera_board, centre),
                axis_camera=rotate_vectors(T_camera_board, axis),
                **measures,
            )
        )
    return tuple(truth)


def _dent_measures(item: custom.DentConfig, face: Face) -> dict[str, Any]:
    """Return the size, depth and volume of a dent, by field of `Damage`.

    The sphere's curvature gives paraboloids of the two principal curvatures the same volume as the
    face; exact on flat and spherical faces."""
    bends = face.curvatures(*item.centre_m)
    sphere_bend = (math.sqrt(float(np.prod(1 + item.ball_m * bends))) - 1) / item.ball_m
    rim_m, volume_m3 = _lens(item, sphere_bend)
    return {"diameter_m": 2 * rim_m, "depth_m": item.depth_mm * MM, "volume_m3": volume_m3}


def _hole_measures(
    item: custom.HoleConfig,
    face: Face,
    thickness_m: float,
) -> dict[str, Any]:
    """Return the size, depth and volume of a drilled hole, by field of `Damage`.

    Over a disc of radius a about the normal a face with principal curvatures k lies a^2 (k1 + k2)
    / 8 lower on average than at the centre. The back of a through-hole is a parallel surface,
    curvatures k / (1 - t k)."""
    bends = face.curvatures(*item.centre_m)
    radius_m = item.radius_m
    depth_m = thickness_m if item.depth_mm is None else item.depth_mm * MM
    front = float(bends.sum())
    back = 0.0
    if item.kind == "through":
        back = float((bends / (1 - depth_m * bends)).sum())
    mean_depth_m = depth_m + radius_m**2 / 8 * (back - front)
    chamfer_m = item.mouth_m - radius_m
    volume_m3 = math.pi * radius_m**2 * mean_depth_m
    volume_m3 += math.pi * chamfer_m**2 * (radius_m + chamfer_m / 3)
    return {"diameter_m": 2 * radius_m, "depth_m": depth_m, "volume_m3": volume_m3}


def relief_points(
    item: FlawConfig,
    face: Face,
    thickness_m: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a flaw's grid on the face: points (rows, columns, 3) on it, depths (rows, columns)
    along the axis, that axis (3,) out of the board, and the direction (3,) of t; board frame,
    metres."""
    relief = item.relief()
    axis = face.axis(*item.centre_m)
    along = np.array([math.cos(item.turn_rad), math.sin(item.turn_rad), 0.0])
    along[2] = -(axis[:2] @ along[:2]) / axis[2]
    along /= np.linalg.norm(along)
    across = np.cross(axis, along)
    from_centre = relief.s_m[..., None] * along[:2] + relief.t_m[..., None] * across[:2]
    plan = from_centre + item.centre_m
    depth_m = np.where(np.isnan(relief.depth_m), thickness_m, relief.depth_m)
    return face.point(plan[..., 0], plan[..., 1]), depth_m, axis, across


def _flaw_measures(
    item: FlawConfig,
    face: Face,
    thickness_m: float,
) -> dict[str, Any]:
    """Return what describes a damage with an outline of its own, by field of `Damage`."""
    points, depth_m, axis, _ = relief_points(item, face, thickness_m)
    plan = points[..., :2]
    moved = points - depth_m[..., None] * axis
    raised = bool(depth_m.min() < 0)
    solid = closed_grid(moved, points) if raised else closed_grid(points, moved)
    length_mm, width_mm = item.sides_mm
    line_board_m = None
    if item.size_of != "diameter":
        line_board_m = plan[len(plan) // 2, ::LINE_STEP]
    return {
        "diameter_m": item.size_mm * MM,
        "depth_m": thickness_m if item.depth_mm is None else item.depth_mm * MM,
        "volume_m3": volume_m3(*solid),
        "size_of": item.size_of,
        "raised": raised,
        "outline_board_m": border(plan),
        "line_board_m": line_board_m,
        "length_m": length_mm * MM,
        "width_m": width_mm * MM,
        "angle_rad": item.turn_rad,
    }


def _lens(dent: custom.DentConfig, bend: float) -> tuple[float, float]:
    """Return rim radius and volume that a dent's ball shares with a sphere of a curvature."""
    depth_m = dent.depth_mm * MM
    half_square = dent.radius_m**2 / (2 * (1 + bend * (dent.ball_m - depth_m)))
    sphere_cap_m = bend * half_square
    ball_cap_m = depth_m - sphere_cap_m
    rim_square = 2 * half_square - sphere_cap_m**2
    volume_m3 = _cap_m3(ball_cap_m, rim_square) + _cap_m3(sphere_cap_m, rim_square)
    return math.sqrt(rim_square), volume_m3


def _cap_m3(height_m: float, rim_square: float) -> float:
    """Return the volume of a spherical cap with the square of its rim's radius."""
    return math.pi * height_m * (3 * rim_square + height_m**2) / 6


def widest_rim_m(item: custom.AnyDamage, face: Face) -> float:
    """Return the largest radius of a rim: a chamfer counts, and the direction in which a face
    bends to a dent most."""
    if not isinstance(item, custom.DentConfig):
        return item.reach_mm * MM
    return _lens(item, float(face.curvatures(*item.centre_m).min()))[0]
