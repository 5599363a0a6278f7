"""What unknowns do to a90, on boards of known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.evaluation.intervals import percentiles
from harness.evaluation.study import unknowns
from harness.evaluation.study.record import read_record, record_text
from harness.evaluation.study.unknowns import over_unknowns
from tests.support.drawn_unknowns import (
    A50_MM,
    BACKING,
    BACKINGS,
    BLUR,
    BLUR_FACTOR,
    BLUR_PX,
    IDLE,
    WIDTH,
    drawn_set_up,
    true_a90_mm,
)
from tests.support.synthetic_study import study_record


@pytest.fixture(scope="module")
def many():
    """1,200 boards: estimates within 2 %."""
    return over_unknowns(drawn_set_up(boards=1200), draws=60)


def test_every_value_has_its_own_a90_and_its_own_slope(many):
    backing, blur, idle = many.effects
    assert [effect.unknown.key for effect in many.effects] == [BACKING, BLUR, IDLE]
    assert backing.levels == BACKINGS and blur.levels == BLUR_PX
    truth_mm = [true_a90_mm(number) for number in range(3)]
    assert backing.a90_mm == pytest.approx(truth_mm, rel=0.03)
    assert (backing.lowest_level, backing.highest_level) == (0, 1)
    assert backing.factor == pytest.approx(truth_mm[1] / truth_mm[0], rel=0.03)
    assert (blur.lowest_level, blur.highest_level) == (0, 1)
    assert blur.factor == pytest.approx(BLUR_FACTOR, rel=0.03)
    assert blur.a90_mm[1] / blur.a90_mm[0] == pytest.approx(BLUR_FACTOR, rel=0.03)
    assert idle.factor == pytest.approx(1.0, abs=0.03)
    assert [effect.beyond_chance for effect in many.effects] == [True, True, False]
    assert many.deciding == (backing, blur)


def test_the_others_are_at_their_average(many):
    """At the ends of the blur, ln a50 and ln of the width are the means over the backings."""
    middle = np.exp(np.log(A50_MM).mean() + np.log(9.0) * np.exp(np.log(WIDTH).mean()))
    expected_mm = middle * BLUR_FACTOR ** np.array([-0.5, 0.5])
    blur = many.effects[1]
    assert blur.a90_mm == pytest.approx(expected_mm, rel=0.03)


def test_the_range_is_that_of_the_unknowns_that_matter(many):
    assert many.lowest_mm == pytest.approx(true_a90_mm(0, BLUR_PX[0]), rel=0.03)
    assert many.highest_mm == pytest.approx(true_a90_mm(1, BLUR_PX[1]), rel=0.03)


def test_the_sign_of_an_effect_is_that_of_the_range(many):
    """An unknown that is counted backwards has its ends exchanged, and nothing else."""
    record = drawn_set_up(boards=1200)
    blur = record.drawn[1]
    turned = replace(blur, level=BLUR_PX[0] + BLUR_PX[1] - blur.level)
    again = over_unknowns(replace(record, drawn=(record.drawn[0], turned)), draws=20)
    by_key = {effect.unknown.key: effect for effect in again.effects}
    assert (by_key[BLUR].lowest_level, by_key[BLUR].highest_level) == (1, 0)
    assert by_key[BLUR].factor == pytest.approx(BLUR_FACTOR, rel=0.03)


def test_intervals_cover_the_truth():
    """36 boards, 40 studies: each interval of a backing holds its a90, and that of the blur its
    factor, in 85 to 98 % of them (binomial: 31 or more of 40)."""
    covered = np.zeros(4, int)
    beyond_chance = 0
    for seed in range(40):
        judged = over_unknowns(drawn_set_up(seed=seed), draws=150)
        by_key = {effect.unknown.key: effect for effect in judged.effects}
        for number, interval in enumerate(by_key[BACKING].intervals_mm):
            covered[number] += interval.low <= true_a90_mm(number) <= interval.high
        blur = by_key[BLUR]
        interval = blur.factor_interval
        factor = BLUR_FACTOR if blur.highest_level == 1 else 1 / BLUR_FACTOR
        covered[3] += interval.low <= factor <= interval.high
        beyond_chance += by_key[BACKING].beyond_chance
    assert covered.min() >= 31
    assert beyond_chance >= 36


def test_intervals_are_stretched_for_the_coefficients_that_the_boards_determine(monkeypatch):
    """36 boards with 18 coefficients: Student's t of 18 degrees, and half of the variance."""
    assert unknowns._stretch(36, 18) == pytest.approx(2.10092 / 1.95996 * np.sqrt(2.0), rel=1e-5)
    record = drawn_set_up()
    widths = []
    for stretch in (0.5, 1.0):
        monkeypatch.setattr(unknowns, "_stretch", lambda boards, coefficients, by=stretch: by)
        interval = over_unknowns(record, draws=100).effects[0].factor_interval
        widths.append(np.log(interval.high / interval.low))
    assert widths[1] / widths[0] == pytest.approx(2.0, rel=0.1)


