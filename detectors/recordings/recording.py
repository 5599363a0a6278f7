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
from harness.vocabulary.geometry import Frame, Lens, Reason, Region

ROUND_TRIP_PX = 0.1
"""If a pixel's ray does not return to it within this distance, the lens model has no direction for
it."""
NO_GRID = "the cloud has no pixel grid; it is treated as unorganised points"


@contextmanager
def read_errors(problem: str, legal: str, fix: str = "copy or export it again") -> Iterator[None]:
    """Turn a library's exception on a damaged file into a UserError that begins with ``what``, and
    limit its memory."""
    try:
        with limited_memory():
            yield
    except UserError:
        raise
    except Exception as error:
        why = (
            "there is not enough memory for the size that it states"
            if isinstance(error, MemoryError)
            else str(error)
        )
        raise UserError(
            f"{problem} ({(why or type(error).__name__)[:200]})", legal=legal, fix=fix
        ) from error


@dataclass(frozen=True)
class CaptureOptions:
    """The user's statements about a capture. ``scale_m``: metres in one stored unit, None for the
    format's usual one. ``intrinsics``: a file with the depth pixels' lens, preferred to one that
    comes with the frames. ``lens``: the same as a value. ``frames``: selects frames by number.
    ``topic``: of a ROS bag. ``array``: NAME or NAME:NUMBER in a file of arrays. ``pitch``: of a
    height map's pixels (``0.5mm``). ``raw``: layout of bare numbers."""

    scale_m: float | None = None
    intrinsics: Path | None = None
    lens: Lens | None = None
    frames: slice | None = None
    topic: str | None = None
    array: str | None = None
    pitch: str | None = None
    raw: str | None = None


@dataclass(frozen=True)
class Recording:
    """A real capture as a `harness.vocabulary.geometry.FrameSource`.

    ``read``: yields the frames in order; each call starts again. ``shape``: (height, width).
    ``scale_m``: metres in one stored unit. ``files``: all files whose content can change a result.
    ``notes``: how the files were interpreted. ``warnings``: full sentences on doubts about the
    distances; every program shows them first. ``selection``: picks frames. ``unit_from``: origin
    of the unit; "" if the data decide."""

    name: str
    read: Callable[[], Iterator[Frame]]
    shape: tuple[int, int]
    scale_m: float
    z_step_m: float
    files: tuple[Path, ...] = ()
    lens: Lens | None = None
    organised: bool = True
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    projection: Literal["central", "parallel"] = "central"
    selection: slice | None = None
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
        """Return a recording of the first frame's size and step. Raises UserError without a frame."""
        first = next(read(), None)
        if first is None:
            raise UserError(
                f"{name}: contains no frame",
                legal="at least one frame",
                fix="copy or record it again",
            )
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
        for frame in self.selected():
            count += 1
            if frame.z_m.shape != self.shape:
                elements = "pixels" if self.organised else "points"
                sizes = [
                    f"{w} x {h}" if h > 1 else str(w) for h, w in (frame.z_m.shape, self.shape)
                ]
                elements = (
                    f"{frame.name}: {sizes[0]} {elements}, but the first frame has {sizes[1]}"
                )
                raise UserError(
                    elements, legal="frames of one size", fix="run the differing frames separately"
                )
            if self.slopes is not None and frame.xy_m is None:
                rayless = np.isnan(self.slopes[..., 0]) & (frame.reason == Reason.VALID)
                if rayless.any():
                    z_m = np.where(rayless, np.float32(np.nan), frame.z_m)
                    reason = np.where(rayless, np.uint8(Reason.OUTSIDE_MASK), frame.reason)
                    frame = replace(frame, z_m=z_m, reason=reason)
            if not judged and np.isfinite(frame.z_m).any():
                refuse_implausible(frame, self.scale_m)
                if self.projection == "central":
                    refuse_far_aside(frame)
                judged = True
            yield frame
        if not judged:
            fix = "check the selected frames, and that the target was within the camera's range"
            raise UserError(
                f"{self.name}: no valid pixel in {count} frame{'s' * (count != 1)}", fix=fix
            )


@lru_cache(maxsize=2)
def _returning_slopes(lens: Lens, region: Region) -> np.ndarray:
    """Return the slopes of a region, NaN where the ray does not return to its pixel."""
    slopes = lens.region_slopes(region)
    if not any(lens.distortion):
        return slopes
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
    missed_px = np.abs(lens.project(rays) - np.stack([u, v], axis=-1)).max(axis=-1)
    return np.where((missed_px < ROUND_TRIP_PX)[..., None], slopes, np.nan)
