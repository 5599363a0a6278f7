"""The simulated Azure Kinect beside a real one: ``python tests/validation/azure_walls.py FOLDER [--out docs]``.

FOLDER holds frames of a static camera (16-bit PNG, whole millimetres, 640 x 576, NFOV unbinned) before plaster walls,
and ``wall_mask.png``. Each wall's plane is fitted, the same plane is simulated, and one analysis is applied to both:
temporal deviation against range and angle, spatial correlation of the temporal noise, and the fixed pattern.
Writes ``azure_walls.svg`` and ``azure_walls.md``. Nothing is fitted to make the two agree: the camera's file is used as
it stands, and both walls have the albedo of its calibration point.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage, optimize

from detectors.recordings import open_capture
from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.camera import CameraConfig, load_camera
from scenes.sensor.effects import NONE
from scenes.sensor.source import SimulatedUnit

LENS_CENTRE_PX = (332.0, 326.0)
"""The frames come without intrinsics; this is where the unit's optical axis is thought to lie. The rest is nominal."""
EDGE_PX = 3
"""Pixels nearer to a wall's edge are left out: their 5x5 window (2 px) holds light from beyond it."""
FIELD_DEG = 32.5
"""Half the specification's smaller angle of view (75 x 65 degrees): a cone that is lit whatever the field's shape."""
BIN_M = 0.1
LEAST_PIXELS = 300
"""Some 12 independent windows: the deviation of 22 frames is then known to 5 %."""
LAGS = 5
NOISE_ONLY = NONE.model_copy(update={"noise": True, "ambient": True})
PATTERNED = NOISE_ONLY.model_copy(update={"fixed_pattern": True})
UNIT_SEEDS = (1, 2, 3, 4, 5)
SURFACE_DEGREE = 5
BISQUARE = 4.685


@dataclass(frozen=True)
class Wall:
    """One wall as recorded: ``mask`` (h, w) of its pixels in ``region``, ``slopes`` (h, w, 2), ``z_m`` (n, h, w)."""

    name: str
    region: Region
    mask: np.ndarray
    slopes: np.ndarray
    z_m: np.ndarray

    @cached_property
    def plane(self) -> tuple[float, float, float]:
        """(distance in m, slope along x, slope along y) of z = d + sx x + sy y, so 1/z = (1 - sx X - sy Y)/d."""
        z = self.z_m.mean(axis=0)[self.mask]
        basis = np.column_stack([np.ones(z.size), self.slopes[self.mask]])
        (a, b, c), _ = robust_inverse_fit(basis, z)
        return float(1 / a), float(-b / a), float(-c / a)

    @property
    def angle_deg(self) -> np.ndarray:
        """(h, w) angle of each pixel's ray to the optical axis."""
        return np.degrees(np.arctan(np.hypot(self.slopes[..., 0], self.slopes[..., 1])))

    @property
    def inner(self) -> np.ndarray:
        """(h, w) bool: the wall's pixels that are lit for certain."""
        return self.mask & (self.angle_deg < FIELD_DEG)


@dataclass(frozen=True)
class SigmaBin:
    """Temporal deviation (rms over pixels) of a part of a wall; ``at``: its middle, in metres or degrees."""

    at: float
    pixels: int
    measured_m: float
    simulated_m: float

    @property
    def ratio(self) -> float:
        """Simulated by measured."""
        return self.simulated_m / self.measured_m


@dataclass(frozen=True)
class FixedPattern:
    """What stays of a wall's average after a smooth surface and the temporal noise are taken off.

    ``std_m``; ``length_px`` of a Gaussian autocorrelation exp(-k^2 / 2 l^2) over lags 0 to 12; ``pixel_m``: the part
    that is white before the engine's window of 5, told by its triangle up to lag 5; ``covariance_m2`` (lags 0..20).
    """

    std_m: float
    length_px: float
    pixel_m: float
    covariance_m2: np.ndarray


