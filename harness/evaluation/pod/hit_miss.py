"""Probability of detection from hits and misses: a binomial regression on size, by MIL-HDBK-1823A
appendix G.

Rows with the same identity in ``inspections`` are one target and count as fully dependent, as the
handbook has it. With k rows per target, the covariance and the criterion of the likelihood ratio
are multiplied by k; if k differs between targets, rows are weighted so that each target counts
once. The bound is one-sided: the largest a90 of all (mu, sigma) with 2 (llmax - ll) <=
chi2(confidence, 1) = 3.841 (G.3 of the handbook), which equals the profile likelihood of a90 at
that criterion. Not modelled: targets that differ in anything but size, inspectors, and hits by
chance or misses at any size, for which `floor_ceiling_tests` tests.

The bound of a model holds if that model is true. If the data choose among eight models, the bound
of the best model covers 91 to 96 % (1,000 studies of 60 targets for each of five true curves). So
where the data choose, `harness.evaluation.pod.averaged` averages over all models that the data
hardly distinguish from the best (`near_models`)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special
from scipy.optimize import elementwise

from harness.evaluation.pod.curve import (
    CELLS,
    LINKS,
    Bound,
    HitsAndMisses,
    PodCurve,
    flat_maximum,
    link_cdf,
    link_ppf,
    logs_of_link,
    maxima,
    penalised_maxima,
    profile,
)
from harness.vocabulary.errors import UserError

Beyond = Literal["floor", "ceiling", "both"]
Range = tuple[float, float]
METHOD = "likelihood ratio"
EXACT = 1e-9  # tolerance of the coefficients of a single study
# largest slope in standardised sizes: a curve that rises within a thousandth of their spread is a
# step
STEEPEST = 1e3
NEAR_DEVIANCE = 2.0
"""Largest excess over the least deviance, with one inspection per target, of a model that is
hardly worse than the best. With equally many parameters, it is a difference of 2 in AIC (Burnham
and Anderson 2002, 2.6)."""
LEVEL = 0.05  # of the tests for a floor or a ceiling
STARTS = 10  # points of a coarse grid from which the search with floor or ceiling starts


@dataclass(frozen=True, eq=False)
class HitMissFit:
    """A fitted curve, POD = F(b0 + b1 x) with x = size or ln size, and its basis."""

    curve: PodCurve
    """The same curve as mu = -b0 / b1 and sigma = 1 / b1, with their covariance."""
    b0: float
    """Intercept."""
    b1: float
    """Slope, above 0."""
    covariance: np.ndarray
    """Covariance (2, 2) of b0 and b1, multiplied by ``repeats``."""
    deviance: float
    """-2 times the log-likelihood of all rows, without the penalty of ``method`` "Firth"."""
    null_deviance: float
    """Deviance of a constant POD."""
    log_likelihood: float
    """Log-likelihood of all rows, without the penalty."""
    n: int
    """Number of rows."""
    hits: int
    """Number of rows that are hits."""
    targets: int
    """Number of targets."""
    repeats: float
    """Mean number of rows of a target."""
    method: Literal["ML", "Firth"]
    """Maximum likelihood, or Firth's penalised likelihood if hits and misses are separated."""
    notes: tuple[str, ...]
    """Remarks on the data."""
    centre: float
    """Mean of x."""
    spread: float
    """Standard deviation of x."""
    maximum: np.ndarray
    """Intercept and slope (2,) in z = (x - centre) / spread."""
    data: HitsAndMisses
    """The likelihood in z."""


@dataclass(frozen=True)
class FloorCeilingTest:
    """A test whether POD = floor + (ceiling - floor) F fits better."""

    beyond: Beyond
    """The free parameters: floor, ceiling or both."""
    statistic: float
    """Likelihood ratio of the curves with and without them, with one inspection per target."""
    p_value: float
    """P-value from the mixture of chi-squares for a parameter on its boundary."""
    floor: float
    """Maximum likelihood estimate: POD of the smallest damage."""
    ceiling: float
    """Maximum likelihood estimate: POD of the largest damage."""

    @property
    def needed(self) -> bool:
        """True if the model with two parameters is rejected at `LEVEL`."""
        return self.p_value < LEVEL


