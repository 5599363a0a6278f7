"""Plans hit/miss studies: it simulates them from a guess of the POD curve and analyses them like
real ones."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from harness.evaluation.intervals import threshold_for_rate
from harness.evaluation.pod.averaged import ModelAverage
from harness.evaluation.pod.curve import PodCurve, link_ppf
from harness.evaluation.pod.hit_miss import choose_model, near_models
from harness.evaluation.pod.statement import LEAST_TARGETS, POD
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream


@dataclass(frozen=True, eq=False)
class StudyPlan:
    """Expected outcome of studies, if the guess is right."""

    targets: int
    studies: int
    """Number of simulated studies."""
    true_size: float
    """The guess's a90."""
    bound: float
    """Median a90/95 of the studies; infinite if half of them demonstrate none."""
    low: float
    """10 % quantile of a90/95."""
    high: float
    """90 % quantile of a90/95."""
    demonstrated: float
    """Share of studies with a finite bound."""
    sizes: np.ndarray
    """Sizes (targets,) to make."""


def curve_through(
    a50: float, a90: float, link: str = "logit", *, log_size: bool = False
) -> PodCurve:
    """Return the curve of ``link`` with POD 0.5 at ``a50`` and 0.9 at ``a90`` (same unit); its
    covariance is zero. Raises UserError if it would not rise, or if a size is not above 0."""
    if not (np.isfinite([a50, a90]).all() and 0 < a50 < a90):
        problem = f"a50 {a50:g} and a90 {a90:g}: the probability of detection must grow with size"
        raise UserError(
            problem,
            legal="0 < a50 < a90",
            fix="a50 is found 50 % of the time and a90 90 %, so a90 is larger",
        )
    start, end = np.log([a50, a90]) if log_size else (a50, a90)
    half, nine_tenths = link_ppf(link, np.array([0.5, 0.9]))
    sigma = float((end - start) / (nine_tenths - half))
    return PodCurve(link, log_size, float(start - sigma * half), sigma, np.zeros((2, 2)))


def even_sizes(number: int, range_of_sizes: tuple[float, float]) -> np.ndarray:
    """Return ascending sizes (number,): midpoints of equal parts of the range, so that no target
    lies at its ends."""
    low, high = range_of_sizes
    return low + (high - low) * (np.arange(number) + 0.5) / number


def design(
    guess: PodCurve,
    targets: Sequence[int],
    range_of_sizes: tuple[float, float],
    *,
    studies: int = 100,
    seed: int = 0,
) -> tuple[StudyPlan, ...]:
    """Simulate a `StudyPlan` of evenly spread sizes for each number of targets, analysed as real
    studies are, by the average over all models that fit about equally well. A study in which all
    or no targets are found, or whose POD does not grow with size, demonstrates nothing."""
    plans = []
    for number in targets:
        sizes = even_sizes(number, range_of_sizes)
        bounds = np.full(studies, np.inf)
        stream = random_stream(seed, "pod design", number, "uniform")
        for study, hits in enumerate(stream.random((studies, number)) < guess.pod(sizes)):
            try:
                fits = choose_model(sizes, hits)
            except UserError:
                continue  # no limit: all or no targets are found, or POD does not grow with size
            bounds[study] = ModelAverage(near_models(fits)).bound(POD).value
        # order statistics, because a number and infinity have no mean
        low, median, high = np.quantile(bounds, [0.1, 0.5, 0.9], method="inverted_cdf").tolist()
        plan = StudyPlan(
            targets=number,
            studies=studies,
            true_size=guess.size_at(POD),
            bound=median,
            low=low,
            high=high,
            demonstrated=float(np.mean(np.isfinite(bounds))),
            sizes=sizes,
        )
        plans.append(plan)
    return tuple(plans)


def recommend(
    plans: Sequence[StudyPlan], goal: float | None = None
) -> tuple[StudyPlan, bool | None]:
    """Return the plan with the fewest targets, at least `LEAST_TARGETS` if any plan has them, in
    which 90 % of the studies demonstrate ``goal``, and True; else the plan with the most targets,
    and False. No goal: (fewest, None)."""
    most_targets = max(plan.targets for plan in plans)
    # below the handbook's minimum, the largest number of targets is nearest to it
    least = min(LEAST_TARGETS, most_targets)
    allowed = [plan for plan in plans if plan.targets >= least]
    allowed.sort(key=lambda plan: plan.targets)
    if goal is None:
        return allowed[0], None
    for plan in allowed:
        if plan.high <= goal:
            return plan, True
    return allowed[-1], False


@dataclass(frozen=True)
class HoleFree:
    """Hole-free boards needed for a rate of false calls."""

    rate_per_m2: float
    """The wanted rate."""
    board_m2: float
    """Face of a board."""
    confidence: float
    calibration_boards: int
    """Fewest boards that give a threshold."""
    expected_per_m2: float
    """Mean rate at that threshold."""
    upper_per_m2: float
    """Upper bound of the rate at that threshold, with ``confidence``."""
    silent_m2: float
    """Area of other boards that must be free of false calls to show the wanted rate."""
    silent_boards: int
    """Number of these boards."""


def hole_free(rate_per_m2: float, board_m2: float, confidence: float = 0.95) -> HoleFree:
    """Return the hole-free area that must be inspected, by the rule of `threshold_for_rate` and by
    Poisson's law."""
    if not (np.isfinite([rate_per_m2, board_m2]).all() and rate_per_m2 > 0 and board_m2 > 0):
        raise UserError(
            f"{rate_per_m2:g} false calls per m2 on boards of {board_m2:g} m2", legal="both above 0"
        )
    calling = -float(np.expm1(-rate_per_m2 * board_m2))
    fewest = max(int(np.ceil(1 / calling * (1 - 1e-12))) - 1, 1)
    # any distinct scores give the same rates
    threshold = threshold_for_rate(np.arange(float(fewest)), board_m2, rate_per_m2, confidence)
    area_m2 = float(stats.chi2.ppf(confidence, 2) / 2 / rate_per_m2)
    return HoleFree(
        rate_per_m2=rate_per_m2,
        board_m2=board_m2,
        confidence=confidence,
        calibration_boards=fewest,
        expected_per_m2=threshold.rate_per_m2,
        upper_per_m2=threshold.upper_per_m2,
        silent_m2=area_m2,
        silent_boards=int(np.ceil(area_m2 / board_m2 * (1 - 1e-12))),
    )
