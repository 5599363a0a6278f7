"""Sums of noise, expected sizes and the efficiency of a detector, by hand and by brute force."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import special

from harness.evaluation.pod.hit_miss import fit_hit_miss
from harness.evaluation.study.limit import limit_of
from harness.programs.efficiency import ideal_trials
from harness.programs.efficiency.ideal_observer import (
    LONGEST_LAG_PX,
    IdealDamages,
    NoiseSums,
    noise_sums,
)
from harness.programs.efficiency.statistics import efficiency_of, expected_sizes, warnings_of
from tests.support.synthetic_study import Study, study_record

MIDDLE = LONGEST_LAG_PX
SIDE = 2 * LONGEST_LAG_PX + 1


# ---- noise


def test_the_autocovariance_is_under_parzens_window() -> None:
    """Equal products at all lags: the window alone, 1 - 6 f^2 (1 - f) up to half of the longest
    lag, and 2 (1 - f)^3 beyond."""
    sums = NoiseSums(np.full((SIDE, SIDE), 5.0), np.full((SIDE, SIDE), 2.0), 48.0, 4.0)
    window = sums.autocovariance
    assert window[MIDDLE, MIDDLE] == 1.0
    assert window[MIDDLE, MIDDLE + 18] == pytest.approx(1 - 6 * 0.25**2 * 0.75)
    assert window[MIDDLE - 36, MIDDLE] == pytest.approx(0.25)
    assert window[MIDDLE, MIDDLE + 54] == pytest.approx(2 * 0.25**3)
    # 43.2 and 57.6 lie 72 apart
    assert window[MIDDLE, 0] == 0.0
    assert window[0, 0] == 0.0
    assert window == pytest.approx(window[::-1, ::-1])
    unpaired = replace(sums, pairs=np.where(np.arange(SIDE) == MIDDLE + 18, 0.0, sums.pairs))
    expected = 2 * window[MIDDLE, MIDDLE + 18]
    assert unpaired.autocovariance[MIDDLE, MIDDLE + 18] == pytest.approx(expected)


def test_kurtosis_and_sums_of_sums_by_hand() -> None:
    """A variance of 8 / 4 and a fourth moment of 60 / 4: 15 / 4 - 3."""
    products = np.zeros((SIDE, SIDE))
    products[MIDDLE, MIDDLE] = 8.0
    sums = NoiseSums(products, np.ones((SIDE, SIDE)), 60.0, 4.0)
    assert sums.kurtosis == pytest.approx(0.75)
    twice = sums + replace(sums, fourth=1.0, pixels=2.0)
    assert twice.products[MIDDLE, MIDDLE] == 16.0
    assert twice.pairs[0, 0] == 2.0
    assert (twice.fourth, twice.pixels) == (61.0, 6.0)
    back = twice - sums
    assert back.products[MIDDLE, MIDDLE] == 8.0
    assert back.pairs[0, 0] == 1.0
    assert (back.fourth, back.pixels) == (1.0, 2.0)


def test_products_of_pairs_by_brute_force() -> None:
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((2, 7, 9))
    is_known = rng.random(noise.shape) < 0.7
    sums = noise_sums(noise, is_known)
    filled = np.where(is_known, noise, 0.0)
    for row, column in ((0, 0), (1, 0), (0, 3), (2, -4), (-6, 8)):
        product = pairs = 0.0
        for field in range(2):
            for v in range(7):
                for u in range(9):
                    if 0 <= v + row < 7 and 0 <= u + column < 9:
                        product += filled[field, v, u] * filled[field, v + row, u + column]
                        pairs += float(
                            is_known[field, v, u] and is_known[field, v + row, u + column]
                        )
        assert sums.products[MIDDLE + row, MIDDLE + column] == pytest.approx(product, abs=1e-9)
        assert sums.pairs[MIDDLE + row, MIDDLE + column] == pytest.approx(pairs, abs=1e-9)
    assert sums.products[MIDDLE + 7, MIDDLE] == pytest.approx(0.0, abs=1e-9)
    assert sums.fourth == pytest.approx((noise[is_known] ** 4).sum())
    assert sums.pixels == is_known.sum()


def test_the_deviation_is_that_of_units_around_each_pixel() -> None:
    """Noise of 2 in the left half and of 3 in the right; where nothing is known, the nearest."""
    noise = np.full((4, 200, 400), 2.0)
    noise[:, :, 200:] = 3.0
    noise[::2] *= -1
    is_known = np.ones(noise.shape, bool)
    is_known[:, :, :50] = False
    is_known[:2, :100] = False
    deviation = ideal_trials._deviation_m(np.where(is_known, noise, 0.0), is_known)
    assert deviation[:, 60:165] == pytest.approx(2.0)
    assert deviation[:, :20] == pytest.approx(2.0)
    assert deviation[:, 235:] == pytest.approx(3.0)
    # half of the square of 61 pixels on either side
    assert deviation[150, 200] == pytest.approx(np.sqrt((30 * 4 + 31 * 9) / 61))


# ---- sizes and efficiency


def test_expected_sizes_are_those_of_the_true_curve() -> None:
    """The likeliest curve of expected hits is the true one, whatever the weights."""
    x = np.linspace(1.0, 6.0, 40)
    pod = special.ndtr(np.log(x / 3.0) / 0.2)
    weights = np.stack([np.ones(40), np.random.default_rng(1).integers(1, 4, 40)])
    sizes = expected_sizes(x, pod, weights)
    assert sizes[0] == pytest.approx([3.0, 3.0], rel=1e-6)
    ninety = 3.0 * np.exp(0.2 * special.ndtri(0.9))
    assert sizes[1] == pytest.approx([ninety, ninety], rel=1e-6)


def test_half_a_hit_or_half_a_miss_is_no_curve() -> None:
    x = np.array([1.0, 2.0, 3.0, 4.0])
    weights = np.ones((1, 4))
    for total, has_curve in ((0.48, False), (0.52, True)):
        fewest = total * np.array([0.0, 0.1, 0.3, 0.6])
        assert np.isfinite(expected_sizes(x, fewest, weights)[0, 0]) == has_curve
        largest = 1 - fewest[::-1]
        smallest = expected_sizes(x, largest, weights)[:, 0]
        assert (smallest.tolist() == [1.0, 1.0]) == (not has_curve)


def judged(**changes: Any) -> tuple[Any, IdealDamages]:
    """Twenty boards inspected twice, and the ideal observer on their damages in another order,
    with one damage that was not inspected."""
    record = study_record(Study(boards=20, holes=6, repeats=2)).set_ups[0]
    inspected = record.inspected
    keys = list(dict.fromkeys(zip(inspected.board.tolist(), inspected.hole.tolist(), strict=True)))
    size_of = dict(
        zip(
            zip(inspected.board.tolist(), inspected.hole.tolist(), strict=True),
            inspected.diameter_mm.tolist(),
            strict=True,
        )
    )
    keys = [*keys[::-1], (99, "1")]
    size_mm = np.array([size_of.get(key, 5.0) for key in keys])
    index = (size_mm / 3.0) ** 3
    needed = np.stack([np.full(len(keys), 4.5), 5.0 + 0.01 * size_mm])
    facts: dict[str, Any] = {
        "board": np.array([board for board, _ in keys]),
        "hole": np.array([hole for _, hole in keys]),
        "index": index,
        "threshold": np.full(len(keys), 4.5),
        "pod": special.ndtr(index - 4.5),
        "needed": needed,
        "units": 200,
        "kurtosis": 0.0,
        "lost": 0.0,
        **changes,
    }
    by_depth = inspected.hit & (np.arange(len(inspected.hit)) % 7 != 0)
    inspected = replace(inspected, by_depth=by_depth, by_no_return=inspected.hit & ~by_depth)
    return limit_of(replace(record, inspected=inspected), draws=20), IdealDamages(**facts)


def test_an_efficiency_is_the_square_of_the_ratio_of_indices() -> None:
    """Hits by depth against d', inspections of one damage together; the ideal observer's d' is the
    mean over the damages that were inspected."""
    limit, ideal = judged()
    result = efficiency_of(limit, ideal)
    inspected = limit.record.inspected
    index = (inspected.diameter_mm / 3.0) ** 3
    names = [f"{board}:{hole}" for board, hole in zip(inspected.board, inspected.hole, strict=True)]
    fit = fit_hit_miss(
        np.maximum(index, 0.05), inspected.by_depth, link="probit", log_size=True, inspections=names
    )
    assert result.curve is not None
    for level, share in ((result.half, 0.5), (result.most, 0.9)):
        assert level.index == pytest.approx(fit.curve.size_at(share), rel=1e-6)
        expected = (level.ideal_index / level.index) ** 2
        assert level.efficiency == pytest.approx(expected)
        assert level.index_interval.low < level.index < level.index_interval.high
        assert level.interval.low < level.efficiency < level.interval.high
        assert not level.at_most
    assert result.half.ideal_index == pytest.approx(4.5)
    sizes = inspected.diameter_mm[::2]
    assert result.most.ideal_index == pytest.approx(5.0 + 0.01 * sizes.mean())
    # a d' of 4.5 is the same in all draws
    assert result.half.interval.low == pytest.approx((4.5 / result.half.index_interval.high) ** 2)
    assert len(result.hits) == 120
    assert result.inspections.tolist() == [2.0] * 120
    assert result.hits.sum() == inspected.by_depth.sum()
    # rows stand in the ideal observer's order, without the damage that was not inspected
    assert result.board.tolist() == ideal.board[:-1].tolist()
    assert result.index == pytest.approx((result.size_mm / 3.0) ** 3)
    assert result.why == ""


def test_the_least_index_stands_for_damage_that_cannot_be_seen() -> None:
    limit, ideal = judged()
    unseen = replace(ideal, index=np.where(ideal.index < 0.5, 0.0, ideal.index))
    least = replace(ideal, index=np.where(ideal.index < 0.5, 0.05, ideal.index))
    first = efficiency_of(limit, unseen)
    second = efficiency_of(limit, least)
    assert first.half.index == pytest.approx(second.half.index, rel=1e-9)
    assert first.index.min() == 0.0


def test_an_ideal_observer_that_misses_nothing_has_an_upper_bound() -> None:
    limit, ideal = judged()
    count = len(ideal.pod)
    for missed, at_most in ((0.4, True), (0.6, False)):
        pod = np.ones(count)
        pod[:4] = 1 - missed / 4
        pod[-1] = 0.0  # was not inspected
        result = efficiency_of(limit, replace(ideal, pod=pod))
        assert result.half.at_most == result.most.at_most == at_most


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"kurtosis": 1.0, "lost": 0.01}, []),
        ({"kurtosis": 1.01}, ["heavier tails"]),
        ({"lost": 0.011}, ["up to 1.1 % of the pixels"]),
    ],
)
def test_doubts_about_the_ideal_observer(changes: dict[str, float], words: list[str]) -> None:
    limit, ideal = judged(**changes)
    warnings = warnings_of([efficiency_of(limit, ideal)])
    assert len(warnings) == len(words)
    for warning, word in zip(warnings, words, strict=True):
        assert word in warning
