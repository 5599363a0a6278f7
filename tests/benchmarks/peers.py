"""Numeric steps of tofpod beside other libraries that do the same work.

Each function here sets up one comparison. The libraries work in turns in one process on one thread,
and what they find is compared with what tofpod finds.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from tests.benchmarks.measuring import Work, median_in_turns_s, median_s

SPEED_OF_LIGHT_IN_AIR_M_S = 299_702_547.0


@dataclass(frozen=True)
class PeerRow:
    """A step of tofpod beside another library's."""

    step: str
    """What is done."""
    ours_ms: float
    """Processor time of tofpod, in milliseconds."""
    library: str
    """The other library."""
    ratio: float
    """Its processor time over ours; of renders at equal error."""
    agreement: str
    """How far its result is from ours."""


@dataclass(frozen=True)
class Peer:
    """Another library's way to do a step."""

    library: str
    """Its name, with the function."""
    work: Work
    """Does the step."""


def compared(
    step: str, ours: Work, peers: list[Peer], runs: int, agreement: Callable[[Any, Any], str]
) -> list[PeerRow]:
    """Return the rows of a step. ``agreement`` says in words how far a peer's result is from
    ours."""
    works: dict[str, Work] = {"tofpod": ours}
    works |= {peer.library: peer.work for peer in peers}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        results = {name: work() for name, work in works.items()}
        times_s = median_in_turns_s(works, runs)
    rows = []
    for peer in peers:
        row = PeerRow(
            step=step,
            ours_ms=round(1e3 * times_s["tofpod"], 3),
            library=peer.library,
            ratio=round(times_s[peer.library] / times_s["tofpod"], 3),
            agreement=agreement(results["tofpod"], results[peer.library]),
        )
        rows.append(row)
    return rows


def noisy_board(pixels: int) -> np.ndarray:
    """Return points (h, w, 3) in metres of a bent board with damage, with 0.5 mm of noise and a
    pitch of 1.4 mm."""
    random = np.random.default_rng(0)
    height = round((pixels / 1.5) ** 0.5)
    width = round(1.5 * height)
    row, column = np.mgrid[:height, :width]
    x_m = 1.4e-3 * column
    y_m = 1.4e-3 * row
    bent_m = 0.1 * x_m + 0.2 * x_m * y_m - y_m**3
    z_m = 0.75 + bent_m + 5e-4 * random.standard_normal(x_m.shape)
    from_hole_m = np.hypot(x_m % 0.06 - 0.03, y_m % 0.06 - 0.03)
    z_m[from_hole_m < 0.005] += 0.0127
    return np.stack([x_m, y_m, z_m], axis=-1)


def averages(runs: int) -> list[PeerRow]:
    """Average frames that lie in memory."""
    from detectors.averages.average import AverageConfig, average
    from harness.vocabulary.geometry import Frame, Lens

    lens = Lens(200, 150, 504.0, 504.0, 99.5, 74.5)
    noise = np.random.default_rng(0).standard_normal((50, 150, 200))
    stack_m = (0.75 + 1e-3 * noise).astype(np.float32)
    frames = [Frame(str(i), z_m, np.zeros(z_m.shape, np.uint8)) for i, z_m in enumerate(stack_m)]
    source: Any = SimpleNamespace(
        name="frames in memory", organised=True, z_step_m=0.0, region=lens.whole, lens=lens
    )
    source.slopes = lens.region_slopes(lens.whole)
    source.frames = lambda: iter(frames)

    def ours() -> np.ndarray:
        return average(source, AverageConfig()).points_m[..., 2]

    def by_numpy() -> np.ndarray:
        np.nanvar(stack_m, axis=0, dtype=float)
        np.isfinite(stack_m).sum(axis=0)
        return np.asarray(np.nanmean(stack_m, axis=0, dtype=float))

    def agreement(mean_m: np.ndarray, their_mean_m: np.ndarray) -> str:
        return f"means within {1e3 * np.abs(mean_m - their_mean_m).max():.1e} mm"

    peers = [Peer("NumPy `nanmean`, `nanvar`", by_numpy)]
    step = "mean, variance and count of 50 frames of 30,000 pixels"
    return compared(step, ours, peers, runs, agreement)


