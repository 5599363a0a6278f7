"""Limits in words and in the terminal's table, and figures drawn from limits alone."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.intervals import UNKNOWN, Interval
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.result import FRAMES, SetUpResult, StudyResult, axis_lines
from harness.records.examples import StudyExample
from harness.records.schema import Estimate
from harness.report.blocks import DAMAGE
from harness.report.clouds import examples_figure
from harness.report.study_figures import MOST_CURVES, axis_figure, overlay_figure, with_room
from harness.report.study_page import study_parts
from harness.tables.limits import (
    LIMITS,
    is_within_sizes,
    limit_notes,
    limit_sentence,
    notes_of,
    short_names,
    study_answer,
)
from harness.tables.study import axis_grid, axis_groups
from harness.vocabulary.text import Grid, interval, size, text_of, unbroken, with_interval
from tests.support.synthetic_study import SetUp, Study, study_record


def limits_of(*set_ups: SetUp, **study: object) -> list[SetUpLimit]:
    record = study_record(Study(set_ups=set_ups, boards=20, hole_free_boards=12, **study))  # type: ignore[arg-type]
    return [limit_of(set_up, draws=100) for set_up in record.set_ups]


def result_of(limits: list[SetUpLimit]) -> StudyResult:
    """A result of limits alone."""
    set_ups = tuple(SetUpResult(limit, None, None, None, None, None, "") for limit in limits)
    return StudyResult(study_record(), set_ups, tuple(limits), (), (), {})


def row_of(limit: SetUpLimit) -> dict[str, str]:
    """The limit's cells on the page by their heads."""
    grid = LIMITS.grid([limit])
    return dict(zip(grid.heads, (cell.text for cell in grid.rows[0]), strict=True))


def study_text(limits: list[SetUpLimit]) -> str:
    return text_of(study_parts(result_of(limits)))


@pytest.fixture(scope="module")
def two() -> list[SetUpLimit]:
    return limits_of(SetUp(frames=1, a50_mm=6.0), SetUp(frames=50, a50_mm=4.0))


@pytest.fixture(scope="module")
def nothing_found() -> SetUpLimit:
    return limits_of(SetUp(a50_mm=60.0))[0]


@pytest.fixture(scope="module")
def everything_found() -> SetUpLimit:
    return limits_of(SetUp(a50_mm=-60.0))[0]


def test_one_sentence_for_each_set_up(two: list[SetUpLimit]) -> None:
    for limit in two:
        sentence = limit_sentence(limit)
        assert sentence.startswith(
            f"{limit.record.label}: damage of {size(limit.a90_95.value)} mm is found 90 % of the "
            "time"
        )
        assert limit.false_calls is not None
        rate = f"{limit.false_calls.rate_per_m2:.2g}"
        assert f", at {rate} false call{'' if rate == '1' else 's'} per m² (" in sentence
    second = limit_sentence(two[1], again=True)
    assert second.startswith(f"{two[1].record.label}: {size(two[1].a90_95.value)} mm, at ")
    assert study_answer(two) == f"One unit of the camera: {limit_sentence(two[0])} {second}"


def test_a_short_name_leaves_out_ranges_of_sizes_unless_set_ups_differ_in_them() -> None:
    variants = ("blind, diameter 2 to 9 mm, depth 6 mm, thesis", "through, diameter 2 to 8 mm")
    names = short_names(limits_of(*(SetUp(variant=variant) for variant in variants)))
    assert list(names.values()) == ["blind, thesis, 1 frame", "through, 1 frame"]
    variants = ("blind, depth 6 mm", "blind, depth 3 mm")
    names = short_names(limits_of(*(SetUp(variant=variant) for variant in variants)))
    assert names == {label: label for label in names}


