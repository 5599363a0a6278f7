"""A unit's fixed pattern as a map over its sensor: its file, and the correction of a cloud by it.

The pattern is assumed to be a range error along each pixel's ray that is the same in every
capture. Not modelled: a pattern that changes with distance, temperature or brightness
(`detectors.averages.flat_captures` tests the first two), and the mixing of pixels by a depth
engine's filter at the edge of a hole."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import Field

from detectors.pixels.noise import LEAST_FRAMES, average_variance_m2
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import atomic_path, refuse_pixels
from harness.vocabulary.geometry import Cloud, Lens
from harness.vocabulary.provenance import check_version

FLAT_FIELD_VERSION = 1
SAME_LENS = 0.02
"""Relative difference of focal lengths, and of centres to the width, up to which two lenses may
belong to one camera and mode: calibrations of one unit differ by less, modes of one camera by
more."""
WELL_COVERED = 0.9
NEAR_ENOUGH = 1.2  # ratio of distances up to which a pattern counts as measured there
AGAIN = "run tofpod flatfield on captures of this camera in this mode"


class FlatFieldConfig(Config):
    """A flat field to record: ``frames`` of a plane across the optical axis at ``distance_m``."""

    frames: int = Field(ge=LEAST_FRAMES, le=10_000)
    distance_m: float = Field(gt=0, le=100)


@dataclass(frozen=True)
class FlatField:
    """A unit's fixed pattern."""

    error_m: np.ndarray
    """(h, w): how much farther along its ray each pixel of the whole sensor sees a surface,
    without smooth parts; NaN where unknown."""
    variance_m2: np.ndarray
    """(h, w): of that error."""
    lens: Lens
    """The lens of the camera in its mode."""
    distances_m: tuple[float, float]
    """The nearest and the farthest at which it was measured."""
    warnings: tuple[str, ...] = ()
    """Full sentences on doubts about it."""
    frames: frozenset[str] = frozenset()
    """Digests of the frames that it was made of; empty if unknown."""
    moved: bool = False
    """Whether the camera moved between the captures, so that the surface's shape is not in it."""

    @property
    def rms_m(self) -> float:
        """Root mean square of the pattern without the map's own noise."""
        squares_m2 = self.error_m.astype(float) ** 2 - self.variance_m2
        return float(np.sqrt(max(np.nanmean(squares_m2), 0.0)))


def corrected(cloud: Cloud, field: FlatField) -> Cloud:
    """Return the cloud with its points moved along their rays to remove the pattern; points where
    it is unknown stay. ``mean_variance_m2`` is the frames' noise (None for a single frame) and the
    map's variance, or the pattern's mean square. Raises UserError if the cloud has no pixel grid
    or is of another camera, size or lens."""
    _refuse_other(cloud, field)
    cut = cloud.region.within(field.lens.whole)
    error_m = field.error_m[cut].astype(float)
    variance_m2 = field.variance_m2[cut].astype(float)
    is_known = np.isfinite(error_m)
    range_m = np.linalg.norm(cloud.points_m, axis=-1)
    moved = cloud.points_m * (1 - np.where(is_known, error_m, 0.0) / range_m)[..., None]
    noise_m2 = average_variance_m2(cloud, cloud.valid)
    if noise_m2 is not None:
        axial = (cloud.points_m[..., 2] / range_m) ** 2
        pattern_m2 = np.where(is_known, variance_m2, field.rms_m**2)
        noise_m2 = noise_m2 + axial * pattern_m2
    return replace(cloud, points_m=moved, mean_variance_m2=noise_m2)


def doubts(
    cloud: Cloud,
    field: FlatField,
    name: str | Path,
) -> tuple[str, ...]:
    """Return full sentences on doubts about the correction of a cloud. ``name``: of the field."""
    notes = [f"the flat field {name}: {warning}" for warning in field.warnings]
    is_known = np.isfinite(field.error_m[cloud.region.within(field.lens.whole)])
    share = 1.0
    distance_m = np.nan
    if cloud.valid.any():
        share = float(is_known[cloud.valid].mean())
        distance_m = float(np.median(cloud.points_m[cloud.valid][:, 2]))
    if share < WELL_COVERED:
        notes.append(
            f"the flat field {name} covers {100 * share:.0f} % of the valid pixels; others are not"
            " corrected"
        )
    nearest_m, farthest_m = field.distances_m
    if distance_m * NEAR_ENOUGH < nearest_m or distance_m > farthest_m * NEAR_ENOUGH:
        measured = f"{nearest_m:.2f} to {farthest_m:.2f} m"
        if farthest_m < nearest_m * 1.01:
            measured = f"{nearest_m:.2f} m"
        notes.append(
            f"the flat field {name} was measured at {measured}, this capture is at"
            f" {distance_m:.2f} m"
        )
    return tuple(notes)


