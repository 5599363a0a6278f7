"""The interface of a source of frames, and what all adapters of cameras share."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detectors.recordings.distances import frame_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens

PATIENCE_S = 5
"""Longest time to wait for a frame: cameras need one or two seconds to start."""
COEFFICIENTS = 8
"""Coefficients of OpenCV that `Lens` has; the next ones are thin prisms and tilted sensors."""


@dataclass(frozen=True)
class Stream:
    """The frames of a camera that runs, or of a recording that is played."""

    name: str
    """The camera in words."""
    lens: Lens
    """The lens of the depth pixels."""
    unit_m: float
    """Metres in one stored number, which is the rounding step of z."""
    frames: Iterator[Frame]
    """The frames in their order, with ``time_s`` if it is known; a recording ends, a camera does
    not."""


OpenStream = Callable[[Path | None], AbstractContextManager[Stream]]
"""A function that starts the camera, or opens its recording at a path, and stops or closes it at
the end of the context. Raises UserError."""


def load_sdk(module: str, camera: str, install: str) -> Any:
    """Return a maker's package. Raises UserError with the line to type if it cannot be imported;
    such packages fail in many ways where a library of the system is missing."""
    try:
        return importlib.import_module(module)
    except Exception as error:
        problem = f"the camera {camera} needs the package {module}, which cannot be loaded"
        raise UserError(f"{problem} ({error})", fix=install) from error


@contextmanager
def camera_errors(camera: str) -> Iterator[None]:
    """Turn an exception of a maker's package into a UserError."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        problem = f"camera {camera}: {str(error) or type(error).__name__}"
        fix = "connect it, and close other programs that use it"
        raise UserError(problem, fix=fix) from error


def without_frames(camera: str) -> UserError:
    """Return the error for a camera that has stopped to send frames."""
    fix = "check its cable, and that it has power"
    return UserError(f"camera {camera}: no frame came for {PATIENCE_S} s", fix=fix)


def refuse_recording(camera: str, path: Path | None, readable: str) -> None:
    """Raise UserError if a recording is named for a camera whose package plays none. ``readable``:
    what tofpod reads itself."""
    if path is not None:
        fix = f"leave --camera out: tofpod reads {readable} itself"
        raise UserError(f"--from {path}: the camera {camera} plays no recording", fix=fix)


def stated_lens(
    camera: str, shape: tuple[int, ...], matrix: np.ndarray, distortion: Sequence[float] = ()
) -> Lens:
    """Return the lens of pictures of this shape (h, w) from OpenCV's camera matrix (3, 3) and
    coefficients. Raises UserError for coefficients that `Lens` lacks, and for a camera that states
    no lens."""
    stated = tuple(float(number) for number in distortion)
    if any(stated[COEFFICIENTS:]):
        problem = f"camera {camera}: its lens has a thin prism or a tilted sensor"
        raise UserError(problem, fix="record rectified depth by the maker's program")
    # packages state a focal length of 0 or 1 pixel where nothing was calibrated
    if not min(matrix[0][0], matrix[1][1]) > 1:
        raise UserError(f"camera {camera}: states no lens", fix="calibrate it")
    height, width = shape
    return Lens(
        width=width,
        height=height,
        fx=float(matrix[0][0]),
        fy=float(matrix[1][1]),
        cx=float(matrix[0][2]),
        cy=float(matrix[1][2]),
        distortion=(stated + (0.0,) * COEFFICIENTS)[:COEFFICIENTS],
    )


class DepthPicture(NamedTuple):
    """A depth picture as a maker's package gives it."""

    time_s: float
    """The camera's clock."""
    stored: np.ndarray
    """Depth (h, w) uint16, 0 where there is none."""
    unit_m: float
    """Metres in one stored number."""
    lens: Lens
    """The lens of its pixels."""
    amplitude: np.ndarray | None = None
    """Active infrared (h, w) of the same pixels, if the camera gives it."""


def stream_of(camera: str, title: str, pictures: Iterator[DepthPicture]) -> Stream:
    """Return the stream of a camera's pictures, the first of which states lens and unit. Raises
    UserError if there is none; its frames raise one when the package does."""
    with camera_errors(camera):
        first = next(pictures, None)
    if first is None:
        raise UserError(f"camera {camera}: the recording holds no depth")
    frames = _frames(camera, chain([first], pictures))
    return Stream(title, first.lens, first.unit_m, frames)


def _frames(camera: str, pictures: Iterator[DepthPicture]) -> Iterator[Frame]:
    with camera_errors(camera):
        for number, picture in enumerate(pictures):
            amplitude = None
            if picture.amplitude is not None and picture.amplitude.shape == picture.stored.shape:
                amplitude = picture.amplitude.astype(np.float32)
            frame = frame_of(f"frame {number}", picture.stored, picture.unit_m, amplitude=amplitude)
            yield replace(frame, time_s=picture.time_s)
