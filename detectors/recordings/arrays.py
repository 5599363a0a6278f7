"""Arrays: ``.npy``, ``.npz`` and raw files, and the meaning of an array's axes that MATLAB files share."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.recordings.distances import (
    default_metres,
    frame_from_depth,
    frame_from_points,
    refuse_narrow,
    rounding_step_m,
)
from detectors.recordings.intrinsics import lens_file_beside, lens_of_size, no_lens, read_lens
from detectors.recordings.recording import Recording
from harness.vocabulary.archives import read_npy
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import refuse_pixels

DISTANCE_NAMES = ("depth", "z", "z_mm", "depth_mm", "xyz", "points", "location")
COLOUR_NAMES = ("rgb", "color", "colour", "colors")
AMPLITUDE_NAMES = ("amplitude", "ir", "intensity")
LEGAL_AXES = "depth (h, w) or (n, h, w); points (h, w, 3), (n, h, w, 3) or, without a pixel grid, (n_points, 3)"
LEGAL_RAW = (
    "--raw WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]: TYPE u2 (the default), >u2, u4, f4 ..; STEP bytes from pixel to pixel; "
    "BYTES before the first frame"
)
SENSOR_SIZES = (
    *((640, 576), (320, 288), (512, 512), (1024, 1024), (640, 480), (512, 424), (320, 240), (224, 172), (224, 171)),
    *((256, 192), (160, 120), (240, 180), (1024, 768), (1280, 720), (848, 480), (1280, 960), (1280, 1024)),
)
"""(width, height) of the depth images of usual cameras."""
SAME_SCENE = 0.05
"""Part of its distance by which the median pixel of two frames of one scene differs at most."""
NEIGHBOURS = 0.1
"""The same of neighbouring pixels: rows of a floor seen flat differ by 1 %, noise by less; a wrong layout by 100 %."""
FRAMES_OF_POINTS = 20
"""(a, b, 3) is taken for a frames of b points, not for a grid, from b = 20 a on: no sensor is that wide."""


@dataclass(frozen=True)
class Stack:
    """One file's arrays with the frame axis first: ``distances`` (n, h, w) depth or (n, h, w, 3) points."""

    distances: np.ndarray
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    organised: bool = True

    @property
    def has_points(self) -> bool:
        return self.distances.ndim == 4


ArraysLoader = Callable[[Path], Mapping[str, np.ndarray]]
"""Loads a file's arrays by name; the only array of a file without names is called ""."""


@dataclass(frozen=True)
class StackReader:
    """Yields the frames of one file. ``.npy`` is mapped, not read; ``.npz`` and ``.mat`` are unpacked whole. ``lens``
    tells apart a grid from a list of points where both fit."""

    path: Path
    scale_m: float
    load: ArraysLoader
    lens: Lens | None
    array: str | None = None

    def frames(self) -> Iterator[Frame]:
        stack = named_stack(str(self.path), self.load(self.path), self.lens, self.array)
        make = frame_from_points if stack.has_points else frame_from_depth
        for i, stored in enumerate(stack.distances):
            rgb = stack.rgb[i] if stack.rgb is not None else None
            amplitude = stack.amplitude[i] if stack.amplitude is not None else None
            yield make(f"{self.path.name} frame {i}", np.asarray(stored), self.scale_m, rgb=rgb, amplitude=amplitude)


def open_stack(
    path: Path,
    scale_m: float | None,
    intrinsics: Path | None,
    lens: Lens | None,
    load: ArraysLoader,
    array: str | None = None,
) -> Recording:
    """Open a file of arrays; ``array`` NAME or NAME:NUMBER chooses. Raises UserError where the axes are no capture's or
    a depth array has no lens."""
    stack = named_stack(str(path), load(path), lens, array)
    if isinstance(load, RawLoader):
        load.refuse_doubtful(path, stack.distances)
    height, width = stack.distances.shape[1:3]
    lens_file = None
    if not stack.has_points:
        lens_file = intrinsics or (None if lens else lens_file_beside(path.parent))
        lens = read_lens(lens_file, width, height) if lens_file else lens
        if lens is None:
            lacking = no_lens(str(path))
            fix = f"{lacking.fix}; of a height map, the distance between its pixels: --pitch 0.5mm"
            raise UserError(lacking.message, legal=lacking.legal, fix=fix)
        lens = lens_of_size(str(path), lens, width, height)
    given = scale_m or default_metres(stack.distances.dtype)
    reader = StackReader(path, given, load, lens, array)
    first = next(reader.frames())
    return Recording(
        name=path.name,
        reader=reader,
        region=Region(0, height, 0, width),
        scale_m=given,
        z_step_m=given if stack.distances.dtype.kind in "iu" else rounding_step_m(first.z_m),
        files=(path, *([lens_file] if lens_file else [])),
        lens=None if stack.has_points else lens,
        organised=stack.organised,
    )


