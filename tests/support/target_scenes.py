"""Random scenes with a known target, cast ray by ray: what a stranger may put before a depth
camera."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from harness.vocabulary.geometry import Cloud, Lens, Region, rays_of

CAMERAS = {
    "azure nfov": (640, 576, 504.6),
    "azure wfov binned": (512, 512, 252.0),
    "l515": (640, 480, 460.0),
    "phone": (256, 192, 212.0),
    "pico": (160, 120, 140.0),
}


@dataclass
class Scene:
    """Surfaces seen by a camera: ``z`` (h, w) the nearest depth in metres, inf where nothing is;
    ``name`` (h, w) index of the surface. `add` puts a surface before what is there."""

    camera: str = "azure nfov"
    z: np.ndarray = field(init=False)
    name: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        w, h, f = CAMERAS[self.camera]
        self.lens = Lens(w, h, f, f, (w - 1) / 2 + 1.3, (h - 1) / 2 - 2.1)
        self.slopes = self.lens.region_slopes(self.lens.whole)
        self.z = np.full((h, w), np.inf)
        self.name = np.full((h, w), -1)

    def add(self, number: int, z: np.ndarray) -> None:
        """Depths (h, w), NaN or inf where the surface is not."""
        nearer = np.nan_to_num(z, nan=np.inf) < self.z
        self.z[nearer] = z[nearer]
        self.name[nearer] = number

    def plane(
        self, centre: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth of the plane, and the places (h, w) along its own axes (a level one first) about
        the centre."""
        normal = np.asarray(normal, float) / np.linalg.norm(normal)
        rays = rays_of(self.slopes)
        with np.errstate(divide="ignore"):
            z = (np.asarray(centre) @ normal) / (rays @ normal)
        z[z <= 0] = np.inf
        across = np.cross([0.0, 1.0, 0.0], normal)
        across = (
            across / np.linalg.norm(across)
            if np.linalg.norm(across) > 1e-3
            else np.array([1.0, 0.0, 0.0])
        )
        down = np.cross(normal, across)
        with np.errstate(invalid="ignore"):
            separation = rays * np.where(np.isfinite(z), z, 1e9)[..., None] - centre
        return z, separation @ across, separation @ down

    def board(
        self,
        number: int,
        centre,
        normal,
        size_m,
        roll_deg: float = 0.0,
        holes: tuple = (),
        thick_m: float = 0.0,
    ) -> None:
        """A rectangle; ``holes``: (a, b, radius) on it, through which one sees what is behind.
        With a thickness, faces of the same number behind its edges close a box."""
        z, a, b = self.plane(np.asarray(centre, float), normal)
        turn = np.deg2rad(roll_deg)
        turned_a = a * np.cos(turn) - b * np.sin(turn)
        b = a * np.sin(turn) + b * np.cos(turn)
        a = turned_a
        inside = (np.abs(a) < size_m[0] / 2) & (np.abs(b) < size_m[1] / 2)
        for hole_a, hole_b, radius in holes:
            inside &= np.hypot(a - hole_a, b - hole_b) > radius
        self.add(number, np.where(inside, z, np.inf))

    def wall(self, number: int, distance_m: float, normal=(0.0, 0.0, -1.0)) -> None:
        self.add(number, self.plane(np.array([0.0, 0.0, distance_m]), normal)[0])

    def floor(self, number: int, below_m: float, pitch_deg: float) -> None:
        """A floor so far below a camera that looks down by so much."""
        pitch = np.deg2rad(pitch_deg)
        up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
        self.add(number, self.plane(-below_m * up, up)[0])

    def cylinder(
        self,
        number: int,
        centre,
        axis,
        radius: float,
        half_length: float = 1e3,
        inner: bool = False,
    ) -> None:
        """The outside of a pipe (``inner``: the far half, a bent sheet seen from its hollow side)."""
        centre = np.asarray(centre, float)
        axis = np.asarray(axis, float) / np.linalg.norm(axis)
        rays = rays_of(self.slopes)
        flat = rays - (rays @ axis)[..., None] * axis
        away = centre - (centre @ axis) * axis
        qa = (flat**2).sum(-1)
        qb = -2 * flat @ away
        qc = away @ away - radius**2
        under = qb**2 - 4 * qa * qc
        root = np.sqrt(np.maximum(under, 0))
        z = np.where(under > 0, (-qb + (root if inner else -root)) / (2 * qa), np.inf)
        z[z <= 0] = np.inf
        with np.errstate(invalid="ignore"):
            along = np.abs((rays * np.where(np.isfinite(z), z, 1e9)[..., None] - centre) @ axis)
        self.add(number, np.where(along < half_length, z, np.inf))

    def sphere(self, number: int, centre, radius: float) -> None:
        centre = np.asarray(centre, float)
        rays = rays_of(self.slopes)
        qa = (rays**2).sum(-1)
        qb = -2 * rays @ centre
        qc = centre @ centre - radius**2
        under = qb**2 - 4 * qa * qc
        self.add(
            number, np.where(under > 0, (-qb - np.sqrt(np.maximum(under, 0))) / (2 * qa), np.inf)
        )

    def cloud(
        self,
        random: np.random.Generator,
        noise_m: float = 1e-3,
        dropouts: float = 0.0,
        step_m: float = 0.0,
        mix_px: int = 3,
        silent: np.ndarray | None = None,
    ) -> Cloud:
        """What the camera tells: pixels mix over a window (flying pixels), noise, dropouts,
        rounding; ``silent`` pixels return nothing."""
        z = self.z.copy()
        nothing = ~np.isfinite(z)
        if mix_px > 1:
            reference = np.where(nothing, 0.0, z)
            share = cv2.blur((~nothing).astype(float), (mix_px, mix_px))
            mixed = cv2.blur(reference, (mix_px, mix_px)) / np.maximum(share, 1e-9)
            parted = cv2.dilate(np.where(nothing, 0, z), np.ones((mix_px, mix_px))) - cv2.erode(
                np.where(nothing, 1e9, z), np.ones((mix_px, mix_px))
            )
            z = np.where((parted > 0.01) & ~nothing, mixed, z)
        z = z + noise_m * random.standard_normal(z.shape)
        if step_m:
            z = np.round(z / step_m) * step_m
        z[nothing | (random.random(z.shape) < dropouts) | (z < 0.05)] = np.nan
        if silent is not None:
            z[silent] = np.nan
        points = np.concatenate([self.slopes * z[..., None], z[..., None]], axis=-1)
        none = np.full(z.shape, np.nan)
        zeros = np.zeros(z.shape, dtype=np.uint8)
        region = Region(0, z.shape[0], 0, z.shape[1])
        return Cloud(points, zeros, zeros.astype(int) + 1, none, region, step_m, 1, lens=self.lens)


