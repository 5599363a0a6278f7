"""Kinds of scenes: each draws a random variant from a random stream."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from tests.strangers.recording import Format, Noise, Stranger
from tests.strangers.world import Camera, Damage, Surface, meet, with_damage

Rng = np.random.Generator
KINDS: dict[str, Callable[[Rng], Stranger]] = {}

CAMERAS = (
    (640, 576, 504.6),
    (320, 288, 252.3),
    (512, 424, 365.0),
    (320, 240, 290.0),
    (240, 180, 225.0),
)
"""Width, height and focal length: today's cameras, and halves of them."""


def kind(make: Callable[[Rng], Stranger]) -> Callable[[Rng], Stranger]:
    """Register a kind under its function's name."""
    KINDS[make.__name__] = make
    return make


# ---- parts
# -----------------------------------------------------------------------------------------------------------


def camera(rng: Rng, *among: tuple[int, int, float]) -> Camera:
    """A camera with its centre a few pixels off the image's."""
    choices = among or CAMERAS
    width, height, f = choices[int(rng.integers(len(choices)))]
    cx = (width - 1) / 2 + rng.uniform(-0.02, 0.02) * width
    cy = (height - 1) / 2 + rng.uniform(-0.04, 0.04) * height
    return Camera(width, height, f, float(cx), float(cy))


def turned(tilt_deg: float, towards_deg: float, spin_deg: float = 0.0) -> np.ndarray:
    """Axes of a surface whose normal leaves the line of sight by ``tilt_deg`` towards a direction
    in the image."""
    tilt, to, spin = np.radians([tilt_deg, towards_deg, spin_deg])
    axis = np.array([-np.sin(to), np.cos(to), 0.0]) * tilt
    turn = cv2.Rodrigues(axis)[0]
    about_z = cv2.Rodrigues(np.array([0.0, 0.0, spin]))[0]
    return turn @ about_z


def board(
    rng: Rng, cam: Camera, distance: tuple[float, float] = (0.45, 0.95), tilt: tuple[float, float] = (0, 20),
    share: tuple[float, float] = (0.45, 0.85), spin: tuple[float, float] = (-20, 20),
) -> Surface:  # fmt: skip
    """A board about the image's middle; ``share``: of the view's width and height that it spans."""
    d = rng.uniform(*distance)
    index = rng.uniform(-0.05, 0.05, 2) * d * np.array([cam.width, cam.height]) / cam.f_px
    half = 0.5 * d * np.array([cam.width, cam.height]) / cam.f_px * rng.uniform(*share, 2)
    r = turned(rng.uniform(*tilt), rng.uniform(0, 360), rng.uniform(*spin))
    return Surface(np.array([*index, d]), r, half[0], half[1], is_target=True)


def filling(
    rng: Rng, cam: Camera, distance: tuple[float, float] = (0.4, 1.0), tilt: float = 15
) -> Surface:
    """A plane that fills the view; its half extents are those of the view."""
    d = rng.uniform(*distance)
    return Surface(
        np.array([0, 0, d]),
        turned(rng.uniform(0, tilt), rng.uniform(0, 360)),
        5.0,
        5.0,
        is_target=True,
    )


def wall(
    surface: Surface, gap_m: float, tilt_deg: float = 0.0, towards_deg: float = 0.0
) -> Surface:
    """An endless plane behind a surface's farthest corner, parallel to the image but for its own
    tilt."""
    x = 0.999 * surface.half_x_m if surface.half_x_m < 5 else 0.0
    y = 0.999 * surface.half_y_m if surface.half_y_m < 5 else 0.0
    corners = [surface.point_m(i * x, j * y)[2] for i in (-1, 0, 1) for j in (-1, 0, 1)]
    index = np.array([*surface.origin_m[:2], np.nanmax(corners) + gap_m])
    return Surface(index, turned(tilt_deg, towards_deg), 9.0, 9.0)


def damaged(
    rng: Rng, cam: Camera, surface: Surface, n: int, profiles: tuple[str, ...] = ("flat", "bowl", "flat", "cosine"),
    radius_mm: tuple[float, float] = (3, 20), depth_mm: tuple[float, float] = (4, 40), sign: float = 1.0,
    reach: tuple[float, float] | None = None,
) -> Surface:  # fmt: skip
    """``n`` damages (fewer where they do not fit) at least 12 mm apart and 12 mm from the rim and
    the view's edge.

    Sizes are uniform in their logarithm; a tapered one is at most 0.4 of its radius deep, as
    pressed dents are.
    """
    d = surface.origin_m[2]
    view = np.array([cam.width, cam.height]) / cam.f_px * d / 2 * 0.85
    half = (
        np.minimum([surface.half_x_m, surface.half_y_m], view) if reach is None else np.array(reach)
    )
    damages: list[Damage] = []
    for _ in range(60 * n):
        if len(damages) == n:
            break
        profile = profiles[int(rng.integers(len(profiles)))]
        radius = 1e-3 * np.exp(rng.uniform(*np.log(radius_mm)))
        depth = 1e-3 * np.exp(rng.uniform(*np.log(depth_mm)))
        if profile in ("bowl", "cosine", "cone"):
            depth = min(depth, 0.4 * radius)
        length = radius * rng.uniform(3, 8) if profile == "slot" else 0.0
        room = half - (radius + length / 2) - max(0.012, 6 * d / cam.f_px)
        if (room <= 0).any():
            continue
        x, y = rng.uniform(-room, room)
        if surface.outline == "disc" and np.hypot(x / room[0], y / room[1]) > 1:
            continue
        extent = radius + length / 2
        gaps = [
            np.hypot(x - o.x_m, y - o.y_m) - extent - o.radius_m - o.length_m / 2 for o in damages
        ]
        if all(gap > max(0.015, 0.4 * extent) for gap in gaps):
            damages.append(
                Damage(x, y, radius, sign * depth, profile, length, rng.uniform(0, np.pi))
            )
    return with_damage(surface, damages)


