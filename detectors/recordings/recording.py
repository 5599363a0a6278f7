"""A recording: the frames of one file format behind the checks that all formats share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import islice
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from detectors.recordings.distances import refuse_implausible
from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens

ROUND_TRIP_PX = 0.1
"""A pixel whose ray does not come back to it within this has no direction that the lens model can give."""


class Reader(Protocol):
    """Reads the frames of one format, in order, one at a time; each call starts again from the first."""

    def frames(self) -> Iterator[Frame]: ...


@dataclass(frozen=True)
class Recording:
    """A real capture as a `harness.vocabulary.capture.FrameSource`.

    ``files``: all files whose content can change a number (frames, colour, intrinsics). ``scale_m``: metres in one
    stored unit, and ``unit_from`` who says so: "" where a reader only takes what is usual for its format, so that
    `detectors.recordings.opening` decides by the data. ``notes``: what the user should know about how the files were
    understood. ``warnings``: full sentences on what makes the distances doubtful; every program shows them before
    anything else. ``selection`` picks frames. ``projection``: see `harness.vocabulary.capture.Cloud`.
    """

    name: str
    reader: Reader
    region: Region
    scale_m: float
    z_step_m: float
    files: tuple[Path, ...]
    lens: Lens | None = None
    organised: bool = True
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    projection: Literal["central", "parallel"] = "central"
    selection: slice | None = None
    unit_from: str = ""

    @property
    def unit_text(self) -> str:
        """The depth unit and who says so, as programs print it."""
        return f"depth unit {1e3 * self.scale_m:.4g} mm, from {self.unit_from}"

    @cached_property
    def slopes(self) -> np.ndarray | None:
        """(h, w, 2) x/z and y/z per pixel; NaN where the distortion has no inverse. None where frames carry points."""
        return None if self.lens is None else _returning_slopes(self.lens, self.region)

    def frames(self) -> Iterator[Frame]:
        """The selected frames. Raises UserError on differing sizes, a wrong unit, or when no pixel is ever valid."""
        count, judged = 0, False
        chosen = self.selection or slice(None)
        for frame in islice(self.reader.frames(), chosen.start, chosen.stop, chosen.step):
            self._refuse_other_size(frame)
            known = self._without_rayless(frame)
            if not judged and np.isfinite(known.z_m).any():
                refuse_implausible(known, self.scale_m)
                judged = True
            count += 1
            yield known
        self._refuse_nothing(count, judged)

    def first_frame(self) -> Frame:
        """The first selected frame, checked. Raises UserError as `frames` does."""
        for frame in self.frames():
            return frame
        raise AssertionError("frames() raises before it yields nothing")

    def _refuse_other_size(self, frame: Frame) -> None:
        if frame.z_m.shape == self.region.shape:
            return
        what = "pixels" if self.organised else "points"
        raise UserError(
            f"{frame.name}: {_size(frame.z_m.shape)} {what}, but the first frame has {_size(self.region.shape)}",
            legal="frames of one size, from one camera that did not move",
            fix="run the differing frames on their own",
        )

    def _without_rayless(self, frame: Frame) -> Frame:
        """The frame without the pixels that the lens model gives no direction to."""
        if self.slopes is None or frame.xy_m is not None:
            return frame
        rayless = np.isnan(self.slopes[..., 0]) & (frame.reason == Reason.VALID)
        if not rayless.any():
            return frame
        z_m, reason = frame.z_m.copy(), frame.reason.copy()
        z_m[rayless], reason[rayless] = np.nan, Reason.OUTSIDE_MASK
        return replace(frame, z_m=z_m, reason=reason)

    def _refuse_nothing(self, count: int, judged: bool) -> None:
        if count == 0:
            raise UserError(f"{self.name}: no frame in it", legal="at least one frame", fix="check the selected frames")
        if not judged:
            raise UserError(
                f"{self.name}: not one valid pixel in {count} frame{'s' if count > 1 else ''}",
                legal="depth above 0 and finite in some pixels",
                fix="check that these are depth images and that the target was within the camera's range",
            )


@lru_cache(maxsize=2)
def slopes_of(lens: Lens, region: Region) -> np.ndarray:
    """(h, w, 2) x/z and y/z per pixel, not to be written to: kept, because captures that are views of one target share
    their lens, and undistorting a sensor takes longer than averaging a frame of it."""
    return lens.region_slopes(region)


@lru_cache(maxsize=2)
def _returning_slopes(lens: Lens, region: Region) -> np.ndarray:
    """The same with NaN where the ray does not come back to its pixel."""
    slopes = slopes_of(lens, region)
    if not any(lens.distortion):
        return slopes
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
    missed_px = np.abs(lens.project(rays) - np.stack([u, v], axis=-1)).max(axis=-1)
    return np.where((missed_px < ROUND_TRIP_PX)[..., None], slopes, np.nan)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]}" if shape[0] > 1 else str(shape[1])