def test_of_many_set_ups_the_span_and_those_without_a_limit(
    two: list[SetUpLimit], nothing_found: SetUpLimit
) -> None:
    answer = study_answer([*two, *two, nothing_found])
    smallest = f"{size(two[1].a90_95.value)} mm (50 frames)"
    largest = f"{size(two[0].a90_95.value)} mm (1 frame)"
    assert answer == (
        f"Nine in ten found by one unit (a90/95): {smallest} to {largest};"
        " 1 of 5 set-ups demonstrates no limit within the sizes inspected."
    )
    none = (
        "none of 4 set-ups demonstrates a limit (a90/95) within the sizes inspected (1 to 14 mm)."
    )
    assert study_answer([nothing_found] * 4) == f"One unit of the camera: {none}"
    assert study_answer([]) == "No set-up was inspected, so there is no answer."


def test_what_is_not_demonstrated_is_written_out(nothing_found: SetUpLimit) -> None:
    row = row_of(nothing_found)
    assert [row[head] for head in ("a50 (mm)", "a90 (mm)")] == ["none", "none"]
    assert [row[head] for head in ("a90/95 (mm)", "over boards (mm)")] == ["not demonstrated"] * 2
    assert notes_of(nothing_found)[0].startswith("every target was missed")
    assert not is_within_sizes(nothing_found)
    assert "a90/95 is not demonstrated: every target was missed" in limit_sentence(nothing_found)


def test_the_answer_is_without_statistics(two: list[SetUpLimit]) -> None:
    why = "not demonstrated: a constant probability is not rejected (ratio 1.79 <= 3.84)"
    limit = replace(two[0], a90_95=replace(two[0].a90_95, value=np.inf, why=why))
    sentence = limit_sentence(limit)
    assert sentence.startswith(
        "1 frame: a90/95 is not demonstrated: the hits do not grow clearly with diameter; "
    )
    assert "3.84" not in sentence
    assert "(ratio 1.79 <= 3.84)" in "; ".join(notes_of(limit))


def test_sizes_beyond_those_inspected_are_no_numbers(two: list[SetUpLimit]) -> None:
    limit = replace(
        two[0],
        a90_95=replace(two[0].a90_95, value=9.468e4),
        over_boards=replace(two[0].over_boards, value=9.468e4),
        a50_interval_mm=Interval(4.2, 17.0),
        a90_mm=21.0,
        a90_interval_mm=Interval(15.0, np.inf),
    )
    row = row_of(limit)
    assert (row["a90/95 (mm)"], row["over boards (mm)"], row["a90 (mm)"]) == ((">\u00a014",) * 3)
    assert row["a50 (mm)"] == f"{limit.a50_mm:.1f} (4.2 to >\u00a014)"
    assert not is_within_sizes(limit)
    assert not is_within_sizes(limit, limit.over_boards)
    assert "lies beyond the largest size inspected, 14 mm" in "; ".join(notes_of(limit))
    assert "no limit (a90/95) within the sizes inspected (1 to 14 mm); " in limit_sentence(limit)
    wide = row_of(replace(limit, a90_interval_mm=Interval(12.0, np.inf)))["a90 (mm)"]
    assert wide == ">\u00a014 (12.00 to >\u00a014)"
    terminal = study_text([limit])
    assert "14 mm" in terminal
    assert "e+" not in terminal
    assert "> 14  > 14  > 14" in re.sub(r"\s\s+", "  ", terminal.replace("\u00a0", " "))


def test_what_all_set_ups_have_in_common_is_said_once(two: list[SetUpLimit]) -> None:
    failed = [replace(limit, record=replace(limit.record, failed=3)) for limit in two]
    failed[1] = replace(
        failed[1],
        a90_95=replace(failed[1].a90_95, value=np.inf, why="not demonstrated: of a ceiling"),
    )
    notes = limit_notes(failed)
    assert notes[0] == "every set-up: 3 trials failed and are not included"
    assert notes[1] == "50 frames: of a ceiling"
    assert limit_notes(two[:1]) == []
    assert limit_notes([]) == []