def usual(rng: Rng, z_m: float = 0.7) -> Noise:
    """A camera's ordinary noise: 0.5 to 1.5 mm, mostly mixed at edges."""
    return Noise(
        white_m=rng.uniform(0.5e-3, 1.5e-3),
        mixing_px=float(rng.choice([0.0, 0.5, 0.7])),
        dropout=0.001,
    )


def plate(rng: Rng, n: int = 4, cam: Camera | None = None, **more: object) -> Stranger:
    """A damaged board before a wall with ordinary noise: what most kinds vary."""
    cam = cam or camera(rng)
    target = damaged(rng, cam, board(rng, cam), n)
    stranger = Stranger(
        [target, wall(target, rng.uniform(0.15, 0.8))],
        cam,
        usual(rng),
        frames=int(rng.integers(4, 12)),
    )
    return replace(stranger, **more)  # type: ignore[arg-type]


def blotch(rng: Rng, cam: Camera, share: float, n: int = 1) -> np.ndarray:
    """(h, w) bool: ``n`` ellipses that together cover about ``share`` of the image."""
    image = np.zeros((cam.height, cam.width), np.uint8)
    size = np.sqrt(share * cam.width * cam.height / np.pi / n)
    for _ in range(n):
        index = (
            int(rng.uniform(0.25, 0.75) * cam.width),
            int(rng.uniform(0.25, 0.75) * cam.height),
        )
        axes = (max(2, int(size * rng.uniform(0.6, 1.6))), max(2, int(size)))
        cv2.ellipse(image, index, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    return image > 0


# ---- boards
# ----------------------------------------------------------------------------------------------------------


@kind
def before_wall(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, (0.6, 0.9)), int(rng.integers(2, 6)))
    gap = np.exp(rng.uniform(np.log(0.015), np.log(0.6)))
    return Stranger(
        [target, wall(target, gap, rng.uniform(0, 8), rng.uniform(0, 360))], cam, usual(rng)
    )


@kind
def small_board(rng: Rng) -> Stranger:
    """A board that covers a tenth of the image, before a wall that covers the rest."""
    cam = camera(rng, CAMERAS[0], CAMERAS[2])
    target = damaged(rng, cam, board(rng, cam, share=(0.28, 0.4)), 2, radius_mm=(5, 14))
    return Stranger([target, wall(target, rng.uniform(0.1, 0.6))], cam, usual(rng))


@kind
def on_floor(rng: Rng) -> Stranger:
    """A thick board that lies on a floor, seen from above at an angle."""
    cam = camera(rng)
    target = board(rng, cam, (0.6, 0.9), tilt=(5, 35))
    floor = replace(
        target, origin_m=target.origin_m + target.R @ np.array([0, 0, rng.uniform(0.01, 0.05)])
    )
    target = damaged(rng, cam, target, 4, depth_mm=(4, 9))
    return Stranger(
        [target, replace(floor, half_x_m=9.0, half_y_m=9.0, is_target=False)], cam, usual(rng)
    )


@kind
def corner(rng: Rng) -> Stranger:
    """A board that stands on a floor before a wall; the floor runs from below the camera to the
    wall."""
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, (0.6, 0.9), tilt=(0, 12), spin=(0, 0)), 3)
    floor = Surface(
        np.array([0, target.origin_m[1] + target.half_y_m, target.origin_m[2]]),
        turned(88, 90),
        9,
        9,
    )
    return Stranger([target, floor, wall(target, rng.uniform(0.1, 0.5))], cam, usual(rng))


@kind
def tilted(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, (0.55, 0.9), tilt=(20, 60)), 4, depth_mm=(4, 15))
    return Stranger(
        [target, wall(target, rng.uniform(0.4, 1.0))] if rng.random() < 0.6 else [target],
        cam,
        usual(rng),
    )


@kind
def smooth_craters(rng: Rng) -> Stranger:
    """Bowls of 24 to 60 mm without an edge, seen at about 45 degrees."""
    cam = camera(rng, *CAMERAS[:3])
    target = board(rng, cam, (0.55, 0.8), tilt=(42, 48), share=(0.7, 0.95))
    target = damaged(rng, cam, target, 4, ("bowl", "cosine"), radius_mm=(12, 30), depth_mm=(4, 10))
    return Stranger([target, wall(target, rng.uniform(0.4, 1.0))], cam, usual(rng))


