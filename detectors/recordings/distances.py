"""From stored numbers to distances: units, reasons for invalid pixels, and the check that catches a wrong unit."""

from __future__ import annotations

import re

import numpy as np

from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError

UNITS_M = {"mm": 1e-3, "m": 1.0, "cm": 1e-2, "um": 1e-6, "tum": 1 / 5000}
"""Metres in one stored unit; ``tum`` is the scale of the TUM RGB-D benchmark, 5000 to the metre."""

NEAREST_M, FARTHEST_M = 0.05, 20.0
"""Bounds of a plausible median distance: nearer than any time-of-flight camera works, farther than any of them sees."""

LEGAL_UNITS = "mm, cm, m, um, tum (5000 to the metre), or N/m for N to the metre (4000/m)"

COMMON_STEPS_M = (1e-3, 2.5e-4, 2e-4, 1e-4)
"""Rounding steps that cameras store: 1 mm (Kinects), 0.25 mm (L515), 0.2 mm (TUM), 0.1 mm."""


def metres_per_unit(unit: str) -> float:
    """Metres in one stored unit. Raises UserError for a unit that is not known."""
    if unit in UNITS_M:
        return UNITS_M[unit]
    counted = re.fullmatch(r"(\d+(?:\.\d+)?)/m", unit)
    if counted and float(counted.group(1)) > 0:
        return 1.0 / float(counted.group(1))
    raise UserError(f"--unit {unit}: no such unit", legal=LEGAL_UNITS)


def default_metres(dtype: np.dtype) -> float:
    """The usual unit of stored numbers: millimetres for integers, metres for floating point."""
    return UNITS_M["mm"] if dtype.kind in "iu" else UNITS_M["m"]


def refuse_narrow(name: str, dtype: np.dtype) -> None:
    """Raise UserError where the numbers cannot be distances: 8 bit, boolean, complex, text or objects."""
    if dtype.kind in "iu" and dtype.itemsize == 1:
        raise UserError(
            f"{name}: holds 8-bit numbers, which is a picture or a mask and not a depth image",
            legal="16-bit or wider integers, or floating point",
            fix="export the depth itself; a preview scaled to 0..255 has lost it",
        )
    if dtype.kind not in "iuf":
        raise UserError(f"{name}: holds {dtype}, not numbers", legal="integers of 16 bits or more, or floating point")


def frame_from_depth(
    name: str, stored: np.ndarray, scale_m: float, rgb: np.ndarray | None = None, amplitude: np.ndarray | None = None
) -> Frame:
    """A frame from stored depth (h, w) in units of ``scale_m`` metres; 0 means no return.

    Raises UserError where most of the points lie behind the camera.
    """
    z_m, reason = _judged(name, stored, scale_m)
    return Frame(name=name, z_m=z_m, reason=reason, rgb=rgb, amplitude=amplitude)


def frame_from_points(
    name: str, stored: np.ndarray, scale_m: float, rgb: np.ndarray | None = None, amplitude: np.ndarray | None = None
) -> Frame:
    """A frame from stored points (h, w, 3) in units of ``scale_m`` metres; a pixel with z = 0 means no return."""
    z_m, reason = _judged(name, stored[..., 2], scale_m)
    sideways = ~np.isfinite(stored[..., :2]).all(axis=-1) & (reason == Reason.VALID)
    reason[sideways] = Reason.NOT_FINITE
    z_m[sideways] = np.nan
    xy_m = stored[..., :2].astype(np.float64) * scale_m
    xy_m[reason != Reason.VALID] = np.nan
    return Frame(name=name, z_m=z_m, reason=reason, xy_m=xy_m, rgb=rgb, amplitude=amplitude)


def _judged(name: str, stored_z: np.ndarray, scale_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances (h, w) float32 with NaN where invalid, and the reason of each pixel."""
    reason = np.zeros(stored_z.shape, np.uint8)
    reason[stored_z == 0] = Reason.NO_RETURN
    if stored_z.dtype.kind == "f":
        reason[~np.isfinite(stored_z)] = Reason.NOT_FINITE
    behind = (stored_z < 0) & (reason == Reason.VALID)
    if behind.sum() > 0.5 * (reason == Reason.VALID).sum():
        raise UserError(
            f"{name}: most points lie behind the camera (z below 0)",
            legal="the camera's frame: x right, y down, z forward from the lens",
            fix="turn the cloud before saving it (a cloud with y up and z back: negate y and z)",
        )
    reason[behind] = Reason.OUT_OF_RANGE
    z_m = (stored_z * np.float64(scale_m)).astype(np.float32)
    z_m[reason != Reason.VALID] = np.nan
    return z_m, reason


def rounding_step_m(z_m: np.ndarray) -> float:
    """The coarsest common rounding step that all valid distances are multiples of; 0 where they follow none.

    A cloud in floating-point metres that came from a camera with 1 mm output still has steps of 1 mm.
    """
    values = z_m[np.isfinite(z_m)].astype(np.float64)
    for step_m in COMMON_STEPS_M:
        turns = values / step_m
        # 0.02 steps: float32 metres hold 20 m to 1 um, a hundredth of the finest step.
        if values.size and np.abs(turns - np.rint(turns)).max() < 0.02:
            return step_m
    return 0.0


def refuse_implausible(frame: Frame, scale_m: float) -> None:
    """Raise UserError where the frame's median distance speaks for a wrong unit. Says nothing about an empty frame.

    A factor that leaves the distance plausible (5000 to the metre read as millimetres) cannot be noticed here.
    """
    valid = frame.z_m[np.isfinite(frame.z_m)]
    if valid.size == 0:
        return
    median_m = float(np.median(valid[:: max(1, valid.size // 50_000)]))
    if NEAREST_M <= median_m <= FARTHEST_M:
        return
    fitting = [
        f"--unit {unit} (then {median_m / scale_m * metres:.3g} m)"
        for unit, metres in UNITS_M.items()
        if NEAREST_M <= median_m / scale_m * metres <= FARTHEST_M
    ]
    raise UserError(
        f"{frame.name}: the median distance would be {median_m:.4g} m, which speaks for a wrong unit",
        legal=f"a median between {NEAREST_M:g} m and {FARTHEST_M:g} m",
        fix="pass " + " or ".join(fitting) if fitting else f"state the unit with --unit: {LEGAL_UNITS}",
    )
