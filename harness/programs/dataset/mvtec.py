"""Data sets in the layout of MVTec 3D-AD: ``<category>/<split>/<defect or good>/{xyz,gt}``.

Sources: Bergmann et al., The MVTec 3D-AD dataset (VISAPP 2022), and MVTec's public evaluation code,
whose map files are ``<category>/test/<defect>/<number>.tiff``, whose regions are the connected
components of ``gt`` with corners, and whose metrics are over all pixels, background included.

The data set has no sizes. A defect's size here is the diameter of the circle with the area of its
region, by one pixel area for each picture: the median spacing of ``xyz`` across the camera's axis
(0 0 0 is a missing pixel). Not modelled: slant of the surface within a picture, and depth of
defects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from harness.programs.dataset.judged_sets import VALIDATION, JudgedPicture
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import PICTURE_BYTES, bounded_bytes
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import digest

GOOD = "good"
LINKED_PX = 1.5
"""Pixels of a finding touch, at least at corners."""
PITCHES_MM = (0.01, 20.0)
"""Plausible distances of neighbouring pixels; others mean another unit than metres."""
HIT_RADIUS_MM = 5.0
HIT_OVERLAP = 0.5
FEWEST_STEPS = 100  # between neighbouring valid pixels, of which the spacing is the median


def is_mvtec(folder: Path) -> bool:
    """Return whether a folder has the layout."""
    return any(folder.glob("*/test/*/xyz"))


class MvtecSet:
    """A folder in the layout of MVTec 3D-AD."""

    def __init__(self, folder: Path) -> None:
        """List the pictures. Raises UserError for an empty folder."""
        self.folder = folder
        self.name = folder.resolve().name
        self.false_calls_per_m2: float | None = None
        self.hit_radius_mm = HIT_RADIUS_MM
        self.hit_overlap: float | None = HIT_OVERLAP
        self._samples: list[str] = []
        for split in (VALIDATION, "test"):
            for path in sorted(folder.glob(f"*/{split}/*/xyz/*.tiff")):
                folder_name = path.parent.parent.relative_to(folder).as_posix()
                self._samples.append(f"{folder_name}/{path.stem}")
        if not self._samples:
            raise UserError(f"{folder}: has no <category>/test/<defect>/xyz/<number>.tiff")
        self._numbers = {name: number for number, name in enumerate(self._samples)}
        names = dict.fromkeys(name.partition("/")[0] for name in self._samples)
        self.categories: Mapping[str, Mapping[str, Any]] = {
            name: {"frames": 1, "units": 1} for name in names
        }
        sizes = [self._file(name, "xyz", ".tiff").stat().st_size for name in self._samples]
        self.content = digest([self._samples, sizes])

    def wanted(self, named: set[str]) -> set[str]:
        """Return the pictures of ``test``, and of `VALIDATION` if any of these has a map."""
        splits = {"test"}
        if any(name.split("/")[1:2] == [VALIDATION] for name in named):
            splits.add(VALIDATION)
        return {name for name in self._samples if name.split("/")[1] in splits}

    def picture(self, name: str) -> JudgedPicture:
        """Read a picture; all of its pixels count."""
        damage = self._regions(name)
        across_m, down_m = self._pitch_m(name)
        v, u = np.indices(damage.shape)
        places_m = np.stack([u * across_m, v * down_m], axis=-1)
        inspected = np.ones(damage.shape, bool)
        return JudgedPicture(inspected, places_m, damage, LINKED_PX * max(across_m, down_m))

    def damages(self, name: str) -> tuple[int, list[dict[str, Any]]]:
        """Return the number of a picture and its defects, by their regions."""
        regions = self._regions(name)
        across_m, down_m = self._pitch_m(name)
        damages = []
        for number in range(1, int(regions.max(initial=0)) + 1):
            rows, columns = np.nonzero(regions == number)
            x_m = float(columns.mean()) * across_m
            y_m = float(rows.mean()) * down_m
            area_m2 = len(rows) * across_m * down_m
            damage = {
                "id": number,
                "line_m": [[x_m, y_m]],
                "diameter_mm": float(np.sqrt(4 * area_m2 / np.pi)) / MM,
                "depth_mm": 0.0,
                "x_board_mm": x_m / MM,
                "y_board_mm": y_m / MM,
                "size_of": "diameter",
            }
            damages.append(damage)
        return self._numbers[name], damages

    def quiet_split(self, category: str, named: Sequence[str]) -> str:
        """Return `VALIDATION` if it has maps, else ``test``, on whose good pictures false calls
        are then counted too."""
        for split in (VALIDATION, "test"):
            if any(name.startswith(f"{category}/{split}/{GOOD}/") for name in named):
                return split
        raise UserError(f"{self.folder}: {category} has no good picture that sets a threshold")

    def _file(self, name: str, kind: str, ending: str) -> Path:
        """Return a picture's file of a kind."""
        folder_name, _, number = name.rpartition("/")
        return self.folder / folder_name / kind / f"{number}{ending}"

    def _xyz_m(self, name: str) -> np.ndarray:
        """Return the points (h, w, 3) of a picture, NaN where missing."""
        return _points_m(self._file(name, "xyz", ".tiff"))

    def _pitch_m(self, name: str) -> tuple[float, float]:
        """Return the spacing of neighbouring pixels along rows and along columns."""
        xyz_m = self._xyz_m(name)
        spacing = []
        for axis in (1, 0):
            step_m = np.linalg.norm(np.diff(xyz_m[..., :2], axis=axis), axis=-1)
            step_m = step_m[np.isfinite(step_m)]
            spacing.append(float(np.median(step_m)) if len(step_m) >= FEWEST_STEPS else np.nan)
        across_m, down_m = spacing
        low, high = PITCHES_MM
        if not (low <= across_m / MM <= high and low <= down_m / MM <= high):
            file = self._file(name, "xyz", ".tiff")
            problem = f"{file}: neighbouring pixels are {across_m:.3g} and {down_m:.3g} m apart"
            legal = f"{low:g} to {high:g} mm, with at least {FEWEST_STEPS} neighbours"
            raise UserError(problem, legal=legal, fix="write x, y and z in metres")
        return across_m, down_m

    def _regions(self, name: str) -> np.ndarray:
        """Return the connected regions (h, w) of a picture's mask, numbered from 1; a good picture
        may lack a mask."""
        file = self._file(name, "gt", ".png")
        shape = self._xyz_m(name).shape[:2]
        if not file.is_file() and name.split("/")[2] == GOOD:
            return np.zeros(shape, np.int32)
        mask = _picture(file)
        if mask.ndim == 3:
            mask = mask.max(axis=-1)
        if mask.shape != shape:
            sizes = [" x ".join(map(str, size)) for size in (mask.shape, shape)]
            raise UserError(f"{file}: {sizes[0]} pixels, but its xyz has {sizes[1]}")
        _, regions = cv2.connectedComponents((mask > 0).astype(np.uint8), connectivity=8)
        return np.asarray(regions)


@lru_cache(maxsize=2)
def _points_m(file: Path) -> np.ndarray:
    """Return the points (h, w, 3) of a file, NaN where all three numbers are 0."""
    z_y_x = _picture(file)  # the order in which OpenCV reads channels
    if z_y_x.ndim != 3 or z_y_x.shape[2] != 3 or z_y_x.dtype.kind != "f":
        raise UserError(f"{file}: holds no points", legal="a picture of three real numbers each")
    xyz_m = z_y_x[..., ::-1].astype(float)
    xyz_m[~(xyz_m != 0).any(axis=-1)] = np.nan
    return xyz_m


def _picture(file: Path) -> np.ndarray:
    """Return a picture's numbers. Raises UserError."""
    try:
        content = np.frombuffer(bounded_bytes(file, PICTURE_BYTES), np.uint8)
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    picture = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) else None
    if picture is None:
        raise UserError(f"{file}: is no picture")
    return np.asarray(picture)