@kind
def fills_view(rng: Rng) -> Stranger:
    cam = camera(rng)
    return Stranger([damaged(rng, cam, filling(rng, cam, tilt=40), 5)], cam, usual(rng))


@kind
def round_board(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = replace(board(rng, cam), outline="disc")
    return Stranger(
        [damaged(rng, cam, target, 3), wall(target, rng.uniform(0.05, 0.6))], cam, usual(rng)
    )


# ---- curved targets
# --------------------------------------------------------------------------------------------------


def _pipe(rng: Rng, cam: Camera, radius_m: float, **more: object) -> Surface:
    d = rng.uniform(0.5, 0.9)
    r = turned(
        rng.uniform(0, 15), rng.uniform(0, 360), float(rng.choice([0, 90, rng.uniform(0, 180)]))
    )
    half = 0.999 * abs(radius_m)
    pipe = Surface(np.array([0, 0, d]), r, half, 0.5, "cylinder", radius_m, is_target=True)
    view = 0.4 * min(cam.width, cam.height) / cam.f_px * d
    reach = (min(0.6 * abs(radius_m), view), view)
    return damaged(rng, cam, pipe, int(rng.integers(2, 5)), reach=reach, **more)  # type: ignore[arg-type]


@kind
def pipe_outside(rng: Rng) -> Stranger:
    cam = camera(rng)
    pipe = _pipe(
        rng,
        cam,
        np.exp(rng.uniform(np.log(0.05), np.log(0.5))),
        radius_mm=(6, 20),
        depth_mm=(3, 12),
    )
    return Stranger(
        [pipe, wall(pipe, rng.uniform(0.6, 1.5))] if rng.random() < 0.5 else [pipe], cam, usual(rng)
    )


@kind
def thin_pipe(rng: Rng) -> Stranger:
    cam = camera(rng, CAMERAS[0])
    pipe = _pipe(
        rng,
        cam,
        rng.uniform(0.03, 0.06),
        radius_mm=(6, 10),
        depth_mm=(3, 8),
        profiles=("flat", "bowl"),
    )
    return Stranger([pipe, wall(pipe, rng.uniform(0.3, 0.8))], cam, usual(rng))


@kind
def pipe_inside(rng: Rng) -> Stranger:
    """A half pipe seen from its axis' side; the view may be filled by it."""
    cam = camera(rng)
    pipe = _pipe(rng, cam, -rng.uniform(0.2, 0.5), radius_mm=(6, 20), depth_mm=(3, 12))
    return Stranger([pipe, wall(pipe, 1.0)], cam, usual(rng))


@kind
def sphere(rng: Rng) -> Stranger:
    cam = camera(rng)
    radius = rng.uniform(0.08, 0.3)
    d = rng.uniform(0.5, 0.9)
    ball = Surface(
        np.array([0, 0, d]),
        np.eye(3),
        radius,
        radius,
        "sphere",
        radius,
        outline="disc",
        is_target=True,
    )
    ball = damaged(
        rng, cam, ball, 3, ("bowl", "flat"), (6, 15), (3, 10), reach=(0.55 * radius,) * 2
    )
    behind = [wall(ball, radius + rng.uniform(0.1, 0.8))] if rng.random() < 0.6 else []
    return Stranger([ball, *behind], cam, usual(rng))


def _shaped(rng: Rng, shape: str, bend_m: float, pitch_m: float = 0.2, n: int = 3) -> Stranger:
    cam = camera(rng)
    target = replace(board(rng, cam, tilt=(0, 12)), shape=shape, bend_m=bend_m, pitch_m=pitch_m)
    target = damaged(rng, cam, target, n, radius_mm=(5, 15), depth_mm=(4, 15))
    return Stranger([target, wall(target, rng.uniform(0.2, 0.8))], cam, usual(rng))


@kind
def dome(rng: Rng) -> Stranger:
    return _shaped(rng, "sphere", float(rng.choice([-1, 1])) * rng.uniform(0.5, 1.2))


@kind
def saddle(rng: Rng) -> Stranger:
    return _shaped(rng, "saddle", rng.uniform(0.02, 0.05))


@kind
def bent_sheet(rng: Rng) -> Stranger:
    return _shaped(rng, "bent", float(rng.choice([-1, 1])) * rng.uniform(0.02, 0.06))


@kind
def corrugated(rng: Rng) -> Stranger:
    pitch = rng.uniform(0.08, 0.2)
    return _shaped(rng, "waves", pitch * rng.uniform(0.02, 0.06), pitch, n=2)


# ---- parts of several faces, with joints, behind things
# --------------------------------------------------------------------------------------------------


def _on_faces(
    rng: Rng, cam: Camera, surface: Surface, xs_m: np.ndarray, half_m: float, n: int, depth_m: float
) -> Surface:
    """``n`` damages in the view on faces about the lines x = ``xs_m``, which reach ``half_m`` to
    either side."""
    d = surface.origin_m[2]
    view = 0.4 * d * np.array([cam.width, cam.height]) / cam.f_px
    half = np.minimum([surface.half_x_m, surface.half_y_m], view)
    damages: list[Damage] = []
    for _ in range(60 * n):
        radius = min(rng.uniform(0.006, 0.014), 0.7 * half_m)
        x = float(rng.choice(xs_m)) + rng.uniform(-0.3, 0.3) * (half_m - radius)
        y = rng.uniform(-0.85, 0.85) * half[1]
        is_near = [np.hypot(x - o.x_m, y - o.y_m) < 0.05 for o in damages]
        if len(damages) < n and abs(x) < half[0] - radius and not any(is_near):
            profile = str(rng.choice(["flat", "bowl"]))
            damages.append(
                Damage(x, y, radius, depth_m if profile == "flat" else 0.4 * radius, profile)
            )
    return with_damage(surface, damages)


def _sheet(rng: Rng, cam: Camera, shape: str, bend_m: float, pitch_m: float) -> Surface:
    """A profiled board that fills the view or most of it."""
    target = board(rng, cam, (0.6, 1.0), tilt=(0, 15), share=(0.75, 1.3), spin=(-90, 90))
    return replace(target, shape=shape, bend_m=bend_m, pitch_m=pitch_m)


def _multiples(pitch_m: float, offset: float = 0.0) -> np.ndarray:
    return pitch_m * (np.arange(-12, 13) + offset)


@kind
def trapezoidal_sheet(rng: Rng) -> Stranger:
    cam = camera(rng, *CAMERAS[:3])
    pitch = rng.uniform(0.13, 0.25)
    sheet = _sheet(rng, cam, "trapezoids", rng.uniform(0.012, 0.03), pitch)
    flats = np.concatenate([_multiples(pitch), _multiples(pitch, 0.5)])
    sheet = _on_faces(rng, cam, sheet, flats, 0.2 * pitch, int(rng.integers(0, 5)), 0.006)
    return Stranger([sheet, wall(sheet, rng.uniform(0.3, 0.8))], cam, usual(rng))


@kind
def corrugated_sheet(rng: Rng) -> Stranger:
    """A roof's waves: a quarter to a third as high as half a period."""
    cam = camera(rng, *CAMERAS[:3])
    pitch = rng.uniform(0.075, 0.18)
    sheet = _sheet(rng, cam, "waves", pitch * rng.uniform(0.08, 0.12), pitch)
    crests = np.concatenate([_multiples(pitch, 0.25), _multiples(pitch, 0.75)])
    sheet = _on_faces(rng, cam, sheet, crests, 0.2 * pitch, int(rng.integers(0, 5)), 0.006)
    return Stranger([sheet, wall(sheet, rng.uniform(0.3, 0.8))], cam, usual(rng))


@kind
def cabled_wall(rng: Rng) -> Stranger:
    """Cables that cross the whole view cut a wall into pieces."""
    cam = camera(rng, *CAMERAS[:4])
    target = filling(rng, cam, (0.6, 1.0))
    d = float(target.origin_m[2])
    cables = []
    keep_off = []
    steps = int(rng.integers(2, 5))
    for centre_m in np.linspace(-0.28, 0.28, steps) * d * cam.width / cam.f_px:
        radius = rng.uniform(0.004, 0.012)
        high = radius + rng.uniform(0.0, 0.06)
        turn = float(rng.uniform(-12, 12))
        base = target.point_m(float(centre_m), 0.0) - target.R @ np.array([0, 0, high + radius])
        turned_R = target.R @ cv2.Rodrigues(np.array([0.0, 0.0, np.radians(turn)]))[0]
        cables.append(
            Surface(base, turned_R, 0.999 * radius, 3.0, "cylinder", radius, is_object=True)
        )
        keep_off.append((centre_m, turn, radius))
    target = damaged(rng, cam, target, 9, radius_mm=(6, 14), depth_mm=(4, 10))
    free = []
    for damage in target.damages:
        clear = True
        for centre_m, turn, radius in keep_off:
            off = damage.x_m - centre_m + damage.y_m * np.tan(np.radians(turn))
            clear = clear and abs(off) > damage.radius_m + radius + 0.035
        if clear:
            free.append(damage)
    return Stranger([replace(target, damages=tuple(free[:5])), *cables], cam, usual(rng))


@kind
def ribbed_wall(rng: Rng) -> Stranger:
    cam = camera(rng, *CAMERAS[:3])
    pitch = rng.uniform(0.14, 0.25)
    target = replace(filling(rng, cam, (0.6, 1.0)), half_x_m=1.5, half_y_m=1.5)
    target = replace(target, shape="ribs", bend_m=rng.uniform(0.015, 0.04), pitch_m=pitch)
    target = _on_faces(rng, cam, target, _multiples(pitch), 0.25 * pitch, 4, 0.006)
    return Stranger([target], cam, usual(rng))


def _joined(rng: Rng, shape: str, depth_m: float, pitch_m: float, n: int) -> Stranger:
    cam = camera(rng, *CAMERAS[:3])
    target = filling(rng, cam, (0.6, 1.0))
    spin = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(-1.5, 1.5)]))[0]
    target = replace(target, R=target.R @ spin, half_x_m=1.5, half_y_m=1.5)
    target = replace(target, shape=shape, bend_m=depth_m, pitch_m=pitch_m)
    if n:
        target = _on_faces(rng, cam, target, _multiples(pitch_m), 0.25 * pitch_m, n, 0.006)
    return Stranger([target], cam, usual(rng))


