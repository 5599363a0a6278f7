"""Orbbec's Femto Bolt, Mega and Mega I through pyorbbecsdk, version 2.

Source: the package's own interface file and examples (depth is 16 bits, and the frame states the
millimetres in one number; 0 is none). Not run with a camera."""

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
    refuse_recording,
    stated_lens,
    stream_of,
    without_frames,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Lens

CAMERA = "femto"
INSTALL = "pip install --no-deps pyorbbecsdk2, as it asks for an older NumPy than tofpod"


@contextmanager
def open_femto(path: Path | None) -> Iterator[Stream]:
    """Start the first camera with its default depth and infrared."""
    refuse_recording(CAMERA, path, ".mkv and bags")
    sdk = load_sdk("pyorbbecsdk", CAMERA, INSTALL)
    with camera_errors(CAMERA):
        pipeline = sdk.Pipeline()
        config = sdk.Config()
        for sensor in (sdk.OBSensorType.DEPTH_SENSOR, sdk.OBSensorType.IR_SENSOR):
            profiles = pipeline.get_stream_profile_list(sensor)
            config.enable_stream(profiles.get_default_video_stream_profile())
        pipeline.start(config)
    try:
        yield stream_of(CAMERA, "Femto", _pictures(sdk, pipeline))
    finally:
        pipeline.stop()


def _pictures(sdk: Any, pipeline: Any) -> Iterator[DepthPicture]:
    """Yield the frames that have depth."""
    while True:
        frames = pipeline.wait_for_frames(1000 * PATIENCE_S)
        if frames is None:
            raise without_frames(CAMERA)
        depth = frames.get_depth_frame()
        if depth is None:
            continue
        infrared = frames.get_ir_frame()
        is_16_bit = infrared is not None and infrared.get_format() == sdk.OBFormat.Y16
        yield DepthPicture(
            time_s=1e-6 * depth.get_timestamp_us(),
            stored=_numbers(depth),
            # stated as a 32-bit number
            unit_m=round(MM * depth.get_depth_scale(), 9),
            lens=_lens(sdk, depth.get_stream_profile().as_video_stream_profile()),
            amplitude=_numbers(infrared) if is_16_bit else None,
        )


def _numbers(frame: Any) -> np.ndarray:
    """Return the 16-bit numbers (h, w) of a frame, whose memory the package uses again."""
    stored = np.frombuffer(frame.get_data(), np.uint16).copy()
    return stored.reshape(frame.get_height(), frame.get_width())


def _lens(sdk: Any, profile: Any) -> Lens:
    """Return the lens of a stream. Raises UserError for a model other than OpenCV's."""
    stated = profile.get_intrinsic()
    bent = profile.get_distortion()
    first = [bent.k1, bent.k2, bent.p1, bent.p2]
    distortion = [*first, bent.k3, bent.k4, bent.k5, bent.k6]
    models = sdk.OBCameraDistortionModel
    legal = (models.NONE, models.BROWN_CONRADY, models.BROWN_CONRADY_K6)
    if any(distortion) and bent.model not in legal:
        problem = f"camera {CAMERA}: its depth has the lens model {bent.model}"
        raise UserError(problem, legal="none, or Brown-Conrady as in OpenCV")
    matrix = np.array([[stated.fx, 0, stated.cx], [0, stated.fy, stated.cy], [0, 0, 1]])
    return stated_lens(CAMERA, (stated.height, stated.width), matrix, distortion)
