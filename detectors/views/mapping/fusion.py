"""Fusion in the target's frame: registered views to one 2.5-D map over the fitted surface, with
its variance.

Each pixel's depth counts as a height over the surface at the place where its *ray meets the
surface*. On an intact surface that is the point itself; at a hole it is the mouth, which therefore
has the same place in all views. In a slanted view, points at the bottom of a wide hole or in front
of the surface are displaced.

View i measures a cell's height as h + e_i + f(p_i) + g_i. e_i: noise that the sensor's law and the
registration's covariance explain. f: the camera's fixed pattern, a function of the *pixel* p_i
that sees the cell. g_i: an error that is fixed for a view and cell. Half the mean square
difference of two views is noise + var g + var f (1 - exp(-(|p_i - p_j| / length)^exponent)), a
variogram with nugget and sill (Matheron 1963; Cressie 1993). It is fitted to medians, because
views see different parts of damage. Views that look through the same pixels share f.

Not modelled: errors that all views share in all pixels, or registrations to one reference; a
pattern that varies over the sensor; changes of the blur. If views are no farther apart than the
pattern's length, its sill is extrapolated."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from scipy.optimize import nnls
from scipy.special import gammaincinv

from detectors.averages.average import pixel_medians
from detectors.pixels.noise import rounding_left_m2
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from detectors.views.mapping import placing
from harness.vocabulary.geometry import Cloud, MapViews, Reason, Region, invert, transform_points

CELLS = 2000
# distance classes on the sensor, with equal numbers of pairs; fewest pairs for a median
CLASSES = 12
PER_CLASS = 100
# number of trial lengths, geometric from a pixel to the largest distance between views
LENGTHS = 24
EXPONENTS = (1.0, 1.5, 2.0)
"""A pattern that a filter smooths over a few pixels has a covariance that is flat at first (2),
not pointed (1)."""
MEDIAN_SQUARE = 0.45494  # median of the square of a standard normal deviate
MEDIAN_ERROR = 2.33  # relative standard error of the median of n such squares, times the root of n
# an observation this many deviations from the median of at least three views is an outlier
GATE_SIGMAS = 5.0


@dataclass(frozen=True)
class BetweenViews:
    """Differences between views. The fixed pattern has the covariance ``pattern_m2``
    exp(-(distance / ``length_px``)^``exponent``) between pixels."""

    own_m2: float = 0.0
    """Variance of the error of a view and cell."""
    pattern_m2: float = 0.0
    """Variance of the fixed pattern."""
    length_px: float = 1.0
    """Distance on the sensor over which the pattern's covariance falls to 1 / e."""
    exponent: float = 1.0
    """Shape of that fall: 1 pointed, 2 flat at first."""
    noise_share: float = 1.0
    """Share of the sensor law's variance that is noise; below 1 only if the law is from a single
    frame."""


