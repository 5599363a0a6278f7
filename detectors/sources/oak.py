"""Luxonis' cameras with a time-of-flight sensor (OAK-D ToF, OAK-D SR PoE) through depthai,
version 3.

Source: Luxonis' documents of the ToF node and its example tof_all_queues (depth is 16 bits in
millimetres, 0 is none), and of ImgTransformation, with OpenCV's order of coefficients. Not run with
a camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.distances import UNITS_M
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
from harness.vocabulary.geometry import Lens

CAMERA = "oak"
INSTALL = "pip install 'tofpod[oak]'"


@contextmanager
def open_oak(path: Path | None) -> Iterator[Stream]:
    """Start the first camera's time-of-flight sensor with the profile of middle ranges."""
    refuse_recording(CAMERA, path, "bags")
    dai = load_sdk("depthai", CAMERA, INSTALL)
    with camera_errors(CAMERA):
        pipeline = dai.Pipeline()
        node = pipeline.create(dai.node.ToF).build(
            boardSocket=dai.CameraBoardSocket.AUTO, profile=dai.ToFConfig.Profile.MID_RANGE
        )
        # of the two generations, only the older one gives depth before its filters
        is_older = pipeline.getDefaultDevice().getPlatform() == dai.Platform.RVC2
        depths = (node.rawDepth if is_older else node.depth).createOutputQueue()
        pipeline.start()
    try:
        yield stream_of(CAMERA, "OAK-D ToF", _pictures(dai, depths))
    finally:
        pipeline.stop()


def _pictures(dai: Any, depths: Any) -> Iterator[DepthPicture]:
    """Yield the depth frames of a queue."""
    while True:
        frame = depths.get(timedelta(seconds=PATIENCE_S))
        if frame is None:
            raise without_frames(CAMERA)
        stored = np.array(frame.getFrame())
        yield DepthPicture(
            time_s=frame.getTimestampDevice().total_seconds(),
            stored=stored,
            unit_m=UNITS_M["mm"],
            lens=_lens(dai, frame.getTransformation(), stored.shape),
        )


def _lens(dai: Any, stated: Any, shape: tuple[int, ...]) -> Lens:
    """Return the lens of a frame's pixels. Raises UserError for a model other than OpenCV's."""
    model = stated.getDistortionModel()
    if model != dai.CameraModel.Perspective:
        problem = f"camera {CAMERA}: its depth has the lens model {model}"
        raise UserError(problem, legal="perspective, with the coefficients of OpenCV")
    matrix = np.array(stated.getIntrinsicMatrix())
    return stated_lens(CAMERA, shape, matrix, stated.getDistortionCoefficients())
