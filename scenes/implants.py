"""Virtual damage for a real scan: the change that a damage would make to a camera's measurement.

A flat board as large as the scanned part is placed in the tangent plane at the damage, and the
pixels around the damage are rendered with and without it. The board's size matters: light that
passes the edges of a smaller one reaches what lies behind the damage, and shows it too deep where
the camera looks at it obliquely. The camera's model turns both renders into frames with the same
random numbers; recorded frames keep their own errors.

Not modelled: the part's curvature and openings, texture at the damage, light that reaches it by
way of other objects, and damage that lowers noise: recorded noise is never removed. Ranges are not
rounded again."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region, rays_of, transform_points
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import AnyCamera, camera_of, number_paths, numbers_of_lens
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom

# frames drawn with and without the damage, to find how much noisier it makes a pixel
LEAST_DRAWS = 48
# rounding step of the drawn frames; recorded ranges already contain the camera's own
FINEST_STEP_MM = 1e-3
# pixels beyond the reach of the camera's filter around the damage's rim that may change
BEYOND_PX = 2
NEAREST_M = 0.1  # z of the board's nearest point, from which poses are legal
# a board reaches at least so many times as far from the damage's centre as the damage does
LEAST_BOARD = 2.0
CIRCLE_STEPS = 64  # points of the circle around a damage of which the pixels are found
KINDS = ("holes", "dents", "flaws")  # fields of a declaration that list damage
# of the camera: what a recording does not contain already
DRAWN_EFFECTS = ("noise", "multipath", "wiggling", "ambient", "saturation")


@dataclass(frozen=True, eq=False)
class PartFace:
    """The face of a scanned part: a rectangle about the part in a plane."""

    T_camera_part: np.ndarray
    """(4, 4): from the plane's frame, z towards the camera, to the camera's."""
    low_m: np.ndarray
    """(2,): least x and y of the part in the plane."""
    high_m: np.ndarray
    """(2,): its largest x and y."""


@dataclass(frozen=True)
class Implant:
    """The difference that a damage makes to a recording."""

    region: Region
    """The pixels (h, w) of the recording that may change."""
    shift_m: np.ndarray
    """(h, w): change of z."""
    noise_m: np.ndarray
    """(t, h, w): noise to add to frame t."""
    lost: np.ndarray
    """(t, h, w) bool: pixels that it makes invalid."""

    @property
    def depth_mm(self) -> float:
        """The largest change of distance that the damage makes."""
        return float(np.abs(self.shift_m).max()) / MM

    def put_into(
        self,
        frame: Frame,
        number: int,
        z_m: np.ndarray,
        reason: np.ndarray,
    ) -> None:
        """Change ``z_m`` and ``reason`` (H, W), copies of those of a recording's frame, in place;
        pixels without range stay so. ``number``: of the frame among those drawn, from 0; beyond
        them, they are used again from the first."""
        region = self.region
        cut = np.s_[region.row0 : region.row1, region.col0 : region.col1]
        draw = number % len(self.noise_m)
        lost = self.lost[draw] & np.isfinite(frame.z_m[cut])
        z_m[cut] += np.where(lost, np.nan, self.shift_m + self.noise_m[draw])
        reason[cut][lost] = Reason.LOW_AMPLITUDE


def unit_config(name: str, lens: Lens) -> tuple[CameraConfig, bool]:
    """Return the camera without the parts that the recording contains (pattern, offset, drift,
    jumps, rounding), and whether its pixels are those of the recording: if so it has the
    recording's ``lens``, otherwise its own."""
    camera = camera_of(CameraConfig(name=name))
    own_lens = camera.nominal_lens
    same = own_lens.width == lens.width and own_lens.height == lens.height
    numbers: dict[str, Any] = {"engine.output_step_mm": FINEST_STEP_MM}
    if same:
        numbers.update(numbers_of_lens(lens))
    paths = number_paths(camera.to_data())
    config = CameraConfig(
        name=name,
        effects=NO_EFFECTS.model_copy(update=dict.fromkeys(DRAWN_EFFECTS, True)),
        numbers={path: value for path, value in numbers.items() if path in paths},
    )
    return config, same