def test_the_confidence_of_what_matters_allows_for_all_pairs_of_values(monkeypatch):
    """Three backings have three pairs, two ranges one each: 1 - 0.05 / 5."""
    confidences = []

    def recorded(values, *confidence):
        confidences.extend(confidence)
        return percentiles(values, *confidence)

    monkeypatch.setattr(unknowns, "percentiles", recorded)
    over_unknowns(drawn_set_up(), draws=50)
    assert confidences == pytest.approx([0.99, 0.99, 0.99])


def test_chance_is_seldom_said_to_matter():
    """None of three unknowns does anything: one is named in 5 % of studies (6 or fewer of 40)."""
    decided = 0
    for seed in range(40):
        judged = over_unknowns(drawn_set_up(seed=seed, idle_only=True), draws=200)
        decided += bool(judged.deciding)
        if not judged.deciding:
            assert judged.lowest_mm == judged.highest_mm
    assert decided <= 6


def test_the_same_numbers_each_time():
    first = over_unknowns(drawn_set_up(), draws=50)
    second = over_unknowns(drawn_set_up(), draws=50)
    for effect, repeated_effect in zip(first.effects, second.effects, strict=True):
        assert effect.a90_mm.tolist() == repeated_effect.a90_mm.tolist()
        assert effect.factor_interval == repeated_effect.factor_interval


def test_repeats_of_the_noise_are_no_further_boards():
    """Every inspection twice: the same sizes and intervals."""
    record = drawn_set_up()
    once = record.inspected
    columns = {}
    for name, column in vars(once).items():
        if isinstance(column, np.ndarray):
            columns[name] = np.concatenate([column, column])
    columns["repeat"] = np.repeat([0, 1], len(once.hit))
    twice = over_unknowns(replace(record, inspected=replace(once, **columns)), draws=50)
    plain = over_unknowns(record, draws=50)
    for effect, doubled_effect in zip(plain.effects, twice.effects, strict=True):
        assert doubled_effect.a90_mm == pytest.approx(effect.a90_mm, rel=5e-3)
        assert doubled_effect.factor_interval.high == pytest.approx(
            effect.factor_interval.high, rel=0.02
        )


def test_without_unknowns_or_without_enough_boards():
    assert over_unknowns(study_record().set_ups[0]) is None
    of_few_boards = over_unknowns(drawn_set_up(boards=14))
    assert of_few_boards.why == "14 boards are too few to tell the unknowns apart; 15 are needed"
    assert of_few_boards.effects == ()
    assert over_unknowns(drawn_set_up(boards=15), draws=20).why == ""
    record = drawn_set_up()
    all_found = replace(record.inspected, hit=np.ones_like(record.inspected.hit))
    assert over_unknowns(replace(record, inspected=all_found)).why


def test_a_record_keeps_what_was_drawn(tmp_path):
    study = study_record()
    study = replace(study, set_ups=(*study.set_ups, drawn_set_up()))
    (tmp_path / "study.json").write_text(record_text(study))
    read = read_record(tmp_path / "study.json").set_ups[1]
    for before, after in zip(study.set_ups[1].drawn, read.drawn, strict=True):
        assert (before.key, before.values, before.range) == (after.key, after.values, after.range)
        assert before.level.tolist() == after.level.tolist()
        assert before.stated == after.stated