@kind
def floor_boards(rng: Rng) -> Stranger:
    return _joined(rng, "boards", rng.uniform(0.0015, 0.004), rng.uniform(0.09, 0.2), 0)


@kind
def damaged_floor_boards(rng: Rng) -> Stranger:
    return _joined(rng, "boards", rng.uniform(0.0015, 0.004), rng.uniform(0.09, 0.2), 3)


@kind
def brick_wall(rng: Rng) -> Stranger:
    n = 3 * int(rng.integers(2))
    return _joined(rng, "bricks", rng.uniform(0.002, 0.006), 0.25, n)


def _car_door(rng: Rng, crease: float, handle: bool) -> Stranger:
    cam = camera(rng, *CAMERAS[:3])
    target = board(rng, cam, (0.7, 1.1), tilt=(0, 15), share=(0.8, 1.2), spin=(-10, 10))
    target = replace(target, shape="door", bend_m=crease, pitch_m=0.2 if handle else 0.0)
    return Stranger([target, wall(target, rng.uniform(0.3, 0.8))], cam, usual(rng))


@kind
def curved_door(rng: Rng) -> Stranger:
    """Undamaged, with or without a crease."""
    return _car_door(rng, float(rng.choice([0.0, rng.uniform(0.05, 0.3)])), False)