def load_npy(path: Path) -> dict[str, np.ndarray]:
    """An ``.npy`` file, mapped. Raises UserError where it is broken, or holds objects (they would need pickle)."""
    return {"": read_npy(path)}


@dataclass(frozen=True)
class RawLoader:
    """Whole frames of ``width`` x ``height`` numbers, row by row, from a byte of a file on. ``step``: bytes from pixel
    to pixel, more than a number's where brightness and confidence stand between."""

    width: int
    height: int
    kind: str
    step: int
    offset: int

    @classmethod
    def stated(cls, text: str) -> RawLoader:
        """From WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]. Raises UserError for anything else."""
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})(?::([<>]?[uif][248])(?:/(\d{1,3}))?)?(?::(\d{1,12}))?", text)
        if match is None:
            raise UserError(f"--raw {text}: no such layout", legal=LEGAL_RAW)
        width, height, kind, step, offset = match.groups()
        refuse_pixels(f"--raw {text}", int(width), int(height))
        kind = kind or "u2"
        own = np.dtype(kind).itemsize
        if int(step or own) < own:
            raise UserError(f"--raw {text}: a number of {own} bytes in every {step}", legal=LEGAL_RAW)
        return cls(int(width), int(height), kind if kind[0] in "<>" else f"<{kind}", int(step or own), int(offset or 0))

    def __call__(self, path: Path) -> dict[str, np.ndarray]:
        """The frames (n, h, w), mapped. Raises UserError where there is none."""
        kind, size = np.dtype(self.kind), path.stat().st_size - self.offset
        frame = self.width * self.height * self.step
        if size < frame:
            raise UserError(
                f"{path}: has {size} bytes from byte {self.offset} on, but a frame of {self.width} x {self.height}"
                f" numbers in steps of {self.step} bytes needs {frame}",
                legal=LEGAL_RAW,
            )
        content = np.memmap(path, np.uint8, "r", self.offset, (size // frame * frame,))
        strides = (frame, self.width * self.step, self.step)
        return {"": np.ndarray((size // frame, self.height, self.width), kind, content, strides=strides)}

    def refuse_doubtful(self, path: Path, frames: np.ndarray) -> None:
        """Raise UserError where neighbours differ as no surface's do, or the planes are no frames of one scene."""
        first, last = (frames[i].astype(np.float64) for i in (0, -1))
        rough = _apart(first[:, 1:], first[:, :-1])
        if not rough < NEIGHBOURS:
            raise UserError(
                f"{path}: read so, the median pixel differs from its neighbour by {100 * rough:.3g} %: the layout is"
                " another",
                legal=LEGAL_RAW,
                fix=raw_layout_of(path).fix,
            )
        left_over = (path.stat().st_size - self.offset) % (self.width * self.height * self.step)
        apart = _apart(first, last)
        if len(frames) > 1 and (left_over or not apart < SAME_SCENE):
            raise UserError(
                f"{path}: {len(frames)} planes and {left_over} bytes more; the median pixel differs by"
                f" {100 * apart:.3g} % between the first and the last plane: depth beside brightness and confidence?",
                legal="frames of one scene, or one plane",
                fix="choose the plane with the depth: --array :0",
            )


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    """Median part by which the numbers of two arrays differ, of those where both have one; infinity without any."""
    both = (one > 0) & (other > 0)
    return float(np.median(np.abs(one - other)[both] / one[both])) if both.any() else float("inf")


def raw_layout_of(path: Path) -> UserError:
    """The message for a file of bare numbers: the layouts of usual cameras that its size fits."""
    size = path.stat().st_size
    layouts = {f"{w}x{h}": size // (w * h) for w, h in SENSOR_SIZES if size % (w * h) == 0 and size >= 2 * w * h}
    ranked = sorted(layouts, key=lambda wh: layouts[wh] != 2)[:4]
    fitting = " or ".join(f"--raw {wh}" + ("" if (n := layouts[wh]) == 2 else f":u2/{n}" * (n < 17)) for wh in ranked)
    return UserError(
        f"{path}: nothing says how its {size} bytes are laid out",
        legal=LEGAL_RAW,
        fix=f"state the layout; its size fits {fitting}" if fitting else "state the layout",
    )


def named_array(
    name: str, arrays: Mapping[str, np.ndarray], usual: Sequence[str], asked: str | None
) -> tuple[str, np.ndarray]:
    """(what to call it, array): the one asked for as NAME[:NUMBER], else the only one with a usual name, else the only
    one. Raises UserError where none or several could be meant."""
    held = ", ".join(f"{key} {value.shape}".strip() for key, value in arrays.items()) or "nothing"
    key, _, number = (asked or "").partition(":")
    if asked is None or not key:
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


def named_stack(name: str, arrays: Mapping[str, np.ndarray], lens: Lens | None, asked: str | None = None) -> Stack:
    """The stack among named arrays, with colour and amplitude. Raises UserError where none or several could be it."""
    found, array = named_array(name, arrays, DISTANCE_NAMES, asked)
    beside = {key.lower(): value for key, value in arrays.items()}
    rgb = next((beside[key] for key in COLOUR_NAMES if key in beside), None)
    amplitude = next((beside[key] for key in AMPLITUDE_NAMES if key in beside), None)
    return stack_of(found, array, rgb, amplitude, lens)


def stack_of(
    name: str, array: np.ndarray, rgb: np.ndarray | None, amplitude: np.ndarray | None, lens: Lens | None
) -> Stack:
    """Put the frame axis first and tell points from depth. Raises UserError for other axes, 8 bits, or nothing."""
    refuse_narrow(name, array.dtype)
    if array.size == 0:
        raise UserError(f"{name}: is empty {array.shape}", legal=LEGAL_AXES)
    points, shape, organised = _axes(name, array.shape, lens)
    refuse_pixels(name, shape[2], shape[1])
    full = (*shape, 3) if points else shape
    return Stack(
        distances=array.reshape(full),
        rgb=_colours(rgb, (*shape, 3)),
        amplitude=amplitude.reshape(shape).astype(np.float32)
        if amplitude is not None and amplitude.dtype.kind in "biuf" and amplitude.size == np.prod(shape)
        else None,
        organised=organised,
    )


def _axes(name: str, shape: tuple[int, ...], lens: Lens | None) -> tuple[bool, tuple[int, int, int], bool]:
    """(holds points, (n, h, w), has a pixel grid) of an array's shape."""
    if len(shape) == 2 and shape[-1] == 3:
        return True, *_grid_of(1, shape[0], lens)
    if len(shape) == 3 and shape[-1] == 3:
        if shape[1] >= FRAMES_OF_POINTS * shape[0]:
            return True, *_grid_of(shape[0], shape[1], lens)
        return True, (1, shape[0], shape[1]), True
    if len(shape) == 4 and shape[-1] == 3:
        return True, (shape[0], shape[1], shape[2]), True
    if len(shape) == 2 and min(shape) > 1:
        return False, (1, shape[0], shape[1]), True
    if len(shape) == 3:
        return False, (shape[0], shape[1], shape[2]), True
    raise UserError(f"{name}: axes {shape} are no capture's", legal=LEGAL_AXES)


def _grid_of(frames: int, points: int, lens: Lens | None) -> tuple[tuple[int, int, int], bool]:
    """A list of points, put back on the lens' pixels where it has exactly as many."""
    if lens is not None and points == lens.width * lens.height:
        return (frames, lens.height, lens.width), True
    return (frames, 1, points), False


def _colours(rgb: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray | None:
    """Colours as uint8 on the stack's axes; None where their count does not fit it."""
    if rgb is None or rgb.dtype.kind not in "biuf" or rgb.size != np.prod(shape):
        return None
    if rgb.dtype.kind == "f":
        rgb = rgb * 255.0 if np.nanmax(rgb) <= 1.0 else rgb
        rgb = np.nan_to_num(np.clip(np.rint(rgb), 0, 255))
    return rgb.astype(np.uint8).reshape(shape)