def tilted(random: np.random.Generator, most_deg: float) -> np.ndarray:
    """A normal towards the camera, tilted by up to so much in any direction."""
    tilt = np.deg2rad(random.uniform(0, most_deg))
    turn = random.uniform(0, 2 * np.pi)
    return np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])


def _pair(random, low, high):
    return random.uniform(low, high), random.uniform(low, high)


def _board(random, scene, distance=None, most_tilt=35.0, size=None, holes=True):
    """A board, aimed at loosely; returns its centre, normal, size."""
    distance = random.uniform(0.5, 1.0) if distance is None else distance
    size = size or (random.uniform(0.2, 0.45), random.uniform(0.15, 0.35))
    centre = np.array([*_pair(random, -0.06, 0.06), distance])
    sample = (
        tuple((*_pair(random, -0.06, 0.06), random.uniform(0.002, 0.02)) for _ in range(3))
        if holes
        else ()
    )
    normal = tilted(random, most_tilt)
    scene.board(1, centre, normal, size, random.uniform(-15, 15), sample)
    return centre, normal, size


def board_before_wall(random, scene):
    centre, _, _ = _board(random, scene)
    scene.wall(0, centre[2] + random.uniform(0.25, 1.5), tilted(random, 20))


def board_close_before_wall(random, scene):
    normal = tilted(random, 15)
    size = (random.uniform(0.25, 0.45), random.uniform(0.2, 0.35))
    centre = np.array([*_pair(random, -0.04, 0.04), random.uniform(0.5, 0.8)])
    scene.board(1, centre, normal, size, random.uniform(-10, 10))
    scene.add(0, scene.plane(centre - random.uniform(0.015, 0.04) * normal, normal)[0])


