"""Captures in files of arrays: which array holds the distances, and the meaning of its axes. Height maps too.

A height map of a profiler has no lens: its pixels lie a stated pitch apart, and it is a cloud in parallel projection.
x and y count from its middle, and z, which points away from the viewer, is `DISTANCE_M` at the median height. Without a
stated unit, micrometres, millimetres or metres are taken, whichever gives the relief a plausible part of the extent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from detectors.recordings.array_files import ArraysLoader, RawLoader, load_mat, load_npy, load_npz
from detectors.recordings.distances import UNITS_M, default_metres, frame_of, refuse_narrow, rounding_step_m
from detectors.recordings.intrinsics import lens_beside, lens_for
from detectors.recordings.recording import Asked, Recording
from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import refuse_pixels

LOADERS: dict[str, ArraysLoader] = {".npy": load_npy, ".npz": load_npz, ".mat": load_mat}
DISTANCE_NAMES = ("depth", "z", "z_mm", "depth_mm", "xyz", "points", "location")
COLOUR_NAMES = ("rgb", "color", "colour", "colors")
AMPLITUDE_NAMES = ("amplitude", "ir", "intensity")
LEGAL_AXES = "depth (h, w) or (n, h, w); points (h, w, 3), (n, h, w, 3) or, without a pixel grid, (n_points, 3)"
FRAMES_OF_POINTS = 20
"""(a, b, 3) is taken for a frames of b points, not for a grid, from b = 20 a on: no sensor is that wide."""


@dataclass(frozen=True)
class Stack:
    """One file's arrays with the frame axis first: ``distances`` (n, h, w) depth or (n, h, w, 3) points."""

    distances: np.ndarray
    rgb: np.ndarray | None
    amplitude: np.ndarray | None
    organised: bool


def open_arrays(path: Path, asked: Asked) -> Recording:
    """Open a file of arrays: the frames of a capture, or with a pitch a height map.

    Raises UserError where no array, or more than one, could be meant, and where its axes are no capture's.
    """
    load = RawLoader.stated(asked.raw) if asked.raw is not None else LOADERS[path.suffix.lower()]
    if asked.pitch is not None:
        return _open_height_map(path, load, asked)
    stack = _stack(path, load, asked)
    if isinstance(load, RawLoader):
        load.refuse_doubtful(path, stack.distances)
    height, width = stack.distances.shape[1:3]
    lens: Lens | None = None
    files: tuple[Path, ...] = ()
    if stack.distances.ndim == 3:
        own = partial(lens_beside, [path.parent], width, height)
        hint = "; of a height map, the distance between its pixels: --pitch 0.5mm"
        lens, files = lens_for(str(path), asked, width, height, own, hint)
    scale_m = asked.scale_m or default_metres(stack.distances.dtype)
    read = partial(_frames, path, load, asked, scale_m)
    is_whole = stack.distances.dtype.kind in "iu"
    step_m = scale_m if is_whole else rounding_step_m(next(read()).z_m)
    return Recording(path.name, read, (height, width), scale_m, step_m, (path, *files), lens, stack.organised)


def _frames(path: Path, load: ArraysLoader, asked: Asked, scale_m: float) -> Iterator[Frame]:
    """Yield the frames of one file. ``.npy`` is mapped, not read; ``.npz`` and ``.mat`` are unpacked whole."""
    stack = _stack(path, load, asked)
    for i, stored in enumerate(stack.distances):
        rgb = stack.rgb[i] if stack.rgb is not None else None
        amplitude = stack.amplitude[i] if stack.amplitude is not None else None
        yield frame_of(f"{path.name} frame {i}", np.asarray(stored), scale_m, rgb, amplitude)


