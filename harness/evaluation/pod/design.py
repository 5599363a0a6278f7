"""Plans of hit/miss studies, made before anybody drills a hole: studies are simulated from a guess of the POD curve and
analysed as real ones would be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import stats

from harness.evaluation.intervals import threshold_for_rate
from harness.evaluation.pod.curve import PodCurve, link_ppf
from harness.evaluation.pod.hit_miss import METHOD, bound, fit_hit_miss
from harness.evaluation.pod.statement import LEAST_TARGETS
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream

SPREAD_SHARE = 1 / 3
"""Share of a concentrated design's targets that is still spread over the whole range: insurance against the guess."""
RISE = (0.03, 0.97)
"""POD between which a curve counts as rising (MIL-HDBK-1823A: sizes should cover about that)."""
LEAST_SIGNALS = 40
"""MIL-HDBK-1823A: independent targets where signals are recorded (a-hat), at least."""
WORTH = 0.05
"""Concentrated sizes are recommended where they lower the 90 % quantile of the bound by more than this share: evenly
spread ones do not rest on the guess. The ratio's Monte Carlo error is 0.028 with 200 studies of 60 targets."""
CALLS = (0, 1, 2)
"""Numbers of false calls for which the area of an upper bound is told."""
Placement = Literal["uniform", "concentrated"]
PLACEMENTS: tuple[Placement, ...] = ("uniform", "concentrated")


@dataclass(frozen=True, eq=False)
class StudyPlan:
    """Expected outcome of studies, if the guess is right. ``bound``: median over simulated studies of a90/95, infinite
    where half of them demonstrate none; ``low``, ``high``: their 10 % and 90 % quantiles; ``true_size``: the guess's
    own; ``demonstrated``: share of studies with a finite bound; ``sizes`` (targets,) to make."""

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


def curve_through(a50: float, a90: float, link: str = "logit", *, log_size: bool = False) -> PodCurve:
    """The curve of ``link`` with POD 0.5 at ``a50`` and 0.9 at ``a90`` (any one unit); its covariance is zero.
    UserError where it would not rise, and for sizes that are not above 0."""
    if not (np.isfinite([a50, a90]).all() and 0 < a50 < a90):
        said = f"a50 {a50:g} and a90 {a90:g}: the chance of detection has to grow with size"
        raise UserError(said, legal="0 < a50 < a90", fix="a50 is found half the time, the larger a90 nine times of ten")
    start, end = np.log([a50, a90]) if log_size else (a50, a90)
    half, nine_tenths = link_ppf(link, np.array([0.5, 0.9]))
    sigma = float((end - start) / (nine_tenths - half))
    return PodCurve(link, log_size, float(start - sigma * half), sigma, np.zeros((2, 2)))