def _refuse_other(cloud: Cloud, field: FlatField) -> None:
    """Raise UserError if the cloud cannot be of the camera and mode of the flat field."""
    if not cloud.organised or cloud.projection != "central":
        problem = "a flat field corrects a camera's own pixels, and this cloud has no pixel grid"
        raise UserError(problem, fix="leave out the flat field, or name the capture's depth images")
    lens = field.lens
    height, width = cloud.valid.shape
    if cloud.lens is not None:
        width = cloud.lens.width
        height = cloud.lens.height
    if (width, height) != (lens.width, lens.height):
        raise UserError(
            f"the flat field has {lens.width} x {lens.height} pixels, the capture has {width} x"
            f" {height}",
            legal="the same camera in the same mode",
            fix=AGAIN,
        )
    if cloud.lens is not None and not _is_same_lens(cloud.lens, lens):
        raise UserError(
            f"the capture's lens ({_lens_text(cloud.lens)}) is not that of the flat field"
            f" ({_lens_text(lens)})",
            legal="the same camera in the same mode",
            fix=AGAIN,
        )


def _is_same_lens(lens: Lens, other: Lens) -> bool:
    """Return whether two lenses may belong to one camera and mode; the second sets the scale."""
    limit = SAME_LENS * max(other.fx, other.width)
    names = ("fx", "fy", "cx", "cy")
    return all(abs(getattr(lens, name) - getattr(other, name)) <= limit for name in names)


def _lens_text(lens: Lens) -> str:
    return f"fx {lens.fx:.1f}, fy {lens.fy:.1f}, centre {lens.cx:.1f}, {lens.cy:.1f}"


def save_flat_field(path: Path, field: FlatField) -> None:
    """Write the file, whole or not at all. Raises UserError if it cannot be written."""
    lens = field.lens
    numbers = [lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            error_m=field.error_m.astype(np.float32),
            variance_m2=field.variance_m2.astype(np.float32),
            version=np.array(FLAT_FIELD_VERSION),
            lens=np.array(numbers, float),
            distances_m=np.array(field.distances_m),
            warnings=np.array(json.dumps(field.warnings)),
            frames=np.array(json.dumps(sorted(field.frames))),
            moved=np.array(field.moved),
        )


def load_flat_field(path: Path) -> FlatField:
    """Read a file of `save_flat_field`. Raises UserError if it is not such a file, is broken, too
    large or newer."""
    from detectors.recordings.arrays import load_npz

    arrays = load_npz(path)
    version = arrays.get("version")
    number = None
    if version is not None and version.shape == ():
        number = version.item()
    check_version(number, 1, path, "a flat field")
    try:
        field = _field_of(arrays, path)
    except (KeyError, ValueError, TypeError) as error:
        why = f"it has no {error}" if isinstance(error, KeyError) else str(error)[:200]
        raise UserError(
            f"{path}: not a flat field ({why})",
            legal="a file of tofpod flatfield",
            fix=AGAIN,
        ) from error
    return field


def _field_of(arrays: Mapping[str, np.ndarray], path: Path) -> FlatField:
    """Return the flat field in a file's arrays. Raises KeyError, ValueError or TypeError if they
    are not one."""
    width, height, fx, fy, cx, cy, *distortion = arrays["lens"].astype(float).tolist()
    lens = Lens(int(width), int(height), fx, fy, cx, cy, distortion=tuple(distortion))
    refuse_pixels(str(path), lens.width, lens.height)
    error_m = arrays["error_m"].astype(np.float32)
    variance_m2 = arrays["variance_m2"].astype(np.float32)
    nearest_m, farthest_m = arrays["distances_m"].astype(float).tolist()
    warnings = json.loads(str(arrays["warnings"]))
    # files of earlier versions do not name their frames
    frames = json.loads(str(arrays.get("frames", "[]")))
    moved = bool(arrays.get("moved", np.array(False)).item())
    is_known = np.isfinite(error_m)
    is_sound = (
        error_m.shape == variance_m2.shape == (lens.height, lens.width)
        and len(lens.distortion) == 8
        and is_known.any()
        and bool((variance_m2[is_known] >= 0).all())
        and 0 < nearest_m <= farthest_m < np.inf
        and all(isinstance(text, str) for text in (*warnings, *frames))
    )
    if not is_sound:
        raise ValueError("its arrays do not belong together")
    return FlatField(
        error_m,
        variance_m2,
        lens,
        (nearest_m, farthest_m),
        tuple(warnings),
        frames=frozenset(frames),
        moved=moved,
    )
