"""RealSense cameras through pyrealsense2.

Source: librealsense's documents of its Python wrapper and of projection (depth is 16 bits in the
depth sensor's scale, 0 is none; (0, 0) is the centre of the first pixel). Run with a recording,
not with a camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from detectors.sources.interface import (
    PATIENCE_S,
    DepthPicture,
    Stream,
    camera_errors,
    load_sdk,
    stated_lens,
    stream_of,
    without_frames,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens

CAMERA = "realsense"
INSTALL = "pip install 'tofpod[realsense]'; on Linux also the system's package libusb-1.0"


@contextmanager
def open_realsense(path: Path | None) -> Iterator[Stream]:
    """Start the first camera with its default depth stream, or play a recording of its SDK."""
    rs = load_sdk("pyrealsense2", CAMERA, INSTALL)
    pipeline = rs.pipeline()
    config = rs.config()
    with camera_errors(CAMERA):
        config.enable_stream(rs.stream.depth)
        if path is not None:
            config.enable_device_from_file(str(path), repeat_playback=False)
        profile = pipeline.start(config)
    try:
        if path is not None:
            # else frames are dropped where they are not fetched in time
            profile.get_device().as_playback().set_real_time(False)
        pictures = _pictures(rs, pipeline, profile, is_live=path is None)
        yield stream_of(CAMERA, "RealSense", pictures)
    finally:
        pipeline.stop()


def _pictures(rs: Any, pipeline: Any, profile: Any, *, is_live: bool) -> Iterator[DepthPicture]:
    """Yield the depth frames, until a recording ends."""
    # stored as a 32-bit number: a millimetre is .0010000000475
    unit_m = round(profile.get_device().first_depth_sensor().get_depth_scale(), 9)
    stream = profile.get_stream(rs.stream.depth).as_video_stream_profile()
    lens = _lens(rs, stream.get_intrinsics())
    while True:
        has_come, frames = pipeline.try_wait_for_frames(1000 * PATIENCE_S)
        if not has_come:
            if is_live:
                raise without_frames(CAMERA)
            return
        depth = frames.get_depth_frame()
        if depth:
            # the package uses the frame's memory again
            stored = np.array(depth.get_data())
            yield DepthPicture(1e-3 * depth.get_timestamp(), stored, unit_m, lens)


def _lens(rs: Any, stated: Any) -> Lens:
    """Return the lens of rectified depth. Raises UserError for a model other than OpenCV's."""
    models = (rs.distortion.none, rs.distortion.brown_conrady)
    if any(stated.coeffs) and stated.model not in models:
        problem = f"camera {CAMERA}: its depth has the lens model {stated.model}"
        raise UserError(problem, legal="none, or Brown-Conrady as in OpenCV")
    matrix = np.array([[stated.fx, 0, stated.ppx], [0, stated.fy, stated.ppy], [0, 0, 1]])
    return stated_lens(CAMERA, (stated.height, stated.width), matrix, stated.coeffs)
