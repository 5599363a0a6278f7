"""The simulated Azure Kinect beside a real one: ``python tests/validation/azure_walls.py FOLDER
[--out docs]``.

FOLDER holds frames of a static camera (16-bit PNG, whole millimetres, 640 x 576, NFOV unbinned)
before plaster walls, and ``wall_mask.png``. Each wall's plane is fitted, the same plane is
simulated, and one analysis is applied to both: temporal deviation against range and angle, spatial
correlation of the temporal noise, and the fixed pattern. Writes ``azure_walls.svg``,
``azure_walls.txt`` and ``azure_walls.md``. Nothing is fitted to make the two agree: the camera's file is used as it
stands, and both walls have the albedo of its calibration point.
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
from harness.stills.statistics import (
    LAGS,
    FixedPattern,
    correlation,
    deviations,
    fit_plane,
    fixed_pattern,
    temporal_sigma_m,
)
from harness.vocabulary.errors import UserError, exit_code_of
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.camera import load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit

LENS_CENTRE_PX = (332.0, 326.0)
"""The frames come without intrinsics; this is where the unit's optical axis is thought to lie. The
rest is nominal."""
EDGE_PX = 3
"""Pixels nearer to a wall's edge are left out: their 5x5 window (2 px) holds light from beyond it.
"""
FIELD_DEG = 32.5
"""Half the specification's smaller angle of view (75 x 65 degrees): a cone that is lit whatever
the field's shape."""
BIN_M = 0.1
LEAST_PIXELS = 300
"""Some 12 independent windows: the deviation of 22 frames is then known to 5 %."""
NOISE_ONLY = NO_EFFECTS.model_copy(update={"noise": True, "ambient": True, "frame_jumps": True})
"""With the jitter of whole frames; `walls_camera` takes out their rare jumps, which these captures
do not hold."""
PATTERNED = NOISE_ONLY.model_copy(update={"fixed_pattern": True})
UNIT_SEEDS = (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class Wall:
    """One wall as recorded: ``mask`` (h, w) of its pixels in ``region``, ``slopes`` (h, w, 2),
    ``z_m`` (n, h, w)."""

    name: str
    region: Region
    mask: np.ndarray
    slopes: np.ndarray
    z_m: np.ndarray

    @cached_property
    def plane(self) -> tuple[float, float, float]:
        """(distance in m, slope along x, slope along y) of z = d + sx x + sy y, so 1/z = (1 - sx X
        - sy Y)/d."""
        plane = fit_plane(self.z_m.mean(axis=0)[self.mask], self.slopes[self.mask])
        return plane.distance_m, plane.slope_x, plane.slope_y

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
    """Temporal deviation (rms over pixels) of a part of a wall; ``at``: its middle, in metres or
    degrees."""

    at: float
    pixels: int
    measured_m: float
    simulated_m: float

    @property
    def ratio(self) -> float:
        """Simulated by measured."""
        return self.simulated_m / self.measured_m


@dataclass(frozen=True)
class WallCheck:
    """All numbers of one wall. ``correlation`` maps (who, common jitter kept) to (x and y, lags 1
    to 5)."""

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


# ---------------------------------------------------------------- the walls, measured and
# simulated


def walls_camera() -> AmcwCamera:
    """The camera file's numbers with this unit's optical centre."""
    data = load_camera("azure_kinect_nfov").to_data()
    data["unit"]["jump_rate"]["value"] = 0.0
    data["lens"]["cx_px"]["value"], data["lens"]["cy_px"]["value"] = LENS_CENTRE_PX
    return AmcwCamera.from_data(data)


def without_polygon(camera: AmcwCamera) -> AmcwCamera:
    """The same camera without its illuminated polygon, so that every measured pixel has a
    simulated one beside it."""
    data = camera.to_data()
    data["emitter"]["mask_slopes"]["value"] = [[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]]
    return AmcwCamera.from_data(data)


def read_walls(folder: Path, camera: AmcwCamera) -> list[Wall]:
    """The walls of a folder from left to right. Raises UserError where the frames or their mask
    cannot be used."""
    lens = camera.nominal_lens
    capture = open_capture([folder], lens=lens)
    mask = cv2.imread(str(folder / "wall_mask.png"), cv2.IMREAD_GRAYSCALE)
    if mask is None or mask.shape != (lens.height, lens.width):
        raise UserError(
            f"{folder / 'wall_mask.png'}: no mask of {lens.width} x {lens.height} pixels"
        )
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
    names = (
        ("left", "right") if len(walls) == 2 else [f"wall {i}" for i in range(1, len(walls) + 1)]
    )
    return [
        Wall(name, w.region, w.mask, w.slopes, w.z_m) for name, w in zip(names, walls, strict=True)
    ]


def simulate(wall: Wall, camera: AmcwCamera, albedo: float, config: CameraConfig) -> np.ndarray:
    """As many frames of the wall's plane as were recorded: z in metres, (n, h, w)."""
    lens = camera.nominal_lens
    distance_m, slope_x, slope_y = wall.plane
    outer = wall.region.grown(camera.optics.margin_px, lens.height, lens.width)
    unit = SimulatedUnit(
        camera, config, plane_view(camera, outer, distance_m, albedo, slope_x, slope_y)
    )
    cut = wall.region.within(unit.region)
    frames = unit.capture(len(wall.z_m), 1, "walls", wall.name, config.unit_seed).frames()
    return np.stack([frame.z_m[cut] for frame in frames]).astype(float)


# ---------------------------------------------------------------- one analysis for both


def sigma_bins(
    wall: Wall, simulated_m: np.ndarray, where: np.ndarray, value: np.ndarray, width: float
) -> list[SigmaBin]:
    """Both deviations in bins of ``value`` (h, w); bins of few pixels are left out."""
    number = np.floor(np.where(where, value, 0.0) / width + 1e-9).astype(int)
    bins = []
    for b in np.unique(number[where]):
        part = where & (number == b)
        if part.sum() >= LEAST_PIXELS:
            measured = temporal_sigma_m(wall.z_m, part)
            simulated = temporal_sigma_m(simulated_m, part)
            bins.append(SigmaBin(float((b + 0.5) * width), int(part.sum()), measured, simulated))
    return bins


def needed_albedo(wall: Wall, camera: AmcwCamera, start: float) -> float:
    """The albedo at which the simulated deviation of the wall's lit pixels would be the measured
    one (not used)."""
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
        simulate(wall, everywhere, albedo, CameraConfig(unit_seed=seed, effects=PATTERNED))
        for seed in UNIT_SEEDS
    )
    return WallCheck(
        wall,
        sigma_bins(wall, z_m, wall.mask, average, BIN_M),
        sigma_bins(wall, z_m, wall.inner, average, BIN_M),
        sigma_bins(wall, z_m, wall.mask, wall.angle_deg, 2.0),
        {
            (holder, jitter): correlations(deviations(z, wall.mask, jitter), wall.mask)
            for holder, z in (("measured", wall.z_m), ("simulated", z_m))
            for jitter in (True, False)
        },
        (
            float(wall.z_m[:, wall.mask].mean(1).std(ddof=1)),
            float(z_m[:, wall.mask].mean(1).std(ddof=1)),
        ),
        needed_albedo(wall, everywhere, albedo),
        fixed_pattern(wall.z_m, wall.mask, wall.slopes),
        [fixed_pattern(z, wall.mask, wall.slopes) for z in patterned],
        float(1 - outside[wall.mask].mean()),
    )


