"""The frames of each view on the whole sensor, with a time and a true pose, as other programs get them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from harness.vocabulary.capture import FrameSource
from harness.vocabulary.geometry import invert
from harness.vocabulary.lens import Lens

START_NS = 1_000_000_000 * 10**9
"""Time of the first frame: a round number in 2001, because 0 means "the latest" to ROS' tf."""
PAUSE_NS = 10**9
"""Time between the last frame of a view and the first of the next, in which the camera is carried on."""
BOARD_FRAME = "board"
"""Name of the world's frame: x along the row of holes, y up the face, z out of it to the camera, origin at its centre.
"""


@dataclass(frozen=True)
class ExportedView:
    """Frames of one view. ``source`` has a lens and a pixel grid; ``T_camera_board`` (4, 4) is the true pose.

    ``start_ns``: time of its first frame.
    """

    name: str
    source: FrameSource
    T_camera_board: np.ndarray
    n_frames: int
    frames_per_second: float
    start_ns: int

    @property
    def lens(self) -> Lens:
        """The lens of the whole sensor."""
        lens = self.source.lens
        assert lens is not None, "only simulated cameras are exported, and they have a lens"
        return lens

    @property
    def T_board_camera(self) -> np.ndarray:
        """(4, 4): where the camera stands in the board's frame."""
        return invert(self.T_camera_board)

    def stamp_ns(self, frame: int) -> int:
        """Return the time of a frame."""
        return self.start_ns + round(frame * 1e9 / self.frames_per_second)

    def exposures(self) -> Iterator[Exposure]:
        """Yield the frames, each on the whole sensor: no range, black and no amplitude outside the simulated region."""
        lens, region = self.lens, self.source.region

        def on_sensor(values: np.ndarray, outside: float) -> np.ndarray:
            whole = np.full((lens.height, lens.width, *values.shape[2:]), outside, values.dtype)
            whole[region.row0 : region.row1, region.col0 : region.col1] = values
            return whole

        for number, frame in enumerate(self.source.frames()):
            rgb = frame.rgb if frame.rgb is not None else np.zeros((*region.shape, 3), np.uint8)
            amplitude = frame.amplitude if frame.amplitude is not None else np.full(region.shape, np.nan)
            yield Exposure(
                stamp_ns=self.stamp_ns(number),
                z_m=on_sensor(frame.z_m.astype(np.float32), np.nan),
                rgb=on_sensor(rgb, 0),
                amplitude=on_sensor(amplitude.astype(np.float32), np.nan),
            )


@dataclass(frozen=True)
class Exposure:
    """One frame on the whole sensor: ``z_m`` (h, w) float32, NaN where invalid; ``rgb`` (h, w, 3) uint8; ``amplitude``
    (h, w) float32; ``stamp_ns`` since the epoch."""

    stamp_ns: int
    z_m: np.ndarray
    rgb: np.ndarray
    amplitude: np.ndarray


def in_turn(
    sources: Sequence[FrameSource], poses: Sequence[np.ndarray], n_frames: int, frames_per_second: float
) -> tuple[ExportedView, ...]:
    """Place views one after the other in time, named ``view_00`` and so on; ``poses`` are their ``T_camera_board``."""
    digits = max(2, len(str(len(sources) - 1)))
    length_ns = round(n_frames * 1e9 / frames_per_second) + PAUSE_NS
    return tuple(
        ExportedView(
            f"view_{number:0{digits}d}", source, pose, n_frames, frames_per_second, START_NS + number * length_ns
        )
        for number, (source, pose) in enumerate(zip(sources, poses, strict=True))
    )


def quaternion_of(T_a_b: np.ndarray) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a rigid transform's rotation, w >= 0, of unit length."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True).tolist()
    return x, y, z, w
