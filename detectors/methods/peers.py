"""Methods of other fields and libraries behind the same interface, for comparison on the same
clouds.

`m3c2` uses py4dgeo's distance to a surface and its level of detection; `plane_ransac` uses
Open3D's plane; `fpfh_memory` compares shape features with those of undamaged targets. Each has the
settings and the formula of its source; none knows the camera's noise."""

import logging
import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import threadpoolctl
from pydantic import Field
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import cKDTree

from detectors.averages.average import AverageConfig, average
from detectors.crop import AutoCrop, CropConfig, crop
from detectors.interface import Detector, Evidence
from detectors.open3d_library import open3d_on_one_thread
from detectors.pixels.noise import median_of, rounding_floor, sigma_of
from detectors.recordings import open_capture
from detectors.score_map import ScoreMapConfig, ScoreMapDetector, on_grid
from detectors.surfaces.background import background
from detectors.surfaces.smooth_surfaces import raster
from detectors.surfaces.surface import SurfaceConfig
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.seeds import random_stream

# standard deviations in py4dgeo's level of detection, which holds 95 % of chance differences
LOD_SIGMAS = 1.96
LEAST_SAMPLES = 4  # fewest points of a cylinder in each cloud: fewer do not show the scatter
MOST_ALONE = 0.01  # share of the target without a counterpart that gives a warning


class PlaneRansacConfig(ScoreMapConfig):
    """Settings of the plane by random sampling.

    - ``inlier_mm``: distance up to which a point supports the plane; the default is about three
      deviations of a single frame of a continuous-wave camera.
    - ``iterations``: largest number of triples of points.
    - ``seed``: draws them."""

    crop: CropConfig = Field(default_factory=AutoCrop)
    inlier_mm: float = Field(default=2.0, gt=0)
    iterations: int = Field(default=1000, ge=1, le=1_000_000)
    seed: int = Field(default=0, ge=0)