def correlations(d: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(x and y, lags 1 to `LAGS`) correlation of deviations."""
    along = ([(lag, 0) for lag in range(1, LAGS + 1)], [(0, lag) for lag in range(1, LAGS + 1)])
    return np.array([[correlation(d, where, *lags) for lags in axis] for axis in along])


def check_folder(folder: Path) -> list[WallCheck]:
    """Check every wall of a folder."""
    camera = walls_camera()
    return [check(wall, camera) for wall in read_walls(folder, camera)]


def main(arguments: Sequence[str] | None = None) -> int:
    """The program: print the table, write the figure and the page."""
    from azure_walls_page import TABLES, figure, page, table

    parser = argparse.ArgumentParser(
        description="Compare the simulated Azure Kinect with frames of real walls."
    )
    parser.add_argument("folder", type=Path, help="frames (16-bit PNG, mm) and wall_mask.png")
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), help="where page, figure and tables go (docs)"
    )
    args = parser.parse_args(arguments)

    def body() -> int:
        checks = check_folder(args.folder)
        tables = table(checks)
        print(tables)
        write_text(args.out / TABLES, tables + "\n")
        write_text(args.out / "azure_walls.svg", figure(checks))
        write_text(args.out / "azure_walls.md", page(checks, walls_camera()))
        return 0

    return exit_code_of(body)


if __name__ == "__main__":
    sys.exit(main())
