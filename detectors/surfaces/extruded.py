"""Surfaces that are extruded along a direction: profiled sheets, ribs, boards with joints.

Seen along the direction of extrusion, a camera's rays are rays of a plane that leave one point, and
the surface is a curve in that plane: its inverse distance is a function of the ray's slope alone,
whatever the perspective. The function is the median over all rays of a slope, so damage that takes
less than half of the visible length along the direction does not move it.

Not modelled: damage that runs through the whole view along the direction, which is taken for a
joint; a profile that changes along the direction in other ways than by a move of degree 3."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from detectors.pixels.medians import group_medians
from detectors.surfaces.surface import SurfaceFunction, bisquare_weights, polynomial

SEARCHED = 8_000  # points from which a tilt and a twist are found
TWIST_SEARCHED = 6_000  # points from which the frame of a twist is found
TWIST_STEPS = (3e-3, 1e-2, 3e-2)  # first steps of its angles, radians
COARSE_SEARCHED = 60_000  # points from which a direction is searched
FINE_PX = 1.5  # width of the strips in the fine search
MOST_STRIPS = 20_000
"""Extent of a picture in such strips, beyond which its points belong to no surface: a ray that
grazes the plane meets it anywhere."""
COARSE_PX = 4.0  # side of the blocks whose means show a direction
TURNS = 180
"""Number of directions tried: a joint 4 pixels wide and 250 long is blurred by one degree."""
DIRECTED = 1.5
"""Least variance that a profile along the best direction explains, in variances along the median
direction: an isotropic residual has none."""
CLIP_SIGMAS = 5.0  # to which residuals are clipped, so that damage does not choose a direction
LEAST_LENGTH_M = 0.04
"""Least visible length along the direction from which a place of the profile is known."""
LEAST_POINTS = 12
STEEP = 3.7  # tan(75 degrees): a steeper place is a step, beside which pixels mix both of its sides
RIM_PX = 3  # knots on either side of a step that mix both of its sides, as at a target's rim
STEP_KNOTS = 2
"""Knots over which pixels beside a step may lie on its other side: their footprint is one knot, and
the step's own place is known to one."""
CURVED_KNOTS = 6  # over which a smooth curve bends like a parabola
ROUNDED = 2.0
"""Deviations of rounding beyond which no rounding error lies: half a step is 1.73 of them."""
SEEN = 0.5  # least departure from a smooth surface, as a share of a pixel's noise
GAIN_SIGMAS = 4.0
"""Least significance of a profile's gain over a smooth surface."""
SOUGHT_SIGMAS = 1.0
"""Least significance, as first fitted, from which a profile's twist is sought. The search sharpens
a profile that is there and makes none: of 64 grooved, bent, creased, ribbed and corrugated surfaces
none began below 1 and ended above `GAIN_SIGMAS`. Flat boards have less than .5, before it and
after, and it took half of the time of `local`."""
OF_BANDS = 0.75
"""Quantile of the bands at which a place of the profile is uncertain: damage is in fewer, and where
the fit is a little off, a step is off in more."""
BANDS = 10
"""Number of bands along the direction, of which every other one is predicted from the others."""


