"""Errors that the pixels of a real frame share: ``python tests/validation/frame_errors.py FOLDER``.

FOLDER holds frames of a static Azure Kinect before plaster walls, as `azure_walls.py` reads them.
Prints, for each wall, the deviation over frames of its mean range (jitter), the median sum of
amplitudes of the camera model before the same plane with the albedo that the wall's noise requires,
and their product. Then it fits laws to each frame's mean error in bins of range: one error for all
pixels; one that grows with range; and an offset of the samples that all pixels share, which turns
a phasor by an angle that is inversely proportional to its length and follows its phase.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from azure_walls import NOISE_ONLY, Wall, needed_albedo, read_walls, walls_camera, without_polygon

from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR
from scenes.closed_form import plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit

BIN_M = 0.025
LEAST_PIXELS = 350
WINDOW_PIXELS = 25  # pixels of the filter's window share their noise


def median_amplitude(wall: Wall, camera: AmcwCamera) -> float:
    """Return the median sum of amplitudes in units, at the albedo of the wall's own noise."""
    albedo = needed_albedo(wall, camera, camera.photons.calibration_albedo.value)
    distance_m, slope_x, slope_y = wall.plane
    view = plane_view(camera, wall.region, distance_m, albedo, slope_x, slope_y)
    unit = SimulatedUnit(camera, CameraConfig(effects=NOISE_ONLY), view)
    assert isinstance(unit.model, AmcwImager)
    sums = unit.model.amplitude_sums(unit.exposure).reshape(wall.mask.shape)
    return float(np.median(sums[wall.mask]))


class Bins:
    """Each frame's mean error, and its white noise, in bins of range of all walls."""

    def __init__(self, walls: list[Wall]) -> None:
        range_m = []
        weakness = []
        errors_mm = []
        wall_of = []
        for number, wall in enumerate(walls):
            stretch = np.sqrt(1 + (wall.slopes**2).sum(axis=-1))[wall.mask]
            ranges_m = wall.z_m[:, wall.mask] * stretch
            mean_m = ranges_m.mean(axis=0)
            _, slope_x, slope_y = wall.plane
            normal = np.array([slope_x, slope_y, -1.0])
            rays = np.dstack([wall.slopes, np.ones(wall.mask.shape)])[wall.mask]
            cosine = np.abs(rays @ normal) / np.linalg.norm(normal) / stretch
            range_m.append(mean_m)
            weakness.append(mean_m**2 / cosine)
            errors_mm.append((ranges_m - mean_m) / MM)
            wall_of.append(np.full(mean_m.shape, number))
        self._range_m = np.concatenate(range_m)
        self._weakness = np.concatenate(weakness)
        pixel_errors = np.concatenate(errors_mm, axis=1)
        key = 1000 * np.concatenate(wall_of) + np.floor(self._range_m / BIN_M).astype(int)
        _, self._bin_of, self._pixels = np.unique(key, return_inverse=True, return_counts=True)
        self._large = self._pixels >= LEAST_PIXELS
        self.errors_mm = np.array([self._mean(frame) for frame in pixel_errors])
        variance = self._mean(pixel_errors.var(axis=0, ddof=1))
        self.variance = variance * WINDOW_PIXELS / self._pixels[self._large]

    def _mean(self, values: np.ndarray) -> np.ndarray:
        sums = np.bincount(self._bin_of, values)
        return np.asarray((sums / self._pixels)[self._large])

    def laws(self, frequencies_hz: tuple[float, ...]) -> dict[str, np.ndarray]:
        """Return the regressors (bins, p) of each law."""
        ones = np.ones_like(self._range_m)

        def offset(of: list[float]) -> list[np.ndarray]:
            columns = []
            for frequency in of:
                phase = 4 * np.pi * frequency * self._range_m / SPEED_OF_LIGHT_AIR
                columns += [self._weakness * np.sin(phase), self._weakness * np.cos(phase)]
            return columns

        first = frequencies_hz[0]
        last = frequencies_hz[-1]
        laws = {
            "one error for all pixels": [ones],
            "proportional to range": [self._range_m],
            "constant and range": [ones, self._range_m],
            f"offset, {last / 1e6:.0f} MHz": offset([last]),
            f"offset, {first / 1e6:.0f} and {last / 1e6:.0f} MHz": offset([first, last]),
        }
        return {
            name: np.array([self._mean(column) for column in columns]).T
            for name, columns in laws.items()
        }

    def misfit(self, regressors: np.ndarray) -> float:
        """Return chi^2 per degree of freedom of a law that is fitted to each frame."""
        weight = 1 / np.sqrt(self.variance)
        target = (self.errors_mm * weight).T
        factors = np.linalg.lstsq(regressors * weight[:, None], target, rcond=None)[0]
        remaining = target - regressors * weight[:, None] @ factors
        bins, terms = regressors.shape
        return float((remaining**2).sum() / (target.shape[1] * (bins - terms)))


def _table(misfits: Mapping[str, tuple[int, float]]) -> str:
    lines = ["law of a frame's error | terms | chi^2 per degree of freedom"]
    for name, (terms, misfit) in misfits.items():
        lines.append(f"{name} | {terms} | {misfit:.2f}")
    return "\n".join(lines)


def main() -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    camera = walls_camera()
    walls = read_walls(folder, camera)
    for wall in walls:
        jitter_mm = float(wall.z_m[:, wall.mask].mean(axis=1).std(ddof=1)) / MM
        units = median_amplitude(wall, without_polygon(camera))
        print(f"{wall.name}: {jitter_mm:.3f} mm at {units:.0f} units: {jitter_mm * units:.0f}")
    bins = Bins(walls)
    nothing = float((bins.errors_mm**2 / bins.variance).mean())
    misfits = {"none": (0, nothing)}
    for name, regressors in bins.laws(camera.frequencies_hz).items():
        misfits[name] = (regressors.shape[1], bins.misfit(regressors))
    print(_table(misfits))
    return 0


if __name__ == "__main__":
    sys.exit(main())
