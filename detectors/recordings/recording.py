"""A recording: the frames of a real capture behind the checks that all formats share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Literal

import numpy as np

from detectors.recordings.distances import refuse_implausible
from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens

ROUND_TRIP_PX = 0.1
"""A pixel whose ray does not come back to it within this has no direction that the lens model can give."""
NO_GRID = "the cloud has no pixel grid; it is treated as single points"


@dataclass(frozen=True)
class Asked:
    """The user's statements about a capture: the options of `detectors.recordings.opening.open_capture`.

    ``scale_m``: metres in one stored unit, None where the format's usual unit counts.
    """

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
    """A real capture as a `harness.vocabulary.capture.FrameSource`.

    ``read`` yields the frames in order, one at a time; each call starts again from the first. ``shape``: (height,
    width). ``files``: all files whose content can change a number (frames, colour, intrinsics). ``scale_m``: metres in
    one stored unit, and ``unit_from`` who says so: "" where a reader only takes what is usual for its format, so that
    `detectors.recordings.opening` decides by the data. ``notes``: what the user should know about how the files were
    understood. ``warnings``: full sentences on what makes the distances doubtful; every program shows them before
    anything else. ``selection`` picks frames. ``projection``: see `harness.vocabulary.capture.Cloud`.
    """

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

    @property
    def region(self) -> Region:
        """The whole image."""
        return Region(0, self.shape[0], 0, self.shape[1])

    @property
    def unit_text(self) -> str:
        """The depth unit and who says so, as programs print it."""
        return f"depth unit {1e3 * self.scale_m:.4g} mm, from {self.unit_from}"

    @cached_property
    def slopes(self) -> np.ndarray | None:
        """(h, w, 2) x/z and y/z per pixel; NaN where the distortion has no inverse. None where frames carry points."""
        return None if self.lens is None else _returning_slopes(self.lens, self.region)

    def selected(self) -> Iterator[Frame]:
        """Yield the selected frames as they are read, unchecked."""
        chosen = self.selection or slice(None)
        return islice(self.read(), chosen.start, chosen.stop, chosen.step)

    def frames(self) -> Iterator[Frame]:
        """Yield the selected frames. Raises UserError on differing sizes, a wrong unit, or when no pixel is valid."""
        count, judged = 0, False
        for frame in self.selected():
            if frame.z_m.shape != self.shape:
                what = "pixels" if self.organised else "points"
                raise UserError(
                    f"{frame.name}: {_size(frame.z_m.shape)} {what}, but the first frame has {_size(self.shape)}",
                    legal="frames of one size, from one camera that did not move",
                    fix="run the differing frames on their own",
                )
            if self.slopes is not None and frame.xy_m is None:
                rayless = np.isnan(self.slopes[..., 0]) & (frame.reason == Reason.VALID)
                if rayless.any():
                    z_m = np.where(rayless, np.float32(np.nan), frame.z_m)
                    reason = np.where(rayless, np.uint8(Reason.OUTSIDE_MASK), frame.reason)
                    frame = replace(frame, z_m=z_m, reason=reason)
            if not judged and np.isfinite(frame.z_m).any():
                refuse_implausible(frame, self.scale_m)
                judged = True
            count += 1
            yield frame
        if count == 0:
            raise UserError(f"{self.name}: no frame in it", legal="at least one frame", fix="check the selected frames")
        if not judged:
            raise UserError(
                f"{self.name}: not one valid pixel in {count} frame{'s' if count > 1 else ''}",
                legal="depth above 0 and finite in some pixels",
                fix="check that these are depth images and that the target was within the camera's range",
            )

    def first_frame(self) -> Frame:
        """Return the first selected frame, checked. Raises UserError as `frames` does."""
        for frame in self.frames():
            return frame
        raise AssertionError("frames() raises before it yields nothing")


@lru_cache(maxsize=2)
def slopes_of(lens: Lens, region: Region) -> np.ndarray:
    """Return (h, w, 2) x/z and y/z per pixel, not to be written to: kept, because captures that are views of one target
    share their lens, and undistorting a sensor takes longer than averaging a frame of it."""
    return lens.region_slopes(region)


@lru_cache(maxsize=2)
def _returning_slopes(lens: Lens, region: Region) -> np.ndarray:
    """Return the same with NaN where the ray does not come back to its pixel."""
    slopes = slopes_of(lens, region)
    if not any(lens.distortion):
        return slopes
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
    missed_px = np.abs(lens.project(rays) - np.stack([u, v], axis=-1)).max(axis=-1)
    return np.where((missed_px < ROUND_TRIP_PX)[..., None], slopes, np.nan)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}" if shape[0] > 1 else str(shape[1])