def fit_hit_miss(
    size: ArrayLike,
    hit: ArrayLike,
    *,
    link: str = "logit",
    log_size: bool = False,
    inspections: ArrayLike | None = None,
) -> HitMissFit:
    """Fit the POD curve of hits (0/1, (n,)) at sizes ((n,), any unit).

    ``inspections`` (n,): the target of each row. If hits and misses do not overlap, the likelihood
    has no maximum: Firth's penalised likelihood is used, with a note. Raises `UserError` for
    values that cannot be fitted and for a POD that does not grow with size."""
    x, hits = _checked(size, hit, link, log_size)
    n = len(x)
    rows_each = rows_of_target(x, inspections)
    targets = round(float((1 / rows_each).sum()))
    repeats = n / targets
    weight = repeats / rows_each  # every target counts the same, however often it was inspected
    centre = float(x.mean())
    spread = float(x.std())
    design = np.column_stack([np.ones_like(x), (x - centre) / spread])
    weighted_hits = weight * hits
    separated = _separated(x, hits)
    data = HitsAndMisses(
        design=design,
        hits=weighted_hits,
        misses=weight - weighted_hits,
        link=link,
        penalty=repeats if separated else None,
    )
    hit_rate = float(np.average(hits, weights=weight))
    maximum = _maximum(data, hit_rate)
    if separated and x[hits].mean() < x[~hits].mean():
        maximum[1] = 0.0  # hits are smaller than misses
    if maximum[1] <= 0:
        fix = "check that hits are 1 and misses 0, and that size is what detection depends on"
        raise UserError(
            "the probability of detection does not grow with size: the slope is not positive",
            fix=fix,
        )

    log_likelihood = float(replace(data, penalty=None).value(maximum))
    constant = hit_rate * np.log(hit_rate) + (1.0 - hit_rate) * np.log1p(-hit_rate)
    unscale = np.array([[1.0, -centre / spread], [0.0, 1.0 / spread]])
    b0, b1 = (unscale @ maximum).tolist()
    log_hit, log_miss, log_density = logs_of_link(link, design @ maximum)
    # expected information, of the intercept and slope in z
    of_rows = weight * np.exp(2.0 * log_density - log_hit - log_miss)
    information = (design.T * of_rows) @ design
    covariance = unscale @ (np.linalg.pinv(information) * repeats) @ unscale.T
    # slopes of mu = -b0 / b1 and sigma = 1 / b1 by b0 and b1
    jacobian = np.array([[-1.0 / b1, b0 / b1**2], [0.0, -1.0 / b1**2]])
    return HitMissFit(
        curve=PodCurve(link, log_size, -b0 / b1, 1.0 / b1, jacobian @ covariance @ jacobian.T),
        b0=b0,
        b1=b1,
        covariance=covariance,
        deviance=-2.0 * log_likelihood,
        null_deviance=float(-2.0 * n * constant),
        log_likelihood=log_likelihood,
        n=n,
        hits=int(hits.sum()),
        targets=targets,
        repeats=repeats,
        method="Firth" if separated else "ML",
        notes=_notes(rows_each, targets, separated),
        centre=centre,
        spread=spread,
        maximum=maximum,
        data=data,
    )


def _separated(x: np.ndarray, hits: np.ndarray) -> bool:
    """Return whether hits and misses do not overlap: complete and quasi-complete separation in
    either direction (Albert and Anderson, Biometrika 71 (1984))."""
    rising = x[~hits].max() <= x[hits].min()
    falling = x[hits].max() <= x[~hits].min()
    return bool(rising or falling)


def _maximum(data: HitsAndMisses, hit_rate: float) -> np.ndarray:
    """Return the intercept and slope (2,) with the largest (penalised) likelihood."""
    studies = replace(data, hits=data.hits[None], misses=data.misses[None])
    if data.penalty is not None:
        return np.asarray(penalised_maxima(studies, EXACT)[0])
    start = np.array([float(link_ppf(data.link, np.array(hit_rate))), 0.0])
    return np.asarray(maxima(studies, start, EXACT)[0])


