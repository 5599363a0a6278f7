"""Captures from files of arrays: which array holds the distances, and what its axes mean; height
maps; bare numbers.

The libraries that read them run within `files.limited_memory`. Arrays of objects, which would need
pickle, are refused. A height map's pixels are a stated pitch apart. It becomes a cloud in parallel
projection: x and y count from its middle; z points away from the viewer and is `DISTANCE_M` at the
median height. If no unit is stated, the program takes micrometres, millimetres or metres,
whichever makes the relief a plausible share of the extent."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from detectors.recordings.distances import UNITS_M, default_metres, frame_of, refuse_narrow
from detectors.recordings.exr import load_exr
from detectors.recordings.intrinsics import lens_for
from detectors.recordings.recording import CaptureOptions, Recording, read_errors
from harness.vocabulary import files
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RAISE, refuse_bytes, refuse_pixels
from harness.vocabulary.geometry import Frame, Lens, Reason
from harness.vocabulary.program import length_m

LEGAL_ARRAYS = "numeric arrays as written by numpy.save or numpy.savez, without objects"
LEGAL_MAT = (
    "MATLAB 5 to 7 files (-v6, -v7) of numeric arrays: Location (h, w, 3), (n, 3) or (k, n, 3), "
    "and Color"
)
LEGAL_RAW = (
    "--raw WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]: TYPE u2 (the default), >u2, u4, f4 ..; "
    "STEP bytes from pixel to pixel; BYTES before the first frame"
)
LEGAL_PICTURES = (
    "a page or more of one channel in 16 bits or floating point, or of x, y, z in floating point"
)
EXPORT = "Location = pc.Location; Color = pc.Color; save('cloud.mat','Location','Color','-v7')"
"""The MATLAB line that saves a point cloud ``pc`` as arrays."""

Arrays = Mapping[str, np.ndarray]
ArraysLoader = Callable[[Path], Arrays]
"""Function that loads a file's arrays by name; the name of a single array without a name is ""."""