@dataclass(frozen=True)
class Profile:
    """A surface that is extruded along a direction."""

    along: np.ndarray
    """(3,): unit vector of the direction."""
    across: np.ndarray
    """(3,): unit vector across it, in the surface's mean plane."""
    ahead: np.ndarray
    """(3,): unit vector normal to both, away from the camera; the twist moves along it."""
    first: float
    """Slope (or, with parallel rays, place in metres) of the first knot."""
    step: float
    """Distance of the knots."""
    curve: np.ndarray
    """(k,): inverse distance ahead at each knot, or the distance where rays are parallel; NaN where
    it is unknown."""
    central: bool
    """Whether rays leave the origin, else they run along z."""
    spread_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """(k,): deviation of the surface's z at each knot, metres; empty until `with_spread`."""
    twist: SurfaceFunction | None = None
    """Distance ahead, metres, by which a polynomial moves the surface."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return z (n,) of the surface on the rays of points (n, 3); NaN where it is unknown."""
        curve = self._curve_at(self.slopes(points))
        share = self.ahead_by_z(points)
        if not self.central:
            beside_m = points[:, :2] @ self.ahead[:2]
            return (curve + self._twisted_m(points) - beside_m) / share
        return (1.0 / curve + self._twisted_m(points)) / share

    def ahead_by_z(self, points: np.ndarray) -> np.ndarray:
        """Return how far ahead (n,) each of the points (n, 3) moves per z along its ray."""
        if not self.central:
            return np.full(len(points), self.ahead[2])
        return points @ self.ahead / points[:, 2]

    def slopes(self, points: np.ndarray) -> np.ndarray:
        """Return the place (n,) of points (n, 3) across the direction, as the knots count it."""
        across_m = points @ self.across
        if not self.central:
            return across_m
        return across_m / (points @ self.ahead - self._twisted_m(points))

    def lengths(self, points: np.ndarray) -> np.ndarray:
        """Return each point's place (n,) along the direction, as `slopes` across it."""
        if self.central:
            return (points @ self.along) / (points @ self.ahead)
        return points @ self.along

    def knots(self, slopes: np.ndarray) -> np.ndarray:
        """Return the number (n,) of the knot nearest to each place."""
        return np.rint((slopes - self.first) / self.step).astype(np.int64)

    def knots_of(self, points: np.ndarray) -> np.ndarray:
        """Return the number (n,) of the curve's knot nearest to each of the points (n, 3)."""
        return self.knots(self.slopes(points)).clip(0, len(self.curve) - 1)

    def _curve_at(self, slopes: np.ndarray) -> np.ndarray:
        position = np.clip((slopes - self.first) / self.step, 0.0, len(self.curve) - 1.0)
        left = np.minimum(np.nan_to_num(position).astype(np.int64), len(self.curve) - 2)
        share = position - left
        return self.curve[left] * (1.0 - share) + self.curve[left + 1] * share

    def _curve_of(self, points: np.ndarray) -> np.ndarray:
        """Return the curve's value (n,) that puts the surface through each point."""
        ahead_m = points @ self.ahead - self._twisted_m(points)
        return 1.0 / ahead_m if self.central else ahead_m

    def _twisted_m(self, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points)) if self.twist is None else self.twist(points)

    def fitted(self, points: np.ndarray) -> Profile:
        """Return the profile with the curve of medians of points (n, 3).

        Points so far across that their rays graze the surface count at the ends of the curve."""
        slopes = self.slopes(points)
        middle = float(np.median(slopes))
        reach = 0.5 * MOST_STRIPS * self.step
        slopes = np.clip(slopes, middle - reach, middle + reach)
        low = float(slopes.min())
        count = max(math.ceil((float(slopes.max()) - low) / self.step) + 1, 2)
        result = replace(self, first=low, curve=np.zeros(count))
        knots = result.knots(slopes)
        values = self._curve_of(points)
        curve = group_medians(values, knots, count)[0]
        curve = _filled(curve)
        # on a slope, values beside a knot differ from it by the slope itself
        result = replace(result, curve=curve)
        corrections = group_medians(values - result._curve_at(slopes), knots, count)[0]
        return replace(result, curve=curve + np.nan_to_num(corrections))

    def spread_at(self, points: np.ndarray) -> np.ndarray:
        """Return the deviation (n,) by which the surface may be wrong at points (n, 3), metres."""
        return self.spread_m[self.knots_of(points)]

    def with_spread(self, points: np.ndarray) -> Profile:
        """Return the profile with its own deviation in z beside steps, as points (n, 3) show it.

        A strip beside a step holds pixels of both of its sides, and its median is one of them. Its
        variance, less a usual strip's, is that of the surface. It counts at the quantile `OF_BANDS`
        of the bands along the direction, and up to the square of the step's height nearby."""
        count = len(self.curve)
        knots = self.knots_of(points)
        # residuals are along z
        heights_m2 = (self._step_heights_m()[knots] / self.ahead_by_z(points)) ** 2
        squares_m2 = np.nan_to_num(points[:, 2] - self(points)) ** 2
        noise_m2 = group_medians(squares_m2, knots, count)[0] / 0.6745**2
        usual_m2 = float(np.nanmedian(noise_m2))
        limited_m2 = np.minimum(squares_m2, heights_m2 + usual_m2)
        means_m2 = _means_in_bands(limited_m2, _bands(self.lengths(points)), knots, count)
        with warnings.catch_warnings():
            # no band shows a strip of few points
            warnings.simplefilter("ignore", RuntimeWarning)
            variance_m2 = np.nanquantile(means_m2, OF_BANDS, axis=0)
        own_m2 = np.nan_to_num(variance_m2 - usual_m2)
        spread_m2 = np.where(own_m2 > usual_m2, own_m2, 0.0)
        return replace(self, spread_m=np.sqrt(spread_m2))

    def _step_heights_m(self) -> np.ndarray:
        """Return the largest height (k,) ahead of a step within `STEP_KNOTS` of each knot: the bend
        of the curve over these beyond what a curvature over `CURVED_KNOTS` explains."""
        ahead_m = _filled(1.0 / self.curve if self.central else self.curve)
        bends_m = _bends(ahead_m, STEP_KNOTS)
        # the bend of a parabola grows with the square of the distance
        curvature_share = (STEP_KNOTS / CURVED_KNOTS) ** 2
        curved_m = curvature_share * _bends(ahead_m, CURVED_KNOTS)
        return np.asarray(maximum_filter1d(np.abs(bends_m - curved_m), 2 * STEP_KNOTS + 1))

    def trusted(self, points: np.ndarray) -> Profile:
        """Return the profile, unknown where points (n, 3) show less than `LEAST_LENGTH_M` of it,
        and beside steps."""
        count = len(self.curve)
        number = np.bincount(self.knots_of(points), minlength=count)
        # the visible length: the number of points, each a knot's distance long
        # at each knot; a parallel projection has no distance, and steps are metres
        distance_m = np.abs(1.0 / self.curve) if self.central else np.ones(count)
        visible_m = number * self.step * distance_m
        unknown = (visible_m < LEAST_LENGTH_M) | (number < LEAST_POINTS)
        steps = np.abs(np.diff(1.0 / self.curve if self.central else self.curve))
        width_m = self.step * distance_m[1:]
        is_step = steps > STEEP * width_m
        for shift in range(1 - RIM_PX, RIM_PX + 1):
            index = np.flatnonzero(is_step) + shift
            unknown[index[(index >= 0) & (index < count)]] = True
        return replace(self, curve=np.where(unknown, np.nan, self.curve))


