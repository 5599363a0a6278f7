"""The ideal observer against brute force: dense matrices, densities of the normal distribution,
drawn fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
from scipy import ndimage, special, stats

from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.programs.efficiency import ideal_observer as ideal
from harness.programs.efficiency.ideal_observer import LAGS, LONGEST_LAG_PX, IdealDamages, NoiseSums
from harness.programs.efficiency.statistics import efficiency_of, expected_sizes, warnings_of
from harness.vocabulary.seeds import random_stream
from tests.support.synthetic_study import study_record

SIDE = 13
KINDS = {"white": (0.0, 1.0), "correlated": (2.0, 0.05)}
"""Length of a Gaussian autocorrelation in pixels, and the share of white noise."""


def rng(*labels: str | int) -> np.random.Generator:
    return random_stream(5, "ideal observer", *labels)


def noise_of(kind: str) -> NoiseSums:
    """Return sums whose autocovariance is the given one under Parzen's window."""
    length, white = KINDS[kind]
    separation = np.hypot(LAGS[:, None], LAGS)
    smooth = np.exp(-(separation**2) / (2 * length**2)) if length else np.zeros(separation.shape)
    return NoiseSums(
        (1 - white) * smooth + white * (separation == 0), np.ones(separation.shape), 3.0, 1.0
    )


