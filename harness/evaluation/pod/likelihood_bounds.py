"""Confidence bounds of a hit/miss curve: on a size such as a90, and on the POD at every size.

- "likelihood ratio" (default): the set 2 (llmax - ll) <= chi2(confidence, 1) = 3.841 in (mu, sigma), MIL-HDBK-1823A
  G.3; a90/95 is the largest a90 in it, which equals the profile likelihood of a90 at that criterion.
- "profile": the same at the one-sided criterion chi2(2 confidence - 1, 1) = 2.706.
- "wald": the size at which the pointwise lower Wald band of the linear predictor crosses the wanted POD (Fieller).

All are one-sided upper bounds on size. Coverage at 60 targets is measured by ``tests/validation/pod_coverage.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import optimize, stats

from harness.evaluation.pod.curve import Bound, link_cdf, link_ppf
from harness.evaluation.pod.hit_miss import HitMissFit, bounded_profile, most_likely_below
from harness.evaluation.pod.likelihood import flat_maximum, profile
from harness.vocabulary.errors import UserError

METHODS = ("likelihood ratio", "wald", "profile")
FARTHEST = 2.0**40
"""Largest distance from the estimate, in spreads of the sizes, at which a bound is looked for."""
DIRECTIONS = 720
"""Points on the outline of the likelihood ratio set from which a band is drawn."""
REACH, REFINED = 10, 40
"""Doublings of a distance (from 2 to 2000 standard errors) and refinements of it, at most; about ten are needed."""


def bound(
    fit: HitMissFit,
    pod: float = 0.9,
    confidence: float = 0.95,
    method: str = "likelihood ratio",
    *,
    design_effect: float = 1.0,
) -> Bound:
    """Upper bound on the size with this POD, a90/95 by default; infinite, with its reason, where there is none.

    ``design_effect``: what targets that come in clusters multiply the variance by; so it multiplies the criterion (Rao
    and Scott, Annals of Statistics 12 (1984), 46).
    """
    _check(pod, confidence, method)
    if not design_effect > 0:
        raise UserError(f"design effect {design_effect:g} is out of range", legal="above 0")
    if pod <= fit.curve.floor:
        raise UserError(f"POD {pod:g} is under the fitted floor {fit.curve.floor:.3g}: every size reaches it")
    if method == "wald":
        x, why = _wald_bound(fit, pod, confidence, design_effect)
    else:
        x, why = _likelihood_bound(fit, pod, criterion(method, confidence) * design_effect * fit.repeats)
    with np.errstate(over="ignore"):
        value = float(np.exp(x)) if fit.curve.log_size else x
    if not np.isfinite(value):
        why = f"not demonstrated: {why or 'the bound is beyond all numbers'}"
        return Bound(pod, confidence, method, float("inf"), why)
    return Bound(pod, confidence, method, value)


def band(
    fit: HitMissFit, sizes: np.ndarray, confidence: float = 0.95, method: str = "likelihood ratio"
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper POD at ``sizes`` (n,), each one-sided at ``confidence`` as in `bound`, for drawing: the lower one
    crosses 90 % at a90/95 to a part in 1e4. A fitted floor and ceiling are held at their estimates."""
    _check(0.5, confidence, method)
    x = np.log(sizes) if fit.curve.log_size else np.asarray(sizes, float)
    if method == "wald":
        middle = fit.b0 + fit.b1 * x
        v = fit.covariance
        reach = float(stats.norm.ppf(confidence)) * np.sqrt(v[0, 0] + 2.0 * x * v[0, 1] + x**2 * v[1, 1])
        low, high = middle - reach, middle + reach
    else:
        outline = _outline(fit, criterion(method, confidence) * fit.repeats)
        predictors = outline[:, :1] + outline[:, 1:] * (x - fit.centre) / fit.spread
        low, high = predictors.min(axis=0), predictors.max(axis=0)
    between = fit.curve.ceiling - fit.curve.floor
    low, high = (fit.curve.floor + between * link_cdf(fit.curve.link, edge) for edge in (low, high))
    return low, high


def criterion(method: str, confidence: float) -> float:
    """Largest 2 (llmax - ll) in the set: 3.841 for the likelihood ratio, 2.706 for the one-sided profile, at 95 %."""
    share = confidence if method == "likelihood ratio" else 2.0 * confidence - 1.0
    return float(stats.chi2.ppf(share, 1))


def _likelihood_bound(fit: HitMissFit, pod: float, allowed: float) -> tuple[float, str]:
    """The largest x of this POD in the set 2 (llmax - ll) <= ``allowed``, or infinity and why."""
    data, place, level = fit.data, fit.place, float(link_ppf(fit.curve.link, np.array(pod)))
    share = (pod - fit.curve.floor) / (fit.curve.ceiling - fit.curve.floor)
    # The curve's middle where floor or ceiling keep it from this POD.
    z_best = fit.curve.mu + fit.curve.sigma * (float(link_ppf(fit.curve.link, np.array(share))) if 0 < share < 1 else 0)
    z_best = (z_best - fit.centre) / fit.spread
    top = float(data.value(place[:2]))
    plain = replace(data, floor=0.0, ceiling=1.0)
    flat = 2.0 * (top - flat_maximum(plain, level))
    if flat <= allowed:
        return float("inf"), f"a chance that does not grow with size fits too (ratio {flat:.2f} <= {allowed:.2f})"
    low = 2.0 * (top - most_likely_below(data, place, fit.bounded, pod))
    if low <= allowed:
        return float("inf"), f"a ceiling of {pod:.0%} or less fits too (ratio {low:.2f} <= {allowed:.2f})"

    slope = place[1]

    def excess(z: float) -> float:
        """The root of the ratio, which grows about linearly with z, less that of the criterion."""
        nonlocal slope
        if fit.bounded == "none":
            value, slope = profile(plain, z, level, slope)
        else:
            value = bounded_profile(data, place, fit.bounded, z, pod)
        return float(np.sqrt(max(2.0 * (top - value), 0.0)) - np.sqrt(allowed))

    reach = 0.25
    while excess(z_best + reach) <= 0:
        reach *= 2.0
        if reach > FARTHEST:
            return float("inf"), "the likelihood ratio set has no end"
    exactness = 1e-10 if fit.bounded == "none" else 1e-6
    z = optimize.brentq(excess, z_best, z_best + reach, xtol=exactness)
    return fit.centre + fit.spread * float(z), ""


