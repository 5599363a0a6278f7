"""Spheres of a known size in a depth image: found by votes of surface normals, and fitted along the
rays.

Fit. Noise acts along the ray, so the sum of squares of (measured range - range at which the ray
meets the sphere) is minimised, which a radial distance would bias. Weights are the squared cosine
of incidence, as noise grows with its inverse. Only pixels within `STEEPEST_DEG` of incidence and
`RIMS_PX` inside the silhouette count: further out, a pixel also sees what lies behind. The centre
is that of a sphere with the stated diameter, unless the diameter is free. Errors are those of the
residuals, with the correlation of neighbours; errors that a whole sphere shares are not in them.
Not modelled: light between the sphere and its surroundings, and a lens that is wrong."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from scipy import special

from harness.evaluation.intervals import UPPER, Interval
from harness.vocabulary.geometry import rays_of

STEEPEST_DEG = 60.0
RIM_SHARE = 0.15
RIMS_PX = (1.5, 2.5)
"""Margin inside the silhouette: a share of its radius, within these limits. A blur of 0.6 pixels
puts 0.6 % of what lies behind into pixels 1.5 inside, and none into those 2.5 inside; on small
spheres, whose noise is larger, the wider margin would leave too few."""
FEWEST_PX = 40
"""Pixels that a fit of four numbers needs."""
LEAST_SHARE = 0.2
"""Least share of a sphere's pixels with a range: fewer may all lie on one side of it."""
LEAST_ON_SPHERE = 0.8
"""Share of the pixels with a range that must lie on the sphere, or it is something else."""
LEAST_SIDES = 3
"""Quarters of the disc that must hold pixels."""
WIDEST = 0.5
"""Distance from the sphere, in radii, within which a point may belong to it at first."""
OUTLIER = 4.0
"""Robust deviations from the fit beyond which a point does not count."""
NOISIEST = 0.25
"""Largest scatter in radii: beyond it, no shape is recognised."""
# longest lag of the correlation of residuals: a share of the side of their square, within limits
LAG_SHARE = 0.1
LAGS_PX = (2, 5)
# votes: radius of the window of a normal and side of a cell in radii, and the windows in pixels
WINDOW = 0.35
CELL = 0.7
WINDOWS_PX = (1, 2, 3, 5, 8, 12, 18, 27)
LEAST_VOTES = 0.12
"""Least votes in a cell over the pixels of a sphere: half of these see the centre within a cell,
and the sun takes half of them; a plane gives 0.16 in each of its cells."""
OF_PLANE = CELL**2 / np.pi
MOST_CANDIDATES = 300
LEAST_EVIDENCE = 20.0
"""Least logarithm of the likelihood of a sphere over that of a plane, which has as many free
numbers; among the 3e5 places of an image, noise alone reaches 13."""
LEAST_EVIDENCE_ALONE = 11.0
"""The same for something of a sphere's width that stands alone: of such, a view has some thirty at
most, 1e-4 of its places, whose logarithm is -9."""
AROUND = 1.6
"""Radius, in those of the sphere, of the ring that is empty around what stands alone."""
MOST_AROUND = 0.3
"""Most points there at the sphere's distance, over those of a surface that goes on."""
MOST_SPHERES = 12
LOOSEST = 0.13
"""Largest relative error of a free radius: pieces of edges and noise do not determine one."""
OTHER_SIZE = 0.1
"""Relative difference of radii from which a sphere is another one, beside three of its errors."""
SCREENED_PX = 500
"""Pixels with which a candidate is judged before all are fitted."""


def farthest_m(pitch_rad: float, radius_m: float) -> float:
    """Return the distance from which a sphere has fewer than `FEWEST_PX` pixels within the limits
    of incidence and rim."""
    disc_px = np.sqrt(FEWEST_PX / np.pi)
    # all angles are small there
    by_incidence = radius_m * np.sin(np.radians(STEEPEST_DEG)) / (disc_px * pitch_rad)
    by_rim = radius_m / ((disc_px + RIMS_PX[0]) * pitch_rad)
    return float(min(by_incidence, by_rim))