@dataclass(frozen=True)
class WallCheck:
    """All numbers of one wall. ``correlation`` maps (who, common jitter kept) to (x and y, lags 1 to 5)."""

    wall: Wall
    by_range: list[SigmaBin]
    by_range_inner: list[SigmaBin]
    by_angle: list[SigmaBin]
    correlation: dict[tuple[str, bool], np.ndarray]
    jitter_m: tuple[float, float]
    needed_albedo: float
    pattern: FixedPattern
    simulated_patterns: list[FixedPattern]
    share_in_polygon: float


# ---------------------------------------------------------------- the walls, measured and simulated


def walls_camera() -> AmcwCamera:
    """The camera file's numbers with this unit's optical centre."""
    data = load_camera("azure_kinect_nfov").to_data()
    data["lens"]["cx_px"]["value"], data["lens"]["cy_px"]["value"] = LENS_CENTRE_PX
    return AmcwCamera.from_data(data)


def without_polygon(camera: AmcwCamera) -> AmcwCamera:
    """The same camera without its illuminated polygon, so that every measured pixel has a simulated one beside it."""
    data = camera.to_data()
    data["emitter"]["mask_slopes"]["value"] = [[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]
    return AmcwCamera.from_data(data)


def read_walls(folder: Path, camera: AmcwCamera) -> list[Wall]:
    """The walls of a folder from left to right. Raises UserError where the frames or their mask cannot be used."""
    lens = camera.nominal_lens
    capture = open_capture([folder], lens=lens)
    mask = cv2.imread(str(folder / "wall_mask.png"), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != (lens.height, lens.width):
        raise UserError(f"{folder / 'wall_mask.png'}: no mask of {lens.width} x {lens.height} pixels")
    z_m = np.stack([frame.z_m for frame in capture.frames()]).astype(float)
    labels, _ = ndimage.label((mask > 0) & np.isfinite(z_m).all(axis=0), np.ones((3, 3)))
    if labels.max() == 0:
        raise UserError(f"{folder}: no pixel of the mask is valid in every frame")
    slopes = lens.region_slopes(lens.whole)
    walls = []
    for number, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        region = Region(rows.start, rows.stop, columns.start, columns.stop)
        inside = np.pad(labels[rows, columns] == number, 1)
        far = (ndimage.distance_transform_edt(inside) > EDGE_PX)[1:-1, 1:-1]
        if far.sum() >= LEAST_PIXELS:
            walls.append(Wall("", region, far, slopes[rows, columns], z_m[:, rows, columns]))
    walls.sort(key=lambda wall: wall.region.col0)
    names = ("left", "right") if len(walls) == 2 else [f"wall {i}" for i in range(1, len(walls) + 1)]
    return [Wall(name, w.region, w.mask, w.slopes, w.z_m) for name, w in zip(names, walls, strict=True)]


def simulate(wall: Wall, camera: AmcwCamera, albedo: float, config: CameraConfig) -> np.ndarray:
    """As many frames of the wall's plane as were recorded: z in metres, (n, h, w)."""
    lens = camera.nominal_lens
    distance_m, slope_x, slope_y = wall.plane
    outer = wall.region.grown(camera.margin_px, lens.height, lens.width)
    unit = SimulatedUnit(camera, config, plane_view(camera, outer, distance_m, albedo, slope_x, slope_y))
    cut = wall.region.within(unit.region)
    frames = unit.capture(len(wall.z_m), 1, "walls", wall.name, config.unit_seed).frames()
    return np.stack([frame.z_m[cut] for frame in frames]).astype(float)


def robust_inverse_fit(basis: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients c with 1/z = basis c, and which points count, by Tukey's bisquare on the residuals of z."""
    weight = np.ones_like(z)
    for _ in range(15):
        # an error of z is z^2 times one of 1/z
        row = np.sqrt(weight) * z**2
        coefficients = np.linalg.lstsq(basis * row[:, None], row / z, rcond=None)[0]
        residual = z - 1 / (basis @ coefficients)
        # on exact data the median is 0: a micrometre counts as exact
        u = residual / (BISQUARE * max(1.4826 * float(np.median(np.abs(residual))), 1e-6))
        weight = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)
    return coefficients, weight > 0


# ---------------------------------------------------------------- one analysis for both


def temporal_sigma_m(z_m: np.ndarray, where: np.ndarray) -> float:
    """Standard deviation over frames, rms over the pixels of ``where``."""
    return float(np.sqrt(z_m[:, where].var(axis=0, ddof=1).mean()))


def sigma_bins(
    wall: Wall, simulated_m: np.ndarray, where: np.ndarray, value: np.ndarray, width: float
) -> list[SigmaBin]:
    """Both deviations in bins of ``value`` (h, w); bins of few pixels are left out."""
    number = np.floor(np.where(where, value, 0.0) / width + 1e-9).astype(int)
    bins = []
    for b in np.unique(number[where]):
        part = where & (number == b)
        if part.sum() >= LEAST_PIXELS:
            measured, simulated = (temporal_sigma_m(z, part) for z in (wall.z_m, simulated_m))
            bins.append(SigmaBin(float((b + 0.5) * width), int(part.sum()), measured, simulated))
    return bins


def deviations(z_m: np.ndarray, where: np.ndarray, keep_jitter: bool) -> np.ndarray:
    """(n, h, w) deviations from each pixel's mean; without what a frame's pixels have in common unless kept."""
    d = np.where(where, z_m - z_m.mean(axis=0), 0.0)
    return d if keep_jitter else np.where(where, d - d[:, where].mean(axis=1)[:, None, None], 0.0)


def covariance(d: np.ndarray, where: np.ndarray, lag: int, axis: int) -> tuple[float, float]:
    """(mean product of pixels ``lag`` apart along x (0) or y (1), their mean square) over pairs inside ``where``."""
    if axis == 1:
        d, where = d.swapaxes(-1, -2), where.T
    last = where.shape[1] - lag
    both = where[:, lag:] & where[:, :last]
    a, b = d[..., lag:][:, both], d[..., :last][:, both]
    return float((a * b).mean()), float(((a**2).mean() + (b**2).mean()) / 2)


def correlation(d: np.ndarray, where: np.ndarray, lags: int = LAGS) -> np.ndarray:
    """(x and y, lags 1 to ``lags``) correlation of the temporal noise."""
    pairs = [[covariance(d, where, lag, axis) for lag in range(1, lags + 1)] for axis in (0, 1)]
    return np.array([[product / square for product, square in row] for row in pairs])


def fixed_pattern(z_m: np.ndarray, where: np.ndarray, slopes: np.ndarray, lags: int = 20) -> FixedPattern:
    """The fixed pattern of a wall: average, minus a robust surface of degree 5 in 1/z, minus left temporal noise."""
    average = z_m.mean(axis=0)[where]
    middle, half = slopes[where].mean(axis=0), np.ptp(slopes[where], axis=0) / 2
    x, y = ((slopes[where] - middle) / half).T
    basis = np.polynomial.legendre.legvander2d(x, y, (SURFACE_DEGREE, SURFACE_DEGREE))
    i, j = np.divmod(np.arange(basis.shape[1]), SURFACE_DEGREE + 1)
    basis = basis[:, i + j <= SURFACE_DEGREE]
    coefficients, counts = robust_inverse_fit(basis, average)
    good = np.zeros_like(where)
    good[where] = counts
    residual = np.zeros(where.shape)
    residual[where] = average - 1 / (basis @ coefficients)
    residual[good] -= residual[good].mean()
    noise = deviations(z_m, good, keep_jitter=False)
    # Deviations from a mean of n frames have (n - 1)/n of the variance, the mean 1/n: together 1/(n - 1).
    left = np.array(
        [
            [
                covariance(residual[None], good, k, a)[0] - covariance(noise, good, k, a)[0] / (len(z_m) - 1)
                for a in (0, 1)
            ]
            for k in range(lags + 1)
        ]
    ).mean(axis=1)
    return FixedPattern(float(np.sqrt(max(left[0], 0))), _gaussian_length(left[:13]), _pixel_part(left), left)


def _gaussian_length(c: np.ndarray) -> float:
    k = np.arange(c.size)
    found = optimize.least_squares(lambda p: p[0] * np.exp(-(k**2) / (2 * p[1] ** 2)) - c / c[0], [1.0, 5.0])
    return float(abs(found.x[1]))


def _pixel_part(c: np.ndarray) -> float:
    """c(0) - c(k) = p^2 k/5 + q k^2 - r k^4 up to the window: white noise makes the line, a smooth field the rest."""
    k = np.arange(1.0, 6.0)
    white, *_ = np.linalg.lstsq(np.column_stack([k / 5, k**2, k**4]), c[0] - c[1:6], rcond=None)[0]
    return float(np.sign(white) * np.sqrt(abs(white)))


def needed_albedo(wall: Wall, camera: AmcwCamera, start: float) -> float:
    """The albedo at which the simulated deviation of the wall's lit pixels would be the measured one (not used)."""
    measured = temporal_sigma_m(wall.z_m, wall.inner)

    def excess(log_albedo: float) -> float:
        z_m = simulate(wall, camera, float(np.exp(log_albedo)), CameraConfig(effects=NOISE_ONLY))
        return np.log(temporal_sigma_m(z_m, wall.inner) / measured)

    guess = np.log(start) + 2 * excess(np.log(start))
    return float(np.exp(optimize.newton(excess, np.log(start), x1=guess, tol=0.02)))


def check(wall: Wall, camera: AmcwCamera) -> WallCheck:
    """Measure one wall, simulate it with the calibration point's albedo, and compare."""
    albedo = camera.photons.calibration_albedo.value
    everywhere = without_polygon(camera)
    z_m = simulate(wall, everywhere, albedo, CameraConfig(effects=NOISE_ONLY))
    average = wall.z_m.mean(axis=0)
    outside = AmcwImager(camera, CameraConfig(), wall.region, wall.slopes).outside_mask
    patterned = (
        simulate(wall, everywhere, albedo, CameraConfig(unit_seed=seed, effects=PATTERNED)) for seed in UNIT_SEEDS
    )
    return WallCheck(
        wall,
        sigma_bins(wall, z_m, wall.mask, average, BIN_M),
        sigma_bins(wall, z_m, wall.inner, average, BIN_M),
        sigma_bins(wall, z_m, wall.mask, wall.angle_deg, 2.0),
        {
            (who, jitter): correlation(deviations(z, wall.mask, jitter), wall.mask)
            for who, z in (("measured", wall.z_m), ("simulated", z_m))
            for jitter in (True, False)
        },
        (float(wall.z_m[:, wall.mask].mean(1).std(ddof=1)), float(z_m[:, wall.mask].mean(1).std(ddof=1))),
        needed_albedo(wall, everywhere, albedo),
        fixed_pattern(wall.z_m, wall.mask, wall.slopes),
        [fixed_pattern(z, wall.mask, wall.slopes) for z in patterned],
        float(1 - outside[wall.mask].mean()),
    )


def check_folder(folder: Path) -> list[WallCheck]:
    """Check every wall of a folder."""
    camera = walls_camera()
    return [check(wall, camera) for wall in read_walls(folder, camera)]


def main(arguments: Sequence[str] | None = None) -> int:
    """The program: print the table, write the figure and the page."""
    from azure_walls_page import figure, page, table

    parser = argparse.ArgumentParser(description="Compare the simulated Azure Kinect with frames of real walls.")
    parser.add_argument("folder", type=Path, help="frames (16-bit PNG, mm) and wall_mask.png")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="where the page and figure go (docs)")
    given = parser.parse_args(arguments)

    def body() -> int:
        checks = check_folder(given.folder)
        print(table(checks))
        write_text(given.out / "azure_walls.svg", figure(checks))
        write_text(given.out / "azure_walls.md", page(checks, walls_camera()))
        return 0

    return exit_code_of(body)


if __name__ == "__main__":
    sys.exit(main())
