"""Azure Kinects, and Orbbec's Femtos behind the same interface, through pyk4a.

Source: k4a.h of the Azure Kinect Sensor SDK (depth is 16 bits in millimetres, 0 is none; the lens
is OpenCV's rational model, and (0, 0) is the centre of the first pixel), and pyk4a's documents. Run
with a recording, not with a camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from detectors.recordings.distances import UNITS_M
from detectors.sources.interface import (
    PATIENCE_S,
    DepthPicture,
    Stream,
    camera_errors,
    load_sdk,
    stated_lens,
    stream_of,
)

CAMERA = "k4a"
INSTALL = "pip install pyk4a, on a computer with the Azure Kinect SDK or Orbbec's wrapper for it"


@contextmanager
def open_k4a(path: Path | None) -> Iterator[Stream]:
    """Start the first camera in NFOV unbinned at 30 Hz without colour, or play an .mkv."""
    pyk4a = load_sdk("pyk4a", CAMERA, INSTALL)
    device: Any
    with camera_errors(CAMERA):
        if path is None:
            config = pyk4a.Config(
                color_resolution=pyk4a.ColorResolution.OFF,
                depth_mode=pyk4a.DepthMode.NFOV_UNBINNED,
                camera_fps=pyk4a.FPS.FPS_30,
                synchronized_images_only=False,
            )
            device = pyk4a.PyK4A(config)
            device.start()
        else:
            device = pyk4a.PyK4APlayback(path)
            device.open()
    try:
        pictures = _pictures(device, pyk4a.CalibrationType.DEPTH, is_live=path is None)
        yield stream_of(CAMERA, "Azure Kinect", pictures)
    finally:
        if path is None:
            device.stop()
        else:
            device.close()


def _pictures(device: Any, depth_camera: Any, *, is_live: bool) -> Iterator[DepthPicture]:
    """Yield the captures that have depth, until a recording ends."""
    calibration = device.calibration
    matrix = calibration.get_camera_matrix(depth_camera)
    distortion = calibration.get_distortion_coefficients(depth_camera)
    while True:
        try:
            capture = (
                device.get_capture(1000 * PATIENCE_S) if is_live else device.get_next_capture()
            )
        except EOFError:
            return
        if capture.depth is None:
            continue
        yield DepthPicture(
            time_s=1e-6 * capture.depth_timestamp_usec,
            stored=capture.depth,
            unit_m=UNITS_M["mm"],
            lens=stated_lens(CAMERA, capture.depth.shape, matrix, distortion),
            amplitude=capture.ir,
        )
