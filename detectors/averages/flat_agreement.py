"""The test of a flat field against a capture. They do not belong together if it was made from the
capture's own frames, or if it holds no pattern of this camera.

A capture is the unit's pattern, the surface's shape and noise of its own; a flat field is the
pattern and noise of other frames. After the correction at least the capture's own noise remains,
which the difference between its even and odd frames shows. If less remains, the noise was in the
flat field as well. If the correction makes the surface rougher, the flat field is another unit's.
All three maps lose what is wider than `WINDOW_PX`, so that neither the surface's shape nor noise
that neighbours share counts. Not seen: a flat field of which the capture is a small part, unless
its frames are named in the file."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from detectors.averages.flat_field import FlatField
from detectors.pixels.noise import sigma_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame

WINDOW_PX = 11
FILLED = 0.97
"""Least share of a window with numbers: the mean of a tilted surface over a window with a gap is
off."""
HALF_FILLED = 0.5
FEWEST_PIXELS = 1000
FEWEST_FRAMES = 4
OUTLIER_SIGMAS = 6.0
"""Larger differences from the neighbours are edges and damage, not pattern or noise."""
OWN_NOISE = 0.6
"""Share of the capture's own noise, as a variance, that remains if another one was corrected: 1 or
more if its frames were not in the flat field, 0 if it was made of them, .5 if they were half."""
ROUGHER = 1.1
"""Factor of roughness, beyond the map's noise, from which a correction does harm."""
BLOCKS = 8  # blocks along each side, whose scatter gives the standard error
SURE_SIGMAS = 3.0
PATCH_PX = 7
"""Width of the places that are compared: smaller ones are single pixels, which damage is not."""
AROUND_PX = 35
STANDS_OUT = 5.0
"""Sigmas of its own map beyond which a place stands out: one in two million places by chance."""
NOT_THIS = "leave out --flat-field, or make one from other captures of this camera"


def frame_digest(frame: Frame) -> str:
    """Return a digest of a frame's distances, "" if it has none."""
    if not np.isfinite(frame.z_m).any():
        return ""
    z_m = np.where(np.isfinite(frame.z_m), frame.z_m, np.nan).astype("<f4")
    return hashlib.blake2b(z_m.tobytes(), digest_size=16).hexdigest()


def frame_digests(frames: Iterable[Frame]) -> frozenset[str]:
    """Return the digests of all frames that have distances."""
    return frozenset(filter(None, map(frame_digest, frames)))


@dataclass(frozen=True)
class _Maps:
    """A capture and a flat field without what is wide; (n,) of the pixels that both know."""

    capture_m: np.ndarray
    """Range of the capture, before the correction."""
    field_m: np.ndarray
    """Error of range by the flat field."""
    variance_m2: np.ndarray
    """Variance of the flat field by its own noise."""
    block: np.ndarray
    """Number of the block of each pixel."""
    counts: np.ndarray
    """(h, w) bool: the pixels."""


def refuse_unfit(
    cloud: Cloud,
    frames: Iterable[Frame],
    field: FlatField,
    name: str | Path,
) -> None:
    """Raise UserError if a flat field must not correct a cloud, which is the average of the
    ``frames``, before the correction. ``name``: of the flat field."""
    in_field = 0
    offered = 0
    left_out = {frame.name for frame in cloud.left_out}
    sums_m = np.zeros((2, *cloud.valid.shape))
    counts = np.zeros((2, *cloud.valid.shape), int)
    for frame in frames:
        in_field += frame_digest(frame) in field.frames
        if frame.name in left_out or frame.z_m.shape != cloud.valid.shape:
            continue
        is_finite = np.isfinite(frame.z_m)
        sums_m[offered % 2] += np.where(is_finite, frame.z_m, 0.0)
        counts[offered % 2] += is_finite
        offered += 1
    if in_field:
        raise UserError(
            f"the flat field {name} was made from this capture: {in_field} of its frames are in"
            " both; it would take the surface's own shape and damage away",
            legal="a flat field of other captures",
            fix=NOT_THIS,
        )
    maps = _maps(cloud, field)
    if maps is None:
        return
    left_m = maps.capture_m - maps.field_m
    if offered >= FEWEST_FRAMES:
        with np.errstate(invalid="ignore", divide="ignore"):
            first_m, second_m = sums_m / counts
        noise_m = _without_wide((first_m - second_m) / 2)[maps.counts]
        noise_m = noise_m[np.isfinite(noise_m)]
        own_share = (sigma_of(left_m) / max(sigma_of(noise_m), 1e-12)) ** 2
        if own_share < OWN_NOISE:
            raise UserError(
                f"the flat field {name} holds the noise of this capture: after the correction"
                f" {100 * own_share:.0f} % of it remain, so it was made from these frames",
                legal="a flat field of other captures",
                fix=NOT_THIS,
            )
    before_m = sigma_of(maps.capture_m)
    after_m = sigma_of(left_m)
    # a map of few frames adds its own noise, and still takes the pattern away
    by_pattern_m = np.sqrt(max(after_m**2 - float(np.median(maps.variance_m2)), 0.0))
    if by_pattern_m > ROUGHER * before_m and _is_surely_rougher(maps):
        raise UserError(
            f"the flat field {name} makes this capture rougher, from {before_m / MM:.2g} to"
            f" {after_m / MM:.2g} mm: its pattern is not in the capture",
            legal="a flat field of the same unit, in the same mode and at such distances",
            fix=NOT_THIS,
        )