def _without_handle(created: Stranger) -> Stranger:
    """Findings on the handle and its bowl are neither right nor false."""
    target = created.surfaces[0]
    hit = meet(target, created.camera.slopes())
    across = np.abs(hit.x_m - 0.5 * target.half_x_m) < 0.13
    return replace(created, ignored=across & (np.abs(hit.y_m) < 0.045))


@kind
def car_door(rng: Rng) -> Stranger:
    return _without_handle(_car_door(rng, rng.uniform(0.1, 0.3), True))


@kind
def dented_car_door(rng: Rng) -> Stranger:
    created = _car_door(rng, rng.uniform(0.1, 0.3), True)
    target = created.surfaces[0]
    dents_ = []
    for x, y in ((-0.6, -0.65), (-0.5, 0.2), (-0.1, 0.6)):
        radius = rng.uniform(0.012, 0.022)
        x_m = (x + rng.uniform(-0.1, 0.1)) * min(target.half_x_m, 0.3)
        y_m = y * min(target.half_y_m, 0.25)
        dents_.append(Damage(x_m, y_m, radius, 0.25 * radius, "bowl"))
    dented = with_damage(target, dents_)
    return _without_handle(replace(created, surfaces=[dented, *created.surfaces[1:]]))


# ---- things on and before the target
# ---------------------------------------------------------------------------------


def _objects(target: Surface, rng: Rng) -> list[Surface]:
    """A box, a tape or a cable that lies on a board, clear of its damages."""
    created: list[Surface] = []
    for _ in range(200):
        content = str(rng.choice(["box", "tape", "cable"]))
        halves = {
            "box": rng.uniform(0.015, 0.05, 2),
            "tape": (rng.uniform(0.04, 0.1), 0.012),
            "cable": (0.1, 0.004),
        }
        half = halves[content]
        high = {"box": rng.uniform(0.01, 0.06), "tape": 0.0003, "cable": 0.008}[content]
        reach = float(np.hypot(*half))
        x = rng.uniform(-0.8, 0.8) * target.half_x_m
        y = rng.uniform(-0.8, 0.8) * target.half_y_m
        if any(
            np.hypot(x - d.x_m, y - d.y_m) < reach + d.radius_m + d.length_m + 0.02
            for d in target.damages
        ):
            continue
        index = target.origin_m + target.R @ np.array([x, y, -high])
        turn = cv2.Rodrigues(np.array([0, 0, rng.uniform(0, np.pi)]))[0]
        created.append(Surface(index, target.R @ turn, half[0], half[1], is_object=True))
        if len(created) == 2:
            break
    return created


@kind
def object_on_plate(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, tilt=(0, 15), share=(0.7, 0.95)), 3)
    return Stranger(
        [target, *_objects(target, rng), wall(target, rng.uniform(0.2, 0.8))], cam, usual(rng)
    )


@kind
def tags(rng: Rng) -> Stranger:
    """Printed tags with black squares that a measures 1 to 3 mm off; findings there are not
    judged."""
    created = plate(rng)
    cam = created.camera
    target = created.surfaces[0]
    offset = np.zeros((cam.height, cam.width))
    for sx, sy in ((-0.8, -0.8), (0.8, -0.8), (-0.8, 0.8), (0.8, 0.8)):
        index = target.point_m(sx * target.half_x_m, sy * target.half_y_m)
        u = int(cam.f_px * index[0] / index[2] + cam.cx_px)
        v = int(cam.f_px * index[1] / index[2] + cam.cy_px)
        pattern = rng.integers(0, 2, (4, 4)).repeat(3, 0).repeat(3, 1) * rng.uniform(1e-3, 3e-3)
        window = offset[max(v, 0) : v + 12, max(u, 0) : u + 12]
        window[:] = pattern[: window.shape[0], : window.shape[1]]
    nearby = cv2.dilate((offset > 0).astype(np.uint8), np.ones((7, 7))) > 0
    return replace(created, offset_m=offset, ignored=nearby)