def tangent_board(
    target: custom.TargetConfig,
    damage: custom.AnyDamage,
    part: PartFace,
    place_m: np.ndarray,
    normal: np.ndarray,
) -> custom.TargetConfig:
    """Return a flat board of ``target``'s material, as large as the part, with this damage alone
    where it lies on the part: at ``place_m`` (3,) in the camera's frame. Its face is turned
    towards ``normal`` (3,), a unit vector to the camera. Of a part that reaches too near to the
    camera, the board is smaller on all sides."""
    along = part.T_camera_part[:3, 0]
    along = along - (along @ normal) * normal
    along /= np.linalg.norm(along)
    axes = np.column_stack([along, np.cross(normal, along), normal])
    low_m = part.low_m - damage.centre_m
    high_m = part.high_m - damage.centre_m
    nearest_m = np.minimum(axes[2, :2] * low_m, axes[2, :2] * high_m).sum()
    room_m = place_m[2] - NEAREST_M
    share = min(1.0, room_m / max(-nearest_m, MM))
    least_m = LEAST_BOARD * damage.reach_mm * MM
    low_m = np.minimum(share * low_m, -least_m)
    high_m = np.maximum(share * high_m, least_m)
    middle_m = (low_m + high_m) / 2
    centre_m = place_m + axes[:, :2] @ middle_m
    unturned = np.diag([1.0, -1.0, -1.0]) @ axes
    tilt_x_deg, tilt_y_deg, roll_deg = Rotation.from_matrix(unturned).as_euler("xyz", degrees=True)
    pose = custom.PoseConfig(
        distance_m=float(centre_m[2]),
        offset_x_mm=float(centre_m[0]) / MM,
        offset_y_mm=float(centre_m[1]) / MM,
        tilt_x_deg=float(tilt_x_deg),
        tilt_y_deg=float(tilt_y_deg),
        roll_deg=float(roll_deg),
    )
    width_mm, height_mm = ((high_m - low_m) / MM).tolist()
    off_x_mm, off_y_mm = (-middle_m / MM).tolist()
    alone = damage.model_copy(update={"centre_mm": (off_x_mm, off_y_mm)})
    changed: dict[str, Any] = {
        "board": target.board.model_copy(update={"width_mm": width_mm, "height_mm": height_mm}),
        "pose": pose,
    }
    if target.backing is not None:
        changed["backing"] = target.backing.model_copy(update={"size_mm": None})
    for kind in KINDS:
        ids = [item.id for item in getattr(target, kind)]
        changed[kind] = (alone,) if damage.id in ids else ()
    return target.model_copy(update=changed)


def implant_of(
    config: CameraConfig,
    same: bool,
    lens: Lens,
    board: custom.TargetConfig,
    frames: int,
    seed: int,
    cache: Path,
) -> Implant:
    """Return the difference that the damage of `tangent_board` makes to ``frames`` frames (or
    more) of a recording with this lens. ``config``, ``same``: those of `unit_config`. Raises
    UserError if the damage is out of the camera's view."""
    camera = camera_of(config)
    reached = _reached_disc(camera, board)
    region = reached.region(camera.nominal_lens)
    damaged = board.at_wavelength(camera.optics.wavelength_nm)
    drawn_m, smooth_m = _drawn(config, damaged, region, frames, seed, cache)
    drawn_whole_m, smooth_whole_m = _drawn(config, damaged.hole_free(), region, frames, seed, cache)
    with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that no frame shows
        mean_m = np.nanmean(drawn_m, axis=0)
        mean_whole_m = np.nanmean(drawn_whole_m, axis=0)
        # without noise the mean has no scatter; a pixel at a gate may need noise to be valid
        middle_m = np.where(np.isfinite(smooth_m), smooth_m, mean_m)
        middle_whole_m = np.where(np.isfinite(smooth_whole_m), smooth_whole_m, mean_whole_m)
        # the noise that the damage adds: variances add
        ratio = np.nanvar(drawn_whole_m, axis=0) / np.nanvar(drawn_m, axis=0)
        added_share = np.sqrt(np.clip(1.0 - ratio, 0.0, 1.0))
        added_noise_m = added_share * (drawn_m - mean_m)
    near_damage = reached.holds(camera.nominal_lens.region_slopes(region))
    shift_m = np.where(near_damage, np.nan_to_num(middle_m - middle_whole_m), 0.0)
    noise_m = np.where(near_damage, np.nan_to_num(added_noise_m), 0.0)
    lost = near_damage & np.isnan(drawn_m) & np.isfinite(drawn_whole_m)
    if same:
        return Implant(region, shift_m, noise_m, lost)
    # the recording is aligned to other pixels: interpolate between the camera's pixels
    onto = reached.region(lens)
    rays = rays_of(lens.region_slopes(onto))
    pixels = camera.nominal_lens.project(rays)
    rows_columns = [pixels[..., 1] - region.row0, pixels[..., 0] - region.col0]

    def moved(image: np.ndarray) -> np.ndarray:
        return np.asarray(ndimage.map_coordinates(image.astype(float), rows_columns, order=1))

    moved_noise_m = np.stack([moved(image) for image in noise_m])
    moved_lost = np.stack([moved(image) for image in lost]) > 0.5
    return Implant(onto, moved(shift_m), moved_noise_m, moved_lost)