def _maps(cloud: Cloud, field: FlatField, corrected: bool = False) -> _Maps | None:
    """Return the maps of a cloud, before or after the correction; None if they share too few
    pixels."""
    error_m = field.error_m[cloud.region.within(field.lens.whole)].astype(float)
    range_m = np.linalg.norm(cloud.points_m, axis=-1)
    if corrected:
        range_m = range_m + np.where(np.isfinite(error_m), error_m, 0.0)
    capture_m = _without_wide(np.where(cloud.valid, range_m, np.nan))
    field_m = _without_wide(error_m)
    counts = np.isfinite(capture_m) & np.isfinite(field_m)
    if counts.sum() < FEWEST_PIXELS:
        return None
    for values in (capture_m, field_m, capture_m - field_m):
        spread = sigma_of(values[counts])
        counts &= np.abs(np.nan_to_num(values)) <= OUTLIER_SIGMAS * spread
    rows, columns = np.nonzero(counts)
    height, width = counts.shape
    block = BLOCKS * rows // height * BLOCKS + BLOCKS * columns // width
    variance_m2 = field.variance_m2[cloud.region.within(field.lens.whole)].astype(float)
    return _Maps(
        capture_m=capture_m[counts],
        field_m=field_m[counts],
        variance_m2=variance_m2[counts],
        block=block,
        counts=counts,
    )


def _is_surely_rougher(maps: _Maps) -> bool:
    """Return whether blocks of the picture agree that the correction adds roughness, beyond the
    noise of the map."""
    added_m2 = maps.field_m**2 - 2 * maps.field_m * maps.capture_m - maps.variance_m2
    pixels = np.bincount(maps.block)
    sums_m2 = np.bincount(maps.block, added_m2)
    of_blocks_m2 = sums_m2[pixels > 0] / pixels[pixels > 0]
    error_m2 = of_blocks_m2.std(ddof=1) / np.sqrt(len(of_blocks_m2))
    return bool(of_blocks_m2.mean() > SURE_SIGMAS * error_m2)


def places_doubt(cloud: Cloud, field: FlatField, name: str | Path) -> str:
    """Return a full sentence if a flat field may hold the shape of a corrected cloud's surface,
    else "". A flat field for which the camera moved holds no surface."""
    shared_px = np.zeros((0, 2)) if field.moved else shared_places(cloud, field)
    if not len(shared_px):
        return ""
    u, v = shared_px[0]
    count = "one place" if len(shared_px) == 1 else f"{len(shared_px)} places"
    return (
        f"the flat field {name}, recorded from one position, and this capture stand out alike at"
        f" {count} as wide as damage (the clearest at pixel {u}, {v}): if both show the same"
        " surface, the correction takes its damage away"
    )


def shared_places(cloud: Cloud, field: FlatField) -> np.ndarray:
    """Return the places (k, 2) u, v in pixels of the whole sensor, as wide as damage, that stand
    out alike in a flat field and in the corrected ``cloud`` before its correction; the most
    striking first."""
    region = cloud.region.within(field.lens.whole)
    error_m = field.error_m[region].astype(float)
    range_m = np.linalg.norm(cloud.points_m, axis=-1)
    before_m = np.where(cloud.valid, range_m + error_m, np.nan)
    of_field = _striking(error_m)
    of_capture = _striking(before_m)
    of_rest = _striking(np.where(np.isfinite(error_m), before_m - error_m, np.nan))
    height = np.minimum(np.abs(of_field), np.abs(of_capture))
    is_same_sign = of_field * of_capture > 0
    # the correction takes more than half of it away
    is_corrected = np.abs(of_rest) < np.abs(of_capture) / 2
    is_shared = is_same_sign & (height > STANDS_OUT) & is_corrected
    count, labels = cv2.connectedComponents(is_shared.astype(np.uint8))
    peaks = []
    for number in range(1, count):
        values = np.where(labels == number, height, -np.inf)
        row, column = np.unravel_index(int(values.argmax()), values.shape)
        peaks.append((values[row, column], column + region[1].start, row + region[0].start))
    peaks.sort(reverse=True)
    return np.array([(u, v) for _, u, v in peaks], int).reshape(-1, 2)


def _striking(values_m: np.ndarray) -> np.ndarray:
    """Return how far the means of small windows lie off their surroundings, in sigmas of all such
    differences (h, w); 0 where unknown."""
    narrow = _window_mean(values_m, PATCH_PX, HALF_FILLED)
    differences = narrow - _window_mean(values_m, AROUND_PX, FILLED)
    # a curved surface shifts all differences nearby alike
    differences -= _window_mean(differences, AROUND_PX, 0.0)
    is_known = np.isfinite(differences)
    if is_known.sum() < FEWEST_PIXELS:
        return np.zeros(values_m.shape)
    spread = max(sigma_of(differences[is_known]), 1e-12)
    return np.where(is_known, differences / spread, 0.0)


def _without_wide(values: np.ndarray) -> np.ndarray:
    """Return a map (h, w) minus the means of its windows, twice; NaN where a window is not full.
    Once would leave a surface's curvature: .1 mm of a plane at 1 m, half of an average's noise."""
    once = values - _window_mean(values, WINDOW_PX, FILLED)
    return once - _window_mean(once, WINDOW_PX, FILLED)


def _window_mean(values: np.ndarray, width_px: int, filled: float) -> np.ndarray:
    """Return the mean of the finite values in the window about each pixel; NaN where fewer than a
    share of it are finite."""
    is_finite = np.isfinite(values)
    window = (width_px, width_px)
    edge = cv2.BORDER_CONSTANT
    share = cv2.boxFilter(is_finite.astype(float), -1, window, borderType=edge)
    total = cv2.boxFilter(np.where(is_finite, values, 0.0), -1, window, borderType=edge)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(share >= filled, total / share, np.nan)