@dataclass(frozen=True)
class RangeImage:
    """Ranges along known rays."""

    range_m: np.ndarray
    """(h, w): NaN where there is none."""
    rays: np.ndarray
    """(h, w, 3): unit vectors; NaN where the lens has none."""

    @cached_property
    def pitch_rad(self) -> float:
        """Angle between neighbouring pixels."""
        beside = np.linalg.norm(np.diff(self.rays, axis=1), axis=-1)
        return float(np.nanmedian(beside))


def range_image(points_m: np.ndarray, slopes: np.ndarray) -> RangeImage:
    """Return the ranges of points (h, w, 3) along rays with ``slopes`` (h, w, 2)."""
    along = rays_of(slopes)
    stretch = np.linalg.norm(along, axis=-1)
    return RangeImage(points_m[..., 2] * stretch, along / stretch[..., None])


@dataclass(frozen=True)
class SphereFit:
    """A sphere in a range image."""

    stated_m: float
    """Stated radius."""
    centre_m: np.ndarray
    """(3,): centre of the sphere with the stated radius."""
    covariance_m2: np.ndarray
    """(3, 3): of that centre."""
    radius_m: float
    """Radius if it is free."""
    radius_sigma_m: float
    """Standard error of that radius."""
    pixels: np.ndarray
    """(n,): flat indices of the pixels that count."""
    residual_m: np.ndarray
    """(n,): range minus that of the sphere with the free radius."""
    radial_m: np.ndarray
    """(n,): distance of the points from its centre minus its radius."""
    expected_px: int
    """Pixels that would count if all had a range."""

    @property
    def seen_share(self) -> float:
        """Share of its pixels that count."""
        return len(self.pixels) / max(self.expected_px, 1)

    @property
    def scatter_m(self) -> float:
        """Root mean square of the residuals along the rays."""
        return float(np.sqrt((self.residual_m**2).mean()))

    @property
    def size_error_m(self) -> float:
        """Measured minus stated diameter: probing error of size (PS)."""
        return 2 * (self.radius_m - self.stated_m)

    @property
    def size_interval_m(self) -> Interval:
        """Two-sided 95 % interval of the error of size. Ranges show a sphere's curvature, one over
        its radius, in which the interval is symmetric."""
        half = student(len(self.pixels) - 4) * self.radius_sigma_m / self.radius_m
        smallest_m = self.radius_m / (1 + half)
        largest_m = self.radius_m / max(1 - half, 1e-3)
        return Interval(2 * (smallest_m - self.stated_m), 2 * (largest_m - self.stated_m))

    def form_error_m(self, share: float) -> float:
        """Return the width of the shell that holds a share of the points: probing error of form
        (PF), with 0.997 by VDI/VDE 2634-2, with 0.95 by ISO 10360-13."""
        low, high = np.quantile(self.radial_m, [(1 - share) / 2, (1 + share) / 2])
        return float(high - low)


@dataclass(frozen=True)
class NoFit:
    """A place without a fit."""

    why: str


def student(degrees: float) -> float:
    """Return the half width of a two-sided 95 % interval in standard errors."""
    return float(special.stdtrit(max(degrees, 1), UPPER))


class _Model(NamedTuple):
    """Ranges (n,) to a sphere, and their derivatives (n, 4) by centre and radius."""

    range_m: np.ndarray
    jacobian: np.ndarray
    cosine: np.ndarray


def _model(rays: np.ndarray, centre_m: np.ndarray, radius_m: float) -> _Model:
    """Return where rays (n, 3) meet a sphere. Those that miss it are taken at its rim."""
    along_m = rays @ centre_m
    inside_m2 = radius_m**2 - centre_m @ centre_m + along_m**2
    half_chord_m = np.sqrt(np.maximum(inside_m2, (1e-3 * radius_m) ** 2))
    by_centre = rays - (along_m[:, None] * rays - centre_m) / half_chord_m[:, None]
    by_radius = -radius_m / half_chord_m
    return _Model(
        range_m=along_m - half_chord_m,
        jacobian=np.column_stack([by_centre, by_radius]),
        cosine=half_chord_m / radius_m,
    )


