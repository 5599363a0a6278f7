"""What repeats of a few targets are worth, by simulation: the limit that counts targets, and the one that counts rows.

Whether a target is found depends on its size and on luck, and luck is in part the target's own (its place, its edges,
the pixels that fall on it), which a repeat does not draw again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.design import place_sizes, repeats_are_not_targets
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream

SHARES = (0.0, 0.5, 1.0)
"""Shares of the variance of luck that are the target's own: none (then, and only then, rows are as good as targets),
half, all (then a repeat tells nothing new). A study with repeats shows its own; a guess cannot."""


@dataclass(frozen=True)
class RepeatedStudies:
    """``studies`` simulated studies, each of ``repeats`` inspections of ``targets`` targets of ``sizes`` (targets,).

    ``share``: of the variance of luck, the target's own. ``right``, ``wrong``: medians of the upper bound that counts
    targets and of the one that counts rows, infinite where half of the studies demonstrate none; ``*_demonstrated``:
    share of studies with a finite one; ``*_too_small``: share whose bound is below ``true_size``, which has to be no
    more than 1 - confidence. ``text``: the first study that has a curve, in words; empty where none has.
    """

    share: float
    targets: int
    repeats: int
    studies: int
    true_size: float
    sizes: np.ndarray
    right: float
    wrong: float
    right_demonstrated: float
    wrong_demonstrated: float
    right_too_small: float
    wrong_too_small: float
    text: str


def repeated_studies(
    guess: PodCurve,
    targets: int,
    repeats: int,
    range_of_sizes: tuple[float, float],
    *,
    shares: Sequence[float] = SHARES,
    pod: float = 0.9,
    confidence: float = 0.95,
    studies: int = 200,
    seed: int = 0,
) -> tuple[RepeatedStudies, ...]:
    """One row for each of ``shares``; sizes evenly spread. Any single inspection is found with the guess's POD at any
    share (luck is a normal copula). A study without a rising curve demonstrates nothing. Bounds by likelihood ratio."""
    if targets < 2 or repeats < 2:
        raise UserError(f"{repeats} repeats of {targets} targets", legal="two repeats of two targets at least")
    sizes = place_sizes(guess, targets, range_of_sizes, "uniform")
    return tuple(_studies_of(guess, sizes, repeats, share, pod, confidence, studies, seed) for share in shares)


def _studies_of(
    guess: PodCurve,
    sizes: np.ndarray,
    repeats: int,
    share: float,
    pod: float,
    confidence: float,
    studies: int,
    seed: int,
) -> RepeatedStudies:
    targets, true_size = len(sizes), guess.size_at(pod)
    stream = random_stream(seed, "repeats", targets, repeats)
    right, wrong, texts = np.full(studies, np.inf), np.full(studies, np.inf), []
    for study in range(studies):
        own, of_noise = stream.standard_normal((targets, 1)), stream.standard_normal((targets, repeats))
        luck = stats.norm.cdf(np.sqrt(share) * own + np.sqrt(1 - share) * of_noise)
        hit = luck < guess.pod(sizes)[:, None]
        try:
            check = repeats_are_not_targets(
                np.repeat(sizes, repeats),
                hit.ravel(),
                np.repeat(np.arange(targets), repeats),
                link=guess.link,
                log_size=guess.log_size,
                pod=pod,
                confidence=confidence,
            )
        except UserError:  # One class only, or a slope that is not positive: such a study demonstrates nothing.
            continue
        right[study], wrong[study] = check.right.value, check.wrong.value
        texts.append(check.text)
    medians = [float(np.quantile(one, 0.5, method="inverted_cdf")) for one in (right, wrong)]
    return RepeatedStudies(
        share=share,
        targets=targets,
        repeats=repeats,
        studies=studies,
        true_size=true_size,
        sizes=sizes,
        right=medians[0],
        wrong=medians[1],
        right_demonstrated=float(np.mean(np.isfinite(right))),
        wrong_demonstrated=float(np.mean(np.isfinite(wrong))),
        right_too_small=float(np.mean(right < true_size)),
        wrong_too_small=float(np.mean(wrong < true_size)),
        text=texts[0] if texts else "",
    )
