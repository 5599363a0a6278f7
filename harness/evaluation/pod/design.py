"""What a hit/miss study will be able to say, before anybody drills a hole; and what repeats of a few holes cannot say.

A study is planned from a guess of the POD curve: studies are simulated from it and analysed as real ones would be.
MIL-HDBK-1823A asks for at least 60 independent targets, with sizes spread evenly and over where POD rises. The plan is
as good as the guess: a study whose sizes miss the rise of the true curve demonstrates less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from harness.evaluation.pod.curve import Bound, PodCurve
from harness.evaluation.pod.hit_miss import Between, HitMissFit, fit_hit_miss
from harness.evaluation.pod.likelihood_bounds import bound
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream

LEAST_TARGETS = 60
"""MIL-HDBK-1823A: independent targets that a hit/miss study should have at least."""
SPREAD_SHARE = 1 / 3
"""Share of a concentrated design's targets that is still spread over the whole range: insurance against the guess."""
RISE = (0.03, 0.97)
"""POD between which a curve counts as rising (MIL-HDBK-1823A: sizes should cover about that)."""

Placement = Literal["uniform", "concentrated"]
PLACEMENTS: tuple[Placement, ...] = ("uniform", "concentrated")


@dataclass(frozen=True, eq=False)
class Plan:
    """What studies of ``targets`` targets, placed by ``placement``, demonstrate if the guess is right.

    ``bound``: median over simulated studies of the upper bound on the size with this ``pod`` (a90/95), infinite where
    half of them demonstrate none; ``low``, ``high``: their 10 % and 90 % quantiles; ``true_size``: the guess's own;
    ``demonstrated``: share of studies with a finite bound; ``sizes`` (targets,) to make.
    """

    targets: int
    placement: Placement
    pod: float
    confidence: float
    method: str
    studies: int
    true_size: float
    bound: float
    low: float
    high: float
    demonstrated: float
    sizes: np.ndarray
    notes: tuple[str, ...]


def design(
    guess: PodCurve,
    targets: Sequence[int],
    range_of_sizes: tuple[float, float],
    *,
    placements: Sequence[Placement] = PLACEMENTS,
    pod: float = 0.9,
    confidence: float = 0.95,
    method: str = "likelihood ratio",
    studies: int = 200,
    seed: int = 0,
) -> tuple[Plan, ...]:
    """One `Plan` for each number of targets and placement, in that order; a study takes about 5 ms.

    Studies are analysed with the guess's link and axis (and with a floor or a ceiling where it has one, at about a
    second a study), so choosing a model costs nothing here. A study that found all or nothing, or whose POD does not
    grow with size, demonstrates nothing. The Monte Carlo error of ``demonstrated`` is sqrt(p (1 - p) / studies).
    UserError for a range that is empty, or not above 0 under a logarithm.
    """
    low, high = range_of_sizes
    if not (np.isfinite([low, high]).all() and low < high) or (guess.log_size and low <= 0):
        raise UserError(
            f"range of sizes {low:g} to {high:g}",
            legal="low < high" + (", above 0 for a curve over ln size" if guess.log_size else ""),
        )
    if studies < 1 or min(targets, default=0) < 2:
        raise UserError(f"{studies} studies of {list(targets)} targets", legal="one study, two targets at least")
    plans = []
    for number in targets:
        for placement in placements:
            sizes = place_sizes(guess, number, range_of_sizes, placement)
            stream = random_stream(seed, "pod design", number, placement)
            hits = stream.random((studies, number)) < guess.pod(sizes)
            bounds = np.array([_bound_of(sizes, row, guess, pod, confidence, method) for row in hits])
            plans.append(_plan(guess, sizes, placement, bounds, range_of_sizes, pod, confidence, method))
    return tuple(plans)


def place_sizes(guess: PodCurve, number: int, range_of_sizes: tuple[float, float], placement: Placement) -> np.ndarray:
    """Ascending sizes (number,), evenly spaced on the Cartesian scale over the range ("uniform"), or `SPREAD_SHARE` of
    them so and the rest evenly where the guess rises through `RISE`, cut to the range ("concentrated")."""
    if placement == "uniform":
        return _evenly(number, *range_of_sizes)
    if placement != "concentrated":
        raise UserError(f"placement {placement!r} is not known", legal=", ".join(PLACEMENTS))
    low, high = range_of_sizes
    between = [guess.floor + share * (guess.ceiling - guess.floor) for share in RISE]
    start, end = (float(np.clip(guess.size_at(pod), low, high)) for pod in between)
    if not start < end:
        raise UserError(
            f"the guessed curve does not rise between sizes {low:g} and {high:g}",
            legal=f"a range that meets {guess.size_at(between[0]):.4g} to {guess.size_at(between[1]):.4g}",
        )
    spread = round(number * SPREAD_SHARE)
    return np.sort(np.concatenate([_evenly(spread, low, high), _evenly(number - spread, start, end)]))


