"""Arrays: ``.npy`` and ``.npz`` stacks, and the meaning of an array's axes that MATLAB files share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from detectors.recordings.distances import (
    default_metres,
    frame_from_depth,
    frame_from_points,
    refuse_narrow,
    rounding_step_m,
)
from detectors.recordings.intrinsics import lens_file_beside, no_lens, read_lens
from detectors.recordings.recording import Recording
from harness.vocabulary.archives import read_npy, read_npz
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import refuse_pixels

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
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    organised: bool = True

    @property
    def has_points(self) -> bool:
        return self.distances.ndim == 4


class StackLoader(Protocol):
    """Loads a file's arrays. ``lens`` tells apart a grid from a list of points where both fit."""

    def __call__(self, path: Path, lens: Lens | None) -> Stack: ...


@dataclass(frozen=True)
class StackReader:
    """Yields the frames of one file. ``.npy`` is mapped, not read; ``.npz`` and ``.mat`` are unpacked whole."""

    path: Path
    scale_m: float
    load: StackLoader
    lens: Lens | None

    def frames(self) -> Iterator[Frame]:
        stack = self.load(self.path, self.lens)
        make = frame_from_points if stack.has_points else frame_from_depth
        for i, stored in enumerate(stack.distances):
            rgb = stack.rgb[i] if stack.rgb is not None else None
            amplitude = stack.amplitude[i] if stack.amplitude is not None else None
            yield make(f"{self.path.name} frame {i}", np.asarray(stored), self.scale_m, rgb=rgb, amplitude=amplitude)


def open_stack(
    path: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None, load: StackLoader
) -> Recording:
    """Open a file of arrays. Raises UserError where the axes are no capture's or a depth array has no lens."""
    stack = load(path, lens)
    height, width = stack.distances.shape[1:3]
    lens_file = None
    if not stack.has_points:
        lens_file = intrinsics or (None if lens else lens_file_beside(path.parent))
        lens = read_lens(lens_file, width, height) if lens_file else lens
        if lens is None:
            raise no_lens(str(path))
        if (lens.width, lens.height) != (width, height):
            raise UserError(f"{path}: {width} x {height} pixels, but the lens is of {lens.width} x {lens.height}")
    given = scale_m or default_metres(stack.distances.dtype)
    reader = StackReader(path, given, load, lens)
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


def load_npy(path: Path, lens: Lens | None) -> Stack:
    """An ``.npy`` file, mapped. Raises UserError where it is broken, or holds objects (they would need pickle)."""
    return stack_of(str(path), read_npy(path), None, None, lens)


def load_npz(path: Path, lens: Lens | None) -> Stack:
    """An ``.npz`` file: its only array, or the one named depth, z, xyz or points; colour and amplitude."""
    return named_stack(str(path), read_npz(path), lens)


def named_stack(name: str, arrays: dict[str, np.ndarray], lens: Lens | None) -> Stack:
    """The stack among named arrays. Raises UserError where none or several could be it."""
    found = [key for key in arrays if key.lower() in DISTANCE_NAMES]
    if not found and len(arrays) == 1:
        found = list(arrays)
    if len(found) != 1:
        held = ", ".join(f"{key} {value.shape}" for key, value in arrays.items()) or "nothing"
        what = "several arrays that could be the depth" if found else "no array that could be the depth"
        raise UserError(
            f"{name}: {what} (it holds {held})",
            legal="one array named " + ", ".join(DISTANCE_NAMES) + "; " + LEGAL_AXES,
        )
    beside = {key.lower(): value for key, value in arrays.items()}
    rgb = next((beside[key] for key in COLOUR_NAMES if key in beside), None)
    amplitude = next((beside[key] for key in AMPLITUDE_NAMES if key in beside), None)
    return stack_of(f"{name}: {found[0]}", arrays[found[0]], rgb, amplitude, lens)


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
