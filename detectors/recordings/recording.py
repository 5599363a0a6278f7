"""A recording: the frames of a real capture with the checks that all formats share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np

from detectors.recordings.distances import refuse_far_aside, refuse_implausible, rounding_step_m
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import limited_memory
from harness.vocabulary.geometry import Frame, Lens, Reason, Region, rays_of

ROUND_TRIP_PX = 0.1
"""If a pixel's ray does not return to it within this distance, the lens model has no direction for
it."""
NO_GRID = "the cloud has no pixel grid; it is treated as unorganised points"


@contextmanager
def read_errors(problem: str, legal: str, fix: str = "copy or export it again") -> Iterator[None]:
    """Turn a library's exception on a damaged file into a UserError that begins with ``problem``,
    and limit its memory."""
    try:
        with limited_memory():
            yield
    except UserError:
        raise
    except Exception as error:
        reason = str(error) or type(error).__name__
        if isinstance(error, MemoryError):
            reason = "there is not enough memory for the size that it states"
        raise UserError(f"{problem} ({reason[:200]})", legal=legal, fix=fix) from error


@dataclass(frozen=True)
class CaptureOptions:
    """The user's statements about a capture; None where nothing is stated."""

    # metres in one stored unit; None for the format's usual one
    scale_m: float | None = None
    # a file with the depth pixels' lens, preferred to one that comes with the frames
    intrinsics: Path | None = None
    # the same as a value
    lens: Lens | None = None
    # selects frames by number
    frames: slice | None = None
    # a topic of a ROS bag
    topic: str | None = None
    # NAME or NAME:NUMBER in a file of arrays
    array: str | None = None
    # distance between a height map's pixels (``0.5mm``)
    pitch: str | None = None
    # layout of bare numbers
    raw: str | None = None


@dataclass(frozen=True)
class Recording:
    """A real capture as a `harness.vocabulary.geometry.FrameSource`."""

    name: str
    # yields the frames in order; each call starts again
    read: Callable[[], Iterator[Frame]]
    # height and width, pixels
    shape: tuple[int, int]
    # metres in one stored unit
    scale_m: float
    # rounding step of one frame's z; 0 if there is none
    z_step_m: float
    # all files whose content can change a result
    files: tuple[Path, ...] = ()
    # of the depth pixels; None if frames carry points
    lens: Lens | None = None
    # whether there is a pixel grid
    organised: bool = True
    # how the files were interpreted
    notes: tuple[str, ...] = ()
    # full sentences on doubts about the distances; every program shows them first
    warnings: tuple[str, ...] = ()
    # whether rays leave the lens, or run along z as in a height map
    projection: Literal["central", "parallel"] = "central"
    # picks frames
    selection: slice | None = None
    # origin of the unit; "" if the data decide
    unit_from: str = ""

    @classmethod
    def begun(
        cls,
        name: str,
        read: Callable[[], Iterator[Frame]],
        scale_m: float,
        is_whole: bool = False,
        **fields: Any,
    ) -> Recording:
        """Return a recording of the first frame's size and step. ``is_whole``: stored numbers are
        whole. ``fields``: others of the class. Raises UserError without a frame."""
        first = next(read(), None)
        if first is None:
            problem = f"{name}: contains no frame"
            raise UserError(problem, legal="at least one frame", fix="copy or record it again")
        step_m = scale_m if is_whole else rounding_step_m(first.z_m)
        return cls(name, read, first.z_m.shape, scale_m, step_m, **fields)

    @property
    def region(self) -> Region:
        """The whole image."""
        return Region(0, self.shape[0], 0, self.shape[1])

    @property
    def unit_text(self) -> str:
        """The depth unit and its origin, as programs print it."""
        return f"depth unit {1e3 * self.scale_m:.4g} mm, from {self.unit_from}"

    @cached_property
    def slopes(self) -> np.ndarray | None:
        """Slopes x/z, y/z (h, w, 2) of pixels; NaN where the distortion has no inverse. None if
        frames carry points."""
        return None if self.lens is None else _returning_slopes(self.lens, self.region)

    def selected(self) -> Iterator[Frame]:
        """Yield the selected frames as they are read, unchecked."""
        chosen = self.selection or slice(None)
        return islice(self.read(), chosen.start, chosen.stop, chosen.step)

    def frames(self) -> Iterator[Frame]:
        """Yield the selected frames. Raises UserError for different sizes, a wrong unit, or if no
        pixel is valid."""
        count = 0
        judged = False
        for stored in self.selected():
            count += 1
            self._refuse_other_size(stored)
            frame = self._without_rayless(stored)
            if not judged and np.isfinite(frame.z_m).any():
                refuse_implausible(frame, self.scale_m)
                if self.projection == "central":
                    refuse_far_aside(frame)
                judged = True
            yield frame
        if not judged:
            frames = "1 frame" if count == 1 else f"{count} frames"
            raise UserError(
                f"{self.name}: no valid pixel in {frames}",
                fix="check the selected frames, and that the target was within the camera's range",
            )

    def _refuse_other_size(self, frame: Frame) -> None:
        """Raise UserError if a frame's size is not the first one's."""
        if frame.z_m.shape == self.shape:
            return
        elements = "pixels" if self.organised else "points"
        size = _size_text(frame.z_m.shape)
        problem = (
            f"{frame.name}: {size} {elements}, but the first frame has {_size_text(self.shape)}"
        )
        fix = "run the differing frames separately"
        raise UserError(problem, legal="frames of one size", fix=fix)

    def _without_rayless(self, frame: Frame) -> Frame:
        """Return a frame without the pixels for which the lens has no direction."""
        if self.slopes is None or frame.xy_m is not None:
            return frame
        rayless = np.isnan(self.slopes[..., 0]) & (frame.reason == Reason.VALID)
        if not rayless.any():
            return frame
        z_m = np.where(rayless, np.float32(np.nan), frame.z_m)
        reason = np.where(rayless, np.uint8(Reason.OUTSIDE_MASK), frame.reason)
        return replace(frame, z_m=z_m, reason=reason)


def _size_text(shape: tuple[int, ...]) -> str:
    height, width = shape
    return f"{width} x {height}" if height > 1 else str(width)


@lru_cache(maxsize=2)
def _returning_slopes(lens: Lens, region: Region) -> np.ndarray:
    """Return the slopes of a region, NaN where the ray does not return to its pixel."""
    slopes = lens.region_slopes(region)
    if not any(lens.distortion):
        return slopes
    rays = rays_of(slopes)
    v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
    pixels = np.stack([u, v], axis=-1)
    missed_px = np.abs(lens.project(rays) - pixels).max(axis=-1)
    returns = missed_px < ROUND_TRIP_PX
    return np.where(returns[..., None], slopes, np.nan)
