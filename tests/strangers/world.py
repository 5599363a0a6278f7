"""Surfaces, damage and a pinhole camera: noise-free depth images with known truth, by analytic ray
casting.

A surface is z = g(x, y) in a frame of its own (metres; z away from the camera at the origin) with
an outline in x, y. Damage moves the surface along its normal inside a disc or a slot. Not
modelled: interreflection, the light's falloff, and the walls of slots; a round hole's wall ends
the rays that meet it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

STEPS = 12
"""Fixed-point steps to where a ray meets a height field; slopes below 0.5 leave less than 0.1 mm.
"""


MARCH = 48
"""Steps by which rays are followed through the layer of a steep shape."""


@dataclass(frozen=True)
class Camera:
    """Pinhole with OpenCV's distortion (k1 k2 p1 p2 k3); focal length and centre in pixels."""

    width: int
    height: int
    f_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = (0.0,) * 5

    def slopes(self, finer: int = 1) -> np.ndarray:
        """(finer h, finer w, 2) x/z and y/z of the rays; ``finer`` rays a pixel across and down."""
        index = [(np.arange(finer * n) + 0.5) / finer - 0.5 for n in (self.width, self.height)]
        u, v = np.meshgrid(*index)
        if not any(self.distortion):
            return np.dstack([(u - self.cx_px) / self.f_px, (v - self.cy_px) / self.f_px])
        observed = np.dstack([(u - self.cx_px) / self.f_px, (v - self.cy_px) / self.f_px])
        k1, k2, p1, p2, k3 = self.distortion
        rays = observed
        for _ in range(
            50
        ):  # OpenCV's own way: divide what is seen by the distortion of the last guess
            x = rays[..., 0]
            y = rays[..., 1]
            r2 = x * x + y * y
            aside = np.dstack(
                [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
            )
            rays = (observed - aside) / (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))[..., None]
        return rays


@dataclass(frozen=True)
class Damage:
    """Displacement of a surface around (x_m, y_m) of its own frame; positive depth is away from
    the camera.

    ``profile``: flat (a blind hole), bowl, cosine, cone, slot (``length_m`` along ``angle_rad``),
    through (what is behind shows), absent (nothing returns).
    """

    x_m: float
    y_m: float
    radius_m: float
    depth_m: float
    profile: str = "flat"
    length_m: float = 0.0
    angle_rad: float = 0.0