def _notes(
    rows_each: np.ndarray,
    targets: int,
    separated: bool,
) -> tuple[str, ...]:
    notes = []
    n = len(rows_each)
    if separated:
        notes.append(
            "no miss is larger than any hit (separation), so Firth's penalised likelihood is used"
        )
    if targets < n:
        counted = f"{n} inspections of {targets} targets count as {targets}"
        notes.append(f"{counted} (variance multiplied by {n / targets:.4g})")
        if np.ptp(rows_each):
            numbers = f"{rows_each.min()} to {rows_each.max()}"
            notes.append(f"{numbers} inspections per target: each target counts once")
    return tuple(notes)


def choose_model(
    size: ArrayLike,
    hit: ArrayLike,
    *,
    inspections: ArrayLike | None = None,
) -> tuple[HitMissFit, ...]:
    """Fit every link with a and, if all sizes are positive, with ln a; least deviance first. The
    order does not depend on the limits: a model chosen because its limit is small has no coverage.
    """
    logs = (False, True) if np.all(np.asarray(size, float) > 0) else (False,)
    fit = partial(fit_hit_miss, size, hit, inspections=inspections)
    fits = [fit(link=link, log_size=log_size) for log_size, link in product(logs, LINKS)]
    return tuple(sorted(fits, key=lambda fit: fit.deviance))


def near_models(fits: Sequence[HitMissFit]) -> tuple[HitMissFit, ...]:
    """Return the fits of the same hits whose deviance is within `NEAR_DEVIANCE` of the least, in
    the same order."""
    least = min(fit.deviance for fit in fits)
    return tuple(fit for fit in fits if fit.deviance <= least + NEAR_DEVIANCE * fit.repeats)


def floor_ceiling_tests(fit: HitMissFit, *, each: bool = True) -> tuple[FloorCeilingTest, ...]:
    """Test three or four parameters against the two of ``fit`` by the likelihood ratio. A floor of
    0 and a ceiling of 1 lie on the boundary: the distribution is 1/2 chi2(0) + 1/2 chi2(1) for
    either, and 1/4, 1/2, 1/4 of chi2(0), chi2(1), chi2(2) for both (Self and Liang, JASA 82
    (1987), 605, cases 5 and 7, without their correlation). No test of separated data.

    Not ``each``: both parameters are tested first, and the others left out if they cannot be
    needed, because neither alone can raise the likelihood by more. That takes a third of the time.
    """
    if fit.method == "Firth":
        return ()
    free_floor = (0.0, 0.5)
    free_ceiling = (0.5, 1.0)
    both = _tested(fit, "both", free_floor, free_ceiling)
    if not each and _p_value("floor", both.statistic) >= LEVEL:
        return (both,)
    return (
        _tested(fit, "floor", free_floor, (1.0, 1.0)),
        _tested(fit, "ceiling", (0.0, 0.0), free_ceiling),
        both,
    )


def _tested(
    fit: HitMissFit,
    beyond: Beyond,
    floor: Range,
    ceiling: Range,
) -> FloorCeilingTest:
    """Test the likeliest curve with floor and ceiling in these ranges."""
    likeliest, value = _search(fit.data, fit.maximum, floor, ceiling)
    statistic = max(2.0 * (value - fit.log_likelihood) / fit.repeats, 0.0)
    return FloorCeilingTest(
        beyond=beyond,
        statistic=statistic,
        p_value=_p_value(beyond, statistic),
        floor=float(likeliest[2]),
        ceiling=float(likeliest[3]),
    )


def _p_value(beyond: Beyond, statistic: float) -> float:
    """Return the probability of so large a likelihood ratio without floor and ceiling."""
    if statistic <= 1e-9:
        return 1.0
    tail_of_one, tail_of_two = special.chdtrc([1, 2], statistic).tolist()
    if beyond == "both":
        return float(0.5 * tail_of_one + 0.25 * tail_of_two)
    return float(0.5 * tail_of_one)


