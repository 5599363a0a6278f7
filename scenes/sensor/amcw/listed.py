"""Pixels that go through the whole chain alone: which light they need, and their frames.

The windows of runs of such pixels in a row, or in a column, stand side by side as strips, so that
one loop filters them all."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.imager import AmcwImager, NoisyLight
from scenes.sensor.amcw.ranging import DepthEngine
from scenes.sensor.amcw.windows import pixels_within, windows_of
from scenes.sensor.common.unit import DecodedFrame

f4 = np.float32


class Listed(NamedTuple):
    """Pixels to simulate by the whole chain."""

    pixels: np.ndarray
    """(p,): flat indices of the pixels whose result is wanted."""
    columns: np.ndarray
    """(p,): first column of the window of each."""
    halo: np.ndarray
    """(g,): flat indices of pixels whose light is needed."""
    strips: np.ndarray
    """(side, s) int32: indices in ``halo`` of the columns of windows, run by run; g stands for what
    is beyond the picture. A window begins at each of the first c = s - side + 1 columns."""
    turned: int
    """First column of the windows that are turned: their columns are rows of the picture."""
    middles: np.ndarray
    """(c,) int32: indices in ``halo`` of the middles of windows."""
    neighbours: np.ndarray
    """(c, 9) int32: the windows of a pixel's neighbours and of itself, -1 for none."""
    engine: DepthEngine
    """The depth engine of the windows' pixels; those whose window is no square of the picture are
    outside its mask."""


def listed_of(wanted: np.ndarray, imager: AmcwImager) -> Listed:
    """Return the list for ``wanted`` (h, w) bool pixels of a view."""
    engine = imager.engine
    side = len(imager.filter_settings.space)
    half = side // 2
    # the gate on the finished image looks at a pixel's neighbours
    ranges = wanted if engine.flying is None else pixels_within(wanted, 3)
    halo = pixels_within(ranges, side)
    halo_pixels = np.flatnonzero(halo)
    number_in_halo = _running_numbers(halo, len(halo_pixels))
    strips, turned, columns = _strips(ranges, number_in_halo, side, len(halo_pixels))
    windows = max(strips.shape[1] - side + 1, 0)
    middles = strips[half, half : half + windows]
    column_of = np.full(wanted.shape, -1, np.int32)
    column_of[ranges] = columns
    neighbours = np.full((windows, 9), -1, np.int32)
    if engine.flying is not None:
        neighbours[columns] = windows_of(column_of, 3, -1, np.flatnonzero(ranges))
    outside_mask = np.ones(windows, bool)
    outside_mask[columns] = engine.outside_mask[ranges.ravel()]
    return Listed(
        pixels=np.flatnonzero(wanted),
        columns=column_of[wanted],
        halo=halo_pixels,
        strips=strips,
        turned=turned,
        middles=middles,
        neighbours=neighbours,
        engine=engine._replace(
            geometry=engine.geometry.take(np.append(halo_pixels, 0)[middles], axis=1),
            outside_mask=outside_mask,
        ),
    )


def _running_numbers(pixels: np.ndarray, without: int) -> np.ndarray:
    """Return (h, w) int32: 0, 1, 2 .. at the ``pixels`` (h, w) bool, ``without`` elsewhere."""
    numbers = np.cumsum(pixels).reshape(pixels.shape) - 1
    return np.where(pixels, numbers, without).astype(np.int32)


def _run_lengths(pixels: np.ndarray) -> np.ndarray:
    """Return (h, w): the length of the run of pixels (h, w) bool in a row to which each belongs, 0
    elsewhere."""
    changes = np.diff(np.pad(pixels, ((0, 0), (1, 1))).view(np.int8).ravel())
    lengths = np.flatnonzero(changes == -1) - np.flatnonzero(changes == 1)
    of_pixels = np.zeros(pixels.shape, int)
    of_pixels[pixels] = np.repeat(lengths, lengths)
    return of_pixels


def _strips(
    pixels: np.ndarray, numbers: np.ndarray, side: int, beyond: int
) -> tuple[np.ndarray, int, np.ndarray]:
    """Return ``strips``, ``turned`` and ``columns`` of `Listed` for pixels (h, w) bool, with the
    ``numbers`` (h, w) of all pixels, and ``beyond`` outside the picture."""
    # a run of m pixels takes m + side - 1 columns: each pixel goes with the longer of its two runs
    in_rows = pixels & (_run_lengths(pixels) >= _run_lengths(pixels.T).T)
    in_columns = np.ascontiguousarray((pixels & ~in_rows).T)
    turned_numbers = np.ascontiguousarray(numbers.T)
    upright_strips, upright_columns = _strips_of_rows(in_rows, numbers, side, beyond)
    turned_strips, turned_columns = _strips_of_rows(in_columns, turned_numbers, side, beyond)
    turned = upright_strips.shape[1]
    columns = np.empty(pixels.shape, int)
    columns[in_rows] = upright_columns
    columns.T[in_columns] = turned + turned_columns
    return np.concatenate([upright_strips, turned_strips], axis=1), turned, columns[pixels]


def _strips_of_rows(
    pixels: np.ndarray, numbers: np.ndarray, side: int, beyond: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the strips of runs in rows, and each pixel's first column; arguments as of
    `_strips`."""
    half = side // 2
    padded = np.pad(pixels, half)
    padded_numbers = np.pad(numbers, half, constant_values=beyond)
    # the columns of windows, run by run
    reached = cv2.dilate(padded.view(np.uint8), np.ones((1, side), np.uint8)).view(bool)
    column_numbers = np.cumsum(reached).reshape(reached.shape) - 1
    width = padded.shape[1]
    upper = np.flatnonzero(reached) - half * width
    below = np.arange(side)[:, None] * width
    return padded_numbers.ravel()[upper + below], column_numbers[padded] - half


def decoded(listed: Listed, imager: AmcwImager, light: NoisyLight, error_m: float) -> DecodedFrame:
    """Run the whole engine on noisy ``light`` of the list's halo and, as its last pixel, of what is
    beyond the picture. Return the wanted pixels (p,)."""
    n_frequencies = len(light.amplitude)
    windows = len(listed.middles)
    filtered = np.empty((n_frequencies, 3, windows), f4)
    edge = np.empty((n_frequencies, windows), f4)
    kernels.filter_strips(
        light.unit,
        light.amplitude,
        listed.strips,
        listed.turned,
        imager.filter_settings,
        filtered,
        edge,
    )
    frame = imager.decode(
        filtered=filtered,
        edge=edge,
        saturated=light.saturated[listed.middles],
        engine=listed.engine,
        neighbours=listed.neighbours,
        error_m=error_m,
    )
    return DecodedFrame(
        z_m=frame.z_m[listed.columns],
        reason=frame.reason[listed.columns],
        amplitude=frame.amplitude[listed.columns],
    )