def test_where_everything_is_found_the_method_is_named(everything_found: SetUpLimit) -> None:
    row = row_of(everything_found)
    # the smallest of 160 sizes from 1 to 14 mm: an upper limit of both estimates, and none of them
    # has an interval
    assert row["a50 (mm)"] == row["a90 (mm)"] == "≤\u00a01.00"
    assert row["a90/95 (mm)"] == size(everything_found.a90_95.value)
    assert notes_of(everything_found)[0].startswith("all found: binomial")
    assert row["found"] == "160 of 160"


def test_the_terminals_table_and_its_plain_twin_say_the_same(
    two: list[SetUpLimit], nothing_found: SetUpLimit
) -> None:
    from rich.console import Console

    limits = [*two, nothing_found]
    plain = study_text(limits)
    console = Console(width=110, force_terminal=False)
    (grid,) = [part for part in study_parts(result_of(limits)) if isinstance(part, Grid)]
    with console.capture() as capture:
        console.print(grid.rich())
    shown = [line.split() for line in capture.get().splitlines()[1:]]
    assert shown == [line.split() for line in plain.splitlines()[: len(limits) + 1]]
    assert max(map(len, plain.splitlines()[: len(limits) + 1])) <= 105
    for number, limit in enumerate(limits):
        assert limit_sentence(limit, again=number > 0) in plain


def test_every_number_of_a_limit_stands_in_its_file(
    two: list[SetUpLimit], nothing_found: SetUpLimit
) -> None:
    frame = LIMITS.frame([*two, nothing_found])
    first = frame.iloc[0]
    limit = two[0]
    assert limit.false_calls is not None
    ends = limit.a90_interval_mm
    numbers = (
        first["a90_95_mm"],
        first["a90_mm"],
        first["a90_low_mm"],
        first["a90_high_mm"],
        first["a50_mm"],
    )
    assert numbers == (limit.a90_95.value, limit.a90_mm, ends.low, ends.high, limit.a50_mm)
    rate = limit.false_calls.interval_per_m2
    assert first["false_calls_low_per_m2"] == rate.low
    assert first["false_calls_high_per_m2"] == rate.high
    assert first["targets"] == limit.targets
    assert first["boards"] == limit.boards
    assert first["hits"] == limit.hits
    assert first["a90_95_method"] == "average over models"
    assert list(frame["a90_95_verdict"]) == ["demonstrated", "demonstrated", "not demonstrated"]
    assert np.isnan(frame["a90_95_mm"].iloc[2])


def test_boards_that_matter_and_failed_trials_are_told(two: list[SetUpLimit]) -> None:
    limit = replace(
        two[0],
        over_boards=replace(two[0].a90_95, value=1.2 * two[0].a90_95.value),
        design_effect=2.34,
        record=replace(two[0].record, failed=3),
    )
    why = "; ".join(notes_of(limit))
    assert "design effect 2.3" in why
    assert "3 trials failed" in why


def test_repeats_are_no_targets() -> None:
    limit = limits_of(SetUp(), repeats=3)[0]
    assert limit.statement is not None
    why = "; ".join(notes_of(limit))
    assert "480 inspections of 160 targets count as 160" in why


def test_few_targets_are_told() -> None:
    limit = limits_of(SetUp(), holes=2)[0]
    assert "40 independent targets; MIL-HDBK-1823A asks for at least 60" in "; ".join(
        notes_of(limit)
    )