@dataclass(frozen=True)
class Surface:
    """z = g(x, y) by ``shape``: plane, cylinder, sphere (``bend_m`` = radius; negative: seen from
    inside), saddle, bent, waves (``bend_m`` = amplitude or rise, ``pitch_m`` = period), trapezoids
    (``bend_m`` = height of the flats, two fifths of the period each), ribs (``bend_m`` high, a
    fifth of the period), boards (grooves along y, ``bend_m`` deep), bricks (joints ``bend_m`` deep;
    ``pitch_m`` = length of a brick), door (a curved sheet with a crease along x of ``bend_m`` slope,
    and with a bowl and a handle across if ``pitch_m`` > 0). ``R`` has the surface's axes as columns
    in the camera frame; ``outline``: box or disc, of the half extents."""

    origin_m: np.ndarray
    R: np.ndarray
    half_x_m: float
    half_y_m: float
    shape: str = "plane"
    bend_m: float = 0.0
    pitch_m: float = 0.2
    outline: str = "box"
    damages: tuple[Damage, ...] = ()
    is_target: bool = False
    is_object: bool = False

    def height_m(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """g at (x, y)."""
        r = self.bend_m
        with np.errstate(invalid="ignore"):
            if self.shape == "cylinder":
                return r - np.sign(r) * np.sqrt(r * r - x * x)
            if self.shape == "sphere":
                return r - np.sign(r) * np.sqrt(r * r - x * x - y * y)
        if self.shape == "saddle":
            return r * ((x / self.half_x_m) ** 2 - (y / self.half_y_m) ** 2)
        if self.shape == "bent":
            s = x / self.half_x_m
            return r * (s * s + 0.4 * s**3 + 0.3 * s * (y / self.half_y_m))
        if self.shape == "waves":
            return r * np.sin(2 * np.pi * x / self.pitch_m)
        if self.shape in PROFILES:
            return PROFILES[self.shape](self, x, y)
        return np.zeros_like(x)

    def normal(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit normal (away from the camera) at (x, y), by central differences of 20 um."""
        e = 2e-5
        gx = (self.height_m(x + e, y) - self.height_m(x - e, y)) / (2 * e)
        gy = (self.height_m(x, y + e) - self.height_m(x, y - e)) / (2 * e)
        size = np.sqrt(1 + gx * gx + gy * gy)
        return -gx / size, -gy / size, 1 / size

    def point_m(self, x: float, y: float) -> np.ndarray:
        """The point (3,) above (x, y), camera frame."""
        z = float(self.height_m(np.array(x), np.array(y)))
        return self.origin_m + self.R @ np.array([x, y, z])


def _phase(x: np.ndarray, pitch_m: float) -> np.ndarray:
    """Distance (m) from the middle of the nearest period."""
    return np.abs(x - pitch_m * np.round(x / pitch_m))


def _trapezoids(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Flats in front where x is a multiple of the period, webs of a tenth of it."""
    pitch_m = surface.pitch_m
    return surface.bend_m * np.clip((_phase(x, pitch_m) / pitch_m - 0.2) / 0.1, 0.0, 1.0)


def _ribs(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Ribs in front of a wall, midway between multiples of the period; their sides are 1 mm wide."""
    inner = _phase(x, surface.pitch_m) - 0.4 * surface.pitch_m
    return -surface.bend_m * np.clip(inner / 1e-3, 0.0, 1.0)


def _groove(off_m: np.ndarray, depth_m: float, width_m: float) -> np.ndarray:
    """A groove about ``off_m`` = 0 with sides that take a fifth of its width each."""
    return depth_m * np.clip((0.5 * width_m - off_m) / (0.2 * width_m), 0.0, 1.0)


def _boards(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return _groove(_phase(x - 0.5 * surface.pitch_m, surface.pitch_m), surface.bend_m, 4e-3)


def _bricks(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Courses along x, a third of a brick's length high, each shifted by half a brick."""
    length_m = surface.pitch_m
    course = np.round(3.0 * y / length_m)
    bed = _phase(y - length_m / 6.0, length_m / 3.0)
    head = _phase(x - 0.5 * length_m * (course % 2), length_m)
    return _groove(np.minimum(bed, head), surface.bend_m, 10e-3)


def _door(surface: Surface, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Curved more towards its top; the slope changes at the crease, which is 12 mm wide."""
    down = y / surface.half_y_m
    along = x / surface.half_x_m
    sheet = 0.05 * surface.half_y_m * down**2 * (1.6 - 0.8 * down)
    sheet = sheet + 0.02 * surface.half_x_m * along**2
    above = y + 0.3 * surface.half_y_m - 0.05 * x
    sheet = sheet + 0.5 * surface.bend_m * np.hypot(above, 6e-3)
    if surface.pitch_m <= 0:
        return sheet
    u = (x - 0.5 * surface.half_x_m) / 0.10
    v = y / 0.03
    bowl = 0.02 * np.exp(-((u**2 + v**2) ** 2))
    bar = 0.035 * (np.abs(u) < 0.9) * np.clip((0.010 - np.abs(y)) / 3e-3, 0.0, 1.0)
    return sheet + bowl - bar


PROFILES = {
    "trapezoids": _trapezoids,
    "ribs": _ribs,
    "boards": _boards,
    "bricks": _bricks,
    "door": _door,
}
"""Steep shapes by name; rays are followed to them step by step."""


@dataclass(frozen=True)
class Hit:
    """Where the rays meet a surface: camera z (inf: nowhere), its own coordinates, and the rays in
    its frame."""

    z_m: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray
    rays: np.ndarray
    start_m: np.ndarray


def meet(surface: Surface, slopes: np.ndarray) -> Hit:
    """Cast all rays of ``slopes`` (h, w, 2) onto a surface."""
    rays = np.dstack([slopes, np.ones(slopes.shape[:2])]) @ surface.R
    start = -surface.R.T @ surface.origin_m
    dx, dy, dz = np.moveaxis(rays, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        if surface.shape in ("cylinder", "sphere"):
            z = _round(surface, start, (dx, dy, dz))
        elif surface.shape in (*PROFILES, "waves"):
            z = _marched(surface, start, (dx, dy, dz))
        else:
            z = -start[2] / dz
            for _ in range(STEPS if surface.shape != "plane" else 0):
                x = np.clip(start[0] + z * dx, -2 * surface.half_x_m, 2 * surface.half_x_m)
                y = np.clip(start[1] + z * dy, -2 * surface.half_y_m, 2 * surface.half_y_m)
                z = (surface.height_m(x, y) - start[2]) / dz
        x = start[0] + z * dx
        y = start[1] + z * dy
        a = np.abs(x) / surface.half_x_m
        b = np.abs(y) / surface.half_y_m
        inside = (np.hypot(a, b) < 1) if surface.outline == "disc" else (a < 1) & (b < 1)
        met = inside & (z > 0) & np.isfinite(z)
        z = np.where(met, z, np.inf)
        x = np.where(met, x, np.nan)
        y = np.where(met, y, np.nan)
    return Hit(z, x, y, rays, start)


def _marched(surface: Surface, start: np.ndarray, ray: tuple[np.ndarray, ...]) -> np.ndarray:
    """Camera z where rays first meet a steep height field: `MARCH` even steps through the layer
    that holds it, then halvings."""
    dx, dy, dz = ray
    x_m, y_m = np.meshgrid(
        np.linspace(-surface.half_x_m, surface.half_x_m, 2001),
        np.linspace(-surface.half_y_m, surface.half_y_m, 301),
    )
    heights_m = surface.height_m(x_m, y_m)
    low = (heights_m.min() - 1e-4 - start[2]) / dz
    step = (heights_m.max() + 2e-4 - heights_m.min()) / dz / MARCH

    def above(z: np.ndarray) -> np.ndarray:
        x = np.clip(start[0] + z * dx, -surface.half_x_m, surface.half_x_m)
        y = np.clip(start[1] + z * dy, -surface.half_y_m, surface.half_y_m)
        return start[2] + z * dz < surface.height_m(x, y)

    free = np.ones(dz.shape, bool)
    z = low
    for _ in range(MARCH):
        free &= above(z + step)
        z = np.where(free, z + step, z)
    for _ in range(12):
        step = step / 2
        z = np.where(above(z + step), z + step, z)
    return z


def _round(surface: Surface, start: np.ndarray, ray: tuple[np.ndarray, ...]) -> np.ndarray:
    """Camera z where rays meet a cylinder along y or a sphere: the near side, or the far one seen
    from inside."""
    r = surface.bend_m
    s = start - np.array([0.0, 0.0, r])
    axes = (0, 2) if surface.shape == "cylinder" else (0, 1, 2)
    a = sum(ray[i] ** 2 for i in axes)
    b = sum(2 * s[i] * ray[i] for i in axes)
    c = sum(s[i] ** 2 for i in axes) - r * r
    root = np.sqrt(b * b - 4 * a * c)
    return (-b - np.sign(r) * root) / (2 * a)


@dataclass(frozen=True)
class CastView:
    """One noise-free view. ``depth_m`` (h, w), NaN where nothing returns; ``on_target`` where the
    target is seen; ``footprints``: of each damage its pixels (flat indices) and its signal there
    (metres along z; NaN: no return)."""

    depth_m: np.ndarray
    on_target: np.ndarray
    on_object: np.ndarray
    footprints: tuple[tuple[np.ndarray, np.ndarray], ...]
    hidden: tuple[float, ...]


def cast(surfaces: list[Surface], camera: Camera, finer: int = 1) -> CastView:
    """Cast ``finer`` x ``finer`` rays a pixel; the nearest surface wins, and its damage is cut
    where it is seen."""
    slopes = camera.slopes(finer)
    hits = [meet(surface, slopes) for surface in surfaces]
    z = np.stack([hit.z_m for hit in hits])
    nearest = z.argmin(axis=0)
    depth = z.min(axis=0)
    feet = []
    hidden = []
    observed = np.isfinite(depth)
    for i, surface in enumerate(surfaces):
        behind = (
            np.delete(z, i, axis=0).min(axis=0)
            if len(surfaces) > 1
            else np.full(depth.shape, np.inf)
        )
        for damage in surface.damages:
            own_rows, signal = _signal(surface, hits[i], damage, behind)
            visible = own_rows & (nearest == i)
            feet.append((np.flatnonzero(visible), signal[visible]))
            hidden.append(1 - visible.sum() / max(own_rows.sum(), 1))
            depth = np.where(visible, depth + np.where(np.isfinite(signal), signal, np.inf), depth)
    target = observed & np.array([s.is_target for s in surfaces])[nearest]
    objects = observed & np.array([s.is_object for s in surfaces])[nearest]
    depth = np.where(np.isfinite(depth), depth, np.nan)
    return CastView(depth, target, objects, tuple(feet), tuple(hidden))


def _signal(
    surface: Surface, hit: Hit, damage: Damage, behind: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(pixels whose ray enters the damage, the change of camera z there; inf: no return)."""
    with np.errstate(invalid="ignore"):
        qx = hit.x_m - damage.x_m
        qy = hit.y_m - damage.y_m
        normal = surface.normal(hit.x_m, hit.y_m)
        rim = float(surface.height_m(np.array(damage.x_m), np.array(damage.y_m)))
        qz = surface.height_m(hit.x_m, hit.y_m) - rim
        if damage.profile == "slot":
            c = np.cos(damage.angle_rad)
            s = np.sin(damage.angle_rad)
            along = np.clip(qx * c + qy * s, -damage.length_m / 2, damage.length_m / 2)
            rho = np.sqrt((qx - along * c) ** 2 + (qy - along * s) ** 2 + qz * qz)
        else:
            rho = np.sqrt(qx * qx + qy * qy + qz * qz)
        inside = np.isfinite(hit.z_m) & (rho < damage.radius_m)
        into = sum(n * hit.rays[..., i] for i, n in enumerate(normal))
    s = np.where(inside, rho / damage.radius_m, 0.0)
    height = {"bowl": 1 - s * s, "cosine": 0.5 + 0.5 * np.cos(np.pi * s), "cone": 1 - s}.get(
        damage.profile
    )
    if height is not None:
        return inside, damage.depth_m * height / into
    if damage.profile == "absent":
        return inside, np.full(s.shape, np.inf)
    deep = damage.depth_m / into
    if damage.profile == "slot" or damage.depth_m < 0:
        return inside, deep
    wall = _to_the_wall(qx, qy, hit.rays, damage.radius_m)
    if damage.profile == "through":
        return inside, np.where(wall < deep, wall, behind - hit.z_m)
    return inside, np.minimum(deep, wall)


def _to_the_wall(qx: np.ndarray, qy: np.ndarray, rays: np.ndarray, radius_m: float) -> np.ndarray:
    """How far along z a ray that enters a round hole runs until it meets the wall (surface taken
    as flat there)."""
    vx = rays[..., 0]
    vy = rays[..., 1]
    a = vx * vx + vy * vy
    b = qx * vx + qy * vy
    c = qx * qx + qy * qy - radius_m**2
    with np.errstate(all="ignore"):
        t = (-b + np.sqrt(b * b - a * c)) / a
    return np.where(a > 1e-12, t, np.inf)


def with_damage(surface: Surface, damages: list[Damage]) -> Surface:
    """The same surface, damaged."""
    return replace(surface, damages=(*surface.damages, *damages))