def load_npy(path: Path) -> dict[str, np.ndarray]:
    """Map an ``.npy`` file. Raises UserError if it is broken or holds objects."""
    with read_errors(f"{path}: cannot be read as arrays", LEGAL_ARRAYS):
        return {"": np.lib.format.open_memmap(path, mode="r")}


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by name. Raises UserError if it is broken, too large,
    or has objects."""
    with read_errors(f"{path}: cannot be read as arrays", LEGAL_ARRAYS):
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(entry.file_size for entry in archive.infolist())
        fix = f"save its frames as .npy, which is not unpacked; {RAISE}"
        refuse_bytes(str(path), unpacked, files.ARRAYS_BYTES, "unpacks to", fix)
        with np.load(path, allow_pickle=False) as archived:
            return {name: np.asarray(archived[name]) for name in archived}


def load_mat(path: Path) -> dict[str, np.ndarray]:
    """Return the numeric arrays of a ``.mat`` file by name; (h, w, 3, k) has its frames moved
    first. Raises UserError for -v7.3 (HDF5), for objects such as ``pointCloud``, and for a broken
    file."""
    import scipy.io

    fix = f"save it with '-v7', not '-v7.3'; save the arrays of a point cloud pc: {EXPORT}"
    flat = []
    with read_errors(f"{path}: cannot be read as a MATLAB file", LEGAL_MAT, fix):
        try:
            for name, _, kind in scipy.io.whosmat(path):
                # cells and structs hold no frames, and deeply nested ones end the process without
                # a message
                if kind not in ("cell", "struct"):
                    flat.append(name)
        except TypeError as error:
            problem = "it holds a MATLAB object, which cannot be read outside MATLAB"
            raise ValueError(problem) from error
        loaded = scipy.io.loadmat(path, variable_names=flat)
    arrays = {}
    for name, value in loaded.items():
        # MATLAB's scalars are 1 x 1 arrays; text has another kind
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size > 1:
            if value.ndim == 4 and value.shape[2] == 3 and value.shape[3] != 3:
                value = np.moveaxis(value, -1, 0)
            arrays[name] = value
    if not arrays:
        raise UserError(f"{path}: holds no numeric array", legal=LEGAL_MAT, fix=fix)
    return arrays


def load_picture(path: Path) -> dict[str, np.ndarray]:
    """Return a TIFF's pages, or a PFM, of numbers or x, y, z. Raises UserError for broken files
    and pictures."""
    level = cv2.utils.logging.getLogLevel()
    # the messages below replace its output
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with read_errors(f"{path}: cannot be read", LEGAL_PICTURES):
            is_read, pages = cv2.imreadmulti(str(path), flags=cv2.IMREAD_UNCHANGED)
            if not is_read or not pages:
                raise ValueError("it is damaged, or its type does not match its name")
            stack = np.stack(pages)
            if stack.ndim == 4 and (stack.dtype.kind != "f" or stack.shape[3] != 3):
                raise ValueError(f"{stack.shape[3]} channels of {stack.dtype}, which is a picture")
    finally:
        cv2.utils.logging.setLogLevel(level)
    if stack.ndim == 4:
        stack = stack[..., ::-1]  # OpenCV gives the last channel first
    return {"": stack}


SENSOR_SIZES = (
    (640, 576),
    (320, 288),
    (512, 512),
    (1024, 1024),
    (640, 480),
    (512, 424),
    (320, 240),
    (224, 172),
    (224, 171),
    (256, 192),
    (160, 120),
    (240, 180),
    (1024, 768),
    (1280, 720),
    (848, 480),
    (1280, 960),
    (1280, 1024),
)  # (width, height) of the depth images of usual cameras
SAME_SCENE = 0.05  # largest relative difference of the median pixel between successive frames
SEVERAL = 8  # number of frames examined for it
NEIGHBOURS = 0.1
"""Largest difference between neighbours: rows of a flat floor differ by 1 %, noise by less; a
wrong layout by 100 %."""


@dataclass(frozen=True)
class RawLoader:
    """Loads whole frames of bare numbers, row by row, from a file."""

    # size of a frame, pixels
    width: int
    height: int
    # numpy's name of the numbers' type
    kind: str
    # bytes from pixel to pixel: more than a number's if brightness and confidence lie between
    step: int
    # bytes before the first frame
    offset: int

    @classmethod
    def stated(cls, text: str) -> RawLoader:
        """Parse WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]. Raises UserError for anything else."""
        match = re.fullmatch(
            r"(\d{1,5})x(\d{1,5})(?::([<>]?[uif][248])(?:/(\d{1,3}))?)?(?::(\d{1,12}))?", text
        )
        if match is None:
            raise UserError(f"--raw {text}: is not a layout", legal=LEGAL_RAW)
        width, height, kind, step, offset = match.groups()
        refuse_pixels(f"--raw {text}", int(width), int(height))
        kind = kind or "u2"
        if kind[0] not in "<>":
            kind = f"<{kind}"
        item_bytes = np.dtype(kind).itemsize
        if int(step or item_bytes) < item_bytes:
            problem = f"--raw {text}: a number of {item_bytes} bytes in every {step}"
            raise UserError(problem, legal=LEGAL_RAW)
        return cls(
            width=int(width),
            height=int(height),
            kind=kind,
            step=int(step or item_bytes),
            offset=int(offset or 0),
        )

    @property
    def _frame_bytes(self) -> int:
        return self.width * self.height * self.step

    def __call__(self, path: Path) -> dict[str, np.ndarray]:
        """Map the frames (n, h, w). Raises UserError if there is none."""
        size = path.stat().st_size - self.offset
        frame_bytes = self._frame_bytes
        if size < frame_bytes:
            problem = (
                f"{path}: has {size} bytes from byte {self.offset} on, but a frame of "
                f"{self.width} x {self.height} numbers in steps of {self.step} bytes "
                f"needs {frame_bytes}"
            )
            raise UserError(problem, legal=LEGAL_RAW)
        count = size // frame_bytes
        content = np.memmap(path, np.uint8, "r", self.offset, (count * frame_bytes,))
        frames = np.ndarray(
            (count, self.height, self.width),
            np.dtype(self.kind),
            content,
            strides=(frame_bytes, self.width * self.step, self.step),
        )
        return {"": frames}

    def refuse_doubtful(self, path: Path, frames: np.ndarray) -> int:
        """Return the number of bytes after the last frame. Raises UserError if neighbours differ
        too much."""
        rough = _apart(frames[0][:, 1:], frames[0][:, :-1])
        if not rough < NEIGHBOURS:
            problem = (
                f"{path}: in this layout the median pixel differs from its neighbour by "
                f"{100 * rough:.3g} %: this layout is wrong"
            )
            raise UserError(problem, legal=LEGAL_RAW, fix=raw_layout_of(path).fix)
        return (path.stat().st_size - self.offset) % self._frame_bytes


def raw_layout_of(path: Path) -> UserError:
    """Return the error for a file of bare numbers, with the layouts of common cameras that fit its
    size."""
    size = path.stat().st_size
    two_bytes = []
    other_bytes = []
    for width, height in SENSOR_SIZES:
        pixels = width * height
        if size % pixels or size < 2 * pixels:
            continue
        layout = f"--raw {width}x{height}"
        pixel_bytes = size // pixels
        if pixel_bytes == 2:
            two_bytes.append(layout)
        elif pixel_bytes < 17:
            other_bytes.append(f"{layout}:u2/{pixel_bytes}")
        else:  # several frames
            other_bytes.append(layout)
    fitting = " or ".join([*two_bytes, *other_bytes][:4])
    fix = "state the layout"
    if fitting:
        fix += f"; its size fits {fitting}"
    return UserError(f"{path}: the layout of its {size} bytes is unknown", legal=LEGAL_RAW, fix=fix)


LOADERS: dict[str, ArraysLoader] = {
    ".npy": load_npy,
    ".npz": load_npz,
    ".mat": load_mat,
    ".tif": load_picture,
    ".tiff": load_picture,
    ".pfm": load_picture,
    ".exr": load_exr,
}
DISTANCE_NAMES = ("depth", "z", "z_mm", "depth_mm", "xyz", "points", "location")
COLOUR_NAMES = ("rgb", "color", "colour", "colors")
AMPLITUDE_NAMES = ("amplitude", "ir", "intensity")
LEGAL_AXES = (
    "depth (h, w) or (n, h, w); points (h, w, 3), (n, h, w, 3) or, without a pixel grid, "
    "(n_points, 3)"
)
FEWEST_ROWS = 8  # of an image; an array with fewer rows is a table of points
FRAMES_OF_POINTS = 20
"""(a, b, 3) counts as a frames of b points, not as a grid, from b = 20 a on: no sensor is that
wide."""


class Stack(NamedTuple):
    """The frames in a file of arrays."""

    # distances (n, h, w) or points (n, h, w, 3), as they are stored
    distances: np.ndarray
    # (n, h, w, 3) uint8
    rgb: np.ndarray | None
    # (n, h, w) float32
    amplitude: np.ndarray | None
    # whether there is a pixel grid
    organised: bool
    # how the axes were interpreted, "" if they are usual
    note: str


"""Distances (n, h, w) or points (n, h, w, 3), colour, amplitude; whether there is a pixel grid; a
note on the axes."""


def open_arrays(path: Path, options: CaptureOptions) -> Recording:
    """Open a file of arrays: frames or, with a pitch, a height map. Raises UserError if no array
    or several fit."""
    load = LOADERS[path.suffix.lower()] if options.raw is None else RawLoader.stated(options.raw)
    if options.pitch is not None:
        return _open_height_map(path, load, options)
    first = _stack(path, load, options)
    distances = first.distances
    left_over = load.refuse_doubtful(path, distances) if isinstance(load, RawLoader) else 0
    lens: Lens | None = None
    lens_files: tuple[Path, ...] = ()
    if distances.ndim == 3:
        _refuse_other_planes(str(path), options.array or "", distances, left_over)
        _, height, width = distances.shape
        hint = "; for a height map, state the distance between its pixels: --pitch 0.5mm"
        beside = [path.parent, path.parent.parent]
        lens, lens_files = lens_for(str(path), options, width, height, beside=beside, hint=hint)
    scale_m = options.scale_m or default_metres(distances.dtype)

    def read() -> Iterator[Frame]:
        # ``.npy`` is mapped, not read; ``.npz`` and ``.mat`` are unpacked whole
        stack = _stack(path, load, options)
        for i, stored in enumerate(stack.distances):
            rgb = None if stack.rgb is None else stack.rgb[i]
            amplitude = None if stack.amplitude is None else stack.amplitude[i]
            yield frame_of(f"{path.name} frame {i}", np.asarray(stored), scale_m, rgb, amplitude)

    return Recording.begun(
        path.name,
        read,
        scale_m,
        is_whole=distances.dtype.kind in "iu",
        files=(path, *lens_files),
        lens=lens,
        organised=first.organised,
        notes=(first.note,),
    )


def open_array_list(paths: Sequence[Path], options: CaptureOptions, name: str) -> Recording:
    """Open files of arrays of one kind as one capture, in the order given. Raises UserError as
    `open_arrays` does."""
    first = open_arrays(paths[0], options)

    def read() -> Iterator[Frame]:
        for path in paths:
            yield from open_arrays(path, options).read()

    return replace(first, name=name, read=read, files=(*paths, *first.files[1:]))


def _refuse_other_planes(name: str, key: str, frames: np.ndarray, left_over: int) -> None:
    """Raise UserError if the first planes (n, h, w) are not frames of one scene, but x and y,
    colour or amplitude."""
    worst = 0.0
    for before, after in pairwise(frames[:SEVERAL]):
        difference = _apart(before, after)
        if math.isfinite(difference):
            worst = max(worst, difference)
    if len(frames) > 1 and (left_over or not worst < SAME_SCENE):
        remainder = f" and {left_over} bytes more" if left_over else ""
        problem = (
            f"{name}: {len(frames)} planes{remainder}; the median pixel differs by "
            f"{100 * worst:.3g} % from plane to plane: depth beside x and y, colour, brightness "
            "or confidence?"
        )
        fix = f"choose the plane that holds depth by its number from 0: --array {key}:N"
        raise UserError(problem, legal="frames of one scene, or one plane", fix=fix)


def _stack(path: Path, load: ArraysLoader, options: CaptureOptions) -> Stack:
    """Find the distances among a file's arrays, with colour and amplitude, and put the frame axis
    first."""
    arrays = load(path)
    name, array = _named_array(str(path), arrays, DISTANCE_NAMES, options.array)
    if array.size == 0:
        raise UserError(f"{name}: is empty {array.shape}", legal=LEGAL_AXES)
    # (n, 1, h, w) or (n, h, w, 1), as networks take images
    if array.ndim == 4 and 1 in array.shape[1::2]:
        array = array.squeeze(axis=1 if array.shape[1] == 1 else 3)
    note = ""
    if _frames_are_last(array):
        note = f"{name} {array.shape}: the frames are assumed to lie along the last axis"
        array = np.moveaxis(array, -1, 0)
    has_points, shape, organised = _axes(name, array.shape, options.lens)
    refuse_pixels(name, shape[2], shape[1])
    pixels = math.prod(shape)
    rgb = _companion(arrays, COLOUR_NAMES, 3 * pixels)
    if rgb is not None:
        if rgb.dtype.kind == "f":
            # floating-point colours run from 0 to 1 or to 255
            levels = rgb * 255.0 if np.nanmax(rgb) <= 1.0 else rgb
            rgb = np.nan_to_num(np.clip(np.rint(levels), 0, 255))
        rgb = rgb.astype(np.uint8).reshape(*shape, 3)
    amplitude = _companion(arrays, AMPLITUDE_NAMES, pixels)
    if amplitude is not None:
        amplitude = amplitude.reshape(shape).astype(np.float32)
    distances = array.reshape((*shape, 3) if has_points else shape)
    return Stack(distances, rgb, amplitude, organised, note=note)


def _companion(arrays: Arrays, names: Sequence[str], size: int) -> np.ndarray | None:
    """Return the first array with one of the names, in any case, if it has this size."""
    numeric = {key.lower(): value for key, value in arrays.items() if value.dtype.kind in "biuf"}
    for key in names:
        if key in numeric:
            return numeric[key] if numeric[key].size == size else None
    return None


def _frames_are_last(array: np.ndarray) -> bool:
    """Return whether an array (h, w, n) holds depth images along its last axis, as MATLAB stacks
    them. With three planes, the content decides: x, y and z of points are not nearly equal
    everywhere, repeated distances are."""
    if not _is_deep(array):
        return False
    if array.shape[2] != 3:
        return True
    last = array[..., 2]
    return all(_apart(array[..., k], last) < SAME_SCENE for k in (0, 1))


def _is_deep(array: np.ndarray) -> bool:
    return array.ndim == 3 and 2 * array.shape[2] <= min(array.shape[:2])


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    """Return the median relative difference where both have a number; infinity if there is none."""
    is_common = (first > 0) & (second > 0)
    if not is_common.any():
        return float("inf")
    before = first[is_common].astype(np.float64)
    after = second[is_common].astype(np.float64)
    return float(np.median(np.abs(before - after) / before))


def _named_array(
    name: str,
    arrays: Arrays,
    usual: Sequence[str],
    selector: str | None,
) -> tuple[str, np.ndarray]:
    """Return (name, array): the one that NAME[:NUMBER] selects, else one with a usual name, else
    the only one."""
    shapes = [f"{key} {value.shape}".strip() for key, value in arrays.items()]
    contents = ", ".join(shapes) or "nothing"
    key, _, number = (selector or "").partition(":")
    key = key or _likely_key(name, arrays, usual, contents)
    if key not in arrays:
        fix = f"--array {next(iter(arrays), '')}"
        raise UserError(f"{name}: holds no array {key}", legal=contents, fix=fix)
    array = arrays[key]
    if key:
        name = f"{name}: {key}"
    if number:
        if _is_deep(array) and array.shape[2] != 3:
            array = np.moveaxis(array, -1, 0)
        if not number.isdigit() or array.ndim < 3 or int(number) >= len(array):
            problem = f"--array {selector}: no such part of {name} {array.shape}"
            raise UserError(problem, legal="NAME, or NAME:0 onwards")
        array = array[int(number)]
        name = f"{name}:{number}" if key else f"{name}: :{number}"
    refuse_narrow(name, array.dtype)
    return name, array


def _likely_key(name: str, arrays: Arrays, usual: Sequence[str], contents: str) -> str:
    """Return the name of the only array that may hold the depth. Raises UserError if there are
    none or several."""
    candidates = [key for key in arrays if key.lower() in usual]
    candidates = candidates or [key for key in arrays if "depth" in key.lower()] or list(arrays)
    if len(candidates) == 1:
        return candidates[0]
    fix = None
    if candidates:
        fix = f"choose one, for instance --array {candidates[0]} (add --pitch for a height map)"
    raise UserError(
        f"{name}: no array, or several arrays, that could be the depth (it holds {contents})",
        legal=f"one array named {', '.join(usual)}; {LEGAL_AXES}",
        fix=fix,
    )


def _axes(
    name: str,
    shape: tuple[int, ...],
    lens: Lens | None,
) -> tuple[bool, tuple[int, int, int], bool]:
    """Return (holds points, (n, h, w), has a pixel grid) of an array's shape."""
    dimensions = len(shape)
    is_lists = False
    if shape[-1:] == (3,):
        is_wide = dimensions == 3 and shape[1] >= FRAMES_OF_POINTS * shape[0]
        is_lists = dimensions == 2 or is_wide
    if is_lists:
        frames, points = (1, *shape[:-1])[-2:]
        if lens is not None and points == lens.width * lens.height:
            return True, (frames, lens.height, lens.width), True
        return True, (frames, 1, points), False
    has_points = dimensions in (3, 4) and shape[-1] == 3
    is_table = dimensions == 2 and min(shape) < FEWEST_ROWS
    is_stack_of_stacks = dimensions == 4 and not has_points
    if is_stack_of_stacks or dimensions not in (2, 3, 4) or is_table:
        fix = None
        if is_table:
            fix = "if rows hold more numbers than x, y and z, save only these: array[:, :3]"
        raise UserError(f"{name}: a shape of {shape} is not a capture", legal=LEGAL_AXES, fix=fix)
    n, height, width = (1, 1, *(shape[:-1] if has_points else shape))[-3:]
    return has_points, (n, height, width), True