@given(st.floats(-1e3, 1e3), st.floats(0, 1e3), st.floats(0, 1e3))
@settings(max_examples=30, deadline=None)
def test_intervals_as_text_hold_their_numbers(
    value: float,
    down: float,
    up: float,
) -> None:
    """To two decimals, or to two significant digits of the estimate (of the upper end where that
    is 0), where the interval is wider than a tenth of it."""
    text = with_interval(value, value - down, value + up)
    numbers = [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", text)]
    assert np.allclose(
        numbers, [value, value - down, value + up], atol=max(0.0051, 0.051 * abs(value or up))
    )


def test_an_interval_from_0_has_two_digits() -> None:
    assert with_interval(0.0, 0.0, 2.857) == "0.0 (0.0 to 2.9)"
    assert with_interval(0.0, 0.0, 0.0) == "0.00 (0.00 to 0.00)"


def test_numbers_are_held_to_their_units() -> None:
    assert (
        unbroken("distance=0.7 m, 50 frames of kind 3, 4")
        == "distance=0.7\u00a0m, 50\u00a0frames of kind 3, 4"
    )


def test_intervals_without_ends() -> None:
    unknown = (UNKNOWN.low, UNKNOWN.high)
    assert interval(*unknown) == "unknown"
    assert with_interval(1.0, *unknown) == "1.00"
    assert with_interval(1.0, 0.5, np.inf) == "1.00 (0.50 to ∞)"
    assert with_interval(np.inf, 2.0, np.inf) == "∞ (2.00 to ∞)"
    assert with_interval(np.nan, 2.0, 3.0) == "none"
    assert Estimate(3.2, 2.9, 3.6).text() == "3.2 (2.9 to 3.6)"
    assert Estimate(3.2, 3.15, 3.25).text() == "3.20 (3.15 to 3.25)"
    assert Estimate(61.2, 40, 90).text() == "61 (40 to 90)"


def test_axes_are_those_with_several_values_and_lines_hold_the_rest() -> None:
    def one(
        camera: str,
        distance: float,
        frames: int,
    ) -> SetUp:
        axes = {
            "source.camera.name": camera,
            "source.target.distance_m": distance,
            "detector.name": "thesis",
        }
        return SetUp(
            variant=f"{camera} {distance}", frames=frames, axes=axes, a50_mm=4.0 + distance
        )

    limits = limits_of(
        *(
            one(camera, distance, n)
            for camera in ("a", "b")
            for distance in (0.5, 1.0)
            for n in (1, 50)
        )
    )
    camera, distance, frames = axis_groups(axis_lines(limits))
    assert [group.path for group in (camera, distance, frames)] == [
        "source.camera.name",
        "source.target.distance_m",
        FRAMES,
    ]
    assert distance.title == "distance (m)"
    assert distance.values == (0.5, 1.0)
    assert distance.numeric is True
    assert camera.values == ("a", "b")
    assert camera.numeric is False
    assert list(camera.lines) == [
        f"distance={metres} m, {n}" for metres in ("0.5", "1") for n in ("1 frame", "50 frames")
    ]
    assert list(distance.lines) == ["a, 1 frame", "a, 50 frames", "b, 1 frame", "b, 50 frames"]
    assert distance.lines["b, 50 frames"].limits == (limits[5], limits[7])
    grid = axis_grid(distance)
    rows = [tuple(cell.text for cell in row) for row in grid.rows]
    assert [row[:2] for row in rows[1:3]] == [("a, 1 frame", "1 m"), ("a, 50 frames", "0.5 m")]
    assert grid.heads[:2] == ("set-ups", "distance (m)")
    step = distance.lines["a, 1 frame"].steps[0]
    assert rows[1][-1].startswith(
        f"× {limits[2].a90_mm / limits[0].a90_mm:.2f} ({step.interval.low:.2f} to"
    )
    assert rows[1][-1].endswith(" *") == step.beyond_chance
    assert "<svg" in axis_figure(distance, "axis-1")


def test_an_axis_ends_at_a_little_more_than_the_largest_size(two: list[SetUpLimit]) -> None:
    """One bound of 95 m does not press all others to the ground; it is an arrow."""
    far = replace(
        two[0],
        a90_mm=9.5e4,
        a90_interval_mm=Interval(5.0, np.inf),
        a90_95=replace(two[0].a90_95, value=1e6),
    )
    (group,) = axis_groups(axis_lines([far, two[1]]))
    figure = axis_figure(group, "axis-1")
    texts = re.findall(r"<!-- (.*?) -->", figure)
    assert (
        max(
            float(text)
            for text in texts
            if re.fullmatch(r"[\d.]+", text) and text not in ("1", "50")
        )
        <= 1.3 * 14
    )
    assert {"no limit", "continues beyond the axis", "largest size inspected"} <= set(texts)
    (group,) = axis_groups(axis_lines(two))
    assert not {"no limit", "continues beyond the axis"} & set(
        re.findall(r"<!-- (.*?) -->", axis_figure(group, "axis-1"))
    )


def test_sizes_that_are_all_equal_have_an_axis(recwarn: pytest.WarningsRecorder) -> None:
    record = study_record(Study(set_ups=(SetUp(),), boards=20, hole_free_boards=12)).set_ups[0]
    same = replace(record.inspected, diameter_mm=np.full_like(record.inspected.diameter_mm, 6.0))
    figure = overlay_figure([limit_of(replace(record, inspected=same), draws=50)])
    assert "all sizes are 6" in figure
    assert [str(warning.message) for warning in recwarn] == []


def test_no_axis_without_two_values(two: list[SetUpLimit]) -> None:
    assert axis_groups(axis_lines(two[:1])) == []
    (frames,) = axis_groups(axis_lines(two))
    assert list(frames.lines) == [""]
    assert axis_grid(frames).heads[0] == "frames"


def test_of_many_set_ups_those_from_the_smallest_limit_to_the_largest_are_shown(
    two: list[SetUpLimit],
) -> None:
    sizes = np.random.default_rng(2).permutation(np.arange(1.0, 21.0))
    twenty = [replace(two[0], a90_95=replace(two[0].a90_95, value=float(size))) for size in sizes]
    shown = [result.limit.a90_95.value for result in with_room(result_of(twenty).set_ups)]
    assert len(shown) == MOST_CURVES
    assert sorted(shown) == [1.0, 5.0, 9.0, 12.0, 16.0, 20.0]
    assert shown == [size for size in sizes if size in shown]
    assert [result.limit for result in with_room(result_of(two).set_ups)] == two


def test_curves_without_a_curve_are_drawn(
    nothing_found: SetUpLimit, everything_found: SetUpLimit
) -> None:
    figure = overlay_figure([nothing_found, everything_found])
    assert "a90/95 is not demonstrated" in figure
    assert "nan" not in re.sub(r"<!--.*?-->", "", figure, flags=re.DOTALL).lower()


def example(**changed: object) -> StudyExample:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rng = np.random.default_rng(3)
    kept = StudyExample(
        variant="main",
        frames=1,
        board=4,
        hole="3",
        where="at",
        diameter_mm=6.2,
        depth_mm=19.0,
        pod=0.71,
        hit=True,
        score=6.123,
        threshold=4.5,
        residual_mm=rng.normal(0.0, 0.5, (21, 21)),
        detected=np.hypot(*(np.indices((21, 21)) - 10)) < 3,
        outline_px=10 + 2.2 * np.column_stack([np.cos(angle), np.sin(angle)]),
        pitch_mm=1.4,
    )
    return replace(kept, **changed)  # type: ignore[arg-type]


def test_examples_say_what_came_of_them() -> None:
    missed = example(where="below", hit=False, score=np.nan, residual_mm=np.full((21, 21), np.nan))
    figure = examples_figure("examples-1", [missed, example()], "1 frame")
    assert "6.2 mm, below the limit, missed: no pixel was judged" in figure
    assert "6.2 mm, at the limit, hit: score 6.12, threshold 4.5" in figure
    without = examples_figure("examples-1", [missed, example()], "1 frame", by_limit=False)
    assert "6.2 mm, smaller, missed" in without
    assert "the limit" not in without


def test_each_pixel_of_a_finding_is_a_filled_mark() -> None:
    """Filled, since matplotlib's drawings set the ends of strokes on the whole page."""
    shown = example()
    figure = examples_figure("examples-1", [shown], "1 frame")
    marks = re.search(rf'<path d="([^"]*)" fill="{DAMAGE}"/>', figure)
    assert marks is not None
    places = re.findall(r"M([\d.]+) ([\d.]+)h\.4v\.4h-\.4z", marks.group(1))
    rows, columns = np.nonzero(shown.detected)
    expected = np.column_stack([columns, rows]) + 0.3
    np.testing.assert_allclose(np.array(places, float), expected)