def _stack(path: Path, load: ArraysLoader, asked: Asked) -> Stack:
    """Find the distances among a file's arrays, with colour and amplitude, and put the frame axis first."""
    arrays = load(path)
    name, array = _named_array(str(path), arrays, DISTANCE_NAMES, asked.array)
    refuse_narrow(name, array.dtype)
    if array.size == 0:
        raise UserError(f"{name}: is empty {array.shape}", legal=LEGAL_AXES)
    has_points, shape, organised = _axes(name, array.shape, asked.lens)
    refuse_pixels(name, shape[2], shape[1])
    beside = {key.lower(): value for key, value in arrays.items() if value.dtype.kind in "biuf"}
    rgb = next((beside[key] for key in COLOUR_NAMES if key in beside), None)
    if rgb is not None and rgb.size == 3 * math.prod(shape):
        if rgb.dtype.kind == "f":
            rgb = np.nan_to_num(np.clip(np.rint(rgb * 255.0 if np.nanmax(rgb) <= 1.0 else rgb), 0, 255))
        rgb = rgb.astype(np.uint8).reshape(*shape, 3)
    else:
        rgb = None
    amplitude = next((beside[key] for key in AMPLITUDE_NAMES if key in beside), None)
    fits = amplitude is not None and amplitude.size == math.prod(shape)
    amplitude = amplitude.reshape(shape).astype(np.float32) if amplitude is not None and fits else None
    return Stack(array.reshape((*shape, 3) if has_points else shape), rgb, amplitude, organised)


def _named_array(
    name: str, arrays: Mapping[str, np.ndarray], usual: Sequence[str], asked: str | None
) -> tuple[str, np.ndarray]:
    """Return (what to call it, array): the one asked for as NAME[:NUMBER], else the only one with a usual name, else
    the only one. Raises UserError where none or several could be meant."""
    held = ", ".join(f"{key} {value.shape}".strip() for key, value in arrays.items()) or "nothing"
    key, _, number = (asked or "").partition(":")
    if not key:
        found = [key for key in arrays if key.lower() in usual]
        if not found and len(arrays) == 1:
            found = list(arrays)
        if len(found) != 1:
            what = "several arrays that could be the depth" if found else "no array that could be the depth"
            raise UserError(
                f"{name}: {what} (it holds {held})",
                legal="one array named " + ", ".join(usual) + "; " + LEGAL_AXES,
                fix=f"choose by --array NAME, for instance --array {(found or list(arrays))[0]}"
                " (of a height map with --pitch, the distance between its pixels)"
                if arrays
                else None,
            )
        (key,) = found
    if key not in arrays:
        raise UserError(f"{name}: holds no array {key}", legal=held, fix=f"--array {next(iter(arrays), '')}")
    array = arrays[key]
    if not number:
        return f"{name}: {key}" if key else name, array
    if not number.isdigit() or array.ndim < 3 or int(number) >= len(array):
        raise UserError(f"--array {asked}: no such part of {key or name} {array.shape}", legal="NAME, or NAME:0 and up")
    return f"{name}: {key}:{number}", array[int(number)]


def _axes(name: str, shape: tuple[int, ...], lens: Lens | None) -> tuple[bool, tuple[int, int, int], bool]:
    """Return (holds points, (n, h, w), has a pixel grid) of an array's shape.

    A list of points goes back on the lens' pixels where it has exactly as many.
    """
    is_lists = shape[-1:] == (3,) and (len(shape) == 2 or (len(shape) == 3 and shape[1] >= FRAMES_OF_POINTS * shape[0]))
    if is_lists:
        frames, points = (1, *shape[:-1])[-2:]
        if lens is not None and points == lens.width * lens.height:
            return True, (frames, lens.height, lens.width), True
        return True, (frames, 1, points), False
    has_points = len(shape) in (3, 4) and shape[-1] == 3
    n, *grid = (1, 1, *(shape[:-1] if has_points else shape))[-3:]
    if (len(shape) == 4 and not has_points) or len(shape) not in (2, 3, 4) or (len(shape) == 2 and min(shape) < 2):
        raise UserError(f"{name}: axes {shape} are no capture's", legal=LEGAL_AXES)
    return has_points, (n, grid[0], grid[1]), True


# ---- height maps -----------------------------------------------------------------------------------------------------

HEIGHT_NAMES = ("height", "heights", "heightmap", "height_map", "elevation", "dem", "map", "h", "z")
DOWN_NAMES = ("depth", "distance", "range", "z_depth")
"""Names of arrays whose numbers grow away from the viewer."""
DISTANCE_M = 1.0
RELIEF = (5e-4, 0.5)
"""Plausible relief (1st to 99th percentile) over the map's shorter side. Its ends are a factor of 1000 apart, as the
units are, so that no two fit: 0.12 mm to 12 cm of a map 24 cm wide."""