@kind
def foreground(rng: Rng) -> Stranger:
    """A pole or a hand stands between the camera and the board."""
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, (0.6, 0.95), share=(0.7, 0.95)), 3)
    d = 0.55 * target.origin_m[2]
    if rng.random() < 0.5:
        index = np.array([rng.choice([-1, 1]) * 0.25 * d, 0, d])
        before = [
            Surface(index, turned(5, 0, rng.uniform(-15, 15)), 0.0149, 1.0, "cylinder", 0.015)
        ]
    else:
        index = np.array([0.35 * d, 0.35 * d, d])
        before = [Surface(index, turned(20, 30, rng.uniform(0, 90)), 0.045, 0.06, outline="disc")]
        for i in range(4):
            finger = index + np.array([-0.06, -0.02 * i, 0.01])
            before.append(Surface(finger, turned(10, 10, 90 + 12 * i), 0.008, 0.04))
    return Stranger([target, *before, wall(target, rng.uniform(0.2, 0.8))], cam, usual(rng))


@kind
def white_millimetre(rng: Rng) -> Stranger:
    """Another kind's scene before the simplest camera: 1 mm of white noise, nothing mixed at
    edges, some pixels lost; stored in millimetres or finer, with 0 or 65535 for no return."""
    by_name = (
        "before_wall on_floor corner tilted fills_view pipe_outside pipe_inside sphere dome "
        "bent_sheet drilled"
    )
    created = KINDS[str(rng.choice([*by_name.split(), "dents", "no_return", "object_on_plate"]))](
        rng
    )
    form = Format(
        unit_m=float(rng.choice([1e-3, 1e-3, 1e-3, 0.25e-3])),
        invalid=float(rng.choice([0, 0, 65535])),
    )
    noise = Noise(1e-3, dropout=float(rng.choice([0, 0, 0.1])))
    return replace(created, camera=Camera(640, 576, 504.6, 321.7, 333.3), noise=noise, format=form)


@kind
def camera_model(rng: Rng) -> Stranger:
    """Another kind's scene before the project's own model of an Azure Kinect or a Kinect v2."""
    by_name = "before_wall tilted fills_view pipe_outside dome drilled object_on_plate on_floor"
    created = KINDS[str(rng.choice(by_name.split()))](rng)
    model, cam, noise_m = (
        ("azure_kinect_nfov", Camera(640, 576, 504.6, 321.7, 333.3), 0.8e-3),
        ("kinect_v2", Camera(512, 424, 365.0, 256.0, 208.0), 1.5e-3),
    )[int(rng.integers(2))]
    noise = Noise(noise_m, blur_px=1.0, fixed_m=0.6e-3, fixed_px=1.5)
    return replace(created, camera=cam, noise=noise, model=model, frames=int(rng.integers(1, 9)))


# ---- damage
# ----------------------------------------------------------------------------------------------------------


@kind
def drilled(rng: Rng) -> Stranger:
    """Through and blind holes of 4 to 60 mm."""
    cam = camera(rng, CAMERAS[0], CAMERAS[2], CAMERAS[1])
    target = board(rng, cam, share=(0.7, 0.95))
    target = damaged(rng, cam, target, 12, ("flat", "through"), (2, 30), (5, 40))
    return Stranger([target, wall(target, rng.uniform(0.05, 0.5))], cam, usual(rng))


@kind
def dents(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam), 4, ("bowl", "cosine", "cone"), (8, 25), (2, 8))
    return Stranger(
        [target, wall(target, rng.uniform(0.2, 0.8))], cam, replace(usual(rng), white_m=5e-4)
    )


