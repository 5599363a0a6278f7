"""The factory calibration of an Azure Kinect: from its JSON to the lens of a depth or colour mode.

Source: the camera modes of Microsoft's Azure-Kinect-Sensor-SDK (mode_specific_calibration.c) and its parameter order
(k4atypes.h). The JSON's numbers are divided by the image's size and count from the corner of the first pixel; a mode
scales them to its binned sensor, subtracts its crop's offset, and 0.5 px leads to the centre of the first pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import TEXT_BYTES, refuse_bytes


@dataclass(frozen=True)
class Mode:
    """A read-out of the sensor: the binned sensor, the offset of the crop in it, and the image; (x, y) pixels."""

    sensor: tuple[int, int]
    offset: tuple[int, int]
    image: tuple[int, int]


DEPTH_MODES = {
    "NFOV_2X2BINNED": Mode((512, 512), (96, 90), (320, 288)),
    "NFOV_UNBINNED": Mode((1024, 1024), (192, 180), (640, 576)),
    "WFOV_2X2BINNED": Mode((512, 512), (0, 0), (512, 512)),
    "WFOV_UNBINNED": Mode((1024, 1024), (0, 0), (1024, 1024)),
}
COLOUR_MODES = (
    Mode((1280, 960), (0, 120), (1280, 720)),
    Mode((1920, 1440), (0, 180), (1920, 1080)),
    Mode((2560, 1920), (0, 240), (2560, 1440)),
    Mode((2048, 1536), (0, 0), (2048, 1536)),
    Mode((3840, 2880), (0, 360), (3840, 2160)),
    Mode((4096, 3072), (0, 0), (4096, 3072)),
)


@dataclass(frozen=True)
class ColourCamera:
    """The colour camera beside the depth camera: ``T_colour_depth`` maps points (metres) from depth to colour."""

    lens: Lens
    T_colour_depth: np.ndarray


def parse_calibration(name: str, content: bytes) -> dict[str, Any]:
    """Parse the calibration's JSON (a trailing zero byte is the recorder's). Raises UserError where it is none."""
    refuse_bytes(name, len(content), TEXT_BYTES)
    try:
        data = strict_json(content.rstrip(b"\0"))
        cameras = data["CalibrationInformation"]["Cameras"]
        return {camera["Purpose"].removeprefix("CALIBRATION_CameraPurpose"): camera for camera in cameras}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{name}: is no Azure Kinect calibration ({type(error).__name__}: {error})",
            legal="the JSON that k4arecorder attaches: CalibrationInformation with its Cameras",
            fix="record again, or give a lens with --intrinsics FILE",
        ) from error


def depth_lens(name: str, cameras: dict[str, Any], mode: str) -> Lens:
    """Return the lens of a depth mode such as ``NFOV_UNBINNED``. Raises UserError for another mode or a bad file."""
    if mode not in DEPTH_MODES:
        raise UserError(f"{name}: depth mode {mode} has no depth image", legal=", ".join(DEPTH_MODES))
    camera, numbers = _camera(name, cameras, "Depth")
    if (camera["SensorWidth"], camera["SensorHeight"]) != (1024, 1024):
        raise UserError(
            f"{name}: calibration of a sensor that is not 1024 x 1024", legal="an Azure Kinect's depth camera"
        )
    return _lens(name, numbers, DEPTH_MODES[mode])


def depth_mode_of_size(width: int, height: int) -> str | None:
    """Return the depth mode whose image has this size, None where there is none."""
    return next((name for name, mode in DEPTH_MODES.items() if mode.image == (width, height)), None)


def colour_camera(name: str, cameras: dict[str, Any], width: int, height: int) -> ColourCamera | None:
    """Return the colour camera in the mode whose image has this size; None where the size is of no mode.

    Raises UserError where the calibration lacks the colour camera.
    """
    mode = next((mode for mode in COLOUR_MODES if mode.image == (width, height)), None)
    if mode is None:
        return None
    camera, parameters = _camera(name, cameras, "PhotoVideo")
    if camera["SensorWidth"] * 9 == camera["SensorHeight"] * 16:
        # Early units were calibrated on the 16:9 part of the sensor: 2304 of its 3072 rows, from row 384.
        parameters[1] = (parameters[1] * 2304 + 384) / 3072
        parameters[3] = parameters[3] * 2304 / 3072
    T_colour_depth = np.eye(4)
    try:
        T_colour_depth[:3, :3] = np.reshape(np.array(camera["Rt"]["Rotation"], float), (3, 3))
        T_colour_depth[:3, 3] = np.reshape(np.array(camera["Rt"]["Translation"], float), 3)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{name}: the colour camera's place cannot be read ({error!r})") from error
    return ColourCamera(_lens(name, parameters, mode), T_colour_depth)


def _camera(name: str, cameras: dict[str, Any], purpose: str) -> tuple[dict[str, Any], list[float]]:
    """Return a camera and its 14 numbers cx, cy, fx, fy, k1..k6, codx, cody, p2, p1."""
    if purpose not in cameras:
        raise UserError(f"{name}: the calibration has no camera for {purpose}", legal="cameras Depth and PhotoVideo")
    camera: dict[str, Any] = cameras[purpose]
    if not all(isinstance(camera.get(key), int) for key in ("SensorWidth", "SensorHeight")):
        raise UserError(f"{name}: the calibration states no size of the sensor for {purpose}")
    try:
        model, numbers = camera["Intrinsics"]["ModelType"], [float(x) for x in camera["Intrinsics"]["ModelParameters"]]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{name}: the calibration's intrinsics cannot be read ({error!r})") from error
    if model != "CALIBRATION_LensDistortionModelBrownConrady" or len(numbers) != 14 or not np.isfinite(numbers).all():
        raise UserError(
            f"{name}: lens model {model} with {len(numbers)} parameters is not known",
            legal="CALIBRATION_LensDistortionModelBrownConrady with 14 finite parameters",
            fix="give a lens with --intrinsics FILE",
        )
    if numbers[10] or numbers[11]:
        raise UserError(
            f"{name}: a centre of distortion beside the principal point is not modelled",
            legal="codx = cody = 0, as in every published Azure Kinect calibration",
            fix="give a lens with --intrinsics FILE",
        )
    return camera, numbers


def _lens(name: str, parameters: list[float], mode: Mode) -> Lens:
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = parameters
    if not (fx > 0 and fy > 0):
        raise UserError(f"{name}: focal length {fx:g}, {fy:g}", legal="above 0")
    return Lens(
        width=mode.image[0],
        height=mode.image[1],
        fx=fx * mode.sensor[0],
        fy=fy * mode.sensor[1],
        cx=cx * mode.sensor[0] - mode.offset[0] - 0.5,
        cy=cy * mode.sensor[1] - mode.offset[1] - 0.5,
        distortion=(k1, k2, p1, p2, k3, k4, k5, k6),
    )