def disc(
    image: RangeImage, centre_m: np.ndarray, radius_m: float, near: np.ndarray | None = None
) -> np.ndarray:
    """Return the flat indices of the pixels that see a sphere within the limits of incidence and
    rim, with or without a range; ``near`` (n,) are the only ones to look at."""
    away_m = float(np.linalg.norm(centre_m))
    if not away_m > 1.5 * radius_m:
        return np.zeros(0, int)
    rays = image.rays.reshape(-1, 3)
    if near is not None:
        rays = rays[near]
    by_incidence = radius_m * np.sin(np.radians(STEEPEST_DEG)) / away_m
    silhouette_rad = np.arcsin(radius_m / away_m)
    rim_px = np.clip(RIM_SHARE * silhouette_rad / image.pitch_rad, *RIMS_PX)
    by_rim = np.sin(max(silhouette_rad - rim_px * image.pitch_rad, 0.0))
    cosine = np.sqrt(1 - min(by_incidence, by_rim) ** 2)
    with np.errstate(invalid="ignore"):
        pixels = np.flatnonzero(rays @ centre_m >= cosine * away_m)
    return pixels if near is None else near[pixels]


def fit_sphere(
    image: RangeImage, start_m: np.ndarray, radius_m: float, most_px: int | None = None
) -> SphereFit | NoFit:
    """Fit the sphere of a stated radius near a centre (3,); its pixels then determine a free
    radius as well. ``most_px``: about so many of its pixels are looked at."""
    centre_m = np.asarray(start_m, float)
    ranges_m = image.range_m.ravel()
    rays = image.rays.reshape(-1, 3)
    limit_m = WIDEST * radius_m
    wide_disc = disc(image, centre_m, 2 * radius_m)
    if most_px is not None:
        # the wider disc has some four times as many
        wide_disc = wide_disc[:: len(wide_disc) // (4 * most_px) + 1]
    for _ in range(12):
        pixels = disc(image, centre_m, radius_m, wide_disc)
        present = pixels[np.isfinite(ranges_m[pixels])]
        if len(present) < FEWEST_PX:
            return NoFit(f"{len(present)} pixels with a range, {FEWEST_PX} needed")
        model = _model(rays[present], centre_m, radius_m)
        off_m = ranges_m[present] - model.range_m
        close = np.abs(off_m) <= limit_m
        used = present[close]
        if len(used) < FEWEST_PX:
            return NoFit(f"{len(used)} pixels on it, {FEWEST_PX} needed")
        step_m = _step(model.jacobian[close, :3], off_m[close], model.cosine[close])
        centre_m = centre_m + np.clip(step_m, -limit_m, limit_m)
        scatter_m = 1.4826 * float(np.median(np.abs(off_m[close])))
        # not below half the last limit: the first centres are rough
        limit_m = min(max(OUTLIER * scatter_m, limit_m / 2), WIDEST * radius_m)
        if np.linalg.norm(step_m) < 1e-6 * radius_m:
            break
    problem = _problem(image, pixels, present, used)
    if problem:
        return NoFit(problem)
    evidence = _evidence(rays[present], ranges_m[present], off_m, radius_m)
    if evidence < LEAST_EVIDENCE:
        fill = len(present) / len(pixels)
        if evidence < LEAST_EVIDENCE_ALONE or not _alone(image, centre_m, radius_m, fill):
            return NoFit("its points lie on a plane as well as on a sphere")
    return _finished(image, pixels, used, centre_m, radius_m)


def _problem(
    image: RangeImage,
    pixels: np.ndarray,
    present: np.ndarray,
    used: np.ndarray,
) -> str:
    """Return why a fit is none, else ""."""
    if len(present) < LEAST_SHARE * len(pixels):
        share = 100 * len(present) / len(pixels)
        return f"{share:.0f} % of its pixels have a range, {100 * LEAST_SHARE:.0f} % needed"
    if len(used) < LEAST_ON_SPHERE * len(present):
        share = 100 * len(used) / len(present)
        return f"{share:.0f} % of its points lie on a sphere"
    width = image.range_m.shape[1]
    rows = used // width
    columns = used % width
    middle_row = pixels // width
    middle_column = pixels % width
    below = rows > middle_row.mean()
    beside = columns > middle_column.mean()
    quarters = np.bincount(2 * below + beside, minlength=4)
    if (quarters >= len(used) / 20).sum() < LEAST_SIDES:
        return "its pixels lie on one side of it"
    return ""


def _evidence(rays: np.ndarray, ranges_m: np.ndarray, off_m: np.ndarray, radius_m: float) -> float:
    """Return the logarithm of the likelihood of a sphere, from which the points (n,) of a disc are
    ``off_m`` (n,), over that of a plane. Residuals count up to the same limit for both."""
    beside = (ranges_m > 0) & (np.abs(off_m) <= radius_m)
    basis = rays[beside]
    # a plane is linear in rays over the range: 1 = range (rays . n), so n solves rays . n = 1/range
    weight = ranges_m[beside] ** 2
    normal, *_ = np.linalg.lstsq(basis * weight[:, None], weight / ranges_m[beside], rcond=None)
    from_plane_m = ranges_m[beside] - 1 / (basis @ normal)
    limit_m2 = (WIDEST * radius_m) ** 2
    of_sphere_m2 = np.minimum(off_m[beside] ** 2, limit_m2).sum()
    of_plane_m2 = np.minimum(from_plane_m**2, limit_m2).sum()
    return len(basis) / 2 * float(np.log(of_plane_m2 / max(of_sphere_m2, 1e-18)))


def _alone(image: RangeImage, centre_m: np.ndarray, radius_m: float, fill: float) -> bool:
    """Return whether hardly any points lie around a sphere at its distance, of those that a surface
    would have there that is ``fill``ed as the sphere is."""
    away_m = float(np.linalg.norm(centre_m))
    silhouette_rad = np.arcsin(min(radius_m / away_m, 1.0))
    with np.errstate(invalid="ignore"):
        off_rad = np.arccos(np.clip(image.rays @ (centre_m / away_m), -1, 1))
        around = (off_rad > silhouette_rad + RIMS_PX[0] * image.pitch_rad) & (
            off_rad < AROUND * silhouette_rad + RIMS_PX[0] * image.pitch_rad
        )
        at_its_distance = around & (np.abs(image.range_m - away_m) < 1.5 * radius_m)
    return bool(at_its_distance.sum() < MOST_AROUND * fill * around.sum())


def _step(jacobian: np.ndarray, off_m: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Return the step (k,) of weighted least squares."""
    step, *_ = np.linalg.lstsq(jacobian * cosine[:, None], off_m * cosine, rcond=None)
    return np.asarray(step)


def _finished(
    image: RangeImage, pixels: np.ndarray, used: np.ndarray, centre_m: np.ndarray, radius_m: float
) -> SphereFit | NoFit:
    """Return the fit with the errors of the centre, and with the free radius."""
    ranges_m = image.range_m.ravel()[used]
    rays = image.rays.reshape(-1, 3)[used]
    fixed_radius = _model(rays, centre_m, radius_m)
    covariance_m2 = _covariance(
        image, used, fixed_radius.jacobian[:, :3], ranges_m - fixed_radius.range_m, fixed_radius
    )
    free_centre_m = centre_m.copy()
    free_radius_m = radius_m
    for _ in range(20):
        model = _model(rays, free_centre_m, free_radius_m)
        step_m = _step(model.jacobian, ranges_m - model.range_m, model.cosine)
        step_m = np.clip(step_m, -radius_m / 4, radius_m / 4)
        free_centre_m = free_centre_m + step_m[:3]
        free_radius_m = float(free_radius_m + step_m[3])
        if not radius_m / 3 < free_radius_m < 3 * radius_m:
            return NoFit("its points do not determine a diameter")
        if np.linalg.norm(step_m) < 1e-7 * radius_m:
            break
    model = _model(rays, free_centre_m, free_radius_m)
    residual_m = ranges_m - model.range_m
    if not residual_m.std() < NOISIEST * radius_m:
        return NoFit(f"its points scatter by {1e3 * residual_m.std():.1f} mm")
    free_covariance_m2 = _covariance(image, used, model.jacobian, residual_m, model)
    points_m = rays * ranges_m[:, None]
    return SphereFit(
        stated_m=radius_m,
        centre_m=centre_m,
        covariance_m2=covariance_m2,
        radius_m=free_radius_m,
        radius_sigma_m=float(np.sqrt(free_covariance_m2[3, 3])),
        pixels=used,
        residual_m=residual_m,
        radial_m=np.linalg.norm(points_m - free_centre_m, axis=1) - free_radius_m,
        expected_px=len(pixels),
    )


def _covariance(
    image: RangeImage, used: np.ndarray, jacobian: np.ndarray, off_m: np.ndarray, model: _Model
) -> np.ndarray:
    """Return the covariance (k, k) of a fit from its residuals, widened by the correlation of
    neighbours."""
    weighted = jacobian * model.cosine[:, None]
    scaled_m = off_m * model.cosine
    count, numbers = jacobian.shape
    shared = correlated_pixels(image.range_m.shape, used, scaled_m, numbers)
    degrees = max(count - numbers * shared, 1.0)
    variance_m2 = float((scaled_m**2).sum()) / degrees
    return np.asarray(np.linalg.pinv(weighted.T @ weighted) * variance_m2 * shared)


def correlated_pixels(
    shape: tuple[int, ...], used: np.ndarray, values: np.ndarray, numbers: int = 0
) -> float:
    """Return how many pixels share one independent error, 1 or more: the sum of the correlations
    of residuals (n,) at the pixels ``used`` over short lags, without the share that a fit of so
    many ``numbers`` takes from each lag."""
    count = len(used)
    reach = int(np.clip(LAG_SHARE * np.sqrt(count), *LAGS_PX))
    picture = np.zeros(shape)
    picture.ravel()[used] = values
    is_used = np.zeros(shape)
    is_used.ravel()[used] = 1.0
    rows, columns = np.divmod(used, shape[1])
    window = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    picture = np.pad(picture[window], reach)
    is_used = np.pad(is_used[window], reach)
    variance = float((picture**2).sum()) / count
    if variance == 0:
        return 1.0
    total = 0.0
    lags = range(-reach, reach + 1)
    for shift in [(row, column) for row in lags for column in lags]:
        pairs = float((is_used * np.roll(is_used, shift, (0, 1))).sum())
        product = float((picture * np.roll(picture, shift, (0, 1))).sum())
        total += product / max(pairs, 1.0) / variance
    lost = numbers * len(lags) ** 2 / count
    return max(total / (1 - min(lost, 0.3)), 1.0)


# ---------------------------------------------------------------- where spheres are


def find_spheres(image: RangeImage, radius_m: float) -> list[SphereFit]:
    """Return the spheres of a stated radius, nearest first, without overlaps."""
    fits: list[SphereFit] = []
    for start_m in _candidates(image, radius_m):
        is_fitted = [np.linalg.norm(fit.centre_m - start_m) < radius_m for fit in fits]
        if any(is_fitted):
            continue
        fit = fit_sphere(image, start_m, radius_m, most_px=SCREENED_PX)
        if isinstance(fit, SphereFit):
            fit = fit_sphere(image, fit.centre_m, radius_m)
        if isinstance(fit, NoFit) or not _has_size(fit):
            continue
        apart_m = [np.linalg.norm(fit.centre_m - earlier_fit.centre_m) for earlier_fit in fits]
        if min(apart_m, default=np.inf) > 1.5 * radius_m:
            fits.append(fit)
        if len(fits) == MOST_SPHERES:
            break
    return sorted(fits, key=lambda fit: float(np.linalg.norm(fit.centre_m)))


def _has_size(fit: SphereFit) -> bool:
    """Return whether a free radius is determined, and agrees with the stated one."""
    sigma = fit.radius_sigma_m / fit.stated_m
    off = abs(fit.radius_m / fit.stated_m - 1)
    return sigma <= LOOSEST and off <= OTHER_SIZE + 3 * sigma


def _candidates(image: RangeImage, radius_m: float) -> Iterator[np.ndarray]:
    """Yield places (3,) of centres, those with most votes first.

    Each pixel votes for the centre that lies a radius behind it along its normal. Votes of a
    sphere meet in one cell; those of a plane spread over many."""
    centres_m, density = _votes(image, radius_m)
    if not len(centres_m):
        return
    cell_m = CELL * radius_m
    most_votes = []
    places_m = []
    for shift in np.ndindex(2, 2, 2):
        cells = np.floor(centres_m / cell_m + np.array(shift) / 2).astype(np.int64)
        # one number for each cell: sorting rows of three takes ten times as long
        number = cells @ np.array([1, 1 << 20, 1 << 40])
        _, cell, counts = np.unique(number, return_inverse=True, return_counts=True)
        votes = np.bincount(cell, density)
        sums_m = np.stack([np.bincount(cell, axis_m) for axis_m in centres_m.T], axis=1)
        is_dense = (votes >= LEAST_VOTES) & (counts >= FEWEST_PX / 4)
        # in deviations of the votes of a plane: far away, a cell has few votes, which scatter
        pixels = counts / votes
        most_votes.append(((votes - OF_PLANE) * np.sqrt(pixels))[is_dense])
        places_m.append((sums_m / counts[:, None])[is_dense])
    order = np.argsort(-np.concatenate(most_votes))
    ordered_m = np.concatenate(places_m)[order]
    for _ in range(MOST_CANDIDATES):
        if not len(ordered_m):
            return
        yield ordered_m[0]
        apart_m = np.linalg.norm(ordered_m - ordered_m[0], axis=1)
        ordered_m = ordered_m[apart_m > cell_m]


def _votes(image: RangeImage, radius_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a centre (n, 3) for each pixel with a normal, and one over the pixels (n,) that a
    sphere at its distance has."""
    pitch = image.pitch_rad
    z_m = image.range_m * image.rays[..., 2]
    valid = np.isfinite(z_m) & (z_m > 0)
    slopes = image.rays[..., :2] / image.rays[..., 2:]
    inverse = np.where(valid, 1 / np.where(valid, z_m, 1.0), 0.0)
    u = np.where(valid, np.nan_to_num(slopes[..., 0]), 0.0)
    v = np.where(valid, np.nan_to_num(slopes[..., 1]), 0.0)
    ones = valid.astype(float)
    # a plane a z + b x + c y = 1 is linear in slopes: 1/z = a + b u + c v
    channels = (ones, u, v, u * u, u * v, v * v, inverse, inverse * u, inverse * v)
    wanted_px = WINDOW * radius_m / pitch / np.where(valid, image.range_m, np.inf)
    nearest = np.abs(np.log(np.maximum(wanted_px, 0.5))[..., None] - np.log(WINDOWS_PX))
    chosen = nearest.argmin(axis=-1)
    centres_m = []
    densities = []
    for number, reach_px in enumerate(WINDOWS_PX):
        mask = valid & (chosen == number)
        if not mask.any():
            continue
        size = (2 * reach_px + 1, 2 * reach_px + 1)
        sums = [
            cv2.boxFilter(channel, cv2.CV_64F, size, normalize=False)[mask] for channel in channels
        ]
        n, su, sv, suu, suv, svv, si, siu, siv = sums
        normal_matrix = np.stack([n, su, sv, su, suu, suv, sv, suv, svv], axis=-1)
        normal_matrix = normal_matrix.reshape(-1, 3, 3)
        scale = n * 1e-9 * pitch**4
        normal_matrix[:, [0, 1, 2], [0, 1, 2]] += scale[:, None]
        enough = (n >= 5) & (np.linalg.det(normal_matrix) > 0)
        right = np.stack([si, siu, siv], axis=-1)[enough]
        plane = np.linalg.solve(normal_matrix[enough], right[..., None])[..., 0]
        length = np.linalg.norm(plane, axis=-1)
        # (b, c, a) points away from the camera
        inwards = plane[:, [1, 2, 0]] / length[:, None]
        rays = image.rays[mask][enough]
        range_m = image.range_m[mask][enough]
        centres_m.append(rays * range_m[:, None] + radius_m * inwards)
        densities.append((pitch * range_m / radius_m) ** 2 / np.pi)
    if not centres_m:
        return np.zeros((0, 3)), np.zeros(0)
    places_m = np.concatenate(centres_m)
    finite = np.isfinite(places_m).all(axis=1)
    return places_m[finite], np.concatenate(densities)[finite]