@dataclass(frozen=True)
class FitData:
    """Points of a board, and the basis of a cubic that is handed to other libraries ready made."""

    x_m: np.ndarray
    """Abscissae (n,)."""
    y_m: np.ndarray
    """Ordinates (n,)."""
    z_m: np.ndarray
    """Depths (n,)."""
    basis: np.ndarray
    """The cubic's terms (n, 10)."""

    def ours(self, method: str) -> np.ndarray:
        """Return the depths (n,) of tofpod's robust cubic."""
        from detectors.surfaces.surface import SurfaceConfig, fit_surface

        config = SurfaceConfig.from_data({"method": method})
        return fit_surface(self.x_m, self.y_m, self.z_m, config).evaluate(self.x_m, self.y_m)


def fit_data(pixels: int) -> FitData:
    """Return a board to which a cubic is fitted."""
    from detectors.surfaces.surface import Chebyshev

    x_m, y_m, z_m = noisy_board(pixels).reshape(-1, 3).T
    places_m = np.stack([x_m, y_m], axis=1)
    terms = Chebyshev.over(places_m, 3).basis(places_m)
    return FitData(x_m, y_m, z_m, np.ascontiguousarray(terms.T))


def fits_apart(ours_m: np.ndarray, theirs_m: np.ndarray) -> str:
    """Say how far a fitted surface is from ours."""
    return f"{1e6 * np.sqrt(np.mean((ours_m - theirs_m) ** 2)):.2g} um apart (rms)"


def surfaces_of_absolute_residuals(runs: int) -> list[PeerRow]:
    """Fit a cubic by least absolute residuals and the like."""
    import statsmodels.api as sm
    from scipy.optimize import least_squares
    from sklearn.linear_model import HuberRegressor

    data = fit_data(30_000)
    middle_m = float(np.median(data.z_m))
    sigma_m = 5e-4  # of the board's noise: these libraries want numbers near 1
    scaled = (data.z_m - middle_m) / sigma_m
    columns = data.basis / sigma_m

    def by_quantile_regression() -> np.ndarray:
        found = sm.QuantReg(scaled, data.basis).fit(0.5).params
        return np.asarray(middle_m + sigma_m * data.basis @ found)

    def by_least_squares() -> np.ndarray:
        found = least_squares(
            lambda c: columns @ c - scaled,
            np.zeros(10),
            loss="soft_l1",
            f_scale=1.345,
            xtol=1e-4,
            jac=lambda _: columns,
        )
        return np.asarray(middle_m + data.basis @ found.x)

    def by_huber() -> np.ndarray:
        huber = HuberRegressor(
            epsilon=1.345, alpha=0.0, fit_intercept=False, max_iter=1000, tol=1e-3
        )
        return np.asarray(middle_m + sigma_m * data.basis @ huber.fit(data.basis, scaled).coef_)

    peers = [
        Peer("statsmodels `QuantReg`", by_quantile_regression),
        Peer("SciPy `least_squares`, soft L1", by_least_squares),
        Peer("scikit-learn `HuberRegressor`", by_huber),
    ]
    step = "robust cubic through 30,000 points, least absolute residuals"
    return compared(step, partial(data.ours, "lar"), peers, runs, fits_apart)


def surfaces_of_bisquare(runs: int) -> list[PeerRow]:
    """Fit a cubic by Tukey's biweight."""
    import statsmodels.api as sm

    data = fit_data(30_000)
    middle_m = float(np.median(data.z_m))
    biweight = sm.robust.norms.TukeyBiweight(c=4.685)

    def by_statsmodels() -> np.ndarray:
        found = sm.RLM(data.z_m - middle_m, data.basis, M=biweight).fit().params
        return np.asarray(middle_m + data.basis @ found)

    peers = [Peer("statsmodels `RLM`", by_statsmodels)]
    step = "robust cubic through 30,000 points, bisquare"
    return compared(step, partial(data.ours, "bisquare"), peers, runs, fits_apart)


