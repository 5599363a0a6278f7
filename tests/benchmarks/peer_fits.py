"""Other libraries at the thesis detector's work: a robust surface through a cloud, and clusters of what lies off it.

All get the same cropped points and, for the cubic, the same basis of 10 Chebyshev products in scaled x and y, which is
made before the clock starts (ours is made within its time). Tolerances are the loosest powers of ten at which a surface
is within a micrometre (root mean square) of where it ends, not defaults that stop early or run long. Open3D fits planes
only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from detectors.clusters import euclidean_clusters
from detectors.surface import SurfaceConfig, fit_surface

HUBER = 1.345
"""95 % efficiency for Gaussian noise, in standard deviations."""
RANSAC_TRIALS = 100
"""With 10 % damage a draw of 10 points is clean with probability 0.35: 11 draws would do for 99 %. scikit-learn stops
by the same reckoning; Open3D draws 3 points."""


@dataclass(frozen=True)
class Points:
    """The cropped points (n, 3) of a cloud, metres; ``basis`` (n, 10) of a cubic; ``sigma_m``: their noise, robust."""

    xyz_m: np.ndarray
    basis: np.ndarray
    sigma_m: float

    @classmethod
    def of(cls, xyz_m: np.ndarray) -> Points:
        """From the points alone; the noise about a bisquare surface."""
        x, y, z = xyz_m.T
        u, v = (2 * (a - a.min()) / np.ptp(a) - 1 for a in (x, y))
        cheb = np.polynomial.chebyshev.chebvander2d(u, v, [3, 3]).reshape(-1, 4, 4)
        basis = np.stack([cheb[:, i, j] for i in range(4) for j in range(4 - i)], axis=1)
        residual = z - fit_surface(x, y, z, SurfaceConfig(method="bisquare")).evaluate(x, y)
        return cls(xyz_m, np.ascontiguousarray(basis), robust_sigma(residual))


Fit = Callable[[Points], np.ndarray]
"""The surface's z (n,) at the points."""
Cluster = Callable[[np.ndarray, float], np.ndarray]
"""Labels (m,) of points (m, 3), chains of steps up to a distance; any whole numbers."""


def robust_sigma(residual: np.ndarray) -> float:
    """Median |residual| / 0.6745, as the detector's scale."""
    return float(np.median(np.abs(residual))) / 0.6745


# ---------------------------------------------------------------- surfaces


def ours(method: str) -> Fit:
    """tofpod's, by method."""
    config = SurfaceConfig.from_data({"method": method})

    def fit(points: Points) -> np.ndarray:
        x, y, z = points.xyz_m.T
        return fit_surface(x, y, z, config).evaluate(x, y)

    return fit


def scipy_robust(points: Points) -> np.ndarray:
    """`least_squares` with the loss soft_l1, exact Jacobian, from the least-squares solution; residuals in sigmas."""
    from scipy.optimize import least_squares

    basis, z = points.basis / points.sigma_m, points.xyz_m[:, 2] / points.sigma_m
    start = np.linalg.lstsq(basis, z, rcond=None)[0]
    found = least_squares(lambda c: basis @ c - z, start, jac=lambda _: basis, loss="soft_l1", f_scale=HUBER, xtol=1e-4)
    return np.asarray(points.basis @ found.x)


def sklearn_huber(points: Points) -> np.ndarray:
    """`HuberRegressor` without penalty; z in sigmas about its median, so that its L-BFGS is well scaled."""
    from sklearn.linear_model import HuberRegressor

    z = points.xyz_m[:, 2]
    middle = np.median(z)
    model = HuberRegressor(epsilon=HUBER, alpha=0.0, fit_intercept=False, max_iter=1000, tol=1e-3)
    model.fit(points.basis, (z - middle) / points.sigma_m)
    return np.asarray(middle + points.sigma_m * (points.basis @ model.coef_))