def value_and_gradient(data: HitsAndMisses, curve: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the log-likelihood of one study and its gradient (4,) at a ``curve`` (b0, b1, floor,
    ceiling)."""
    b0, b1, floor, ceiling = curve
    share, miss, density = np.exp(logs_of_link(data.link, b0 + b1 * data.z))
    p_hit, p_miss = _probabilities(share, miss, floor, ceiling)
    slope = data.hits / p_hit - data.misses / p_miss
    along = slope * (ceiling - floor) * density
    gradient = np.array([along.sum(), along @ data.z, slope @ (1.0 - share), slope @ share])
    return float(data.hits @ np.log(p_hit) + data.misses @ np.log(p_miss)), gradient


def _probabilities(
    share: np.ndarray,
    miss: np.ndarray,
    floor: float,
    ceiling: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities of hit and miss from ``share`` = F and ``miss`` = 1 - F."""
    p_hit = np.maximum(floor + (ceiling - floor) * share, 1e-300)
    p_miss = np.maximum((1.0 - ceiling) + (ceiling - floor) * miss, 1e-300)
    return p_hit, p_miss


def _of_shares(
    data: HitsAndMisses,
    share: np.ndarray,
    miss: np.ndarray,
    floor: float,
    ceiling: float,
) -> np.ndarray:
    """Return the log-likelihoods (m,) of curves with floor and ceiling, from their shares (m, n)
    of hits and misses."""
    p_hit, p_miss = _probabilities(share, miss, floor, ceiling)
    return np.asarray(np.log(p_hit) @ data.hits + np.log(p_miss) @ data.misses)


def _search(
    data: HitsAndMisses,
    plain: np.ndarray,
    floor: Range,
    ceiling: Range,
) -> tuple[np.ndarray, float]:
    """Return the likeliest curve (4,) with floor and ceiling in these ranges, and its
    log-likelihood, from the best points of a coarse grid. ``plain`` (2,): intercept and slope of
    the likeliest curve without them."""
    floors = sorted({float(np.clip(level, *floor)) for level in (0.02, 0.1, 0.25)})
    ceilings = sorted({float(np.clip(level, *ceiling)) for level in (0.75, 0.9, 0.98)})
    levels = np.array([*product(floors, ceilings)])
    curves = _rising_curves(data.z, plain)
    blocks = []
    block = max(1, CELLS // len(data.z))
    for first in range(0, len(curves), block):
        predictor = curves[first : first + block] @ data.design.T
        log_share, log_miss, _ = logs_of_link(data.link, predictor)
        share = np.exp(log_share)
        miss = np.exp(log_miss)
        blocks.append([_of_shares(data, share, miss, *level) for level in levels.tolist()])
    values = np.concatenate(blocks, axis=1)
    best = np.argsort(-values.max(axis=0), kind="stable")[:STARTS]
    starts = np.hstack([curves[best], levels[values.argmax(axis=0)[best]]])

    def loss(curve: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = value_and_gradient(data, curve)
        return -value, -gradient

    ends = [
        optimize.minimize(
            loss,
            start,
            jac=True,
            method="L-BFGS-B",
            bounds=((-STEEPEST * 10, STEEPEST * 10), (1e-6, STEEPEST), floor, ceiling),
            options={"ftol": 1e-13, "gtol": 1e-8, "maxiter": 500},
        )
        for start in starts
    ]
    likeliest = min(ends, key=lambda end: end.fun)
    return likeliest.x, -float(likeliest.fun)


def _rising_curves(z: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Return intercepts and slopes (m, 2) that cover the data: curves of several widths about
    quantiles of the sizes and about the middle of ``plain``, and steps between neighbouring sizes.
    """
    quantiles = np.quantile(z, np.linspace(0.04, 0.96, 16))
    middles = np.append(quantiles, -plain[0] / plain[1])
    slopes = plain[1] * np.array([1.0, 3.0, 12.0, 50.0])
    rises = [*product(middles, slopes)]
    sizes = np.unique(z)
    halfway = 0.5 * (sizes[1:] + sizes[:-1])
    rises += zip(halfway, 6.0 / np.diff(sizes), strict=True)
    middle, slope = np.array(rises).T
    return np.stack([-slope * middle, np.minimum(slope, STEEPEST)], axis=1)


def _checked(
    size: ArrayLike,
    hit: ArrayLike,
    link: str,
    log_size: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return x (n,) and hits (n,) as booleans. Raises UserError for the user's mistake."""
    sizes = np.asarray(size, float)
    hits = np.asarray(hit, float)
    if link not in LINKS:
        raise UserError(f"link {link!r} is not known", legal=", ".join(LINKS))
    if sizes.ndim != 1 or sizes.shape != hits.shape:
        raise UserError(
            f"sizes {sizes.shape} and hits {hits.shape} differ in shape",
            legal="one hit for each size",
        )
    if not np.isfinite(sizes).all():
        raise UserError(f"size {np.flatnonzero(~np.isfinite(sizes))[0]} is not a finite number")
    if not np.isin(hits, (0.0, 1.0)).all():
        row = int(np.flatnonzero(~np.isin(hits, (0.0, 1.0)))[0])
        raise UserError(f"hit {row} is {hits[row]:g}", legal="0 (missed) or 1 (found)")
    if hits.all() or not hits.any():
        outcome = "found" if len(hits) and hits.all() else "missed"
        raise UserError(
            f"every target was {outcome}: there is no curve to fit",
            fix="inspect sizes on both sides of it",
        )
    if log_size and sizes.min() <= 0:
        raise UserError(
            f"size {sizes.min():g} has no logarithm", legal="sizes > 0", fix="fit size itself"
        )
    if np.ptp(sizes) == 0:
        raise UserError(f"all sizes are {sizes[0]:g}: POD against size needs more than one")
    x = np.log(sizes) if log_size else sizes
    return x, hits == 1.0


def rows_of_target(size: np.ndarray, inspections: ArrayLike | None) -> np.ndarray:
    """Return for each row (n,) the number of rows of its target; every row is a target if
    ``inspections`` is None."""
    if inspections is None:
        return np.ones(len(size), int)
    names = np.asarray(inspections).astype(str)
    if len(names) != len(size):
        raise UserError(f"{len(names)} target names for {len(size)} rows", legal="one for each row")
    _, first, target = np.unique(names, return_index=True, return_inverse=True)
    differs = size != size[first][target]
    if np.any(differs):
        raise UserError(
            f"target {names[differs][0]} has more than one size", legal="one size for each target"
        )
    return np.bincount(target)[target]


# largest distance from the estimate, in spreads of the sizes, at which a bound is sought
FARTHEST = 2.0**40
DIRECTIONS = 240  # points on the outline of the confidence set that determine a band
REACH = 10  # most doublings of a distance, from 2 to 2000 standard errors


def bound(
    fit: HitMissFit,
    pod: float = 0.9,
    confidence: float = 0.95,
) -> Bound:
    """Return the upper bound on the size with this POD; infinite, with the reason, if there is
    none."""
    if not 0 < pod < 1:
        raise UserError(f"POD {pod:g} is out of range", legal="between 0 and 1")
    x, why = _likelihood_bound(fit, pod, criterion(confidence) * fit.repeats)
    with np.errstate(over="ignore"):
        value = float(np.exp(x)) if fit.curve.log_size else x
    if not np.isfinite(value):
        why = f"not demonstrated: {why or 'the bound is infinite'}"
        return Bound(pod, confidence, METHOD, float("inf"), why)
    return Bound(pod, confidence, METHOD, value)


def band(
    fit: HitMissFit,
    sizes: np.ndarray,
    confidence: float = 0.95,
) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper POD at ``sizes`` (n,), each one-sided as in `bound`: the lower
    crosses 90 % at a90/95."""
    x = np.asarray(sizes, float)
    if fit.curve.log_size:
        x = np.log(np.maximum(sizes, np.finfo(float).tiny))
    outline = _outline(fit, criterion(confidence) * fit.repeats)
    predictors = outline[:, :1] + outline[:, 1:] * (x - fit.centre) / fit.spread
    low = link_cdf(fit.curve.link, predictors.min(axis=0))
    high = link_cdf(fit.curve.link, predictors.max(axis=0))
    return low, high


def criterion(confidence: float) -> float:
    """Return the largest 2 (llmax - ll) of the confidence set: 3.841 at 95 %."""
    if not 0.5 < confidence < 1:
        raise UserError(f"confidence {confidence:g} is out of range", legal="between 0.5 and 1")
    return 2.0 * float(special.gammaincinv(0.5, confidence))


def _likelihood_bound(
    fit: HitMissFit,
    pod: float,
    allowed: float,
) -> tuple[float, str]:
    """Return the largest x of this POD in the set 2 (llmax - ll) <= ``allowed``, or infinity and
    the reason."""
    data = fit.data
    level = float(link_ppf(fit.curve.link, np.array(pod)))
    z_best = (fit.curve.mu + fit.curve.sigma * level - fit.centre) / fit.spread
    top = float(data.value(fit.maximum))
    flat = 2.0 * (top - flat_maximum(data, level))
    if flat <= allowed:
        ratio = f"ratio {flat:.2f} <= {allowed:.2f}"
        return float("inf"), f"a constant probability is not rejected ({ratio})"
    slope = fit.maximum[1]

    @cache
    def excess(z: float) -> float:
        """Return the root of the ratio, which grows about linearly with z, minus the root of the
        criterion. Each search for the slope starts from that of the last."""
        nonlocal slope
        value, slope = profile(data, z, level, slope)
        return float(np.sqrt(max(2.0 * (top - value), 0.0)) - np.sqrt(allowed))

    inside = 0.0
    outside = 0.25
    while excess(z_best + outside) <= 0:
        inside = outside
        outside = 2.0 * outside
        if outside > FARTHEST:
            return float("inf"), "the likelihood ratio set is unbounded"
    z = optimize.brentq(excess, z_best + inside, z_best + outside, xtol=1e-10)
    return fit.centre + fit.spread * float(z), ""


def _outline(fit: HitMissFit, allowed: float) -> np.ndarray:
    """Return (b0, b1) (n, 2), in standardised sizes, on the outline of 2 (llmax - ll) <=
    ``allowed`` with b1 >= 0, by a search along `DIRECTIONS` rays from the maximum."""
    data = fit.data
    best = fit.maximum
    angle = np.linspace(0.0, 2.0 * np.pi, DIRECTIONS, endpoint=False)
    ray = np.column_stack([np.cos(angle), np.sin(angle)]) @ _metric_root(fit).T
    with np.errstate(divide="ignore"):
        farthest = np.where(ray[:, 1] < 0, -best[1] / ray[:, 1], np.inf)
    lowest = float(data.value(best)) - 0.5 * allowed
    ray_index = np.arange(DIRECTIONS)

    def excess(distance: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the log-likelihood at distances along rays, minus the lowest in the set."""
        curves = best + distance[..., None] * ray[along]
        block = max(1, CELLS // len(data.z))
        values = []
        for first in range(0, max(len(curves), 1), block):
            values.append(data.value(curves[first : first + block]))
        return np.concatenate(values) - lowest

    inside = np.zeros(DIRECTIONS)
    outside = np.minimum(farthest, 2.0)
    for _ in range(REACH):
        extended = (excess(outside, ray_index) > 0) & (outside < farthest)
        if not extended.any():
            break
        inside = np.where(extended, outside, inside)
        outside = np.where(extended, np.minimum(2.0 * outside, farthest), outside)
    crossed = excess(outside, ray_index) < 0
    roots = elementwise.find_root(
        excess,
        (inside[crossed], outside[crossed]),
        args=(ray_index[crossed],),
        tolerances={"xrtol": 1e-9, "fatol": 1e-9},
    )
    outside[crossed] = roots.x
    return np.asarray(best + outside[:, None] * ray)


def _metric_root(fit: HitMissFit) -> np.ndarray:
    """Return a root (2, 2) of the covariance in standardised sizes, in which the outline is about
    a circle."""
    scale = np.array([[1.0, fit.centre], [0.0, fit.spread]])
    metric = scale @ (fit.covariance / fit.repeats) @ scale.T
    try:
        return np.linalg.cholesky(metric)
    except np.linalg.LinAlgError:
        # the covariance of a step is singular: use any metric that spans both directions
        variance, directions = np.linalg.eigh(metric)
        least = 1e-4 * max(float(variance[-1]), 1e-8)
        return np.asarray(directions * np.sqrt(np.maximum(variance, least)))