def between_views(
    heights: np.ndarray,
    sensor: np.ndarray,
    explained: np.ndarray,
    looks_px: np.ndarray,
    repeated: bool,
) -> BetweenViews:
    """Estimate `BetweenViews` from heights (k, h, w), NaN where a view has none; the variances
    that the ``sensor`` and ``explained`` (lens, registration) explain; and the direction
    ``looks_px`` (k, h, w, 2), in pixels, in which each view sees each cell. ``repeated``: the
    sensor's variances come from repeated frames. All zero with too little overlap."""
    several = np.flatnonzero(np.isfinite(heights).sum(axis=0).ravel() >= 2)
    chosen = several[:: max(1, len(several) // CELLS)]
    flat = heights.reshape(len(heights), -1)[:, chosen]
    sensor = sensor.reshape(len(heights), -1)[:, chosen]
    explained = explained.reshape(len(heights), -1)[:, chosen]
    looks = looks_px.reshape(len(heights), -1, 2)[:, chosen]
    i, j = np.triu_indices(len(heights), 1)
    differences = flat[i] - flat[j]
    overlapping = np.isfinite(differences)
    if overlapping.sum() < PER_CLASS:
        return BetweenViews()
    distances_px = np.linalg.norm(looks[i] - looks[j], axis=-1)[overlapping]
    classes = min(CLASSES, max(1, len(distances_px) // PER_CLASS))
    parts = np.array_split(np.argsort(distances_px, kind="stable"), classes)

    def medians(values: np.ndarray) -> np.ndarray:
        return np.array([np.median(values[part]) for part in parts])

    distance = medians(distances_px)
    square = medians(differences[overlapping] ** 2)
    of_sensor = medians(0.5 * (sensor[i] + sensor[j])[overlapping])
    of_other = medians(0.5 * (explained[i] + explained[j])[overlapping])
    half_square = np.maximum(0.5 * square / MEDIAN_SQUARE, 1e-16)
    # k - 1 of the k (k - 1) / 2 differences of k views are independent
    independent = 2.0 / len(heights) * len(distances_px) / len(parts)
    error = half_square * MEDIAN_ERROR / np.sqrt(independent)
    if repeated:
        target = (half_square - of_other - of_sensor) / error
        first = np.ones_like(distance) / error
    else:
        target = (half_square - of_other) / error
        first = of_sensor / error
    level, sill, length, exponent = _law(first, 1.0 / error, distance, target, repeated)
    if repeated:
        return BetweenViews(level, sill, length, exponent)
    return BetweenViews(
        pattern_m2=sill,
        length_px=length,
        exponent=exponent,
        noise_share=min(max(level, 0.01), 1.0),
    )


def _law(
    first: np.ndarray,
    unit: np.ndarray,
    distance: np.ndarray,
    target: np.ndarray,
    may_vanish: bool,
) -> tuple[float, float, float, float]:
    """Return (factor of ``first``, sill, length, exponent), all (c,) in standard errors, of the
    law with the least chi square plus Schwarz's penalty: none (if it ``may_vanish``), ``first``
    alone, or both terms."""
    penalty = float(np.log(max(len(distance), 2)))
    (level,), misfit = nnls(first[:, None], target)
    best = (float(misfit) ** 2 + penalty, float(level), 0.0, 1.0, 1.0)
    if may_vanish and target @ target <= best[0]:
        best = (float(target @ target), 0.0, 0.0, 1.0, 1.0)
    lengths = np.geomspace(1.0, max(1.0, float(distance.max())), LENGTHS)
    for exponent, length in product(EXPONENTS, lengths):
        rise = 1.0 - np.exp(-((distance / length) ** exponent))
        (level, sill), misfit = nnls(np.column_stack([first, rise * unit]), target)
        criterion = float(misfit) ** 2 + 4.0 * penalty
        if criterion < best[0]:
            best = (criterion, float(level), float(sill), float(length), exponent)
    return best[1:]


@dataclass(frozen=True)
class SurfaceMap:
    """Values of each cell of a map (h, w) of k views."""

    cell_m: float
    """Side of a cell."""
    height_m: np.ndarray
    """(h, w): mean deviation from the fitted surface along z, positive behind; NaN where no view
    counts."""
    variance_m2: np.ndarray
    """(h, w): of an intact surface's height, from sensor, lens, registration and further
    differences between views."""
    temporal_m2: np.ndarray
    """(h, w): the part of the variance that more frames would lower."""
    seen_by: np.ndarray
    """(k, h, w) bool: views that count."""
    shares: np.ndarray
    """(k, h, w): their weights, with sum 1."""
    rejected: int
    """Number of outliers."""
    between: BetweenViews
    """Differences between the views."""


def combine(
    heights: np.ndarray,
    sensor: np.ndarray,
    explained: np.ndarray,
    looks_px: np.ndarray,
    repeated: bool,
    cell_m: float,
) -> SurfaceMap:
    """Combine the views' heights (k, h, w); arguments as in `between_views`. The weight of a view
    is the inverse of its own variance. (The best weights under the covariance can be negative,
    which fails at a hole seen by only some views.) The variance of the mean includes the
    covariance of views."""
    between = between_views(heights, sensor, explained, looks_px, repeated)
    temporal = between.noise_share * sensor
    own_m2 = temporal + explained + between.own_m2
    rejected = _outliers(heights, own_m2 + between.pattern_m2)
    used = np.isfinite(heights) & ~rejected
    covered = used.any(axis=0)
    weights = np.where(used, 1.0 / (own_m2 + between.pattern_m2), 0.0)
    with np.errstate(invalid="ignore"):
        shares = np.nan_to_num(weights / weights.sum(axis=0))
    squares = shares**2
    shared = between.pattern_m2 * squares.sum(axis=0)
    if between.pattern_m2 > 0:
        for i, j in combinations(range(len(heights)), 2):
            separation = np.linalg.norm(looks_px[i] - looks_px[j], axis=-1) / between.length_px
            correlation = np.exp(-(separation**between.exponent))
            shared += 2.0 * between.pattern_m2 * shares[i] * shares[j] * correlation
    height = np.where(covered, np.where(used, shares * heights, 0.0).sum(axis=0), np.nan)
    alone = np.where(covered, np.where(used, squares * own_m2, 0.0).sum(axis=0), np.nan)
    by_frames = np.where(covered, np.where(used, squares * temporal, 0.0).sum(axis=0), np.nan)
    return SurfaceMap(
        cell_m=cell_m,
        height_m=height,
        variance_m2=alone + shared,
        temporal_m2=by_frames,
        seen_by=used,
        shares=shares,
        rejected=int(rejected.sum()),
        between=between,
    )


def _outliers(heights: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return (k, h, w) bool: observations more than `GATE_SIGMAS` deviations (their own, or the
    robust spread of the views if larger) from the median of at least three views that cannot be
    damage: in front of the fitted surface, where damage would have hidden it from the others; or
    behind it, but alone among their neighbours."""
    deviation = heights - pixel_medians(heights)
    spread = 1.4826 * pixel_medians(np.abs(deviation))
    limit = GATE_SIGMAS * np.maximum(spread, np.sqrt(variances))
    several = np.isfinite(heights).sum(axis=0) >= 3
    rejected: np.ndarray = several & (deviation < -limit) & (heights < -limit)
    k, row, column = np.nonzero(several & (deviation > limit))
    padded = np.pad(heights, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
    neighbours = []
    for down in range(3):
        for right in range(3):
            neighbours.append(padded[k, row + down, column + right])
    excess = neighbours[4] - pixel_medians(np.stack(neighbours))
    rejected[k, row, column] = excess > limit[k, row, column]
    return rejected


# standard deviation of a pixel's direction: the reprojection error of a well calibrated lens
LATERAL_PX = 0.1
SMOOTH_POINTS = 8192
BINS = 16
PER_BIN = 40
# number of pixels for the law: the median of a class is then known to 7 % from three frames
SAMPLED = 16_384
# least variance, so that no weight is infinite: no point is known better than to 0.1 um
LEAST_M2 = 1e-14


@dataclass(frozen=True)
class _Observation:
    """The observation of one view of the cells (h, w) of a map."""

    height_m: np.ndarray
    """(h, w): deviation from the fitted surface along z; NaN where the view has none."""
    sensor_m2: np.ndarray
    """(h, w): variance of the height by the sensor's noise."""
    explained_m2: np.ndarray
    """(h, w): variance of the height by lens and registration."""
    look_px: np.ndarray
    """(h, w, 2): direction in which the view sees the cell, in pixels of the first view."""
    extras: np.ndarray
    """(h, w, 5): samples, red, green, blue, amplitude; NaN where unknown."""
    repeated: bool
    """Whether the sensor's variance comes from repeated frames."""


def _observation(
    view: placing.PlacedView,
    grid: placing.CellGrid,
    points: np.ndarray,
    gradient: np.ndarray,
    T_reference_map: np.ndarray,
    slope_step: float,
) -> _Observation:
    """Return what a view says about the cells at ``points`` (h, w, 3) of the surface, whose height
    changes by ``gradient`` (h, w, 3) times a small displacement. ``slope_step``: a pixel of the
    first view."""
    cloud = view.chosen.cloud
    inside = view.chosen.inside
    raster = placing.raster_between(view.places_m, inside, cloud.organised, view.pitch_m, grid)
    variance, repeated = depth_noise(cloud, inside, _roughness(view))
    slope2 = (cloud.points_m**2).sum(axis=-1) / cloud.points_m[..., 2] ** 2
    unknown = np.full(inside.shape, np.nan)
    colour = [unknown] * 3
    if cloud.rgb is not None:
        colour = list(np.moveaxis(cloud.rgb, -1, 0))
    amplitude = unknown
    if cloud.amplitude is not None:
        amplitude = cloud.amplitude
    images = (view.deviation_m, variance * slope2, cloud.count, *colour, amplitude)
    values = raster.at_cells(np.stack([image.ravel() for image in images], axis=-1))
    rays = points - view.T_map_view[:3, 3]
    per_range = (rays * gradient).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    across = np.maximum((gradient**2).sum(axis=-1) - per_range**2, 0.0)
    correlation = _neighbour_correlation(view)
    kept = correlation + (1.0 - correlation) * raster.concentration
    in_view = rays @ view.T_map_view[:3, :3]
    by_sensor = values[..., 1] * kept * per_range**2
    by_registration = _registration_variance(view.chosen, points, gradient, T_reference_map)
    by_others = (LATERAL_PX * view.pitch_m) ** 2 * across + by_registration
    look_px = in_view[..., :2] / in_view[..., 2:] / slope_step
    return _Observation(
        height_m=values[..., 0],
        sensor_m2=by_sensor,
        explained_m2=by_others,
        look_px=look_px,
        extras=values[..., 2:],
        repeated=repeated,
    )


def fuse(
    views: Sequence[placing.ChosenView], cell_m: float | None
) -> tuple[Cloud, np.ndarray, SurfaceMap, tuple[str, ...]]:
    """Return the map as an organised cloud, its frame in the first view's (4, 4), further results,
    and notes. The cloud's ``variance_m2`` over ``count`` is the temporal part of the variance,
    ``mean_variance_m2`` the whole with rounding (None for a single view, which cannot know it).
    Raises UserError if the points do not determine a surface or the map would have too many cells.
    """
    T_reference_map = placing.T_reference_map_of(views[0])
    surface = placing.common_surface(views, T_reference_map)
    placed = [placing.place(view, T_reference_map, surface) for view in views]
    grid = placing.grid_over(placed, cell_m)
    x, y = grid.places()
    z = surface.evaluate(x, y)
    # gradient times a small displacement is the change of height along z
    gradient = surface.gradients(x, y, grid.step)
    points = np.stack([x, y, z], axis=-1)

    observations = []
    for view in placed:
        observations.append(
            _observation(view, grid, points, gradient, T_reference_map, views[0].slope_step)
        )
    extras = np.stack([observation.extras for observation in observations])
    fused = combine(
        heights=np.stack([observation.height_m for observation in observations]),
        sensor=np.stack([observation.sensor_m2 for observation in observations]),
        explained=np.stack([observation.explained_m2 for observation in observations]),
        looks_px=np.stack([observation.look_px for observation in observations]),
        repeated=all(observation.repeated for observation in observations),
        cell_m=grid.step,
    )

    clouds = [view.cloud for view in views]
    samples_seen = np.where(fused.seen_by, extras[..., 0], 0.0).sum(axis=0)
    samples = np.round(samples_seen).astype(np.int32)
    means = (fused.shares[..., None] * np.nan_to_num(extras)).sum(axis=0)
    covered = np.isfinite(fused.height_m)
    shares = fused.shares.sum(axis=(1, 2)) / fused.shares.sum()
    pixel_m = np.sqrt(shares @ np.stack([view.pixel_m for view in placed]) ** 2)
    points[..., 2] += fused.height_m
    points[~covered] = np.nan
    mean_rgb = None
    if all(cloud.rgb is not None for cloud in clouds):
        mean_rgb = np.round(means[..., 1:4]).astype(np.uint8)
    mean_amplitude = None
    if all(cloud.amplitude is not None for cloud in clouds):
        mean_amplitude = np.where(covered, means[..., 4], np.nan)
    merged = Cloud(
        points_m=points,
        reason=np.where(covered, Reason.VALID, Reason.NO_RETURN).astype(np.uint8),
        count=samples,
        variance_m2=fused.temporal_m2 * samples,
        region=Region(0, grid.shape[0], 0, grid.shape[1]),
        z_step_m=0.0,
        n_frames=sum(cloud.n_frames for cloud in clouds),
        rgb=mean_rgb,
        amplitude=mean_amplitude,
        left_out=tuple(reason for cloud in clouds for reason in cloud.left_out),
        projection="parallel",
        mean_variance_m2=fused.variance_m2 if len(views) > 1 else None,
        map_views=MapViews(
            np.stack([view.T_map_view for view in placed]),
            shares,
            (pixel_m[0], pixel_m[1]),
        ),
    )
    return merged, T_reference_map, fused, _notes(views, fused)


def _roughness(view: placing.PlacedView) -> np.ndarray:
    """Return z minus the view's own smooth surface (h, w); computed only if frames do not
    repeat."""
    inside = view.chosen.inside
    rough = np.full(inside.shape, np.nan)
    if (view.chosen.cloud.count[inside] > 1).any():
        return rough
    x, y = view.places_m[inside].T
    z = view.deviation_m[inside]
    stride = slice(None, None, max(1, len(z) // SMOOTH_POINTS))
    smooth = fit_surface(x[stride], y[stride], z[stride], SurfaceConfig())
    rough[inside] = z - smooth.evaluate(x, y)
    return rough


def _neighbour_correlation(view: placing.PlacedView) -> float:
    """Return the correlation of neighbouring pixels' deviations, 0..1, from medians; 1 without a
    pixel grid."""
    if not view.chosen.cloud.organised:
        return 1.0
    deviation = view.deviation_m
    single = _median(np.abs(deviation - _median(deviation)))
    steps = [np.abs(np.diff(deviation, axis=axis)).ravel() for axis in (0, 1)]
    step = _median(np.concatenate(steps))
    if not (single > 0 and np.isfinite(step)):
        return 1.0
    return float(np.clip(1.0 - 0.5 * (step / single) ** 2, 0.0, 1.0))


def _median(values: np.ndarray) -> float:
    """Return the median of an even sample of the finite values; NaN if there are none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return np.nan
    stride = max(1, len(finite) // SMOOTH_POINTS)
    return float(np.median(finite[::stride]))


def _registration_variance(
    view: placing.ChosenView,
    points_m: np.ndarray,
    along: np.ndarray,
    T_reference_map: np.ndarray,
) -> np.ndarray:
    """Return the variance (h, w) that the registration gives to displacements w x (p - centre) + t
    of points (h, w, 3) along vectors (h, w, 3): that of w . ((p - centre) x along) + t . along; 0
    without a covariance."""
    if not view.known_covariance:
        return np.zeros(points_m.shape[:2])
    turn = np.kron(np.eye(2), T_reference_map[:3, :3])
    centre = transform_points(invert(T_reference_map), view.registration.centre_m)
    lever = np.concatenate([np.cross(points_m - centre, along), along], axis=-1)
    covariance = turn.T @ view.registration.covariance @ turn
    spread = ((lever @ covariance) * lever).sum(axis=-1)
    return np.asarray(np.maximum(spread, 0.0))


def _notes(views: Sequence[placing.ChosenView], surface_map: SurfaceMap) -> tuple[str, ...]:
    between = surface_map.between
    notes = [
        "one view: its variance excludes errors that are constant in a view (pattern, wiggling)"
    ]
    if len(views) > 1:
        notes = [
            f"fixed pattern {1e3 * np.sqrt(between.pattern_m2):.3f} mm over "
            f"{between.length_px:.1f} px of the sensor,"
            f" other differences between views {1e3 * np.sqrt(between.own_m2):.3f} mm"
        ]
    without = [view.name for view in views if not view.known_covariance]
    if without:
        notes.append(
            f"views without a covariance count among those differences: {', '.join(without)}"
        )
    if surface_map.rejected:
        kept = int(surface_map.seen_by.sum())
        notes.append(
            f"{surface_map.rejected} of {kept + surface_map.rejected} observations were outliers"
        )
    return tuple(notes)


def depth_noise(
    cloud: Cloud,
    inside: np.ndarray,
    deviation_m: np.ndarray,
) -> tuple[np.ndarray, bool]:
    """Return the variance (h, w) of the average's z, NaN where the cloud has no point, and True if
    it comes from the sample variances of repeated frames inside the target. The law is v = k q + c
    with q = 1 / amplitude^2 (phase noise: Lange and Seitz 2001), or the range to the fourth if a
    tenth of the points has no amplitude; a pixel's own sample variance would favour pixels that
    are quiet by chance. ``deviation_m`` (h, w): z minus the view's own smooth surface, whose
    squares replace the variances for a single frame. Not modelled: shared noise, multipath,
    pattern."""
    q = (cloud.points_m**2).sum(axis=-1) ** 2
    valid = cloud.valid
    if cloud.amplitude is not None:
        with_amplitude = valid & (np.nan_to_num(cloud.amplitude) > 0)
        if with_amplitude.sum() >= 0.9 * valid.sum():
            q = 1.0 / np.where(with_amplitude, cloud.amplitude, np.nan) ** 2
            q[valid & ~with_amplitude] = np.median(q[with_amplitude])
    used = inside & (cloud.count > 1) & np.isfinite(cloud.variance_m2)
    repeated = bool(used.sum() >= PER_BIN)
    if repeated:
        samples = cloud.variance_m2[used]
        freedom = cloud.count[used] - 1.0
    else:
        used = inside & np.isfinite(deviation_m)
        # one sample has the variance of a single frame: it is divided by their number below
        samples = deviation_m[used] ** 2 * cloud.count[used]
        freedom = np.ones(int(used.sum()))
    slope = 0.0
    constant = LEAST_M2
    typical = 1.0
    if used.any():
        thinned = slice(None, None, max(1, len(samples) // SAMPLED))
        numbers, where = np.unique(freedom[thinned], return_inverse=True)
        # the median of a variance from so many degrees of freedom, over its mean
        medians = 2.0 * gammaincinv(numbers / 2.0, 0.5) / numbers
        samples = samples[thinned] / medians[where]
        x = q[used][thinned]
        # medians of classes of q make the fit robust against damage in the view
        classes = max(1, min(BINS, len(x) // PER_BIN))
        parts = np.array_split(np.argsort(x, kind="stable"), classes)
        typical = float(np.median(x))
        middle = np.array([np.median(x[part]) for part in parts]) / typical
        height = np.maximum([np.median(samples[part]) for part in parts], LEAST_M2)
        # the relative error of each median is the same
        ones = np.ones(len(parts))
        design = np.column_stack([middle, ones]) / height[:, None]
        slope, constant = nnls(design, ones)[0]
    frame = slope * q / typical + constant
    rounding_m2 = 0.0
    if cloud.z_step_m > 0 and repeated:
        # any average keeps an error of rounding that no scatter shows; if frames repeat exactly,
        # it is the whole error
        dither_m2 = max(float(slope + constant) - cloud.z_step_m**2 / 12.0, 0.0)
        rounding_m2 = rounding_left_m2(cloud.z_step_m, dither_m2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.maximum(frame / cloud.count + rounding_m2, LEAST_M2), repeated