def sklearn_ransac(points: Points) -> np.ndarray:
    """`RANSACRegressor` of least squares: inliers within 3 sigma, sets of 10 points, the last fit on all inliers."""
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    model = RANSACRegressor(
        LinearRegression(fit_intercept=False),
        min_samples=points.basis.shape[1],
        residual_threshold=3 * points.sigma_m,
        max_trials=RANSAC_TRIALS,
        random_state=1,
    )
    return np.asarray(model.fit(points.basis, points.xyz_m[:, 2]).predict(points.basis))


def statsmodels_bisquare(points: Points) -> np.ndarray:
    """`RLM` with Tukey's biweight at 4.685 and the MAD."""
    import statsmodels.api as sm

    model = sm.RLM(points.xyz_m[:, 2], points.basis, M=sm.robust.norms.TukeyBiweight(c=4.685))
    return np.asarray(points.basis @ model.fit(maxiter=50, tol=1e-6, conv="coefs").params)


def statsmodels_lar(points: Points) -> np.ndarray:
    """`QuantReg` at one half: least absolute residuals."""
    import statsmodels.api as sm

    model = sm.QuantReg((points.xyz_m[:, 2] - points.xyz_m[:, 2].mean()) / points.sigma_m, points.basis)
    found = model.fit(q=0.5, max_iter=1000, p_tol=1e-4)
    return np.asarray(points.xyz_m[:, 2].mean() + points.sigma_m * (points.basis @ found.params))


def open3d_plane(points: Points) -> np.ndarray:
    """`segment_plane`: RANSAC of 3 points, within 3 sigma. A plane, no cubic."""
    import open3d as o3d

    o3d.utility.random.seed(1)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.xyz_m))
    (a, b, c, d), _ = cloud.segment_plane(3 * points.sigma_m, 3, RANSAC_TRIALS)
    return np.asarray(-(a * points.xyz_m[:, 0] + b * points.xyz_m[:, 1] + d) / c)


FITS: dict[str, tuple[Fit, str]] = {
    "tofpod LAR": (ours("lar"), "LAR"),
    "tofpod bisquare": (ours("bisquare"), "bisquare"),
    "SciPy least_squares, soft_l1": (scipy_robust, "LAR"),
    "scikit-learn HuberRegressor": (sklearn_huber, "LAR"),
    "scikit-learn RANSACRegressor": (sklearn_ransac, "bisquare"),
    "statsmodels QuantReg 0.5": (statsmodels_lar, "LAR"),
    "statsmodels RLM, Tukey": (statsmodels_bisquare, "bisquare"),
    "Open3D segment_plane (a plane)": (open3d_plane, "LAR"),
}
"""By name: the fit, and which of ours it is compared with: the same estimator, or the nearest in kind."""


# ---------------------------------------------------------------- clusters


def scipy_clusters(points_m: np.ndarray, distance_m: float) -> np.ndarray:
    """All pairs within the distance from a k-d tree, then connected components."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    i, j = cKDTree(points_m).query_pairs(distance_m, output_type="ndarray").T
    links = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(len(points_m), len(points_m)))
    return np.asarray(connected_components(links, directed=False)[1])


def sklearn_clusters(points_m: np.ndarray, distance_m: float) -> np.ndarray:
    """`DBSCAN` with one point a core: single linkage."""
    from sklearn.cluster import DBSCAN

    return np.asarray(DBSCAN(eps=distance_m, min_samples=1).fit_predict(points_m))


def open3d_clusters(points_m: np.ndarray, distance_m: float) -> np.ndarray:
    """`cluster_dbscan`, likewise."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    return np.asarray(cloud.cluster_dbscan(distance_m, 1))


CLUSTERS: dict[str, Cluster] = {
    "tofpod": euclidean_clusters,
    "SciPy k-d tree + components": scipy_clusters,
    "scikit-learn DBSCAN": sklearn_clusters,
    "Open3D cluster_dbscan": open3d_clusters,
}


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two labellings group the same points together."""
    pairs = len(np.unique(np.stack([a, b]), axis=1).T)
    return pairs == len(np.unique(a)) == len(np.unique(b))
