"""What one camera makes of an undamaged board: pitch of its pixels, share that is valid, temporal noise and its grain.

From hole-free trials. Temporal noise comes from the difference of a capture's first two frames, which has everything
that frames share taken out: scene, multipath, fixed pattern, rounding that does not change. A displacement of a whole
frame is taken out with the difference's median.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any

import numpy as np

from harness.engine.setup import SetUp
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM
from scenes.sensor.source import SimulatedCapture

LAGS = (1, 2, 3)
"""Distances in pixels at which the noise's correlation is taken."""
FEWEST_PAIRS = 50
"""Pairs of pixels below which a correlation is not told: its standard error would exceed 0.14."""


def board_noise_rows(
    set_up: SetUp, clouds: Mapping[int, Cloud], capture: SimulatedCapture, repeat: int, variants: set[tuple[str, int]]
) -> Iterator[dict[str, Any]]:
    """One row for each (variant, number of frames): the columns named in the module's first line.

    ``valid_share``: of the board's pixels, after averaging so many frames. ``single_frame_mm``: standard deviation over
    pixels of one frame's temporal noise of z. ``correlation_u<k>``, ``correlation_v<k>``: of that noise with itself k
    columns or rows on. ``pitch_u_mm``, ``pitch_v_mm``: median distance on the board between neighbouring pixels.
    """
    pair = [frame.z_m for frame in islice(capture.frames(), 2)]
    noise = pair_noise(pair[0], pair[1], set_up.bare) if len(pair) == 2 else pair_noise(pair[0], pair[0], set_up.bare)
    pitch = set_up.pitch_mm
    for variant, frames in sorted(variants):
        yield {
            "variant": variant,
            "frames": frames,
            "repeat": repeat,
            "valid_share": float(clouds[frames].valid[set_up.on_board].mean()),
            "pitch_u_mm": pitch[0],
            "pitch_v_mm": pitch[1],
            **noise,
        }


def pair_noise(first_z_m: np.ndarray, second_z_m: np.ndarray, where: np.ndarray) -> dict[str, float]:
    """Standard deviation of one frame's temporal noise and its correlations from two frames' z (h, w), metres.

    Pixels count that are in ``where`` (h, w) and valid in both frames; NaN where there are too few.
    """
    difference = (first_z_m.astype(float) - second_z_m.astype(float)) / np.sqrt(2)
    there = where & np.isfinite(difference)
    if there.sum() < FEWEST_PAIRS:
        return {"single_frame_mm": np.nan} | {f"correlation_{way}{lag}": np.nan for way in "uv" for lag in LAGS}
    noise = np.where(there, difference - np.median(difference[there]), 0.0)
    found = {"single_frame_mm": float(np.sqrt((noise[there] ** 2).mean())) / MM}
    for way, turned, mask in (("u", noise, there), ("v", noise.T, there.T)):
        found |= {f"correlation_{way}{lag}": _correlation(turned, mask, lag) for lag in LAGS}
    return found


def _correlation(noise: np.ndarray, there: np.ndarray, lag: int) -> float:
    """Of pixels with those ``lag`` columns on, over pairs that are both there."""
    both = there[:, :-lag] & there[:, lag:]
    a, b = noise[:, :-lag][both], noise[:, lag:][both]
    power = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / power) if len(a) >= FEWEST_PAIRS and power > 0 else float("nan")