def _filled(curve: np.ndarray) -> np.ndarray:
    """Return a curve (k,) with unknown knots interpolated."""
    is_finite = np.isfinite(curve)
    knots = np.arange(len(curve))
    return np.interp(knots, knots[is_finite], curve[is_finite])


def _bends(curve: np.ndarray, knots: int) -> np.ndarray:
    """Return the sum of the curve's (k,) differences to both neighbours so many ``knots`` away; the
    curve goes on straight beyond its ends."""
    extended = np.pad(curve, knots, mode="reflect", reflect_type="odd")
    return np.asarray(extended[2 * knots :] + extended[: -2 * knots] - 2.0 * curve)


def picked(points: np.ndarray, most: int) -> np.ndarray:
    """Return at most this many of the points (n, 3): at random, because an even step would meet the
    same columns of the picture in every row."""
    if len(points) <= most:
        return points
    return points[np.random.default_rng(0).integers(len(points), size=most)]


def direction_of(
    points: np.ndarray, base: SurfaceFunction, pitch: float, central: bool
) -> Profile | None:
    """Return the profile, not yet fitted, along whose direction points (n, 3) depart least from a
    smooth surface ``base``; None if no direction stands out, or if the points lie in one place or
    in a plane through the camera.

    ``pitch``: distance of neighbouring pixels in x/z, or in metres where rays are parallel."""
    if not pitch > 0.0:
        return None
    sample = picked(points, COARSE_SEARCHED)
    on_base = sample.copy()
    on_base[:, 2] = base(sample)
    if central:
        on_base[:, :2] *= (on_base[:, 2] / sample[:, 2])[:, None]
    # on the surface: what shows far behind through a hole would turn the mean plane
    normal = _normal(on_base, central)
    with np.errstate(divide="ignore", invalid="ignore"):
        frame = _frame(normal, 0.0, pitch, central)
        across = frame.slopes(sample)
        along = frame.lengths(sample)
    if not np.isfinite([across, along]).all():
        return None
    if max(np.ptp(across), np.ptp(along)) > MOST_STRIPS * FINE_PX * pitch:
        return None
    values = frame._curve_of(sample) - frame._curve_of(on_base)
    turns = math.pi / TURNS * np.arange(TURNS)
    blocks = _block_means(across, along, values, COARSE_PX * pitch)
    explained = _explained(blocks, turns, COARSE_PX * pitch)
    if explained.max() < DIRECTED * float(np.median(explained)):
        return None
    turn = float(turns[explained.argmax()])
    for reach in (math.pi / TURNS, math.pi / TURNS / 10):
        turns = turn + reach * np.linspace(-1.2, 1.2, 25)
        explained = _explained((across, along, values), turns, FINE_PX * pitch)
        turn = float(turns[explained.argmax()])
    return _refined(points, normal, turn, pitch, central)