def _drawn(
    config: CameraConfig,
    target: custom.TargetConfig,
    region: Region,
    frames: int,
    seed: int,
    cache: Path,
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (t, h, w) of frames of the target on a region of the camera, and z (h, w) without
    noise."""
    camera = camera_of(config)
    lens = camera.nominal_lens
    lit = region.grown(camera.optics.margin_px, lens.height, lens.width)
    view, _ = cached_view(target, camera.optics, RenderConfig(), cache, lit)
    unit = SimulatedUnit(camera, config, view)
    capture = unit.capture(max(frames, LEAST_DRAWS), seed, "implant")
    drawn_m = np.stack([frame.z_m for frame in capture.frames()]).astype(float)
    without_noise = config.effects.model_copy(update={"noise": False})
    quiet_config = config.model_copy(update={"effects": without_noise})
    quiet = SimulatedUnit(camera, quiet_config, view)
    smooth_m = next(quiet.capture(1, seed).frames()).z_m.astype(float)
    return drawn_m, smooth_m


@dataclass(frozen=True, eq=False)
class _ReachedDisc:
    """The part of a board's face that its damage may change through the camera's filter: a
    disc."""

    centre_m: np.ndarray
    """(3,): its centre, camera frame."""
    axes: np.ndarray
    """(3, 3): unit vectors along its plane, and its normal towards the camera, in columns."""
    radius_m: float
    """Its radius."""

    def region(self, lens: Lens) -> Region:
        """Return the pixels of a lens on which it lies, cut at the sensor's edges. Raises
        UserError if its centre is out of view."""
        if not lens.images(self.centre_m):
            raise UserError(
                "damage is out of the camera's view",
                fix="name the camera and the depth mode that took the capture",
            )
        angle = np.linspace(0.0, 2 * np.pi, CIRCLE_STEPS, endpoint=False)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        rim_m = self.centre_m + self.radius_m * circle @ self.axes[:, :2].T
        pixels = lens.project(rim_m)
        left, top = np.floor(pixels.min(axis=0)).astype(int).tolist()
        right, bottom = np.ceil(pixels.max(axis=0)).astype(int).tolist()
        return Region(top, bottom + 1, left, right + 1).grown(0, lens.height, lens.width)

    def holds(self, slopes: np.ndarray) -> np.ndarray:
        """Return (h, w) bool: which rays with these slopes (h, w, 2) meet it."""
        rays = rays_of(slopes)
        normal = self.axes[:, 2]
        depth_m = (self.centre_m @ normal) / (rays @ normal)
        on_plane = rays * depth_m[..., None]
        apart_m = np.linalg.norm(on_plane - self.centre_m, axis=-1)
        return np.asarray(apart_m < self.radius_m)


def _reached_disc(camera: AnyCamera, board: custom.TargetConfig) -> _ReachedDisc:
    """Return what the only damage of a flat board may change."""
    (damage,) = board.damages
    T_camera_board = board.pose.T_camera_board
    centre_m = transform_points(T_camera_board, np.array([*damage.centre_m, 0.0]))
    lens = camera.nominal_lens
    pitch_m = float(centre_m[2]) / min(lens.fx, lens.fy)
    reach_px = camera.optics.margin_px + BEYOND_PX
    return _ReachedDisc(
        centre_m=centre_m,
        axes=T_camera_board[:3, :3],
        radius_m=damage.reach_mm * MM + reach_px * pitch_m,
    )