def design(
    guess: PodCurve,
    targets: Sequence[int],
    range_of_sizes: tuple[float, float],
    *,
    placements: Sequence[Placement] = PLACEMENTS,
    pod: float = 0.9,
    confidence: float = 0.95,
    studies: int = 200,
    seed: int = 0,
) -> tuple[StudyPlan, ...]:
    """Simulate one `StudyPlan` for each number of targets and placement, in that order; a study takes about 5 ms.
    Studies are analysed with the guess's link and axis. A study that found all or nothing, or whose POD does not grow
    with size, demonstrates nothing."""
    low, high = range_of_sizes
    true_size, plans = guess.size_at(pod), []
    for number in targets:
        for placement in placements:
            sizes = place_sizes(guess, number, range_of_sizes, placement)
            stream = random_stream(seed, "pod design", number, placement)
            bounds = np.full(studies, np.inf)
            for study, hits in enumerate(stream.random((studies, number)) < guess.pod(sizes)):
                try:
                    fit = fit_hit_miss(sizes, hits, link=guess.link, log_size=guess.log_size)
                except UserError:  # All or nothing found, or POD does not grow with size: nothing is demonstrated.
                    continue
                bounds[study] = bound(fit, pod, confidence).value
            notes = []
            if number < LEAST_TARGETS:
                notes.append(f"{number} targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
            if not low <= true_size <= high:
                size = f"the guess's size at POD {pod:g}, {true_size:.4g}"
                notes.append(f"{size}, lies outside the range: it is extrapolated")
            # Order statistics, as there is no mean between a number and infinity.
            least, median, most = np.quantile(bounds, [0.1, 0.5, 0.9], method="inverted_cdf").tolist()
            shown, told = float(np.mean(np.isfinite(bounds))), (number, placement, pod, confidence, METHOD, studies)
            plans.append(StudyPlan(*told, true_size, median, least, most, shown, sizes, tuple(notes)))
    return tuple(plans)


def place_sizes(guess: PodCurve, number: int, range_of_sizes: tuple[float, float], placement: Placement) -> np.ndarray:
    """Ascending sizes (number,), evenly spaced on the Cartesian scale over the range ("uniform"), or `SPREAD_SHARE` of
    them so and the rest evenly where the guess rises through `RISE`, cut to the range ("concentrated")."""

    def evenly(n: int, start: float, end: float) -> np.ndarray:
        """Midpoints of equal parts: no target wasted on the very ends."""
        return start + (end - start) * (np.arange(n) + 0.5) / max(n, 1)

    low, high = range_of_sizes
    if placement == "uniform":
        return evenly(number, low, high)
    rise = [guess.size_at(share) for share in RISE]
    start, end = np.clip(rise, low, high).tolist()
    if not start < end:
        legal = f"a range that meets {rise[0]:.4g} to {rise[1]:.4g}"
        raise UserError(f"the guessed curve does not rise between sizes {low:g} and {high:g}", legal=legal)
    spread = round(number * SPREAD_SHARE)
    return np.sort(np.concatenate([evenly(spread, low, high), evenly(number - spread, start, end)]))


@dataclass(frozen=True)
class Recommendation:
    """The ``plan`` to take. ``enough``: it has the handbook's number of targets. ``reaches``: nine of ten of its
    studies demonstrate the wanted size, None where none was wanted; where it is False no plan does."""

    plan: StudyPlan
    enough: bool
    reaches: bool | None


def recommend(plans: Sequence[StudyPlan], goal: float | None = None) -> Recommendation:
    """Choose the plan with the fewest targets, `LEAST_TARGETS` or more if any plan has them, of whose studies nine of
    ten demonstrate ``goal`` (None: no wish); the most targets where none do. Evenly spread, unless concentrating is
    `WORTH` it."""
    enough = [plan for plan in plans if plan.targets >= LEAST_TARGETS]
    # Below the handbook's minimum the most targets are nearest to it.
    allowed = enough or [plan for plan in plans if plan.targets == max(one.targets for one in plans)]
    reaching = [plan for plan in allowed if goal is None or plan.high <= goal]
    pool = reaching or allowed
    number = (min if reaching else max)(plan.targets for plan in pool)
    by_placement = {plan.placement: plan for plan in pool if plan.targets == number}
    plan, close = (by_placement.get(placement) or next(iter(by_placement.values())) for placement in PLACEMENTS)
    if close.high < (1 - WORTH) * plan.high:
        plan = close
    return Recommendation(plan, bool(enough), None if goal is None else bool(reaching))


@dataclass(frozen=True)
class HoleFree:
    """Hole-free boards for a rate of false calls. ``calibration_boards``: the fewest that give a threshold, with
    ``expected_per_m2`` on average and at most ``upper_per_m2`` with ``confidence``. ``areas_m2``: for each of `CALLS`
    false calls the area on which no more of them bound the rate by the wanted one."""

    rate_per_m2: float
    board_m2: float
    confidence: float
    calibration_boards: int
    expected_per_m2: float
    upper_per_m2: float
    areas_m2: tuple[float, ...]

    def boards(self, area_m2: float) -> int:
        """Number of boards that have this area."""
        return int(np.ceil(area_m2 / self.board_m2 * (1 - 1e-12)))


def hole_free(rate_per_m2: float, board_m2: float, confidence: float = 0.95) -> HoleFree:
    """State how much hole-free area has to be inspected, by the rule of `threshold_for_rate` and by Poisson's law."""
    if not (np.isfinite([rate_per_m2, board_m2]).all() and rate_per_m2 > 0 and board_m2 > 0):
        raise UserError(f"{rate_per_m2:g} false calls per m2 on boards of {board_m2:g} m2", legal="both above 0")
    calling = -float(np.expm1(-rate_per_m2 * board_m2))
    fewest = max(int(np.ceil(1 / calling * (1 - 1e-12))) - 1, 1)
    # Any distinct scores: what the rule says of its rates does not depend on them.
    threshold = threshold_for_rate(np.arange(float(fewest)), board_m2, rate_per_m2, confidence)
    areas = tuple(float(stats.chi2.ppf(confidence, 2 * (calls + 1)) / 2 / rate_per_m2) for calls in CALLS)
    rates = threshold.rate_per_m2, threshold.upper_per_m2
    return HoleFree(rate_per_m2, board_m2, confidence, fewest, *rates, areas)
