"""From a guess to a plan: the guessed curve, which of the simulated plans to take, and the hole-free area beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from harness.evaluation.pod.curve import LINKS, PodCurve, link_ppf
from harness.evaluation.pod.design import LEAST_TARGETS, Placement, Plan, design, guess_with_frames
from harness.evaluation.pod.false_calls import threshold_for_rate
from harness.vocabulary.errors import UserError

LEAST_SIGNALS = 40
"""MIL-HDBK-1823A: independent targets where signals are recorded (a-hat), at least."""
WORTH = 0.05
"""Concentrated sizes are recommended where they lower the 90 % quantile of the bound by more than this share: evenly
spread ones do not rest on the guess. The ratio's Monte Carlo error is 0.028 with 200 studies of 60 targets."""
CALLS = (0, 1, 2)
"""Numbers of false calls for which the area of an upper bound is told."""


def curve_through(a50: float, a90: float, link: str = "logit", *, log_size: bool = False) -> PodCurve:
    """The curve of ``link`` with POD 0.5 at ``a50`` and 0.9 at ``a90`` (any one unit); its covariance is zero.

    UserError where it would not rise, and for sizes that are not above 0.
    """
    if link not in LINKS:
        raise UserError(f"link {link!r} is not known", legal=", ".join(LINKS))
    if not (np.isfinite([a50, a90]).all() and 0 < a50 < a90):
        raise UserError(
            f"a50 {a50:g} and a90 {a90:g}: the chance of detection has to grow with size",
            legal="0 < a50 < a90",
            fix="a50 is found half the time, the larger a90 nine times of ten",
        )
    start, end = np.log([a50, a90]) if log_size else (a50, a90)
    half, nine_tenths = link_ppf(link, np.array([0.5, 0.9]))
    sigma = float((end - start) / (nine_tenths - half))
    return PodCurve(link, log_size, float(start - sigma * half), sigma, np.zeros((2, 2)))


@dataclass(frozen=True)
class Recommendation:
    """The ``plan`` to take. ``enough``: it has the handbook's number of targets. ``reaches``: nine of ten of its
    studies demonstrate the wanted size, None where none was wanted; where it is False no plan does."""

    plan: Plan
    enough: bool
    reaches: bool | None


def recommend(plans: Sequence[Plan], goal: float | None = None) -> Recommendation:
    """The fewest targets, `LEAST_TARGETS` or more if any plan has them, of whose studies nine of ten demonstrate
    ``goal`` (None: no wish); the most targets where none do. Evenly spread, unless concentrating is `WORTH` it."""
    enough = [plan for plan in plans if plan.targets >= LEAST_TARGETS]
    # Below the handbook's minimum the most targets are nearest to it.
    allowed = enough or [plan for plan in plans if plan.targets == max(one.targets for one in plans)]
    reaching = [plan for plan in allowed if goal is None or plan.high <= goal]
    pool = reaching or allowed
    number = (min if reaching else max)(plan.targets for plan in pool)
    plan = _better([plan for plan in pool if plan.targets == number])
    return Recommendation(plan, bool(enough), None if goal is None else bool(reaching))


def _better(plans: Sequence[Plan]) -> Plan:
    """Of plans with one number of targets."""
    by_placement: dict[Placement, Plan] = {plan.placement: plan for plan in plans}
    even, close = by_placement.get("uniform"), by_placement.get("concentrated")
    if even is None or close is None:
        return plans[0]
    return close if close.high < (1 - WORTH) * even.high else even


def fixed_share(white: float, fixed: float, frames: int) -> float:
    """Share of the variance of the average of ``frames`` that more frames do not lessen. ``white``, ``fixed``: standard
    deviations, in one unit, of one frame's noise that averages out and of the error that is in every frame."""
    if not (np.isfinite([white, fixed]).all() and min(white, fixed) >= 0 and max(white, fixed) > 0):
        raise UserError(f"white noise {white:g}, fixed noise {fixed:g}", legal="0 or more, not both 0")
    if frames < 1:
        raise UserError(f"guessed with {frames} frames", legal="one frame at least")
    return float(fixed**2 / (white**2 / frames + fixed**2))


@dataclass(frozen=True, eq=False)
class FramesPlan:
    """The guess for another number of averaged ``frames``, and what one study would demonstrate with them."""

    frames: int
    curve: PodCurve
    plan: Plan


def plans_by_frames(
    guess: PodCurve,
    frames: Sequence[int],
    *,
    guessed_with: int,
    fixed_share: float,
    targets: int,
    range_of_sizes: tuple[float, float],
    pod: float,
    confidence: float,
    studies: int,
    seed: int,
) -> tuple[FramesPlan, ...]:
    """The guess carried to each of ``frames`` by `guess_with_frames`, on the same evenly spread targets and with the
    same luck. UserErrors as of those two."""
    out = []
    for number in frames:
        curve = guess_with_frames(guess, number, guessed_with=guessed_with, fixed_share=fixed_share)
        (plan,) = design(
            curve,
            (targets,),
            range_of_sizes,
            placements=("uniform",),
            pod=pod,
            confidence=confidence,
            studies=studies,
            seed=seed,
        )
        out.append(FramesPlan(number, curve, plan))
    return tuple(out)


@dataclass(frozen=True)
class HoleFree:
    """Hole-free boards of ``board_m2`` for ``rate_per_m2`` false calls.

    ``calibration_boards``: the fewest from which a threshold can be had; such a threshold gives ``expected_per_m2`` on
    average, and no more than ``upper_per_m2`` with ``confidence``. ``areas_m2``: for each of `CALLS` false calls the
    area, on other boards, on which no more of them bound the rate by the wanted one, with the same confidence.
    """

    rate_per_m2: float
    board_m2: float
    confidence: float
    calibration_boards: int
    expected_per_m2: float
    upper_per_m2: float
    areas_m2: tuple[float, ...]

    def boards(self, area_m2: float) -> int:
        """Boards that have this area."""
        return int(np.ceil(area_m2 / self.board_m2 * (1 - 1e-12)))


def hole_free(rate_per_m2: float, board_m2: float, confidence: float = 0.95) -> HoleFree:
    """How much has to be inspected where nothing is, by the rule of `threshold_for_rate` and by Poisson's law."""
    if not (np.isfinite([rate_per_m2, board_m2]).all() and rate_per_m2 > 0 and board_m2 > 0):
        raise UserError(f"{rate_per_m2:g} false calls per m2 on boards of {board_m2:g} m2", legal="both above 0")
    calling = -float(np.expm1(-rate_per_m2 * board_m2))
    fewest = max(int(np.ceil(1 / calling * (1 - 1e-12))) - 1, 1)
    # Any distinct scores: what the rule says of its rates does not depend on them.
    threshold = threshold_for_rate(np.arange(float(fewest)), board_m2, rate_per_m2, confidence)
    return HoleFree(
        rate_per_m2=rate_per_m2,
        board_m2=board_m2,
        confidence=confidence,
        calibration_boards=fewest,
        expected_per_m2=threshold.rate_per_m2,
        upper_per_m2=threshold.upper_per_m2,
        areas_m2=tuple(float(stats.chi2.ppf(confidence, 2 * (calls + 1)) / 2 / rate_per_m2) for calls in CALLS),
    )