HEIGHT_NAMES = ("height", "heights", "heightmap", "height_map", "elevation", "dem", "map", "h", "z")
DOWN_NAMES = (
    "depth",
    "distance",
    "range",
    "z_depth",
)  # names of arrays whose numbers grow away from the viewer
DISTANCE_M = 1.0
RELIEF = (5e-4, 0.5)
"""Plausible relief (1st to 99th percentile) over the map's shorter side: of two units, 1000 apart,
only one fits."""


def _open_height_map(path: Path, load: ArraysLoader, options: CaptureOptions) -> Recording:
    """Open a height map. Raises UserError if the array is not a single map, or its unit cannot be
    determined."""
    pitch_m = _pitch_m(options.pitch or "")
    name, heights = _map_in(path, load, options.array)
    finite_heights = heights[np.isfinite(heights)].astype(np.float64)
    if finite_heights.size == 0:
        legal = "numbers, and NaN where there is no height"
        raise UserError(f"{name}: has no finite height", legal=legal)
    relief = float(np.ptp(np.quantile(finite_heights, (0.01, 0.99))))
    height, width = heights.shape
    side_m = min(height, width) * pitch_m
    span = f"{relief:.4g} over {1e3 * side_m:.4g} mm"
    scale_m = options.scale_m
    if scale_m is None:
        scale_m = _height_unit_m(relief, side_m)
    if scale_m is None:
        problem = f"{name}: the unit of its heights is not stated: they span {span}"
        raise UserError(problem, fix="state it: --unit mm, --unit m or --unit um")
    is_down = name.rpartition(" ")[2].partition(":")[0].lower() in DOWN_NAMES
    signed_m = -scale_m
    direction = "grow towards the viewer: holes are low"
    if is_down:
        signed_m = scale_m
        direction = "grow away from the viewer, as its name says"
    note = (
        f"height map {name}: {width} x {height} pixels of {1e3 * pitch_m:.4g} mm; "
        f"its numbers {direction}"
    )
    return Recording(
        name=path.name,
        read=partial(_map_frames, path, load, options.array, pitch_m, signed_m),
        shape=(height, width),
        scale_m=scale_m,
        # whole numbers were rounded, others were not
        z_step_m=0.0 if (finite_heights % 1).any() else scale_m,
        files=(path,),
        notes=(note, f"the median height lies at z = {1e3 * DISTANCE_M:g} mm"),
        unit_from=f"the map's relief, {span} (--unit states another)",
        projection="parallel",
    )