def _open_height_map(path: Path, load: ArraysLoader, asked: Asked) -> Recording:
    """Open a height map. Raises UserError where the array is no single map, or its unit cannot be told."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?(?:e-?\d+)?)\s*(um|mm|cm|m)", (asked.pitch or "").strip())
    pitch_m = float(match.group(1)) * UNITS_M[match.group(2)] if match else math.nan
    if not 1e-7 <= pitch_m <= 1:
        legal = "the distance between pixels with its unit, for instance 0.5mm, 200um or 0.001m"
        raise UserError(f"--pitch {asked.pitch}: no such length", legal=legal)
    name, heights = _map_in(path, load, asked.array)
    known = heights[np.isfinite(heights)].astype(np.float64)
    if known.size == 0:
        raise UserError(f"{name}: not one finite height", legal="numbers; NaN where there is none")
    relief = float(np.ptp(np.quantile(known, (0.01, 0.99))))
    height, width = heights.shape
    side_m = min(heights.shape) * pitch_m
    plausible = (UNITS_M[u] for u in ("mm", "m", "um") if RELIEF[0] <= relief * UNITS_M[u] / side_m < RELIEF[1])
    scale_m = next(plausible, None) if asked.scale_m is None else asked.scale_m
    if scale_m is None:
        raise UserError(
            f"{name}: nothing tells the unit of its heights: they span {relief:.4g} over {1e3 * side_m:.4g} mm",
            fix="state it: --unit mm, --unit m or --unit um",
        )
    is_down = name.rpartition(" ")[2].partition(":")[0].lower() in DOWN_NAMES
    direction = "grow away from the viewer, as its name says" if is_down else "grow towards the viewer: holes are low"
    return Recording(
        name=path.name,
        read=partial(_map_frames, path, load, asked.array, pitch_m, scale_m if is_down else -scale_m),
        shape=(height, width),
        scale_m=scale_m,
        z_step_m=0.0 if (known % 1).any() else scale_m,  # whole numbers were rounded, others were not
        files=(path,),
        projection="parallel",
        notes=(
            f"height map {name}: {width} x {height} pixels of {1e3 * pitch_m:.4g} mm; its numbers {direction}",
            f"the median height lies at z = {1e3 * DISTANCE_M:g} mm",
        ),
        unit_from=f"the map's relief, {relief:.4g} over {1e3 * side_m:.4g} mm (--unit states another)",
    )


def _map_frames(
    path: Path, load: ArraysLoader, array: str | None, pitch_m: float, signed_scale_m: float
) -> Iterator[Frame]:
    """Yield the map as a frame. ``signed_scale_m`` below 0: heights grow towards the viewer."""
    name, heights = _map_in(path, load, array)
    known = np.isfinite(heights)
    z_m = signed_scale_m * heights.astype(np.float64)
    z_m += DISTANCE_M - (np.median(z_m[known]) if known.any() else 0.0)
    z_m[~known] = np.nan
    v, u = np.mgrid[: heights.shape[0], : heights.shape[1]]
    xy_m = np.stack([u - (heights.shape[1] - 1) / 2, v - (heights.shape[0] - 1) / 2], axis=-1) * pitch_m
    xy_m[~known] = np.nan
    reason = np.where(known, Reason.VALID, Reason.NO_RETURN).astype(np.uint8)
    yield Frame(name, z_m.astype(np.float32), reason, xy_m=xy_m)


def _map_in(path: Path, load: ArraysLoader, array: str | None) -> tuple[str, np.ndarray]:
    """Return the name and the map (h, w). Raises UserError for several maps, which are no frames of one capture."""
    name, values = _named_array(str(path), load(path), (*HEIGHT_NAMES, *DOWN_NAMES), array)
    refuse_narrow(name, values.dtype)
    values = values[0] if values.ndim == 3 and values.shape[0] == 1 else values
    if values.ndim == 3:
        raise UserError(
            f"{name}: {values.shape[0]} maps of {values.shape[2]} x {values.shape[1]} pixels",
            legal="one map: different maps are not averaged",
            fix=f"choose one by its number: --array {(array or '').partition(':')[0]}:0",
        )
    if values.ndim != 2 or min(values.shape) < 2:
        raise UserError(
            f"{name}: axes {values.shape} are no height map's", legal="(h, w), or (n, h, w) with --array NAME:NUMBER"
        )
    refuse_pixels(name, values.shape[1], values.shape[0])
    return name, values
