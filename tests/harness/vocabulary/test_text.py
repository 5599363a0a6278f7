"""Numbers and words as tables, pages and sentences write them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from harness.vocabulary.text import (
    UNKNOWN_TEXT,
    interval,
    joined_words,
    many,
    mm,
    p_value,
    percent,
    plain,
    plus_minus,
    size,
    unbroken,
    with_interval,
)


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0004, "< 0.1"),
        (0.0006, "0.1"),
        (0.005, "0.5"),
        (0.01, "1"),
        (0.934, "93"),
        (0.99, "99"),
        (0.9962, "99.6"),
        (0.9994, "99.9"),
        (0.9996, "> 99.9"),
        (math.nan, UNKNOWN_TEXT),
    ],
)
def test_a_share_in_percent_is_never_impossible_or_certain(share: float, text: str) -> None:
    assert percent(share) == text


@pytest.mark.parametrize(
    ("value_mm", "largest_mm", "text"),
    [
        (0.5, math.inf, "0.50"),
        (5.314, math.inf, "5.3"),
        (99.4, math.inf, "99"),
        (99.6, math.inf, "99.6"),
        (150.4, math.inf, "150"),
        (15.9, 15.9, "16"),
        (16.0, 15.9, ">\u00a015.9"),
        (math.inf, math.inf, "∞"),
        (math.nan, 15.9, "none"),
    ],
)
def test_a_limit_has_two_digits_and_none_beyond_what_was_inspected(
    value_mm: float, largest_mm: float, text: str
) -> None:
    assert size(value_mm, largest_mm) == text


@pytest.mark.parametrize(
    ("p", "text"),
    [(0.00009, "< 0.0001"), (0.0001, "0.0001"), (0.0314, "0.031"), (math.nan, UNKNOWN_TEXT)],
)
def test_a_p_value_has_two_digits(p: float, text: str) -> None:
    assert p_value(p) == text


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        # an interval of more than a tenth of the value leaves two digits
        ((5.12, 4.8, 5.6), "5.1 (4.8 to 5.6)"),
        ((5.12, 5.0, 5.2), "5.12 (5.00 to 5.20)"),
        ((123.4, 100.0, 150.0), "123 (100 to 150)"),
        ((0.0123, 0.001, 0.02), "0.01 (0.00 to 0.02)"),
        # of no value, the upper end counts
        ((0.0, 0.0, 3.69), "0.0 (0.0 to 3.7)"),
        ((5.12, math.nan, 5.6), "5.12"),
    ],
)
def test_an_estimate_has_as_many_digits_as_its_interval_leaves(
    numbers: tuple[float, float, float], text: str
) -> None:
    assert with_interval(*numbers) == text


def test_ends_beyond_what_was_inspected_are_no_numbers() -> None:
    assert interval(4.8, 17.0, largest=15.9) == "4.80 to >\u00a015.9"
    assert interval(4.8, math.nan) == "unknown"
    assert with_interval(17.0, 16.5, 18.0, largest=15.9) == ">\u00a015.9"


def test_a_mean_with_its_deviation() -> None:
    assert plus_minus(3.2, 0.1) == "3.20\u00a0±\u00a00.10"
    assert plus_minus(-1.5, math.nan) == "−1.50"
    assert plus_minus(1.5, math.nan, sign="+") == "+1.50"
    assert plus_minus(math.nan, 0.1) == UNKNOWN_TEXT


def test_plain_values_and_millimetres() -> None:
    assert [plain(value) for value in (None, math.nan, True, 3, 3.14159)] == [
        UNKNOWN_TEXT,
        UNKNOWN_TEXT,
        "yes",
        "3",
        "3.14",
    ]
    assert plain(np.bool_(False)) == "no"
    assert mm(1.005, 1) == "1.0"
    assert mm(math.inf) == UNKNOWN_TEXT


def test_words_are_joined_counted_and_kept_together() -> None:
    assert [joined_words(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == [
        "",
        "a",
        "a and b",
        "a, b and c",
    ]
    assert (many(1, "trial"), many(2, "trial")) == ("1 trial", "2 trials")
    assert unbroken("0.7 m, 50 frames and 3 1/2") == "0.7\u00a0m, 50\u00a0frames and 3 1/2"