def board_on_floor(random, scene):
    below = random.uniform(0.2, 0.5)
    height = random.uniform(0.2, 0.4)
    away = random.uniform(0.5, 0.9)
    # the camera looks at the board's middle, roughly
    pitch = float(np.rad2deg(np.arctan2(below - height / 2, away))) + random.uniform(-4, 4)
    scene.floor(0, below, pitch)
    p = np.deg2rad(pitch)
    up = np.array([0, -np.cos(p), -np.sin(p)])
    ahead = np.array([0, -np.sin(p), np.cos(p)])
    width = random.uniform(0.2, 0.45)
    lean = np.deg2rad(random.uniform(0, 20))
    foot = away * ahead - below * up + np.array([random.uniform(-0.08, 0.08), 0, 0])
    rise = np.cos(lean) * up + np.sin(lean) * ahead
    normal = -np.cross(rise, [1, 0, 0])
    normal = -normal if normal[2] > 0 else normal
    scene.board(1, foot + rise * height / 2, normal, (width, height))
    scene.add(2, scene.plane(foot + random.uniform(0.4, 1.5) * ahead, -ahead)[0])


def object_on_plate(random, scene):
    normal = tilted(random, 20)
    centre = np.array([0, 0, random.uniform(0.4, 0.9)])
    scene.add(1, scene.plane(centre, normal)[0])
    side = random.uniform(0.02, 0.07)
    height = random.uniform(0.004, 0.05)
    position = centre + np.array([*_pair(random, -0.2, 0.2), 0]) * centre[2]
    # where the ray to that place meets the plate
    position *= (centre @ normal) / (position @ normal)
    scene.board(
        1, position + height * normal, normal, (side, side * random.uniform(0.6, 1.0)), 20.0
    )


def object_on_board_before_wall(random, scene):
    centre, normal, _ = _board(random, scene, holes=False)
    side = random.uniform(0.02, 0.06)
    height = random.uniform(0.004, 0.04)
    scene.board(1, centre + height * normal, normal, (side, side), 10.0)
    scene.wall(0, centre[2] + random.uniform(0.25, 1.5))


def plate_with_large_holes(random, scene):
    normal = tilted(random, 25)
    centre = np.array([0, 0, random.uniform(0.5, 0.9)])
    holes = tuple((*_pair(random, -0.12, 0.12), random.uniform(0.02, 0.07)) for _ in range(3))
    complete = random.random() < 0.5
    scene.board(1, centre, normal, (3.0, 3.0) if complete else (0.5, 0.4), 0.0, holes)
    scene.wall(0, centre[2] + random.uniform(0.2, 1.0))


def pipe(random, scene):
    radius = random.uniform(0.05, 0.35)
    level = random.random() < 0.5
    axis = np.array([1.0, random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3)])
    axis = axis if level else axis[[1, 0, 2]]
    away = random.uniform(0.45, 0.8) + radius
    scene.cylinder(1, [random.uniform(-0.03, 0.03), 0, away], axis, radius)
    if random.random() < 0.7:
        scene.wall(0, away + radius + random.uniform(0.1, 0.8))


def sphere(random, scene):
    radius = random.uniform(0.07, 0.3)
    away = random.uniform(0.45, 0.8) + radius
    scene.sphere(1, [*_pair(random, -0.04, 0.04), away], radius)
    if random.random() < 0.7:
        scene.wall(0, away + radius + random.uniform(0.05, 0.8))


