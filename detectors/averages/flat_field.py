"""A unit's fixed pattern as a map over its sensor: its file, and the correction of a cloud by it.

The pattern is assumed to be a range error along each pixel's ray that is the same in every
capture. Not modelled: a pattern that changes with distance, temperature or brightness
(`detectors.averages.flat_captures` tests the first two), and the mixing of pixels by a depth
engine's filter at the edge of a hole."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from detectors.averages.noise import LEAST_FRAMES, average_variance_m2
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
    """A unit's fixed pattern. ``error_m`` (h, w): how much farther along its ray each pixel of the
    whole sensor sees a surface, without smooth parts; NaN where unknown. ``variance_m2`` (h, w) of
    that error. ``distances_m``: the nearest and the farthest at which it was measured.
    ``warnings``: full sentences on doubts about it."""

    error_m: np.ndarray
    variance_m2: np.ndarray
    lens: Lens
    distances_m: tuple[float, float]
    warnings: tuple[str, ...] = ()

    @property
    def rms_m(self) -> float:
        """Root mean square of the pattern without the map's own noise."""
        return float(
            np.sqrt(max(np.nanmean(self.error_m.astype(float) ** 2 - self.variance_m2), 0.0))
        )


def corrected(cloud: Cloud, field: FlatField) -> Cloud:
    """Return the cloud with its points moved along their rays to remove the pattern; points where
    it is unknown stay. ``mean_variance_m2`` is the frames' noise (None for a single frame) and the
    map's variance, or the pattern's mean square. Raises UserError if the cloud has no pixel grid
    or is of another camera, size or lens."""
    _refuse_other(cloud, field)
    at = cloud.region.within(field.lens.whole)
    error_m = field.error_m[at].astype(float)
    variance_m2 = field.variance_m2[at].astype(float)
    known = np.isfinite(error_m)
    range_m = np.linalg.norm(cloud.points_m, axis=-1)
    moved = cloud.points_m * (1 - np.where(known, error_m, 0.0) / range_m)[..., None]
    noise_m2 = average_variance_m2(cloud, cloud.valid)
    if noise_m2 is not None:
        axial = (cloud.points_m[..., 2] / range_m) ** 2
        noise_m2 = noise_m2 + axial * np.where(known, variance_m2, field.rms_m**2)
    return replace(cloud, points_m=moved, mean_variance_m2=noise_m2)


def doubts(cloud: Cloud, field: FlatField, name: str | Path) -> tuple[str, ...]:
    """Return full sentences on doubts about the correction of a cloud; ``name``: the flat field's."""
    notes = [f"the flat field {name}: {warning}" for warning in field.warnings]
    known = np.isfinite(field.error_m[cloud.region.within(field.lens.whole)])
    share = float(known[cloud.valid].mean()) if cloud.valid.any() else 1.0
    if share < WELL_COVERED:
        notes.append(
            f"the flat field {name} covers {100 * share:.0f} % of the valid pixels; others are not corrected"
        )
    distance_m = (
        float(np.median(cloud.points_m[cloud.valid][:, 2])) if cloud.valid.any() else np.nan
    )
    near, far = field.distances_m
    if distance_m * NEAR_ENOUGH < near or distance_m > far * NEAR_ENOUGH:
        measured = f"{near:.2f} m" if far < near * 1.01 else f"{near:.2f} to {far:.2f} m"
        notes.append(
            f"the flat field {name} was measured at {measured}, this capture is at {distance_m:.2f} m"
        )
    return tuple(notes)


def _refuse_other(cloud: Cloud, field: FlatField) -> None:
    """Raise UserError if the cloud cannot be of the camera and mode of the flat field."""
    if not cloud.organised or cloud.projection != "central":
        what = "a flat field corrects a camera's own pixels, and this cloud has no pixel grid"
        raise UserError(what, fix="leave out the flat field, or name the capture's depth images")
    lens, (height, width) = field.lens, cloud.valid.shape
    own = (width, height) if cloud.lens is None else (cloud.lens.width, cloud.lens.height)
    if own != (lens.width, lens.height):
        what = f"the flat field has {lens.width} x {lens.height} pixels, the capture has {own[0]} x {own[1]}"
        raise UserError(what, legal="the same camera in the same mode", fix=AGAIN)
    if cloud.lens is not None:
        pairs = [
            (getattr(cloud.lens, name), getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")
        ]
        if any(abs(one - other) > SAME_LENS * max(lens.fx, lens.width) for one, other in pairs):
            ours = f"fx {cloud.lens.fx:.1f}, fy {cloud.lens.fy:.1f}, centre {cloud.lens.cx:.1f}, {cloud.lens.cy:.1f}"
            theirs = f"fx {lens.fx:.1f}, fy {lens.fy:.1f}, centre {lens.cx:.1f}, {lens.cy:.1f}"
            what = f"the capture's lens ({ours}) is not that of the flat field ({theirs})"
            raise UserError(what, legal="the same camera in the same mode", fix=AGAIN)


def save_flat_field(path: Path, field: FlatField) -> None:
    """Write the file, whole or not at all. Raises UserError if it cannot be written."""
    lens = field.lens
    numbers = [lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]
    held: dict[str, Any] = {
        name: getattr(field, name).astype(np.float32) for name in ("error_m", "variance_m2")
    }
    held |= {"version": np.array(FLAT_FIELD_VERSION), "lens": np.array(numbers, float)}
    held |= {
        "distances_m": np.array(field.distances_m),
        "warnings": np.array(json.dumps(field.warnings)),
    }
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **held)


def load_flat_field(path: Path) -> FlatField:
    """Read a file of `save_flat_field`. Raises UserError if it is not such a file, is broken, too
    large or newer."""
    from detectors.recordings.arrays import load_npz

    held = load_npz(path)
    version = held.get("version")
    check_version(
        version.item() if version is not None and version.shape == () else None,
        1,
        path,
        "a flat field",
    )
    try:
        width, height, fx, fy, cx, cy, *rest = held["lens"].astype(float).tolist()
        lens = Lens(int(width), int(height), fx, fy, cx, cy, tuple(rest))
        refuse_pixels(str(path), lens.width, lens.height)
        maps: list[Any] = [held[name].astype(np.float32) for name in ("error_m", "variance_m2")]
        near, far = held["distances_m"].astype(float).tolist()
        warnings = json.loads(str(held["warnings"]))
        error_m, variance_m2 = maps
        known = np.isfinite(error_m)
        sound = (
            error_m.shape == variance_m2.shape == (lens.height, lens.width)
            and len(lens.distortion) == 8
        )
        sound = (
            sound
            and known.any()
            and bool((variance_m2[known] >= 0).all())
            and 0 < near <= far < np.inf
        )
        if not (sound and all(isinstance(each, str) for each in warnings)):
            raise ValueError("its arrays do not belong together")
    except (KeyError, ValueError, TypeError) as error:
        why = f"it has no {error}" if isinstance(error, KeyError) else str(error)[:200]
        raise UserError(
            f"{path}: not a flat field ({why})", legal="a file of tofpod flatfield", fix=AGAIN
        ) from error
    return FlatField(error_m, variance_m2, lens, (near, far), tuple(warnings))
