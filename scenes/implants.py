"""Virtual damage for a real scan: the change that a damage would make to a camera's measurement.

A small board is placed where the scan's surface is and is rendered with and without the damage.
The camera's model turns both renders into frames with the same random numbers; recorded frames
keep their own errors.

Not modelled: the surface's curvature within the small board, texture at the damage, light that
reaches it by way of other surfaces, and damage that lowers noise: recorded noise is never removed.
Ranges are not rounded again."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region, transform_points
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of, number_paths, numbers_of_lens
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom

# frames drawn with and without the damage, to find how much noisier it makes a pixel
LEAST_DRAWS = 48
# rounding step of the drawn frames; recorded ranges already contain the camera's own
FINEST_STEP_MM = 1e-3
# pixels beyond the reach of the camera's filter around the damage's rim that may change
BEYOND_PX = 2
AROUND_PX = 8  # further pixels of the small board; its rim disturbs both renders alike
KINDS = ("holes", "dents", "flaws")  # fields of a declaration that list damage
# of the camera: what a recording does not contain already
DRAWN_EFFECTS = ("noise", "multipath", "wiggling", "ambient", "saturation")


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


def local_board(
    target: custom.TargetConfig,
    damage: custom.AnyDamage,
    place_m: np.ndarray,
    normal: np.ndarray,
    side_mm: float,
) -> custom.TargetConfig:
    """Return a board of ``target``'s material with this damage alone at its centre, which lies at
    ``place_m`` (3,) in the camera's frame, its face towards ``normal`` (3,), a unit vector to the
    camera."""
    x, y, z = normal * [1.0, -1.0, -1.0]
    pose = custom.PoseConfig(
        distance_m=float(place_m[2]),
        offset_x_mm=float(place_m[0]) / MM,
        offset_y_mm=float(place_m[1]) / MM,
        tilt_x_deg=float(np.degrees(np.arcsin(-y))),
        tilt_y_deg=float(np.degrees(np.arctan2(x, z))),
    )
    alone = damage.model_copy(update={"centre_mm": (0.0, 0.0)})
    changed: dict[str, Any] = {
        "board": target.board.model_copy(update={"width_mm": side_mm, "height_mm": side_mm}),
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
    """Return the difference that the damage of `local_board` makes to ``frames`` frames (or more)
    of a recording with this lens. ``config``, ``same``: those of `unit_config`. Raises UserError
    if the board leaves the view."""
    camera = camera_of(config)
    damaged = board.at_wavelength(camera.optics.wavelength_nm)
    unit, drawn_m, smooth_m = _drawn(config, damaged, frames, seed, cache)
    _, drawn_whole_m, smooth_whole_m = _drawn(config, damaged.hole_free(), frames, seed, cache)
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
    near_damage = _near_damage(unit, board)
    region = unit.region
    shift_m = np.where(near_damage, np.nan_to_num(middle_m - middle_whole_m), 0.0)
    noise_m = np.where(near_damage, np.nan_to_num(added_noise_m), 0.0)
    lost = near_damage & np.isnan(drawn_m) & np.isfinite(drawn_whole_m)
    if same:
        return Implant(region, shift_m, noise_m, lost)
    # the recording is aligned to other pixels: interpolate between the camera's pixels
    onto = _region_of_board(lens, board)
    rays = np.concatenate([lens.region_slopes(onto), np.ones((*onto.shape, 1))], axis=-1)
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
    frames: int,
    seed: int,
    cache: Path,
) -> tuple[SimulatedUnit, np.ndarray, np.ndarray]:
    """Return a unit of the camera before the target, z (t, h, w) of frames, and z (h, w) without
    noise."""
    camera = camera_of(config)
    view, _ = cached_view(target, camera.optics, RenderConfig(), cache)
    unit = SimulatedUnit(camera, config, view)
    capture = unit.capture(max(frames, LEAST_DRAWS), seed, "implant")
    drawn_m = np.stack([frame.z_m for frame in capture.frames()]).astype(float)
    without_noise = config.effects.model_copy(update={"noise": False})
    quiet_config = config.model_copy(update={"effects": without_noise})
    quiet = SimulatedUnit(camera, quiet_config, view)
    smooth_m = next(quiet.capture(1, seed).frames()).z_m.astype(float)
    return unit, drawn_m, smooth_m


def _region_of_board(lens: Lens, board: custom.TargetConfig) -> Region:
    """Return the pixels of a lens on which the small board lies."""
    half_m = board.board.width_mm / 2 * MM
    corners = np.array([(x, y, 0.0) for x in (-half_m, half_m) for y in (-half_m, half_m)])
    pixels = lens.project(transform_points(board.pose.T_camera_board, corners))
    left, top = np.floor(pixels.min(axis=0)).astype(int)
    right, bottom = np.ceil(pixels.max(axis=0)).astype(int)
    return Region(top, bottom + 1, left, right + 1).grown(0, lens.height, lens.width)


def side_mm(
    damage: custom.AnyDamage,
    distance_m: float,
    config: CameraConfig,
) -> float:
    """Return the side of a board with space for a damage, the reach of the camera's filter around
    it, and a rim."""
    camera = camera_of(config)
    lens = camera.nominal_lens
    pitch_mm = distance_m / MM / min(lens.fx, lens.fy)
    rim_px = camera.optics.margin_px + BEYOND_PX + AROUND_PX
    return 2 * damage.reach_mm + 2 * rim_px * pitch_mm


def _near_damage(unit: SimulatedUnit, board: custom.TargetConfig) -> np.ndarray:
    """Return (h, w) bool: pixels of the unit's region that the damage may change through the
    camera's filter."""
    (damage,) = board.damages
    T_camera_board = board.pose.T_camera_board
    slopes = unit.view.slopes[unit.cut]
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    normal = T_camera_board[:3, 2]
    centre = T_camera_board[:3, 3]
    on_plane = rays * ((centre @ normal) / (rays @ normal))[..., None]
    lens = unit.camera.nominal_lens
    reach_m = (unit.camera.optics.margin_px + BEYOND_PX) * float(centre[2]) / min(lens.fx, lens.fy)
    apart_m = np.linalg.norm(on_plane - centre, axis=-1)
    return np.asarray(apart_m < damage.reach_mm * MM + reach_m)