def bent_sheet(random, scene):
    radius = random.uniform(0.25, 0.8)
    away = random.uniform(0.5, 0.8)
    inner = random.random() < 0.5
    centre = [0, 0, away - radius if inner else away + radius]
    scene.cylinder(1, centre, [random.uniform(-0.2, 0.2), 1, 0], radius, 0.2, inner)
    x_m = scene.slopes[..., 0] * scene.z
    beyond = (np.abs(x_m) > random.uniform(0.15, 0.24)) & (scene.name == 1)
    scene.z[beyond] = np.inf
    scene.name[beyond] = -1
    scene.wall(0, away + random.uniform(0.5, 1.2))


def box_in_front(random, scene):
    """A small thing far before the board."""
    centre, _, _ = _board(
        random, scene, distance=random.uniform(0.7, 1.0), size=(0.4, 0.3), most_tilt=20
    )
    position = centre * random.uniform(0.5, 0.7) + np.array([*_pair(random, -0.06, 0.06), 0])
    scene.board(
        2, position, tilted(random, 20), (random.uniform(0.03, 0.07), random.uniform(0.03, 0.07))
    )
    scene.wall(0, centre[2] + random.uniform(0.3, 1.5))


def hand_in_front(random, scene):
    """A palm and an arm that comes in from the side."""
    centre, _, _ = _board(
        random, scene, distance=random.uniform(0.7, 1.0), size=(0.4, 0.3), most_tilt=20
    )
    away = centre[2] * random.uniform(0.55, 0.75)
    side = random.choice([-1.0, 1.0])
    palm = np.array([side * random.uniform(0.05, 0.12), random.uniform(-0.05, 0.05), away])
    axis = np.array([side, random.uniform(-0.2, 0.2), random.uniform(-0.2, 0.2)])
    scene.board(2, palm, tilted(random, 30), (0.09, 0.09))
    for finger in range(4):
        start = palm + np.array([-side * 0.06, -0.035 + 0.022 * finger, 0])
        scene.cylinder(2, start, axis, 0.009, 0.04)
    scene.cylinder(2, palm + 0.25 * axis, axis, 0.04, 0.22)
    scene.wall(0, centre[2] + random.uniform(0.3, 1.5))


def board_beyond_the_view(random, scene):
    """A board that the picture cuts on two or three sides, before a wall."""
    away = random.uniform(0.5, 0.8)
    half = away * np.abs(scene.slopes).max(axis=(0, 1))
    cut = random.uniform(-0.4, 0.3) * half[0]
    normal = tilted(random, 15)
    scene.board(
        1,
        [cut - 1.0, random.uniform(-0.2, 0.2) if random.random() < 0.5 else 0, away],
        normal,
        (2.0, 2.0),
    )
    scene.wall(0, away + random.uniform(0.2, 1.0))


def two_boards(random, scene):
    """Alike, side by side: either may be meant."""
    away = random.uniform(0.7, 0.9)
    for number, side in ((1, -1.0), (2, 1.0)):
        position = [
            side * random.uniform(0.14, 0.16),
            random.uniform(-0.03, 0.03),
            away + random.uniform(0, 0.04),
        ]
        scene.board(number, position, tilted(random, 10), (0.22, 0.26))
    scene.wall(0, away + random.uniform(0.3, 1.0))


def only_a_wall(random, scene):
    scene.wall(1, random.uniform(0.5, 1.5), tilted(random, 30))


def board_alone(random, scene):
    _board(random, scene, most_tilt=55)


SCENES = {
    f.__name__: f
    for f in (
        board_before_wall, board_close_before_wall, board_on_floor, object_on_plate, object_on_board_before_wall,
        plate_with_large_holes, pipe, sphere, bent_sheet, box_in_front, hand_in_front, board_beyond_the_view,
        two_boards, only_a_wall, board_alone,
    )
}  # fmt: skip
"""Each puts its target in as surface 1."""