def clusters(runs: int) -> list[PeerRow]:
    """Cluster points that stand out, at 10 mm."""
    import open3d as o3d
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree
    from sklearn.cluster import DBSCAN

    from detectors.pixels.clusters import euclidean_clusters

    board_m = noisy_board(120_000).reshape(-1, 3)
    is_outlier = np.random.default_rng(1).random(len(board_m)) < 0.02
    points_m = np.ascontiguousarray(board_m[is_outlier])
    points_m[:, 2] = 0.75
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))

    def by_scipy() -> np.ndarray:
        i, j = cKDTree(points_m).query_pairs(0.01, output_type="ndarray").T
        links = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(points_m),) * 2)
        return np.asarray(connected_components(links, directed=False)[1])

    def agreement(labels: np.ndarray, their_labels: np.ndarray) -> str:
        pairs = np.unique(np.stack([labels, their_labels]), axis=1).shape[1]
        ours = len(np.unique(labels))
        theirs = len(np.unique(their_labels))
        return f"the same {ours} clusters" if pairs == ours == theirs else "NOT the same clusters"

    peers = [
        Peer("SciPy k-d tree and components", by_scipy),
        Peer(
            "scikit-learn `DBSCAN`",
            lambda: DBSCAN(eps=0.01, min_samples=1).fit_predict(points_m),
        ),
        Peer("Open3D `cluster_dbscan`", lambda: np.asarray(cloud.cluster_dbscan(0.01, 1))),
    ]
    step = f"clusters of {len(points_m):,} points"
    return compared(step, lambda: euclidean_clusters(points_m, 0.01), peers, runs, agreement)


def curves(runs: int) -> list[PeerRow]:
    """Fit a curve of detection to 300 hits and misses."""
    import statsmodels.api as sm

    from harness.evaluation.pod.hit_miss import fit_hit_miss

    random = np.random.default_rng(0)
    size_mm = random.uniform(2.0, 8.0, 300)
    probability = 1 / (1 + np.exp(-2 * (size_mm - 4)))
    is_hit = (random.random(300) < probability).astype(float)
    design = np.column_stack([np.ones(300), size_mm])

    def by_statsmodels() -> float:
        intercept, slope = sm.Logit(is_hit, design).fit(disp=0).params
        return float(-intercept / slope)

    def agreement(a50_mm: float, their_a50_mm: float) -> str:
        return f"a50 {abs(a50_mm - their_a50_mm):.0e} mm apart"

    peers = [Peer("statsmodels `Logit`", by_statsmodels)]
    step = "logistic curve of 300 hits and misses"
    return compared(step, lambda: fit_hit_miss(size_mm, is_hit).curve.mu, peers, runs, agreement)