def _wald_bound(fit: HitMissFit, pod: float, confidence: float, design_effect: float) -> tuple[float, str]:
    """The root of (b0 + b1 x - t)^2 = z^2 Var(b0 + b1 x) above the estimate; none where the slope may be 0."""
    if fit.bounded != "none":
        raise UserError("no Wald bound with a floor or a ceiling", legal="likelihood ratio, profile")
    level, z2 = float(link_ppf(fit.curve.link, np.array(pod))), float(stats.norm.ppf(confidence)) ** 2
    v = fit.covariance * design_effect
    square = fit.b1**2 - z2 * v[1, 1]
    if square <= 0:
        return float("inf"), f"the slope is within {np.sqrt(z2):.3f} standard errors of 0"
    half = fit.b1 * (fit.b0 - level) - z2 * v[0, 1]
    constant = (fit.b0 - level) ** 2 - z2 * v[0, 0]
    return float((-half + np.sqrt(max(half**2 - square * constant, 0.0))) / square), ""


def _outline(fit: HitMissFit, allowed: float) -> np.ndarray:
    """(n, 2) points (b0, b1), in standardised sizes, on the outline of 2 (llmax - ll) <= ``allowed`` with b1 >= 0.

    Along directions evenly spread in the metric of the covariance; a concave likelihood crosses it once in each.
    """
    data, best = fit.data, fit.place[:2]
    scale = np.array([[1.0, fit.centre], [0.0, fit.spread]])
    metric = scale @ fit.covariance_of_rows @ scale.T
    try:
        root = np.linalg.cholesky(metric)
    except np.linalg.LinAlgError:  # a step, whose covariance is singular: any metric will do that spans both directions
        spread, directions = np.linalg.eigh(metric)
        root = directions * np.sqrt(np.maximum(spread, 1e-4 * max(float(spread[-1]), 1e-8)))
    angle = np.linspace(0.0, 2.0 * np.pi, DIRECTIONS, endpoint=False)
    step = np.column_stack([np.cos(angle), np.sin(angle)]) @ root.T
    with np.errstate(divide="ignore"):
        farthest = np.where(step[:, 1] < 0, -best[1] / step[:, 1], np.inf)
    lowest = float(data.value(best)) - 0.5 * allowed
    inside = _distances(lambda r: data.value(best + r[:, None] * step) - lowest, farthest)
    return np.asarray(best + inside[:, None] * step)


def _distances(excess: Callable[[np.ndarray], np.ndarray], farthest: np.ndarray) -> np.ndarray:
    """Find where ``excess``, above 0 at distance 0, falls through 0, direction by direction; the farthest looked at
    where it does not.

    Doubled distances bracket it, then the Illinois variant of the false position (Dowell and Jarratt, BIT 11 (1971)).
    """
    inside, outside = np.zeros_like(farthest), np.minimum(farthest, 2.0)
    value_in, value_out = excess(inside), excess(outside)
    for _ in range(REACH):
        further = (value_out > 0) & (outside < farthest)
        if not further.any():
            break
        inside, value_in = np.where(further, outside, inside), np.where(further, value_out, value_in)
        outside = np.where(further, np.minimum(2.0 * outside, farthest), outside)
        value_out = excess(outside)
    ends = value_out >= 0
    side = np.zeros_like(farthest)
    for _ in range(REFINED):
        with np.errstate(divide="ignore", invalid="ignore"):
            r = np.where(ends, outside, inside + (outside - inside) * value_in / (value_in - value_out))
        value = excess(r)
        within = value > 0
        value_out = np.where(within & (side > 0), 0.5 * value_out, value_out)
        value_in = np.where(~within & (side < 0), 0.5 * value_in, value_in)
        side = np.where(within, 1.0, -1.0)
        inside, value_in = np.where(within, r, inside), np.where(within, value, value_in)
        outside, value_out = np.where(within, outside, r), np.where(within, value_out, value)
        if np.all(ends | (outside - inside <= 1e-9 * outside) | (np.abs(value) <= 1e-9)):
            break
    return np.where(ends, outside, r)


def _check(pod: float, confidence: float, method: str) -> None:
    if method not in METHODS:
        raise UserError(f"bound by {method!r} is not known", legal=", ".join(METHODS))
    if not 0 < pod < 1:
        raise UserError(f"POD {pod:g} is out of range", legal="between 0 and 1")
    if not 0.5 < confidence < 1:
        raise UserError(f"confidence {confidence:g} is out of range", legal="between 0.5 and 1")