def dense(sums: NoiseSums, known: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of the known pixels."""
    index = np.argwhere(known)
    lags = index[:, None] - index[None] + LONGEST_LAG_PX
    return np.asarray(sums.autocovariance[lags[..., 0], lags[..., 1]])


def fields(sums: NoiseSums, count: int, side: int) -> np.ndarray:
    """Draw periodic fields (count, side, side) of this covariance."""
    white = rng("fields", count, side).standard_normal((count, side, side))
    return np.asarray(
        scipy.fft.irfft2(scipy.fft.rfft2(white) * np.sqrt(sums.power((side, side))), (side, side))
    )


@pytest.mark.parametrize("kind", KINDS)
def test_random_templates_have_the_index_and_the_likelihood_of_brute_force(kind: str) -> None:
    sums = noise_of(kind)
    reference = rng(kind, "holes").random((SIDE, SIDE)) > 0.2
    covariance = dense(sums, reference)
    v = np.linspace(-1, 1, SIDE)
    surface = np.stack([np.ones((SIDE, SIDE)), *np.meshgrid(v, v)])
    signals = rng(kind, "signals").standard_normal((3, SIDE, SIDE))
    result = ideal.detectability(signals * reference, surface * reference, reference, sums)
    s = signals[:, reference].T
    b = surface[:, reference].T
    inverse = np.linalg.inv(covariance)
    k = inverse - inverse @ b @ np.linalg.solve(b.T @ inverse @ b, b.T @ inverse)
    assert result == pytest.approx(np.sqrt(np.diag(s.T @ k @ s)), rel=1e-4)
    # without a surface the statistic is the ratio of the two densities
    observed = rng(kind, "seen").standard_normal((SIDE, SIDE)) * reference
    whitened = ideal.inverse_times(np.stack([observed, signals[0] * reference]), reference, sums)
    normal = stats.multivariate_normal(cov=covariance)
    ratio = normal.logpdf(observed[reference] - s[:, 0]) - normal.logpdf(observed[reference])
    square = float((whitened[1] * signals[0]).sum())
    assert float((whitened[0] * signals[0]).sum()) - square / 2 == pytest.approx(ratio, rel=1e-3)
    assert not whitened[:, ~reference].any()


def test_the_covariance_is_found_in_drawn_noise_with_missing_pixels() -> None:
    sums = noise_of("correlated")
    drawn = fields(sums, 40, 160)
    reference = rng("missing").random(drawn.shape) > 0.3
    result = ideal.noise_sums(drawn, reference)
    nearby = slice(LONGEST_LAG_PX - 6, LONGEST_LAG_PX + 7)
    # a million pixels in patches of 4 pi 2^2: 0.5 % of the variance
    assert result.autocovariance[nearby, nearby] == pytest.approx(
        sums.autocovariance[nearby, nearby], abs=0.025
    )
    assert result.kurtosis == pytest.approx(0.0, abs=0.1)
    part = ideal.noise_sums(drawn[:10], reference[:10])
    assert (result - part).pixels == reference[10:].sum()


@pytest.mark.parametrize("kind", KINDS)
def test_maxima_are_as_many_as_in_drawn_fields(kind: str) -> None:
    sums = noise_of(kind)
    thresholds = np.array([2.0, 2.5, 3.0])
    drawn = fields(sums, 20, 256)
    peaks = drawn[drawn == ndimage.maximum_filter(drawn, (0, 3, 3), mode="wrap")]
    counted = (peaks[:, None] > thresholds).sum(axis=0)
    expected = ideal.maxima_per_pixel(sums.autocovariance, thresholds) * drawn.size
    # five standard errors of the count, and the error of the integration
    assert np.all(np.abs(counted - expected) < 5 * np.sqrt(expected) + 0.03 * expected)
    wanted = ideal.maxima_per_pixel(sums.autocovariance, np.array([4.0]))[0]
    assert ideal.threshold_for(sums.autocovariance, wanted) == pytest.approx(4.0, abs=1e-3)


def test_detection_is_as_likely_as_in_drawn_fields() -> None:
    white = noise_of("white").autocovariance
    assert ideal.detection_probability(ideal.needed_indices(white, 4.6), 4.0) == pytest.approx(
        special.ndtr(-0.6), abs=1e-9
    )
    sums = noise_of("correlated")
    # patches of 19 pixels, a pixel and more apart
    drawn = (
        fields(sums, 60, 160)
        .reshape(60, 8, 20, 8, 20)
        .swapaxes(2, 3)
        .reshape(-1, 20, 20)[:, :19, :19]
    )
    nearby = slice(LONGEST_LAG_PX - 9, LONGEST_LAG_PX + 10)
    needed = ideal.needed_indices(sums.autocovariance, 4.0)
    for index in (3.0, 4.5):
        share = float(
            ((drawn + index * sums.autocovariance[nearby, nearby]).max(axis=(1, 2)) > 4.0).mean()
        )
        result = ideal.detection_probability(needed, index)
        assert result == pytest.approx(share, abs=5 * np.sqrt(0.25 / len(drawn)))
        assert result > special.ndtr(index - 4.0)  # more than at the damage's own place alone
        assert ideal.index_for(needed, result) == pytest.approx(index)


# ---------------------------------------------------------------- efficiency


def judged(share: float) -> tuple[SetUpLimit, IdealDamages]:
    """Return the limit of a linear detector with this efficiency, and the ideal observer on its
    damages."""
    record = study_record().set_ups[0]
    inspected = record.inspected
    index = (inspected.diameter_mm / 3.0) ** 3
    pod = special.ndtr(index - 4.5)
    hit = rng("hits").random(len(index)) < special.ndtr(np.sqrt(share) * index - 4.5)
    inspected = replace(inspected, hit=hit, by_depth=None, by_no_return=None)
    needed = np.full((2, len(index)), [[4.5], [4.5 + special.ndtri(0.9)]])
    ideal_damages = IdealDamages(
        inspected.board, inspected.hole, index, np.full(len(index), 4.5), pod, needed, 200, 0.0, 0.0
    )
    return limit_of(replace(record, inspected=inspected)), ideal_damages


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_efficiency_of_a_linear_detector_is_found(share: float) -> None:
    efficiency = efficiency_of(*judged(share))
    for level in (efficiency.half, efficiency.most):
        assert level.interval.low < share < level.interval.high
        assert level.efficiency == pytest.approx(share, rel=0.15)
    # d' = 4.5; the probit curve of ln a is not quite the true one, of a cubed
    assert efficiency.half.ideal_mm == pytest.approx(3.0 * 4.5 ** (1 / 3), rel=0.02)
    assert not warnings_of([efficiency])


def test_everything_missed_has_no_efficiency_and_says_so() -> None:
    limit, reference = judged(1.0)
    observed = replace(limit.record.inspected, hit=np.zeros(len(reference.index), bool))
    efficiency = efficiency_of(
        limit_of(replace(limit.record, inspected=observed)),
        replace(reference, kurtosis=4.0, lost=0.2),
    )
    assert np.isnan(efficiency.half.efficiency) and not efficiency.half.interval.known
    warnings = warnings_of([efficiency])
    assert [
        word in text
        for word, text in zip(("tails", "return nothing", "not known"), warnings, strict=True)
    ] == [True] * 3


def test_expected_sizes_of_hardly_any_hits_or_misses() -> None:
    x = np.array([1.0, 2.0, 3.0])
    weights = np.ones((1, 3))
    assert np.isinf(expected_sizes(x, np.full(3, 0.01), weights)).all()
    assert expected_sizes(x, np.full(3, 0.99), weights)[:, 0].tolist() == [1.0, 1.0]


def test_a_detector_that_finds_half_at_no_damage_inspected_has_no_efficiency() -> None:
    limit, reference = judged(1.0)
    strong = reference.index > 12.0
    inspected = limit.record.inspected
    subset = replace(
        inspected,
        **{
            name: column[strong]
            for name, column in vars(inspected).items()
            if isinstance(column, np.ndarray)
        },
    )
    efficiency = efficiency_of(limit_of(replace(limit.record, inspected=subset)), reference)
    assert np.isnan(efficiency.half.efficiency) and efficiency.half.at_most and efficiency.why