class PlaneRansacDetector(ScoreMapDetector[PlaneRansacConfig]):
    """Open3D's plane by random sampling; the score is the residual over its median absolute
    deviation.

    Not modelled: any other shape (all of a curved target scores), and noise that differs from
    place to place."""

    settings_type: ClassVar[type[PlaneRansacConfig]] = PlaneRansacConfig
    name = "plane_ransac"
    version = 6

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score |residual| / deviation in the crop. Raises UserError if its points determine no
        plane."""
        mask = crop(cloud, self.settings.crop)
        points = cloud.points_m[mask]
        # sorted by z, so that the triples do not depend on the orientation of the grid
        ordered = np.ascontiguousarray(points[np.argsort(points[:, 2], kind="stable")])
        plane = self._plane(ordered) if len(points) > 2 else (0.0, 0.0, 0.0, 0.0)
        a, b, c, d = plane
        if abs(c) < 1e-3:
            raise UserError(
                f"{len(points)} points determine no plane that is seen from the front",
                fix="widen the crop, or choose another detector",
            )
        fitted_m = -(a * points[:, 0] + b * points[:, 1] + d) / c
        residual_m = points[:, 2] - fitted_m
        scale_m = max(sigma_of(residual_m), rounding_floor(cloud, mask))
        return Evidence(
            score=on_grid(np.abs(residual_m) / scale_m, mask),
            residual_m=on_grid(residual_m, mask),
            surface_z_m=on_grid(fitted_m, mask),
            scale_m=scale_m,
            notes={"surface": "plane", "points": len(points)},
            residual_along="axis",
        )

    def _plane(self, points: np.ndarray) -> tuple[float, ...]:
        """Return (a, b, c, d) of the plane a x + b y + c z + d = 0, of least squares over its
        supporting points."""
        settings = self.settings
        seed = int(random_stream(settings.seed, self.name).integers(2**31))
        with open3d_on_one_thread() as o3d:
            o3d.utility.random.seed(seed)
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            plane, _ = cloud.segment_plane(settings.inlier_mm * MM, 3, settings.iterations)
        return tuple(plane.tolist())


class M3c2Config(ScoreMapConfig):
    """Settings of M3C2.

    - ``reference``: a capture of the same target without damage, in any format that
      ``tofpod detect`` reads and in the frame of the clouds; without it, distances are to
      ``surface``, fitted to the cloud itself.
    - ``registration_error_mm``: the error between both; null: estimated from the scatter of the
      distances.
    - ``cylinder_radius_mm``: half of the scale over which points are averaged; 4 mm holds some 20
      pixels of an Azure Kinect at 0.7 m, as Lague et al. recommend.
    - ``normal_radius_mm``: radius of the neighbourhood for a normal, 20 times a noise of 1 mm.
    - ``reach_mm``: half of a cylinder's length; points deeper than it have no counterpart."""

    crop: CropConfig = Field(default_factory=AutoCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    reference: str | None = None
    registration_error_mm: float | None = Field(default=None, ge=0)
    cylinder_radius_mm: float = Field(default=4.0, gt=0)
    normal_radius_mm: float = Field(default=20.0, gt=0)
    reach_mm: float = Field(default=500.0, gt=0)


class M3c2Detector(ScoreMapDetector[M3c2Config]):
    """Distance to a surface or a reference scan by M3C2 (py4dgeo), over the deviation in its level
    of detection.

    Means over cylinders along the normal (Lague, Brodu and Leroux, ISPRS J. 82 (2013), 10). A
    score of 1.96 is the level of detection: LoD / 1.96 = sqrt(s1^2 / n1 + s2^2 / n2) +
    registration error. Not modelled: noise that neighbours share, for which the level is too low,
    and a rim inside a cylinder, which counts as its scatter."""

    settings_type: ClassVar[type[M3c2Config]] = M3c2Config
    name = "m3c2"
    version = 6

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score |distance| / deviation in the crop. Raises UserError if no point has a
        counterpart."""
        mask = crop(cloud, self.settings.crop)
        points = cloud.points_m[mask]
        notes, warnings, feet = self._feet(cloud, mask, points)
        compared = notes["surface"]
        has_foot = np.isfinite(feet[:, 2])
        distance_m = np.full(len(points), np.nan)
        deviation_m = np.full(len(points), np.nan)
        if has_foot.any():
            before = feet[has_foot] if self.settings.reference is None else self._reference_m
            distances = self._distances(feet[has_foot], before, points)
            distance_m[has_foot], deviation_m[has_foot] = distances
        judged = np.isfinite(distance_m)
        alone = 1.0 - float(judged.mean())
        if not judged.any():
            raise UserError(
                f"no point of the target has {LEAST_SAMPLES} neighbours there and in {compared}",
                fix="check that both are in one frame, or enlarge cylinder_radius_mm or reach_mm",
            )
        error_m = self._registration_error(distance_m[judged], deviation_m[judged])
        deviation_m = np.maximum(deviation_m + error_m, rounding_floor(cloud, mask))
        signed = on_grid(distance_m / deviation_m, mask)
        if self.settings.reference is not None and np.nanmedian(np.abs(signed)) > LOD_SIGMAS:
            warnings.append(
                f"the target lies {median_of(np.abs(distance_m[judged])) / MM:.2g} mm off its"
                " reference scan: it moved, or is not registered to it"
            )
        if alone > MOST_ALONE:
            warnings.append(
                f"{100 * alone:.0f} % of the target has no counterpart in {compared} and is not"
                " judged"
            )
        notes["points"] = len(points)
        notes["registration_error_m"] = error_m
        notes["without_counterpart"] = alone
        return Evidence(
            score=np.abs(signed),
            residual_m=on_grid(points[:, 2] - feet[:, 2], mask),
            surface_z_m=on_grid(feet[:, 2], mask),
            scale_m=median_of(deviation_m[judged]),
            notes=notes,
            warnings=tuple(warnings),
            behind=signed > 0,
        )

    def _feet(
        self,
        cloud: Cloud,
        mask: np.ndarray,
        points: np.ndarray,
    ) -> tuple[dict[str, Any], list[str], np.ndarray]:
        """Return notes and warnings on the surface or the reference, and where the rays through
        points (n, 3) meet it (n, 3)."""
        reference = self.settings.reference
        if reference is not None:
            feet = self._below(points, cloud.projection == "central")
            return {"surface": f"reference scan {reference}"}, [], feet
        ground = background(cloud, mask, self.settings.surface)
        notes = {**ground.notes, "surface": ground.description}
        warnings = [ground.warning] if ground.warning else []
        return notes, warnings, np.column_stack([points[:, :2], ground.surface_z_m[mask]])

    def _registration_error(self, distance_m: np.ndarray, deviation_m: np.ndarray) -> float:
        """Return the registration error in metres, stated or estimated from the scatter of
        distances (n,) beyond their deviations (n,)."""
        if self.settings.registration_error_mm is not None:
            return self.settings.registration_error_mm * MM
        scatter_m = sigma_of(distance_m - median_of(distance_m))
        return float(np.sqrt(max(scatter_m**2 - median_of(deviation_m) ** 2, 0.0)))

    def places(self, points_m: np.ndarray) -> np.ndarray:
        """Return the places across the view, so that a rim and the points deep behind it are one
        finding."""
        return points_m * [1.0, 1.0, 0.0]

    @cached_property
    def _reference_m(self) -> np.ndarray:
        """Points (n, 3) of the reference scan."""
        assert self.settings.reference is not None
        cloud = average(open_capture([Path(self.settings.reference)]), AverageConfig())
        return cloud.points_m[cloud.valid]

    def _below(self, points: np.ndarray, central: bool) -> np.ndarray:
        """Return where the rays through points (n, 3) meet the reference (n, 3), by linear
        interpolation."""
        plan = points[:, :2]
        reference = self._reference_m[:, :2]
        z = self._reference_m[:, 2]
        if central:
            plan = plan / points[:, 2:]
            reference = reference / z[:, None]
        feet_z = LinearNDInterpolator(reference, z)(plan)
        return np.column_stack([plan * feet_z[:, None] if central else plan, feet_z])

    def _distances(
        self,
        feet: np.ndarray,
        before: np.ndarray,
        after: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (n,) of points ``after`` (m, 3) behind points ``before`` (k, 3) at
        each foot (n, 3), and its deviation; NaN if a cylinder holds too few points."""
        py4dgeo = _py4dgeo()
        with threadpoolctl.threadpool_limits(1, user_api="openmp"):
            epochs = (
                py4dgeo.Epoch(np.ascontiguousarray(before)),
                py4dgeo.Epoch(np.ascontiguousarray(after)),
            )
            algorithm = py4dgeo.M3C2(
                epochs=epochs,
                corepoints=np.ascontiguousarray(feet),
                registration_error=0.0,
                normal_radii=(self.settings.normal_radius_mm * MM,),
                cyl_radius=self.settings.cylinder_radius_mm * MM,
                max_distance=self.settings.reach_mm * MM,
            )
            distance, uncertainty = algorithm.run()
        is_sparse = (
            np.minimum(uncertainty["num_samples1"], uncertainty["num_samples2"]) < LEAST_SAMPLES
        )
        return np.where(is_sparse, np.nan, distance), uncertainty["lodetection"] / LOD_SIGMAS


def _py4dgeo() -> Any:
    """Return the module, but without its log, which it prints and writes into the working folder,
    and without the number of threads that it sets for all programs started from here."""
    threads = os.environ.get("OMP_NUM_THREADS")
    import py4dgeo

    if threads is None:
        os.environ.pop("OMP_NUM_THREADS", None)
    log = logging.getLogger("py4dgeo")
    log.handlers.clear()
    log.setLevel(logging.WARNING)
    return py4dgeo


class FpfhMemoryConfig(ScoreMapConfig):
    """Settings of the memory of shape features. The paper's program has 30, 100 and 8.

    - ``normal_neighbours``: typical number of points in the sphere of a normal.
    - ``feature_neighbours``: typical number of points in the sphere of a feature.
    - ``pool_px``: side of the square over which features are averaged.
    - ``memory``: number of features of undamaged targets that are kept.
    - ``surface``: the reference of sizes."""

    crop: CropConfig = Field(default_factory=AutoCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    normal_neighbours: int = Field(default=30, ge=3)
    feature_neighbours: int = Field(default=100, ge=3)
    pool_px: int = Field(default=7, ge=1)
    memory: int = Field(default=1000, ge=1)


class FpfhMemoryDetector(ScoreMapDetector[FpfhMemoryConfig]):
    """Fast point feature histograms (Open3D) against the nearest in a memory of undamaged targets.

    Horwitz and Hoshen, "Back to the Feature", CVPR workshops 2023: FPFH (Rusu et al., ICRA 2009),
    averaged over a window; the memory is a greedy k-centre coreset (Roth et al., CVPR 2022); the
    score is the Euclidean distance to its nearest feature, in units of the median distance of one
    more undamaged target. A wide hole shows by its rim alone, and a sharp step deeper than the
    spheres is missed. Not done: the paper's smoothing of scores. A score is not a length;
    ``scale_m`` is the deviation of the residuals."""

    settings_type: ClassVar[type[FpfhMemoryConfig]] = FpfhMemoryConfig
    name = "fpfh_memory"
    version = 6

    def __init__(
        self,
        settings: FpfhMemoryConfig,
        learned: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        super().__init__(settings)
        self._learned = learned

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        """Return ``memory`` (m, 33) and ``unit`` (): a cloud's median distance. Raises UserError
        for a single cloud."""
        if len(hole_free) < 2:
            raise UserError(f"the detector {self.name!r} learns from at least two hole-free clouds")
        pool_px = self.settings.pool_px
        of_clouds = []
        for cloud in hole_free:
            features, rows, columns = self._features(cloud, crop(cloud, self.settings.crop))
            # only windows that hardly overlap
            of_clouds.append(features[(rows % pool_px == 0) & (columns % pool_px == 0)])
        memory = coreset(np.concatenate(of_clouds[:-1]), self.settings.memory)
        return {"memory": memory, "unit": np.array(np.median(nearest(of_clouds[-1], memory)))}

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> Detector:
        """Return the detector with this memory."""
        return FpfhMemoryDetector(self.settings, learned)

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score the distance from the memory in the crop. Raises UserError without a memory, and
        for few points."""
        if self._learned is None:
            raise UserError(
                f"the detector {self.name!r} has no memory of hole-free targets to compare this"
                " cloud with",
                fix="use it in a study, which has hole-free boards, or call its `calibrate` with"
                " clouds of your own",
            )
        mask = crop(cloud, self.settings.crop)
        memory = self._learned["memory"]
        features, _, _ = self._features(cloud, mask)
        score = nearest(features, memory) / max(float(self._learned["unit"]), 1e-9)
        ground = background(cloud, mask, self.settings.surface)
        sigma_m = sigma_of(ground.residual_m[np.isfinite(ground.residual_m)])
        return Evidence(
            score=on_grid(score, mask),
            residual_m=ground.residual_m,
            surface_z_m=ground.surface_z_m,
            scale_m=max(sigma_m, rounding_floor(cloud, mask)),
            notes={
                "surface": ground.description,
                "points": len(score),
                "memory": len(memory),
            },
            unit="the median distance of an undamaged target's features from the memory, which is"
            " not a length",
        )

    def _features(
        self,
        cloud: Cloud,
        mask: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the averaged features (n, 33) of the masked points, and their rows and columns
        (n,)."""
        settings = self.settings
        points = np.ascontiguousarray(cloud.points_m[mask])
        if len(points) <= settings.feature_neighbours:
            raise UserError(
                f"{len(points)} points are too few for features of {settings.feature_neighbours}"
            )
        # one radius everywhere: two points at a rim may share their nearest points, and only
        # rounding would distinguish their normals
        neighbours = [settings.normal_neighbours, settings.feature_neighbours]
        distances_m, _ = cKDTree(points).query(points, k=neighbours)
        normal_m, feature_m = np.median(distances_m, axis=0).tolist()
        with open3d_on_one_thread() as o3d:
            sphere = o3d.geometry.KDTreeSearchParamRadius
            listed = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            listed.estimate_normals(sphere(normal_m))
            listed.orient_normals_to_align_with_direction([0.0, 0.0, -1.0])
            registration = o3d.pipelines.registration
            by_point = registration.compute_fpfh_feature(listed, sphere(feature_m))
            features = np.asarray(by_point.data).T
        if cloud.organised:
            rows, columns = np.nonzero(mask)
        else:
            _, rows, columns, _ = raster(points, cloud)
        rows = rows - rows.min()
        columns = columns - columns.min()
        # the last channel counts points
        counted = np.column_stack([features, np.ones(len(features))])
        height = int(rows.max()) + 1
        width = int(columns.max()) + 1
        image = np.zeros((height, width, counted.shape[1]))
        np.add.at(image, (rows, columns), counted)
        side = (settings.pool_px, settings.pool_px)
        pooled = cv2.blur(image, side, borderType=cv2.BORDER_CONSTANT)[rows, columns]
        return pooled[:, :-1] / pooled[:, -1:], rows, columns


def coreset(features: np.ndarray, size: int) -> np.ndarray:
    """Return at most ``size`` of the features (n, k): the most central one, then always the one
    farthest from these."""
    squares = ((features - features.mean(axis=0)) ** 2).sum(axis=1)
    taken = [int(squares.argmin())]
    squares = np.full(len(features), np.inf)
    while len(taken) < size:
        squares = np.minimum(squares, ((features - features[taken[-1]]) ** 2).sum(axis=1))
        if squares.max() == 0.0:
            break
        taken.append(int(squares.argmax()))
    return features[taken]


def nearest(features: np.ndarray, memory: np.ndarray) -> np.ndarray:
    """Return the distance (n,) of each feature (n, k) to the nearest in the memory (m, k)."""
    return cKDTree(memory).query(features)[0]
