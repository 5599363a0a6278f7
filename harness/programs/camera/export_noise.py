"""``tofpod export_noise CAMERA --out DIR``: writes a camera's noise as a table and a file of code.

The files are for simulators that render ideal depth (Isaac Sim, Gazebo, MuJoCo, BlenderProc):
``NAME.npz`` with the table, and ``depth_noise.py`` (NumPy or torch), a copy of
`scenes.sensor.common.tabled`, which states what is not modelled. The full model is measured on
planes of many brightnesses: deviation, returns, correlation of neighbours, fixed pattern."""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.vocabulary.program import program

if TYPE_CHECKING:
    from scenes.sensor.camera import AnyCamera

# albedo of the planes; outside the camera's range, darker or brighter planes stand for other
# distances
ALBEDO = 0.6
DARKEST = 0.02  # least albedo of the table
MEASURED = 2  # brightnesses measured per octave
PER_OCTAVE = 16  # table entries per octave, of which the nearest counts
FRAMES = 40  # frames of 3,000 pixels give a deviation to 1 %
FRAMES_OF_CORRELATION = 100
LONGEST_LAG = 12  # largest lag in pixels of the correlation of neighbours


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "camera", help="a camera's name (see tofpod ls), or the path of its .yaml file"
    )
    parser.add_argument(
        "--out", required=True, type=Path, metavar="DIR", help="folder for the three files"
    )