def guess_with_frames(guess: PodCurve, frames: int, *, guessed_with: int, fixed_share: float) -> PodCurve:
    """The guess for another number of averaged frames.

    Noise has a white part that averages out and a fixed part that does not: variance(N) / variance(``guessed_with``) =
    (1 - s) guessed_with / N + s, ``fixed_share`` s of the variance in the guess. With the target's shape known, its
    detectability d' is size / noise (depth at a fixed diameter; about so for the diameter, the more so the larger it is
    than the camera's blur), so sizes of equal POD scale with the noise's standard deviation. The curve's covariance
    scales along. Not modelled: pixels that become valid, motion.
    """
    if not (frames >= 1 and guessed_with >= 1 and 0 <= fixed_share <= 1):
        raise UserError(
            f"{frames} frames, guessed with {guessed_with}, fixed share {fixed_share:g}",
            legal="one frame at least, a share between 0 and 1",
        )
    ratio = float(np.sqrt((1 - fixed_share) * guessed_with / frames + fixed_share))
    if guess.log_size:
        return replace(guess, mu=guess.mu + float(np.log(ratio)))
    return replace(guess, mu=guess.mu * ratio, sigma=guess.sigma * ratio, covariance=guess.covariance * ratio**2)


@dataclass(frozen=True)
class RepeatsCheck:
    """The limit of ``inspections`` inspections of ``targets`` targets, right and wrong.

    ``right``: targets count, ``wrong``: each inspection is taken for a target of its own; ``text`` says it in words.
    """

    targets: int
    inspections: int
    right: Bound
    wrong: Bound
    fit: HitMissFit
    text: str


def repeats_are_not_targets(
    size: ArrayLike,
    hit: ArrayLike,
    target: ArrayLike,
    *,
    link: str = "logit",
    log_size: bool = False,
    pod: float = 0.9,
    confidence: float = 0.95,
    method: str = "likelihood ratio",
) -> RepeatsCheck:
    """Both limits of one set of inspections: ``size``, ``hit`` (0/1) and ``target`` (identity), each (n,).

    Fifty repeats of eight holes repeat the noise, not the holes: they are eight targets. UserErrors as of
    `harness.evaluation.pod.hit_miss.fit_hit_miss`.
    """
    fit = fit_hit_miss(
        np.asarray(size, float), np.asarray(hit, float), link=link, log_size=log_size, inspections=np.asarray(target)
    )
    right = bound(fit, pod, confidence, method)
    # A fit of its own: where hits and misses separate, the penalty would still count targets.
    rows = fit_hit_miss(np.asarray(size, float), np.asarray(hit, float), link=link, log_size=log_size)
    wrong = bound(rows, pod, confidence, method)
    name = f"a{100 * pod:g}/{100 * confidence:g}"
    text = (
        f"{fit.n} inspections of {fit.targets} targets are {fit.targets} targets: {name} {_said(right)}; "
        f"taken for {fit.n} targets, wrongly, {_said(wrong)}"
    )
    return RepeatsCheck(fit.targets, fit.n, right, wrong, fit, text)


def _said(limit: Bound) -> str:
    return f"{limit.value:.4g}" if limit.demonstrated else "not demonstrated"


def _evenly(number: int, low: float, high: float) -> np.ndarray:
    """Midpoints of equal parts: no target wasted on the very ends."""
    return low + (high - low) * (np.arange(number) + 0.5) / max(number, 1)


def _bound_of(
    sizes: np.ndarray, hits: np.ndarray, guess: PodCurve, pod: float, confidence: float, method: str
) -> float:
    try:
        fit = fit_hit_miss(sizes, hits.astype(float), link=guess.link, log_size=guess.log_size, bounded=_bounded(guess))
    except UserError:  # One class only, or a slope that is not positive: such a study demonstrates nothing.
        return float("inf")
    return bound(fit, pod, confidence, method).value


def _bounded(guess: PodCurve) -> Between:
    if guess.floor > 0:
        return "both" if guess.ceiling < 1 else "floor"
    return "ceiling" if guess.ceiling < 1 else "none"


def _plan(
    guess: PodCurve,
    sizes: np.ndarray,
    placement: Placement,
    bounds: np.ndarray,
    range_of_sizes: tuple[float, float],
    pod: float,
    confidence: float,
    method: str,
) -> Plan:
    # Order statistics, as there is no mean between a number and infinity.
    low, middle, high = np.quantile(bounds, [0.1, 0.5, 0.9], method="inverted_cdf")
    true_size, notes = guess.size_at(pod), []
    if len(sizes) < LEAST_TARGETS:
        notes.append(f"{len(sizes)} targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
    if not range_of_sizes[0] <= true_size <= range_of_sizes[1]:
        notes.append(f"the guess's size at POD {pod:g}, {true_size:.4g}, lies outside the range: it is extrapolated")
    return Plan(
        targets=len(sizes),
        placement=placement,
        pod=pod,
        confidence=confidence,
        method=method,
        studies=len(bounds),
        true_size=true_size,
        bound=float(middle),
        low=float(low),
        high=float(high),
        demonstrated=float(np.mean(np.isfinite(bounds))),
        sizes=sizes,
        notes=tuple(notes),
    )