def _explained(
    places: tuple[np.ndarray, np.ndarray, np.ndarray], turns: np.ndarray, width: float
) -> np.ndarray:
    """Return, for each turn, the sum of squares of clipped values that their means in strips of a
    ``width`` explain. ``places``: places across and along, and values (n,)."""
    across, along, values = places
    scale = max(float(np.median(np.abs(values))) / 0.6745, 1e-12)
    clipped = np.clip(values, -CLIP_SIGMAS * scale, CLIP_SIGMAS * scale)
    clipped = clipped - clipped.mean()
    explained = np.zeros(len(turns))
    for number, turn in enumerate(turns):
        position = across * math.cos(turn) + along * math.sin(turn)
        strips = ((position - position.min()) / width).astype(np.int64)
        counts = np.bincount(strips)
        sums = np.bincount(strips, clipped)
        explained[number] = float((sums**2 / np.maximum(counts, 1)).sum())
    return explained


def _normal(points: np.ndarray, central: bool) -> np.ndarray:
    """Return the unit normal (3,), away from the camera, of the mean plane of points (n, 3)."""
    sample = picked(points, SEARCHED)
    centred = sample - sample.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    normal = axes[:, 0]
    towards = sample.mean(axis=0) if central else np.array([0.0, 0.0, 1.0])
    return normal if normal @ towards > 0 else -normal


def _frame(normal: np.ndarray, turn: float, step: float, central: bool) -> Profile:
    """Return a profile without a curve whose direction is turned by ``turn`` about the normal."""
    right = np.array([1.0, 0.0, 0.0])
    right = right - (right @ normal) * normal
    right = right / np.linalg.norm(right)
    down = np.cross(normal, right)
    across = math.cos(turn) * right + math.sin(turn) * down
    return _directed(np.cross(normal, across), normal, step, central)


def _directed(along: np.ndarray, normal: np.ndarray, step: float, central: bool) -> Profile:
    """Return a profile without a curve along a direction (3,)."""
    along = along / np.linalg.norm(along)
    facing = normal if central else np.array([0.0, 0.0, 1.0])
    ahead = facing - (facing @ along) * along
    ahead = ahead / np.linalg.norm(ahead)
    return Profile(
        along=along,
        across=np.cross(along, ahead),
        ahead=ahead,
        first=0.0,
        step=step,
        curve=np.zeros(2),
        central=central,
    )


