"""The table and the sentences of unknowns, and the section of a study's page."""

from __future__ import annotations

from dataclasses import replace

import pytest

from harness.evaluation.study.result import evaluate_study
from harness.report.blocks import split_answer
from harness.report.study_page import study_html, study_parts
from harness.tables.unknowns import UNKNOWN_TABLE, unknown_headline, unknown_rows, unknown_sentences
from harness.vocabulary.text import text_of
from tests.support.drawn_unknowns import BACKING, BLUR, DECLARED, SIZES_MM, drawn_set_up
from tests.support.pages import first_words
from tests.support.synthetic_study import SetUp, Study, study_record, study_tables
from tests.support.synthetic_tables import provenance

FACTS = {"unknowns": [unknown.to_data() for unknown in DECLARED]}


def result_with(drawn):
    stated = SetUp(a50_mm=3.4, width_mm=0.2, axes={"unknowns": "stated"})
    drawn_too = SetUp(variant="unknowns=drawn", axes={"unknowns": "drawn"})
    study = Study(boards=36, sizes_mm=SIZES_MM, set_ups=(stated, drawn_too))
    record = study_record(study)
    record = replace(record, set_ups=(record.set_ups[0], drawn))
    return evaluate_study(record, study_tables(study), FACTS, draws=200)


@pytest.fixture(scope="module")
def result():
    return result_with(drawn_set_up())


def test_a_row_for_each_value_largest_factor_first(result):
    rows = UNKNOWN_TABLE.frame(unknown_rows(result.set_ups))
    assert rows["rank"].tolist()[:3] == [1, 1, 1] and len(rows) == 7
    backing = rows[rows["key"] == BACKING]
    assert backing["value"].tolist() == [
        '{"distance_mm": 20.0}',
        '{"distance_mm": 1000.0}',
        "null",
    ]
    assert backing["factor"].iloc[0] == pytest.approx(
        backing["a90_mm"].max() / backing["a90_mm"].min()
    )
    assert backing["stated"].iloc[0] == "distance 20 mm"
    assert set(rows["reason"]) == {"not seen", "not published", "no matter"}
    assert (rows["a90_low_mm"] < rows["a90_mm"]).all()
    assert (rows["a90_mm"] < rows["a90_high_mm"]).all()
    # the values of backing lie farther apart than their intervals are wide
    assert backing["a90_low_mm"].max() > backing["a90_high_mm"].min()


def test_the_sentence_names_the_range_and_what_it_depends_on(result):
    unknowns = result.set_ups[1].unknowns
    (sentence,) = unknown_sentences(result)
    assert sentence.startswith(unknown_headline(result).removesuffix("."))
    assert [effect.unknown.key for effect in unknowns.deciding] == [BACKING, BLUR]
    low = f"{unknowns.lowest_mm:#.2g}"
    high = f"{unknowns.highest_mm:#.2g}"
    assert sentence.startswith(
        f"1 frame: a90 is {low} to {high} mm, depending on backing (most) and blur; "
    )
    stated = f"{result.limits[0].a90_mm:#.2g} mm at the stated values"
    over = f"{result.limits[1].a90_mm:#.2g} mm over the unknowns"
    assert sentence.endswith(f"{stated} and {over} (drawn for each board).")


def test_a_sentence_without_effects():
    idle = result_with(drawn_set_up(idle_only=True))
    (sentence,) = unknown_sentences(idle)
    assert "no unknown moves it beyond chance (at most " in sentence
    of_few_boards = result_with(drawn_set_up(boards=12))
    (sentence,) = unknown_sentences(of_few_boards)
    assert "; 12 boards are too few to tell the unknowns apart; 15 are needed; " in sentence


def test_a_study_without_unknowns_says_nothing_of_them():
    study = Study(boards=20)
    plain = evaluate_study(study_record(study), study_tables(study), {}, draws=20)
    assert unknown_headline(plain) == "" and unknown_sentences(plain) == []
    page = study_html(plain, [], provenance(), "", "Plain")
    assert "What nobody has measured" not in page


def test_page_and_terminal_begin_with_the_range(result):
    headline = unknown_headline(result)
    page = study_html(result, [], provenance(), "", "Drawn").replace("\u00a0", " ")
    assert first_words(page) == list(
        filter(None, split_answer(headline))
    )  # the limits at the stated values stand below the chart
    assert 'id="tornado-1"' in page and "What nobody has measured" in page
    assert "blur: 0.3 to 0.6 px. not published" in page
    assert "backing: distance 20 mm; distance 1000 mm; none. not seen" in page
    terminal = text_of(study_parts(result))
    assert terminal.count(headline) == 1
    assert "with a surface" not in result.conditions
