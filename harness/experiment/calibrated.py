"""One's own unit instead of the nominal camera: the lens of a recording in place of the camera file's numbers."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens
from scenes.sensor.camera import camera_names, load_camera

LENS_NUMBERS = {"lens.fx_px": "fx", "lens.fy_px": "fy", "lens.cx_px": "cx", "lens.cy_px": "cy"}


def lens_numbers(recording: Path, cameras: Iterable[str]) -> dict[str, Any]:
    """What ``source.camera.numbers`` must hold for the cameras to look through a recording's own lens.

    Raises UserError where the recording cannot be read, names no lens, or is of another size than a camera's sensor.
    """
    lens = _lens_of(recording)
    for name in cameras:
        nominal = load_camera(name).nominal_lens if name in camera_names() else lens
        if (nominal.width, nominal.height) != (lens.width, lens.height):
            raise UserError(
                f"{recording}: the calibration is of {lens.width} x {lens.height} pixels",
                legal=f"{nominal.width} x {nominal.height}, as {name} has",
                fix="name a recording of the same camera in the same mode, or choose another source.camera.name",
            )
    numbers: dict[str, Any] = {path: float(getattr(lens, field)) for path, field in LENS_NUMBERS.items()}
    return {**numbers, "lens.distortion": [float(term) for term in lens.distortion]}


def _lens_of(recording: Path) -> Lens:
    from detectors.recordings import open_capture  # brings the readers of every format

    lens = None
    if recording.is_dir() or recording.suffix.lower() == ".mkv":
        lens = open_capture([recording]).lens
    elif not recording.is_file():
        raise UserError(f"--calibration {recording}: no such file or folder")
    if lens is None:
        raise UserError(
            f"--calibration {recording}: holds no calibration of a lens",
            legal="an Azure Kinect .mkv, or a folder of depth images with its intrinsics beside them",
        )
    return lens