def _pitch_m(text: str) -> float:
    """Parse the distance between a map's pixels, metres. Raises UserError for anything else."""
    pitch_m = length_m("--pitch", text)
    if not 1e-7 <= pitch_m <= 1:
        raise UserError(f"--pitch {text}: is no distance between pixels", legal="0.1um to 1m")
    return pitch_m


def _height_unit_m(relief: float, side_m: float) -> float | None:
    """Return the unit in which a relief is plausible over a map's shorter side, None if none is."""
    for unit in ("mm", "m", "um"):
        if RELIEF[0] <= relief * UNITS_M[unit] / side_m < RELIEF[1]:
            return UNITS_M[unit]
    return None


def _map_frames(
    path: Path,
    load: ArraysLoader,
    array: str | None,
    pitch_m: float,
    scale_m: float,
) -> Iterator[Frame]:
    """Yield the map as a frame. If ``scale_m`` is below 0, heights grow towards the viewer."""
    name, heights = _map_in(path, load, array)
    is_finite = np.isfinite(heights)
    z_m = scale_m * heights.astype(np.float64)
    z_m += DISTANCE_M - (np.median(z_m[is_finite]) if is_finite.any() else 0.0)
    z_m[~is_finite] = np.nan
    rows, columns = heights.shape
    v, u = np.mgrid[:rows, :columns]
    x_px = u - (columns - 1) / 2
    y_px = v - (rows - 1) / 2
    xy_m = np.stack([x_px, y_px], axis=-1) * pitch_m
    xy_m[~is_finite] = np.nan
    reason = np.where(is_finite, Reason.VALID, Reason.NO_RETURN).astype(np.uint8)
    yield Frame(name, z_m.astype(np.float32), reason, xy_m=xy_m)


def _map_in(path: Path, load: ArraysLoader, array: str | None) -> tuple[str, np.ndarray]:
    """Return the name and the map (h, w). Raises UserError for several maps, which are not frames
    of one capture."""
    name, values = _named_array(str(path), load(path), (*HEIGHT_NAMES, *DOWN_NAMES), array)
    if values.ndim == 3 and values.shape[0] == 1:
        values = values[0]
    if values.ndim == 3:
        count, rows, columns = values.shape
        key = (array or "").partition(":")[0]
        raise UserError(
            f"{name}: {count} maps of {columns} x {rows} pixels",
            legal="one map: different maps are not averaged",
            fix=f"choose one by its number: --array {key}:0",
        )
    if values.ndim != 2 or min(values.shape) < 2:
        legal = "(h, w), or (n, h, w) with --array NAME:NUMBER"
        raise UserError(f"{name}: a shape of {values.shape} is not a height map", legal=legal)
    refuse_pixels(name, values.shape[1], values.shape[0])
    return name, values