def registrations(runs: int) -> list[PeerRow]:
    """Bring two clouds of a wavy sheet together, point to point."""
    import open3d as o3d

    from detectors.views.registration.by_points import register_by_icp
    from detectors.views.registration.settings import IcpRegistration
    from tests.detectors.views.registration.test_registration_icp import (
        pose,
        usual_error,
        wavy_view,
    )

    T_guess = pose() @ np.linalg.inv(pose(5, -8)) @ usual_error()
    views = [wavy_view(pose(), np.eye(4), 0, 2e-4), wavy_view(pose(5, -8), T_guess, 1, 2e-4)]
    config = IcpRegistration(points="target")

    def by_open3d() -> np.ndarray:
        clouds = []
        for view in views:
            points = o3d.utility.Vector3dVector(view.points_m)
            clouds.append(o3d.geometry.PointCloud(points))
        fixed, moving = clouds
        point_to_point = o3d.pipelines.registration.TransformationEstimationPointToPoint()
        T = T_guess
        for limit_m in (0.03, 0.015, 0.012):
            T = o3d.pipelines.registration.registration_icp(
                moving, fixed, limit_m, T, point_to_point
            ).transformation
        return np.asarray(T)

    def agreement(T_ours: np.ndarray, T_theirs: np.ndarray) -> str:
        return f"{1e3 * np.linalg.norm((T_ours - T_theirs)[:3, 3]):.2g} mm apart"

    def ours() -> np.ndarray:
        return register_by_icp(*views, config).T_reference_view

    peers = [Peer("Open3D `registration_icp`, without covariance", by_open3d)]
    step = "ICP of two clouds of 2,500 points, with the pose's covariance"
    return compared(step, ours, peers, max(3, runs // 3), agreement)


def renders(runs: int) -> list[PeerRow]:
    """Render a blind hole: ours beside mitransient's path tracer. The ratio is of processor time
    times the variance of the pixels inside, which is the time at equal error."""
    from scenes.optics import RenderConfig
    from scenes.render.scene import lit_scene, load_mitsuba
    from scenes.render.view import render_view
    from scenes.target.custom import TargetConfig
    from scenes.target.mesh import build_target
    from tests.scenes.render.test_transport_oracle import FREQUENCIES, optics_of
    from tests.validation.transport_oracle import oracle

    facts: Mapping[str, Any] = {
        "name": "custom",
        "board": {"width_mm": 60, "height_mm": 60, "thickness_mm": 40},
        "holes": [
            {"id": 1, "kind": "blind", "diameter_mm": 24, "depth_mm": 30, "centre_mm": [0, 0]}
        ],
        "pose": {"distance_m": 0.5, "tilt_x_deg": 8},
        "backing": None,
        "room": None,
    }
    target = build_target(TargetConfig.from_data(facts))
    optics = optics_of(56, 56, 420.0)
    lit = lit_scene(load_mitsuba(), target.parts, optics)
    view = render_view(target, optics, RenderConfig(bounces=6))
    cut = (slice(view.region.row0, view.region.row1), slice(view.region.col0, view.region.col1))
    tracer = oracle(lit, optics, FREQUENCIES)
    is_inside = view.range_m > 0.515

    def ours(seed: int) -> np.ndarray:
        phasor = render_view(target, optics, RenderConfig(bounces=6, seed=seed)).phasor[0]
        return np.asarray(phasor[is_inside])

    def by_mitransient(seed: int) -> np.ndarray:
        return np.asarray(tracer.phasors(256, seed, 6)[0][cut][is_inside])

    def spread_mm(draw: Callable[[int], np.ndarray]) -> float:
        drawn = np.stack([draw(seed) for seed in range(1, runs + 1)])
        variance_rad2 = np.var(np.angle(drawn / drawn.mean(axis=0)), axis=0, ddof=1).mean()
        mm_per_rad = 1e3 * SPEED_OF_LIGHT_IN_AIR_M_S / (4 * np.pi * FREQUENCIES[0])
        return float(mm_per_rad * np.sqrt(variance_rad2))

    ours_s = median_s(partial(ours, 99), 1)
    theirs_s = median_s(partial(by_mitransient, 99), 1)
    ours_mm = spread_mm(ours)
    theirs_mm = spread_mm(by_mitransient)
    row = PeerRow(
        step="render of a blind hole, at equal error of range inside",
        ours_ms=round(1e3 * ours_s, 1),
        library="mitransient, 256 paths a pixel",
        ratio=round(theirs_s * theirs_mm**2 / (ours_s * ours_mm**2), 3),
        agreement=f"errors {ours_mm:.2g} and {theirs_mm:.2g} mm",
    )
    return [row]


PEERS = (
    averages,
    surfaces_of_absolute_residuals,
    surfaces_of_bisquare,
    clusters,
    curves,
    registrations,
    renders,
)
"""Comparisons, in the order of a study."""
