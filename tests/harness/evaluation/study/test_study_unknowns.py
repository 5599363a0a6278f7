"""What unknowns do to a90, on boards of known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.evaluation.intervals import percentiles
from harness.evaluation.pod.curve import link_cdf
from harness.evaluation.study import unknowns
from harness.evaluation.study.boards import targets_of
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


def _row_by_row(targets, columns, b, weights):
    """The log-likelihood of weighted targets, its gradient and the expected information at b
    (2 k,), target by target."""
    k = columns.shape[1]
    value = 0.0
    gradient = np.zeros(2 * k)
    information = np.zeros((2 * k, 2 * k))
    for row, size_mm in enumerate(targets.size_mm):
        width = np.exp(columns[row] @ b[k:])
        predictor = (np.log(size_mm) - columns[row] @ b[:k]) / width
        hit = float(link_cdf("logit", predictor))
        hits = targets.hits[row]
        inspections = targets.inspections[row]
        slope = np.concatenate([-columns[row] / width, -columns[row] * predictor])
        log_likelihood = hits * np.log(hit) + (inspections - hits) * np.log1p(-hit)
        value += weights[row] * log_likelihood
        gradient += weights[row] * (hits - inspections * hit) * slope
        information += weights[row] * inspections * hit * (1 - hit) * np.outer(slope, slope)
    return value, gradient, information


def test_sums_over_boards_are_those_over_their_targets():
    """Boards of one to three targets, inspected once or twice."""
    inspected = drawn_set_up(boards=7).inspected
    kept = inspected.hole.astype(int) <= inspected.board % 3 + 1
    kept = np.concatenate([np.flatnonzero(kept), np.flatnonzero(kept)[:4]])
    rows = (getattr(inspected, name)[kept] for name in ("board", "hole", "size_mm", "hit"))
    targets = targets_of(*rows)
    counts = np.bincount(targets.board.astype(int))
    assert len(set(counts)) > 1 and len(set(targets.inspections)) > 1
    coded = [unknowns._coded(unknown, targets.board) for unknown in drawn_set_up(boards=7).drawn]
    boards = unknowns._Boards.of(targets, coded)
    columns = np.hstack([np.ones((len(targets.board), 1)), *[part.columns for part in coded]])
    stream = np.random.default_rng(1)
    b = stream.normal(0.0, 0.3, (2, 2 * columns.shape[1]))
    b[:, 0] += np.log(10.0)
    weights = stream.integers(0, 3, (2, len(counts))).astype(float)
    values = boards.likelihood(b, weights)
    for study in range(2):
        of_rows = weights[study, targets.board.astype(int)]
        expected_values = _row_by_row(targets, columns, b[study], of_rows)
        for value, expected in zip(values, expected_values, strict=True):
            assert value[study] == pytest.approx(expected, rel=1e-10, abs=1e-12)


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
