"""The probability that a finding is a false call: noise, or at objects and print what they make of
the measured distance.

Findings behind the surface, in front of it, and at marks are compared with the false calls that
their law expects there (`detectors.findings.null`); missing returns have the law of chance
clusters (`detectors.findings.missing`). Each group is a Poisson process of scores s above the
threshold t: false calls with the density of their law, and real findings with the density
m a t^a / s^(a + 1). Their number m and steepness a are unknown; these and the laws that the peaks
allow are weighed by the likelihood of the group's scores. A finding's probability is the mean
share of false calls in the density at its score. It does not rise with the score.

Not modelled: noise that is asymmetric, so that peaks in front of the surface do not show what it
does behind; missing returns that print or an object's edge causes, which are no chance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import special

from detectors.findings.null import MARKS, PLAIN, RIM, behind, is_at_rim
from detectors.findings.objects import marks_of
from detectors.findings.tails import Tail
from detectors.interface import Detection, Evidence, MissingReturns
from harness.vocabulary.geometry import Cloud

LAWS = 200
"""Laws drawn from those that the peaks allow: the mean over them has an error of 7 % of their
scatter."""
STEEPNESS = np.array([0.5, 1.0, 2.0, 4.0, 8.0])
"""Exponents of the number of real findings above a score. With 0.5 half of them exceed four times
the threshold, with 8 only 1.09 times; noise at 5 deviations falls as with 25."""
FEWEST_REAL = 0.01  # lowest expected number of real findings
NUMBERS = 24  # of expected numbers of real findings, in equal ratios
NEGLIGIBLE = 1e-9  # weight of a number and steepness below which they are left out


def noise_probabilities(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
    missing: MissingReturns | None,
) -> tuple[float, ...]:
    """Return the probability of each detection to be a false call, 0 to 1.

    It is NaN for findings by depth if the capture did not set its own threshold: the notes of the
    evidence then hold no ``own_null`` with ``tails``. ``missing``: the missing returns of the
    cloud, with the chance of those among the detections."""
    probabilities = np.full(len(detections), np.nan)
    scores = np.array([detection.score for detection in detections])
    for group, numbers in _groups(cloud, evidence, detections).items():
        if group == "no return":
            assert missing is not None
            threshold, laws = chance_laws(missing)
            density = laws.densities(scores[numbers])
            expected = laws.expected(threshold)
        else:
            null = evidence.notes["own_null"]
            threshold = null["threshold"]
            zone = group.split(", ")[0]
            drawn = Tail.from_facts(null["tails"][zone]).laws(LAWS)
            density = drawn.densities(scores[numbers])
            expected = drawn.expected(threshold)
        probabilities[numbers] = share_of_noise(scores[numbers], threshold, density, expected)
    return tuple(probabilities.tolist())


def _groups(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
) -> dict[str, list[int]]:
    """Return the numbers of the detections that share a law and a side of the surface; those whose
    law is unknown are left out."""
    tails = evidence.notes.get("own_null", {}).get("tails", {})
    marks = marks_of(cloud, evidence) if MARKS in tails else None
    is_behind = behind(evidence).reshape(-1)
    scores = np.nan_to_num(evidence.score.reshape(-1))
    groups: dict[str, list[int]] = {}
    for number, detection in enumerate(detections):
        if detection.kind == "no return":
            groups.setdefault("no return", []).append(number)
            continue
        if not tails:
            continue
        peak = detection.pixels[np.argmax(scores[detection.pixels])]
        side = "behind" if is_behind[peak] else "in front"
        zone = PLAIN
        if marks is not None and detection.kind == "depth" and marks.hold(detection):
            zone = MARKS
        elif RIM in tails and is_at_rim(evidence, detection):
            zone = RIM
        groups.setdefault(f"{zone}, {side}", []).append(number)
    return groups


def share_of_noise(
    scores: np.ndarray,
    threshold: float,
    density: np.ndarray,
    expected: np.ndarray,
) -> np.ndarray:
    """Return the probability (n,) of each finding of one group to be a false call.

    Args:
        scores: (n,), above the threshold.
        threshold: units of score.
        density: (k, n), false calls per unit of score at each score, by each of k likely laws.
        expected: (k,), false calls above the threshold by each law."""
    most_real = 10.0 * (len(scores) + 1.0)
    numbers, steepness = np.meshgrid(np.geomspace(FEWEST_REAL, most_real, NUMBERS), STEEPNESS)
    numbers = numbers.ravel()
    steepness = steepness.ravel()
    # 1 / (sqrt(m) (1 + m)) per m: one in 16 expects fewer than 0.01 real findings, or more than 100
    log_priors = 0.5 * np.log(numbers) - np.log1p(numbers)
    real = numbers / threshold * steepness * (scores[:, None] / threshold) ** -(steepness + 1.0)
    logs = np.empty((len(numbers), len(expected)))
    for row in range(len(numbers)):
        log_total = np.log(density + real[:, row]).sum(axis=1)
        logs[row] = log_total - expected - numbers[row] + log_priors[row]
    weights = np.exp(logs - special.logsumexp(logs))
    probabilities = np.zeros(len(scores))
    for row in np.flatnonzero(weights.sum(axis=1) > NEGLIGIBLE).tolist():
        probabilities += weights[row] @ (density / (density + real[:, row]))
    # a stronger finding is not more likely noise
    falling = np.argsort(-scores, kind="stable")
    probabilities[falling] = np.maximum.accumulate(probabilities[falling])
    return np.clip(probabilities, 0.0, 1.0)


class ChanceLaws:
    """The law of clusters without return: their score is the normal deviation that is as rare as
    the number expected by chance, so this number is known."""

    def expected(self, threshold: float) -> np.ndarray:
        """Return the expected number (1,) of chance clusters above a score."""
        return np.array([special.ndtr(-threshold)])

    def densities(self, scores: np.ndarray) -> np.ndarray:
        """Return the expected number (1, n) per unit of score."""
        densities = np.exp(-0.5 * scores**2) / np.sqrt(2.0 * np.pi)
        return np.asarray(densities)[None, :]


def chance_laws(missing: MissingReturns) -> tuple[float, ChanceLaws]:
    """Return the lowest score of a finding without return, and the law of chance above it."""
    lowest = min((detection.score for detection in missing.detections), default=np.inf)
    threshold = -float(special.ndtri(min(max(missing.expected, 1e-300), 0.5)))
    return min(threshold, lowest), ChanceLaws()