@kind
def bumps(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(
        rng, cam, board(rng, cam), 4, ("bowl", "flat", "cosine"), (5, 20), (3, 12), sign=-1.0
    )
    return Stranger([target, wall(target, rng.uniform(0.2, 0.8))], cam, usual(rng))


@kind
def slots(rng: Rng) -> Stranger:
    cam = camera(rng)
    target = damaged(rng, cam, board(rng, cam, share=(0.7, 0.95)), 3, ("slot",), (2.5, 6), (5, 30))
    return Stranger([target, wall(target, rng.uniform(0.2, 0.8))], cam, usual(rng))


@kind
def no_return(rng: Rng) -> Stranger:
    """Holes of 4 to 100 pixels' width from which nothing returns."""
    cam = camera(rng)
    target = board(rng, cam, share=(0.7, 1.2)) if rng.random() < 0.5 else filling(rng, cam)
    pitch_mm = 1e3 * target.origin_m[2] / cam.f_px
    widest = min(50.0, cam.height / 8)
    target = damaged(rng, cam, target, 3, ("absent",), (2 * pitch_mm, widest * pitch_mm))
    behind = [wall(target, rng.uniform(0.1, 0.6))] if rng.random() < 0.5 else []
    return Stranger(
        [target, *behind], cam, replace(usual(rng), dropout=float(rng.choice([0, 0.001, 0.02])))
    )


# ---- what the camera loses
# -------------------------------------------------------------------------------------------


@kind
def dropouts(rng: Rng) -> Stranger:
    created = plate(rng)
    return replace(created, noise=replace(created.noise, dropout=rng.uniform(0.02, 0.35)))


@kind
def clustered_dropouts(rng: Rng) -> Stranger:
    """Ragged spots of 4 to 12 pixels without return: called or not, both may be right."""
    created = plate(rng)
    gone = np.zeros((created.camera.height, created.camera.width), bool)
    for _ in range(int(rng.integers(2, 8))):
        gone |= blotch(rng, created.camera, 8e-4)
    gone &= rng.random(gone.shape) < 0.7
    return replace(
        created, gone=gone, ignored=cv2.dilate(gone.astype(np.uint8), np.ones((5, 5))) > 0
    )


@kind
def dark_patch(rng: Rng) -> Stranger:
    """A dark patch: three to five times the noise."""
    created = plate(rng)
    patch = blotch(rng, created.camera, rng.uniform(0.01, 0.05))
    return replace(created, louder=np.where(patch, rng.uniform(3, 5), 1.0))


@kind
def specular(rng: Rng) -> Stranger:
    """A highlight that saturates: nothing returns from a patch; calling it is right, calling it
    not too."""
    created = plate(rng)
    patch = blotch(rng, created.camera, rng.uniform(0.001, 0.01))
    return replace(
        created, gone=patch, ignored=cv2.dilate(patch.astype(np.uint8), np.ones((9, 9))) > 0
    )


@kind
def flying_pixels(rng: Rng) -> Stranger:
    created = plate(rng)
    return replace(created, noise=replace(created.noise, mixing_px=rng.uniform(0.8, 1.5)))


# ---- noise
# -----------------------------------------------------------------------------------------------------------


@kind
def white_noise(rng: Rng) -> Stranger:
    created = plate(rng)
    return replace(
        created,
        noise=replace(
            created.noise, white_m=float(np.exp(rng.uniform(np.log(3e-4), np.log(5e-3))))
        ),
    )


@kind
def correlated_noise(rng: Rng) -> Stranger:
    created = plate(rng)
    noise = replace(
        created.noise, white_m=rng.uniform(0.4e-3, 1.5e-3), blur_px=rng.uniform(0.7, 1.2)
    )
    return replace(created, noise=noise)


@kind
def fixed_pattern(rng: Rng) -> Stranger:
    created = plate(rng)
    noise = replace(
        created.noise, fixed_m=rng.uniform(0.3e-3, 0.8e-3), fixed_px=rng.uniform(0.7, 2.5)
    )
    return replace(created, noise=noise, frames=int(rng.integers(5, 20)))


@kind
def heavy_tails(rng: Rng) -> Stranger:
    created = plate(rng)
    return replace(created, noise=replace(created.noise, tail=True))


@kind
def one_frame(rng: Rng) -> Stranger:
    return replace(plate(rng), frames=1)


@kind
def fifty_frames(rng: Rng) -> Stranger:
    return replace(plate(rng, cam=camera(rng, CAMERAS[1], CAMERAS[3], CAMERAS[4])), frames=50)


# ---- what moves
# ------------------------------------------------------------------------------------------------------


@kind
def frame_jump(rng: Rng) -> Stranger:
    """One frame reads 5 to 30 mm off, as after an interrupted exposure."""
    index = int(rng.integers(8))
    off = float(rng.choice([-1, 1])) * rng.uniform(5e-3, 30e-3)
    return replace(plate(rng), frames=8, per_frame=lambda k, depth: depth + off * (k == index))


@kind
def moved_camera(rng: Rng) -> Stranger:
    """The camera is knocked half way: the picture shifts by 5 to 20 pixels."""
    created = plate(rng)
    key = int(rng.integers(5, 20)) * created.camera.width // 320
    return replace(
        created,
        frames=8,
        per_frame=lambda k, depth: np.roll(depth, key, axis=1) if k >= 5 else depth,
    )


@kind
def passer_by(rng: Rng) -> Stranger:
    """Somebody walks through the view in two of ten frames."""
    created = plate(rng)
    h = created.camera.height
    w = created.camera.width
    nearby = 0.6 * created.surfaces[0].origin_m[2]

    def walks(k: int, depth: np.ndarray) -> np.ndarray:
        if k not in (4, 5):
            return depth
        v, u = np.mgrid[:h, :w]
        body = np.hypot((u - w * (0.3 + 0.3 * (k - 4))) / (0.12 * w), (v - 0.6 * h) / (0.5 * h)) < 1
        return np.where(body, nearby, depth)

    return replace(created, frames=10, per_frame=walks)


@kind
def three_heaps(rng: Rng) -> Stranger:
    """Heaps of parts on a table, another heap in each of three frames: nothing to average."""
    created = plate(rng)
    height = created.camera.height
    width = created.camera.width
    seed = int(rng.integers(1 << 30))

    def heap(k: int, depth: np.ndarray) -> np.ndarray:
        of_frame = np.random.default_rng([seed, k])
        v, u = np.mgrid[:height, :width]
        heaped = depth.copy()
        for _ in range(40):
            centre_u = of_frame.uniform(0.15, 0.85) * width
            centre_v = of_frame.uniform(0.15, 0.85) * height
            radius_px = of_frame.uniform(0.04, 0.1) * height
            is_part = np.hypot(u - centre_u, v - centre_v) < radius_px
            heaped[is_part] -= of_frame.uniform(0.015, 0.04)
        return heaped

    return replace(created, frames=3, per_frame=heap, doubtful=True)


# ---- cameras and files
# -----------------------------------------------------------------------------------------------


@kind
def distorted_lens(rng: Rng) -> Stranger:
    cam = replace(
        camera(rng),
        distortion=(rng.uniform(-0.25, 0.15), rng.uniform(-0.03, 0.03), 1e-3, -1e-3, 0.0),
    )
    return plate(rng, cam=cam)


@kind
def resolutions(rng: Rng) -> Stranger:
    return plate(
        rng,
        cam=camera(
            rng, (160, 120, 150.0), (224, 172, 205.0), (640, 480, 460.0), (1280, 720, 900.0)
        ),
    )


def _unit(rng: Rng, unit_m: float, kind_: str = "png", invalid: float = 0) -> Stranger:
    return replace(plate(rng), format=Format(kind_, unit_m, invalid))


@kind
def quarter_mm(rng: Rng) -> Stranger:
    return _unit(rng, 0.25e-3)


@kind
def tenth_mm(rng: Rng) -> Stranger:
    return _unit(rng, 1e-4)


@kind
def tum_units(rng: Rng) -> Stranger:
    return _unit(rng, 1 / 5000)


@kind
def metres_float(rng: Rng) -> Stranger:
    return _unit(
        rng, 1.0, str(rng.choice(["npy", "npz", "mat"])), float(rng.choice([np.nan, 0, -1]))
    )


@kind
def centimetres_float(rng: Rng) -> Stranger:
    return _unit(rng, 1e-2, str(rng.choice(["npy", "npz"])))


@kind
def millimetres_float(rng: Rng) -> Stranger:
    return _unit(rng, 1e-3, str(rng.choice(["npy", "mat"])), float(rng.choice([np.nan, 0, 65535])))


@kind
def invalid_values(rng: Rng) -> Stranger:
    created = no_return(rng) if rng.random() < 0.5 else dropouts(rng)
    return replace(created, format=Format(invalid=float(rng.choice([65535, 65534, 4095]))))


@kind
def clouds(rng: Rng) -> Stranger:
    """Clouds without and with a pixel grid, metres; one frame each."""
    cam = camera(rng, CAMERAS[1], CAMERAS[3], CAMERAS[4])
    form = Format(str(rng.choice(["ply", "pcd", "xyz"])), 1.0, np.nan)
    return replace(plate(rng, cam=cam), frames=1, format=form)


@kind
def clouds_mm(rng: Rng) -> Stranger:
    cam = camera(rng, CAMERAS[1], CAMERAS[3], CAMERAS[4])
    return replace(
        plate(rng, cam=cam),
        frames=1,
        format=Format(str(rng.choice(["ply", "pcd", "xyz"])), 1e-3, np.nan),
    )


@kind
def own_flat_field(rng: Rng) -> Stranger:
    """A flat field that holds the damage: made of the capture's own frames, or of others from the
    same place."""
    created = fills_view(rng)
    source = str(rng.choice(["own", "same place"]))
    frames = int(rng.integers(8, 16))
    return replace(created, frames=frames, flat_field=source, doubtful=True)


# ---- nothing to find
# -------------------------------------------------------------------------------------------------


@kind
def undamaged(rng: Rng) -> Stranger:
    by_name = (
        "before_wall fills_view pipe_outside sphere bent_sheet tilted correlated_noise on_floor "
        "fixed_pattern"
    )
    created = KINDS[str(rng.choice(by_name.split()))](rng)
    return replace(created, surfaces=[replace(surface, damages=()) for surface in created.surfaces])


@kind
def rubble(rng: Rng) -> Stranger:
    """Stones and nothing else: there is no target to inspect."""
    cam = camera(rng, CAMERAS[1], CAMERAS[3], CAMERAS[4])
    stones = []
    for _ in range(60):
        d = rng.uniform(0.5, 0.9)
        radius = rng.uniform(0.02, 0.07)
        index = np.array(
            [*(rng.uniform(-0.6, 0.6, 2) * d * np.array([cam.width, cam.height]) / cam.f_px), d]
        )
        stones.append(Surface(index, np.eye(3), radius, radius, "sphere", radius, outline="disc"))
    return Stranger(stones, cam, usual(rng), doubtful=True)