def _block_means(
    across: np.ndarray, along: np.ndarray, values: np.ndarray, side: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return places across and along (b,) and the mean of the values (n,) of square blocks."""
    columns = np.floor((across - across.min()) / side).astype(np.int64)
    rows = np.floor((along - along.min()) / side).astype(np.int64)
    width = int(columns.max()) + 1
    block = rows * width + columns
    counts = np.bincount(block)
    sums = np.bincount(block, values)
    # blocks at the rim hold few points
    typical_count = float(np.median(counts[counts > 0]))
    used = counts >= max(1.0, 0.3 * typical_count)
    row, column = np.divmod(np.flatnonzero(used), width)
    block_across = (column + 0.5) * side
    block_along = (row + 0.5) * side
    return block_across, block_along, sums[used] / counts[used]


def _refined(
    points: np.ndarray, normal: np.ndarray, turn: float, pitch: float, central: bool
) -> Profile:
    """Return the profile whose turn and tilt leave the least residuals, searched from ``turn``."""
    from scipy.optimize import minimize

    sample = picked(points, SEARCHED)

    def of(change: np.ndarray) -> Profile:
        frame = _frame(normal, turn + float(change[0]), pitch, central)
        return _directed(frame.along + float(change[1]) * normal, normal, pitch, central)

    start = of(np.zeros(2)).fitted(sample)
    size = np.abs(sample[:, 2] - start(sample))
    limit = max(3.0 * float(np.median(size)), 1e-6)

    def remaining(change: np.ndarray) -> float:
        residuals = np.abs(sample[:, 2] - of(change).fitted(sample)(sample))
        return float(np.minimum(residuals, limit).mean())

    simplex = np.array([[0.0, 0.0], [5e-4, 0.0], [0.0, 5e-3]])
    options = {"initial_simplex": simplex, "xatol": 5e-5, "fatol": 1e-3 * limit, "maxfev": 30}
    optimum = minimize(remaining, np.zeros(2), method="Nelder-Mead", options=options)
    return of(optimum.x)


def with_twist(profile: Profile, points: np.ndarray) -> Profile:
    """Return the profile fitted to points (n, 3), moved ahead by the polynomial of degree 3 that
    their residuals follow, with the frame in which they are least.

    A sheet that is bent along its crease moves along its own normal. If ``ahead`` is another
    direction, the crease leaves its place across by the bend times the angle between both."""
    from scipy.optimize import minimize

    sample = picked(points, TWIST_SEARCHED)
    size = np.abs(sample[:, 2] - _twisted(profile, sample, rounds=3)(sample))
    limit = max(CLIP_SIGMAS * float(np.median(size)), 1e-6)

    def remaining(angles: np.ndarray) -> float:
        twisted = _twisted(_turned(profile, angles), sample, rounds=2)
        residuals = np.abs(sample[:, 2] - twisted(sample))
        return float(np.minimum(residuals, limit).mean())

    simplex = np.zeros((4, 3))
    simplex[1:] = np.diag(TWIST_STEPS)
    options = {"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-3 * limit, "maxfev": 100}
    optimum = minimize(remaining, np.zeros(3), method="Nelder-Mead", options=options)
    turned = _turned(profile, optimum.x)
    return _twisted(turned, picked(points, SEARCHED), rounds=3).fitted(points)


def _twisted(profile: Profile, points: np.ndarray, rounds: int) -> Profile:
    """Return the profile with the twist that points (n, 3) follow, found in this many rounds."""
    fitted = profile.fitted(points)
    for _ in range(rounds):
        residuals = points[:, 2] - fitted(points)
        scale = max(float(np.median(np.abs(residuals))) / 0.6745, 1e-9)
        weights = bisquare_weights(residuals, 6.0 * scale)
        moved = points.copy()
        moved[:, 2] = fitted._twisted_m(points) + residuals * fitted.ahead_by_z(points)
        fitted = replace(profile, twist=polynomial(moved, weights, degree=3)).fitted(points)
    return fitted


def _turned(profile: Profile, angles: np.ndarray) -> Profile:
    """Return the profile, whose curve is no longer valid, turned by small angles (3,): about
    ``ahead``, about ``across`` and about ``along``."""
    along = profile.along + angles[0] * profile.across + angles[1] * profile.ahead
    along = along / np.linalg.norm(along)
    ahead = profile.ahead + angles[2] * profile.across
    ahead = ahead - (ahead @ along) * along
    ahead = ahead / np.linalg.norm(ahead)
    return replace(profile, along=along, across=np.cross(along, ahead), ahead=ahead)


def _bands(lengths: np.ndarray) -> np.ndarray:
    """Return the number (n,) of the band, from 0, in which each of the ``lengths`` (n,) along the
    direction lies."""
    extent = max(float(np.ptp(lengths)), 1e-12)
    bands = (BANDS * (lengths - lengths.min()) / extent).astype(np.int64)
    return np.minimum(bands, BANDS - 1)


def _means_in_bands(
    values: np.ndarray,
    bands: np.ndarray,
    knots: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the means (`BANDS`, k) of values (n,) that lie in the same band and at the same of
    ``count`` knots; NaN where there are fewer than `LEAST_POINTS`."""
    strips = bands * count + knots
    numbers = np.bincount(strips, minlength=BANDS * count)
    sums = np.bincount(strips, values, BANDS * count)
    means = np.where(numbers >= LEAST_POINTS, sums, np.nan) / np.maximum(numbers, 1)
    return means.reshape(BANDS, count)


def explains_better(
    profile: Profile, smooth: SurfaceFunction, points: np.ndarray, rounding_m: float = 0.0
) -> bool:
    """Return whether an extruded surface explains points (n, 3) significantly better than a
    ``smooth`` one (`_gain_sigmas`)."""
    return _gain_sigmas(profile, smooth, points, rounding_m) > GAIN_SIGMAS


def _gain_sigmas(
    profile: Profile, smooth: SurfaceFunction, points: np.ndarray, rounding_m: float
) -> float:
    """Return by how many of its standard errors an extruded surface explains points (n, 3) better
    than a ``smooth`` one; -inf where too little departs from the smooth one to tell.

    Every other band along the direction shows where the profile departs from the smooth surface by
    more than `SEEN` of the noise, and predicts the other bands there: the errors must be smaller in
    the bands on average, significantly, because what is extruded is in each of them.

    ``rounding_m``: deviation that rounding leaves. Departures within `ROUNDED` of these do not
    count: the steps of a rounded plane without noise are extruded, too."""
    band = _bands(profile.lengths(points))
    departures = points[:, 2] - smooth(points)
    gain = np.full(len(points), np.nan)
    for parity in (0, 1):
        inside = band % 2 == parity
        if not inside.any() or inside.all():
            return -math.inf
        predicting = profile.fitted(points[~inside])
        errors = np.abs(points[inside, 2] - predicting(points[inside]))
        noise = float(np.nanmedian(errors)) / 0.6745
        limit = CLIP_SIGMAS * noise
        sizes = np.abs(departures[inside])
        knots = predicting.knots_of(points)
        medians, _ = group_medians(departures[~inside], knots[~inside], len(predicting.curve))
        least_m = max(SEEN * noise, ROUNDED * rounding_m)
        departs = np.abs(np.nan_to_num(medians)) > least_m
        gains = (sizes.clip(max=limit) - errors.clip(max=limit)) / noise
        gain[inside] = np.where(departs[knots[inside]], gains, np.nan)
    # where the surface is too steep to be judged, no smooth fit is good, and it does not matter
    is_judged = np.isfinite(gain) & np.isfinite(profile.trusted(points)(points))
    counts = np.bincount(band[is_judged], minlength=BANDS)
    enough = counts >= LEAST_POINTS
    if enough.sum() <= BANDS / 2:
        return -math.inf
    sums = np.bincount(band[is_judged], gain[is_judged], minlength=BANDS)
    means = sums[enough] / counts[enough]
    standard_error = float(means.std(ddof=1)) / math.sqrt(len(means))
    if standard_error == 0.0:
        return math.inf if means.mean() > 0 else -math.inf
    return float(means.mean()) / standard_error


def profiled(
    profile: Profile, smooth: SurfaceFunction, points: np.ndarray, rounding_m: float
) -> Profile | None:
    """Return the profile of `direction_of` fitted to points (n, 3), if it explains them better than
    a ``smooth`` surface. ``rounding_m``: deviation that rounding leaves."""
    sample = picked(points, COARSE_SEARCHED)
    first = _twisted(profile, picked(sample, TWIST_SEARCHED), rounds=3)
    if _gain_sigmas(first, smooth, sample, rounding_m) < SOUGHT_SIGMAS:
        return None
    profile = with_twist(profile, sample)
    if not explains_better(profile, smooth, sample, rounding_m):
        return None
    return profile.fitted(points).with_spread(points).trusted(points)