@program(
    _options,
    "Write a simulated camera's depth noise as a small table (NAME.npz) and as code for NumPy and "
    "torch that turns ideal depth and intensity into noisy depth, for use in other simulators.",
    "tofpod export_noise azure_kinect_nfov --out noise",
    "tofpod export_noise kinect_v2 --out noise",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.vocabulary.files import write_bytes, write_text
    from scenes.sensor.camera import load_camera
    from scenes.sensor.common import tabled

    camera = load_camera(options.camera)
    print(f"measuring the noise of {camera.title} ..", flush=True)
    table = noise_table(camera)
    file = io.BytesIO()
    np.savez_compressed(file, **table, command=np.array(command))  # type: ignore[arg-type]
    write_bytes(options.out / f"{camera.name}.npz", file.getvalue())
    code = Path(str(tabled.__file__)).read_text(encoding="utf-8")
    write_text(options.out / "depth_noise.py", code)
    is_returned = table["seen"] > 0.5
    low = 1000.0 * float(table["sigma_m"][is_returned][-1])
    high = 1000.0 * float(table["sigma_m"][is_returned][0])
    print(
        f"deviation of one frame {low:.3g} to {high:.3g} mm from bright to faint; fixed pattern "
        f"of a unit {1e3 * float(table['pattern_m']):.3g} mm"
    )
    print(f"wrote {options.out / camera.name}.npz, depth_noise.py")
    return 0


def noise_table(camera: AnyCamera) -> dict[str, np.ndarray]:
    """Return the arrays of `scenes.sensor.common.tabled.DepthNoise`.

    ``sigma_m`` and ``seen`` (n,) are the deviation and the probability of a return over log2 of
    intensity / range^2, from ``first`` on, with ``per_octave`` entries an octave. ``rows`` and
    ``columns`` are filters of the noise; ``pattern_rows`` and ``pattern_columns`` are those of the
    pattern, whose deviation is ``pattern_m``. ``slopes`` (h, w, 2) are those of the pixels' rays,
    ``falloff`` (h, w) is each pixel's light relative to the axis.
    """
    from scenes.sensor.calibration import with_number

    optics = camera.optics
    # the table rounds by itself
    fine = with_number(camera, "engine", "output_step_mm", 1e-3)
    nearest_m = max(1.05 * optics.nearest_m, 0.1)
    farthest_m = 0.95 * min(optics.farthest_m, 15.0)
    faintest = np.log2(DARKEST / farthest_m**2)
    brightest = np.log2(1.0 / nearest_m**2)
    levels = np.arange(faintest, brightest, 1.0 / MEASURED)
    measured = [_before_plane(fine, level, nearest_m, farthest_m) for level in levels]
    sigma_m, return_share = np.array(measured).T
    has_sigma = np.isfinite(sigma_m)
    fine_levels = np.arange(levels[0], levels[-1], 1.0 / PER_OCTAVE)
    sigma_m = np.exp(np.interp(fine_levels, levels[has_sigma], np.log(sigma_m[has_sigma])))
    middle_m = np.sqrt(nearest_m * min(farthest_m, 4.0))
    middle_index = int(np.argmin(np.abs(levels - np.log2(ALBEDO / middle_m**2))))
    stack_m = _stack_m(fine, levels[middle_index], nearest_m, farthest_m, FRAMES_OF_CORRELATION)
    residuals = stack_m - np.nanmean(stack_m, axis=0)
    pattern = _pattern_m(fine)
    slopes, falloff = _pixels(camera)
    return {
        "first": np.float32(levels[0]),
        "per_octave": np.float32(PER_OCTAVE),
        "sigma_m": sigma_m.astype(np.float32),
        "seen": np.interp(fine_levels, levels, return_share).astype(np.float32),
        "rows": _filter(residuals, axis=1),
        "columns": _filter(residuals, axis=2),
        "pattern_m": np.float32(np.sqrt(np.nanmean(pattern**2))),
        "pattern_rows": _filter(pattern, axis=1),
        "pattern_columns": _filter(pattern, axis=2),
        "slopes": slopes,
        "falloff": falloff,
        "step_m": np.float32(camera.z_step_m),
        "nearest_m": np.float32(optics.nearest_m),
        "farthest_m": np.float32(min(optics.farthest_m, 1e3)),
    }


def _stack_m(
    camera: AnyCamera, level: float, nearest_m: float, farthest_m: float, frames: int
) -> np.ndarray:
    """Return ranges (frames, h, w), NaN without a return, of a plane whose light has this
    level."""
    from scenes.sensor.calibration import unit_before_plane

    distance_m = float(np.clip(np.sqrt(ALBEDO / 2.0**level), nearest_m, farthest_m))
    albedo = float(min(distance_m**2 * 2.0**level, 1.0))
    unit = unit_before_plane(camera, distance_m, albedo)
    capture = unit.capture(frames, 1, "noise table")
    z_m = np.stack([frame.z_m for frame in capture.frames()]).astype(float)
    stretch = np.sqrt(1.0 + (unit.view.slopes[unit.cut] ** 2).sum(axis=-1))
    return np.asarray(z_m * stretch)


def _before_plane(
    camera: AnyCamera, level: float, nearest_m: float, farthest_m: float
) -> tuple[float, float]:
    """Return the deviation of a pixel's range (NaN if there are hardly any returns) and the share
    of returns."""
    range_m = _stack_m(camera, level, nearest_m, farthest_m, FRAMES)
    valid = np.isfinite(range_m)
    often = valid.sum(axis=0) > FRAMES // 4
    return_share = float(valid.mean())
    if not often.any():
        return float("nan"), return_share
    # a robust deviation excludes ranges with a wrong period, which are rare and far off
    middle = np.nanmedian(range_m[:, often], axis=0)
    deviation_m = np.abs(range_m[:, often] - middle)
    kept = deviation_m < 8.0 * np.nanmedian(deviation_m) / 0.6745
    variance_m2 = np.mean(deviation_m[kept] ** 2) * FRAMES / (FRAMES - 1)
    return float(np.sqrt(variance_m2)), return_share


def _pattern_m(camera: AnyCamera) -> np.ndarray:
    """Return the range (units, h, w) that the fixed pattern of several units adds on a plane."""
    from harness.vocabulary.geometry import Region
    from scenes.closed_form import plane_view
    from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
    from scenes.sensor.source import SimulatedUnit

    lens = camera.nominal_lens
    row = int(lens.cy)
    column = int(lens.cx)
    half_h = min(80, row - 8, lens.height - row - 8)
    half_w = min(100, column - 8, lens.width - column - 8)
    region = Region(row - half_h, row + half_h, column - half_w, column + half_w)
    view = plane_view(camera, region, 1.0, ALBEDO)
    patterns_m = []
    for seed in (1, 2, 3):
        ranges = []
        for has_pattern in (True, False):
            effects = NO_EFFECTS.model_copy(update={"fixed_pattern": has_pattern})
            config = CameraConfig(name=camera.name, unit_seed=seed, effects=effects)
            unit = SimulatedUnit(camera, config, view)
            frame = next(iter(unit.capture(1, 1).frames()))
            ranges.append(frame.z_m.astype(float))
        patterns_m.append(ranges[0] - ranges[1])
    return np.asarray(patterns_m)


def _filter(images: np.ndarray, axis: int) -> np.ndarray:
    """Return the filter taps that give white noise the mean correlation of the images (n, h, w)
    along an axis."""
    from scenes.sensor.common.unit import taps_of

    images = np.moveaxis(np.nan_to_num(images), axis, -1)
    products = [
        np.mean(images[..., lag:] * images[..., : images.shape[-1] - lag])
        for lag in range(LONGEST_LAG + 1)
    ]
    return taps_of(np.asarray(products) / max(products[0], 1e-30))


def _pixels(camera: AnyCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return each pixel's slopes (h, w, 2) and its light relative to the axis (h, w), 0 for unlit
    pixels."""
    from scenes.sensor.amcw.facts import AmcwCamera
    from scenes.sensor.amcw.imager import AmcwImager
    from scenes.sensor.common.config import CameraConfig

    lens = camera.nominal_lens
    slopes = lens.region_slopes(lens.whole)
    if not isinstance(camera, AmcwCamera):
        return slopes.astype(np.float32), np.ones(slopes.shape[:2], np.float32)
    model = AmcwImager(camera, CameraConfig(name=camera.name), lens.whole, slopes)
    lit = np.where(model.outside_mask, 0.0, model.gathered * camera.optics.cone(slopes))
    return slopes.astype(np.float32), lit.astype(np.float32)


if __name__ == "__main__":
    raise SystemExit(main())
