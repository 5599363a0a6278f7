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

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region, transform_points
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import NO_EFFECTS, CameraConfig, camera_of, number_paths, numbers_of_lens
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom

LEAST_DRAWS = (
    48  # frames drawn with and without the damage, to find how much noisier it makes a pixel
)
FINEST_STEP_MM = (
    1e-3  # rounding step of the drawn frames; recorded ranges already contain the camera's own
)
BEYOND_PX = (
    2  # pixels beyond the reach of the camera's filter around the damage's rim that may change
)
AROUND_PX = 8  # further pixels of the small board; its rim disturbs both renders alike


@dataclass(frozen=True)
class Implant:
    """The difference that a damage makes on a ``region`` (h, w) of the recording's pixels.
    ``shift_m`` (h, w): change of z. ``noise_m`` (t, h, w): noise to add to frame t. ``lost`` (t,
    h, w) bool: pixels that it makes invalid."""

    region: Region
    shift_m: np.ndarray
    noise_m: np.ndarray
    lost: np.ndarray

    @property
    def depth_mm(self) -> float:
        """The largest change of distance that the damage makes."""
        return float(np.abs(self.shift_m).max()) / MM

    def put_into(self, frame: Frame, number: int, z_m: np.ndarray, reason: np.ndarray) -> None:
        """Change ``z_m`` and ``reason`` (H, W), copies of those of a recording's frame, in place;
        pixels without range stay so. ``number``: of the frame among those drawn, from 0; beyond
        them, they are used again from the first."""
        cut = np.s_[self.region.row0 : self.region.row1, self.region.col0 : self.region.col1]
        draw = number % len(self.noise_m)
        lost = self.lost[draw] & np.isfinite(frame.z_m[cut])
        z_m[cut] += np.where(lost, np.nan, self.shift_m + self.noise_m[draw])
        reason[cut][lost] = Reason.LOW_AMPLITUDE


def unit_config(name: str, lens: Lens) -> tuple[CameraConfig, bool]:
    """Return the camera without the parts that the recording contains (pattern, offset, drift,
    jumps, rounding), and whether its pixels are those of the recording: if so it has the
    recording's ``lens``, otherwise its own."""
    facts = camera_of(CameraConfig(name=name))
    same = (facts.nominal_lens.width, facts.nominal_lens.height) == (lens.width, lens.height)
    numbers = {"engine.output_step_mm": FINEST_STEP_MM, **(numbers_of_lens(lens) if same else {})}
    known = number_paths(facts.to_data())
    kept = ("noise", "multipath", "wiggling", "ambient", "saturation")
    effects = NO_EFFECTS.model_copy(update=dict.fromkeys(kept, True))
    return CameraConfig(
        name=name, effects=effects, numbers={k: v for k, v in numbers.items() if k in known}
    ), same


KINDS = ("holes", "dents", "flaws")  # fields of a declaration that list damage


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
    kept = {
        name: tuple(alone for each in getattr(target, name) if each.id == damage.id)
        for name in KINDS
    }
    board = target.board.model_copy(update={"width_mm": side_mm, "height_mm": side_mm})
    backing = target.backing and target.backing.model_copy(update={"size_mm": None})
    return target.model_copy(update={**kept, "board": board, "backing": backing, "pose": pose})


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
    declared = board.at_wavelength(camera.optics.wavelength_nm)
    count = max(frames, LEAST_DRAWS)
    drawn = []
    smooth = []
    without_noise = config.model_copy(
        update={"effects": config.effects.model_copy(update={"noise": False})}
    )
    for target in (declared, declared.hole_free()):
        view, _ = cached_view(target, camera.optics, RenderConfig(), cache)
        unit = SimulatedUnit(camera, config, view)
        quiet = SimulatedUnit(camera, without_noise, view)
        drawn.append(
            np.stack([frame.z_m for frame in unit.capture(count, seed, "implant").frames()]).astype(
                float
            )
        )
        smooth.append(next(quiet.capture(1, seed).frames()).z_m.astype(float))
    with np.errstate(invalid="ignore", divide="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels that no frame shows
        means, spreads = zip(
            *((np.nanmean(z, axis=0), np.nanvar(z, axis=0)) for z in drawn), strict=True
        )
        # without noise the mean has no scatter; a pixel at a gate may need noise to be valid
        middle = [np.where(np.isfinite(z), z, mean) for z, mean in zip(smooth, means, strict=True)]
        more = np.sqrt(np.clip(1.0 - spreads[1] / spreads[0], 0.0, 1.0))
        noise_m = more * (drawn[0] - means[0])
    near = _near(unit, board)
    region = unit.region
    shift_m = np.where(near, np.nan_to_num(middle[0] - middle[1]), 0.0)
    noise_m = np.where(near, np.nan_to_num(noise_m), 0.0)
    lost = near & np.isnan(drawn[0]) & np.isfinite(drawn[1])
    if same:
        return Implant(region, shift_m, noise_m, lost)
    # the recording is aligned to other pixels: interpolate between the camera's pixels
    half = board.board.width_mm / 2 * MM
    corners = np.array([(x, y, 0.0) for x in (-half, half) for y in (-half, half)])
    ends = lens.project(transform_points(board.pose.T_camera_board, corners))
    (left, top), (right, bottom) = (
        np.floor(ends.min(axis=0)).astype(int),
        np.ceil(ends.max(axis=0)).astype(int),
    )
    onto = Region(top, bottom + 1, left, right + 1).grown(0, lens.height, lens.width)
    at = camera.nominal_lens.project(
        np.concatenate([lens.region_slopes(onto), np.ones((*onto.shape, 1))], axis=-1)
    )
    rows_columns = [at[..., 1] - region.row0, at[..., 0] - region.col0]

    def moved(image: np.ndarray) -> np.ndarray:
        return np.asarray(ndimage.map_coordinates(image.astype(float), rows_columns, order=1))

    return Implant(
        onto, moved(shift_m), np.stack([*map(moved, noise_m)]), np.stack([*map(moved, lost)]) > 0.5
    )


def side_mm(damage: custom.AnyDamage, distance_m: float, config: CameraConfig) -> float:
    """Return the side of a board with space for a damage, the reach of the camera's filter around
    it, and a rim."""
    camera = camera_of(config)
    pitch_mm = distance_m / MM / min(camera.nominal_lens.fx, camera.nominal_lens.fy)
    return 2 * damage.reach_mm + 2 * (camera.optics.margin_px + BEYOND_PX + AROUND_PX) * pitch_mm


def _near(unit: SimulatedUnit, board: custom.TargetConfig) -> np.ndarray:
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
    return np.asarray(np.linalg.norm(on_plane - centre, axis=-1) < damage.reach_mm * MM + reach_m)
