"""Tables of a study besides its limits: thresholds and their warnings, steps along axes, depths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.evaluation.intervals import UNKNOWN, Interval, false_call_rate
from harness.evaluation.study.curves import ChanceHits, PixelCurves
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import Calibrated
from harness.evaluation.study.result import (
    FRAMES,
    Difference,
    SetUpResult,
    StudyResult,
    axis_lines,
)
from harness.evaluation.study.surface import PodSurface
from harness.evaluation.study.units import OverUnits
from harness.tables.limits import (
    LIMITS,
    bound_estimate,
    bound_text,
    limit_sentence,
    limits_grid,
    notes_of,
    quoted,
    size_estimate,
    study_answer,
)
from harness.tables.study import (
    AXES,
    CHANCE,
    DEPTH_LIMITS,
    OPERATING,
    THRESHOLDS,
    AxisRow,
    axis_groups,
    axis_note,
    axis_rows,
    axis_value,
    depths_at,
    operating_notes,
    set_by,
    study_tables,
    threshold_note,
    threshold_warnings,
)
from tests.support.synthetic_study import SetUp, Study, study_record


def limits_of(*set_ups: SetUp) -> list[SetUpLimit]:
    record = study_record(Study(set_ups=set_ups, boards=15, hole_free_boards=12))
    return [limit_of(set_up, draws=60) for set_up in record.set_ups]


@pytest.fixture(scope="module")
def two() -> list[SetUpLimit]:
    return limits_of(SetUp(frames=1, a50_mm=6.0), SetUp(frames=50, a50_mm=4.0))


def with_runs(
    limit: SetUpLimit,
    threshold: float,
    **columns: object,
) -> SetUpLimit:
    """A limit whose threshold four runs set."""
    runs = Calibrated(
        board=np.array([3, 5, 7, 9]),
        repeat=np.zeros(4, int),
        score=np.array([4.1, 12.0, 7.5, 4.4]),
        x_mm=np.array([1.0, -120.4, np.nan, 3.0]),
        y_mm=np.array([2.0, 33.2, np.nan, 4.0]),
        **columns,  # type: ignore[arg-type]
    )
    return replace(limit, record=replace(limit.record, calibrated=runs, threshold=threshold))


# thresholds


def test_the_run_that_set_a_threshold_has_the_nearest_score(two: list[SetUpLimit]) -> None:
    (row,) = set_by([with_runs(two[0], 11.9)])
    assert row.board == 5
    assert row.x_mm == -120.4
    assert row.y_mm == 33.2
    assert row.runs == 4
    assert row.place == ("−120, 33")
    assert row.same_pixels is None
    (off,) = set_by([with_runs(two[0], 7.5)])
    assert off.board == 7
    assert off.place == "off the board"
    assert set_by([replace(two[0], record=replace(two[0].record, calibrated=None))]) == []


@pytest.mark.parametrize(
    ("u_px", "v_px", "same"),
    [
        ([10.0, 10.0, 90.0, 50.0], [0.0, 5.0, 5.0, 5.0], 2),
        ([10.0, 10.0, 13.0, 14.1], [0.0, 5.1, 9.1, 5.1], 3),
        ([10.0, 10.0, 10.0, 10.0], [7.0, 7.0, 7.0, 7.0], 4),
    ],
)
def test_runs_within_five_pixels_are_on_the_same_pixels(
    two: list[SetUpLimit],
    u_px: list[float],
    v_px: list[float],
    same: int,
) -> None:
    limit = with_runs(two[0], 12.0, u_px=np.array(u_px), v_px=np.array(v_px))
    (row,) = set_by([limit])
    assert row.same_pixels == same


def test_thresholds_set_by_one_place_or_too_high_are_warned_of(two: list[SetUpLimit]) -> None:
    far_px = {"u_px": np.arange(4) * 40.0, "v_px": np.zeros(4)}
    half_px = {"u_px": np.array([10.0, 10.0, 90.0, 50.0]), "v_px": np.zeros(4)}
    most_px = {"u_px": np.array([10.0, 10.0, 12.0, 50.0]), "v_px": np.zeros(4)}
    all_px = {"u_px": np.full(4, 10.0), "v_px": np.zeros(4)}
    # the first run sets a threshold of 4.1
    for columns in (far_px, half_px):
        assert threshold_warnings([with_runs(two[0], 4.1, **columns)]) == []
    (crowd,) = threshold_warnings([with_runs(two[0], 4.4, **all_px), with_runs(two[1], 7.5)])
    assert crowd.startswith("1 frame: 4 of 4 calibration boards have their highest score on the")
    several = [with_runs(two[0], 4.1, **all_px), with_runs(two[1], 4.1, **most_px)]
    (crowd,) = threshold_warnings(several)
    assert crowd.startswith("2 of 2 set-ups: 3 to 4 of 4 calibration boards have")
    (high,) = threshold_warnings([with_runs(two[0], 12.0, **far_px)])
    assert high == (
        "1 frame: the threshold is 12 deviations, above 10: something other than noise sets it "
        "(calibration board 5, at x, y = −120, 33 mm) and thus the limit"
    )
    limit = with_runs(two[0], 10.1)
    scores = replace(limit.record.calibrated, score=np.array([4.1, 12.0, 10.1, 4.4]))
    record = replace(limit.record, calibrated=scores)
    (off,) = threshold_warnings([replace(limit, record=record)])
    assert "(calibration board 7, off the board)" in off
    assert threshold_warnings([with_runs(two[0], 10.0)]) == []


def test_how_thresholds_were_set_is_stated() -> None:
    record = study_record(Study(boards=3, hole_free_boards=2))
    assert "calibrated to 1 false call per m² on" in threshold_note(record)
    higher_rate = replace(record, false_calls_per_m2=2.5)
    assert "calibrated to 2.5 false calls per m² on" in threshold_note(higher_rate)
    assert threshold_note(replace(record, false_calls_per_m2=None)).startswith(
        "Thresholds were given, not calibrated; the rates beside them are those"
    )
    stated = replace(record, provenance={"thresholds": "as elsewhere"})
    assert threshold_note(stated) == "as elsewhere"


# axes


def test_steps_are_those_from_one_value_to_the_next(two: list[SetUpLimit]) -> None:
    (group,) = axis_groups(axis_lines(two))
    rows = axis_rows(group)
    assert [row.value for row in rows] == [1, 50]
    assert rows[0].step is None
    assert rows[1].step is group.lines[""].steps[0]
    assert [row.limit for row in rows] == two
    frame = AXES.frame(rows)
    assert frame["ratio"].iloc[1] == two[1].a90_mm / two[0].a90_mm
    assert group.title == "frames"
    assert axis_value(FRAMES, 50) == "50 frames"
    assert axis_value("source.camera.name", "kinect_v2") == "Kinect v2"


def test_steps_in_words(two: list[SetUpLimit]) -> None:
    (group,) = axis_groups(axis_lines(two))
    step = Difference(two[0], two[1], 0.75, Interval(0.6, 0.9), True, True)

    def text(step: Difference | None) -> str:
        row = AxisRow(group, "", 50, two[1], step)
        cells = AXES.grid([row])
        column = cells.heads.index("a90 over the row above")
        return cells.rows[0][column].text

    assert text(None) == ""
    assert text(step) == "× 0.75 (0.60 to 0.90) *"
    assert text(replace(step, beyond_chance=False)) == "× 0.75 (0.60 to 0.90)"
    far = [replace(limit, a90_mm=20.0) for limit in two]
    assert text(replace(step, frm=far[0], to=far[1])) == "both beyond *"
    assert text(replace(step, to=far[1])).startswith("× 0.75")
    without = replace(two[1], a90_mm=np.nan)
    assert text(replace(step, to=without, ratio=np.nan)) == "no a90 here *"
    assert text(replace(step, frm=without, ratio=np.nan)) == "no a90 above *"


def test_notes_on_axes_count_what_is_beyond_chance(two: list[SetUpLimit]) -> None:
    (group,) = axis_groups(axis_lines(two))
    note = axis_note(group)
    assert "(the same boards, resampled together)" in note
    assert "excludes 1: 1 of 1." in note
    line = group.lines[""]
    unpaired = replace(line.steps[0], paired=False, beyond_chance=False)
    long = replace(
        line,
        values=tuple(range(61)),
        limits=(two[0],) * 61,
        steps=(unpaired,) * 60,
    )
    note = axis_note(replace(group, lines={"": long}))
    assert "(not all of them the same)" in note
    assert "excludes 1: 0 of 60." in note
    assert note.endswith(" The first 60 of 61 rows are shown.")


# limits of depth


def test_depths_are_estimates_up_to_the_deepest_inspected(two: list[SetUpLimit]) -> None:
    surface = PodSurface(
        link="logit",
        b=np.zeros(4),
        interaction_p=0.5,
        deviance=9.0,
        diameter_mm=np.array([2.0, 4.0]),
        d90_mm=np.array([6.0, 3.0]),
        d90_low_mm=np.array([5.0, 2.0]),
        d90_high_mm=np.array([np.inf, 4.0]),
        depth_range_mm=(1.0, 9.0),
    )
    results = [
        SetUpResult(two[0], None, None, None, None, None, "no surface"),
        SetUpResult(two[1], None, None, None, None, surface, ""),
    ]
    rows = depths_at(results)
    assert [row.limit for row in rows] == [two[1], two[1]]
    assert [row.diameter_mm for row in rows] == [2.0, 4.0]
    depth = rows[1].depth
    assert depth.value == 3.0
    assert depth.low == 2.0
    assert depth.high == 4.0
    assert depth.most == 9.0


def test_areas_that_could_not_be_computed_are_named(two: list[SetUpLimit]) -> None:
    pixels = PixelCurves(np.zeros(3), np.zeros(3), np.nan, "the thresholds end early")
    results = [
        SetUpResult(two[0], None, None, None, pixels, None, ""),
        SetUpResult(two[1], None, None, None, replace(pixels, why=""), None, ""),
    ]
    notes = operating_notes(results)
    assert "up to a share of 0.3 and divided by 0.3" in notes[0]
    assert notes[1:] == ["1\u00a0frame: no AU-PRO: the thresholds end early."]


# limits of several units


@pytest.fixture(scope="module")
def units(two: list[SetUpLimit]) -> SetUpLimit:
    bound = replace(two[0].a90_95, value=9.5)
    return replace(
        two[0],
        over_units=OverUnits(
            a90_mm=np.array([7.0, 7.5, 8.5]),
            a90_95_mm=np.array([8.0, 9.1, 8.4]),
            spread=0.1,
            new_unit=bound,
        ),
        false_calls_interval_per_m2=Interval(0.01, 99.6),
    )


def test_the_limit_of_a_new_unit_is_quoted(units: SetUpLimit, two: list[SetUpLimit]) -> None:
    assert quoted(units).value == 9.5
    assert quoted(two[0]) is two[0].a90_95


def test_the_sentence_says_from_how_many_units_a_new_one_is_judged(units: SetUpLimit) -> None:
    sentence = limit_sentence(units)
    assert sentence.startswith(
        "1 frame: damage of 9.5 mm is found 90 % of the time by a new unit of the camera, judged"
        " from 3, with 95 % confidence (a90/95), at"
    )
    # the interval holds that over boards, as each board has its own unit
    assert sentence.endswith("(0.01 to 100).")
    assert study_answer([units]) == sentence


def test_the_table_has_the_limits_of_single_units_and_of_a_new_one(
    units: SetUpLimit, two: list[SetUpLimit]
) -> None:
    row = LIMITS.frame([units]).iloc[0]
    ends_mm = (row["one_unit_low_mm"], row["one_unit_mm"], row["one_unit_high_mm"])
    assert ends_mm == (8.0, 8.4, 9.1)
    assert (row["new_unit_mm"], row["new_unit_verdict"]) == (9.5, "demonstrated")
    single = LIMITS.frame(two).iloc[0]
    assert single["one_unit_mm"] == two[0].a90_95.value


def test_the_table_of_one_unit_says_so(units: SetUpLimit, two: list[SetUpLimit]) -> None:
    assert "all units (mm)" in limits_grid([units, two[1]]).heads
    assert limits_grid(two).title.startswith("One unit of the camera: ")


@pytest.mark.parametrize(
    ("over_boards", "stated"),
    [
        # 3 false calls on 1.5 m²: Garwood's interval is 0.41 to 5.8
        (UNKNOWN, "(0.41 to 5.8)"),
        (Interval(1.0, 3.0), "(0.41 to 5.8)"),
        (Interval(0.1, 9.0), "(0.1 to 9)"),
    ],
)
def test_false_calls_of_several_units_have_the_wider_interval(
    units: SetUpLimit, over_boards: Interval, stated: str
) -> None:
    limit = replace(
        units, false_calls=false_call_rate(3, 1.5), false_calls_interval_per_m2=over_boards
    )
    assert limit_sentence(limit).endswith(f", at 2 false calls per m² {stated}.")


def test_the_limit_over_boards_is_recommended_for_a_single_unit_alone(
    units: SetUpLimit, two: list[SetUpLimit]
) -> None:
    """The limit of a new unit contains what boards do."""
    wider = replace(two[0].a90_95, value=1.2 * two[0].a90_95.value)
    of_one = replace(two[0], over_boards=wider, design_effect=2.34)
    of_several = replace(units, over_boards=wider, design_effect=2.34)
    note = (
        "the results of damages on one board are correlated (design effect 2.3): "
        "quote the limit over boards"
    )
    assert note in notes_of(of_one)
    assert note not in notes_of(of_several)


def test_of_many_limits_depths_are_not_compared_with_diameters(two: list[SetUpLimit]) -> None:
    inspected = two[1].record.inspected
    turned = replace(
        inspected,
        diameter_mm=np.full(len(inspected.hit), 10.0),
        depth_mm=inspected.diameter_mm.copy(),
    )
    deep = limit_of(replace(two[1].record, inspected=turned), draws=20)
    answer = study_answer([two[0], two[0], deep, deep])
    assert "(a90/95): a diameter of " in answer
    assert "; a depth of " in answer
    assert answer.endswith("mm (50 frames).")


def test_estimates_and_bounds(two: list[SetUpLimit]) -> None:
    limit = two[0]
    estimate = size_estimate(limit, "a90")
    assert estimate.value == limit.a90_mm
    assert estimate.low == limit.a90_interval_mm.low
    assert estimate.high == limit.a90_interval_mm.high
    assert estimate.most == limit.largest_mm
    assert np.isnan(size_estimate(replace(limit, a50_mm=0.0), "a50").value)
    nothing = replace(limit.a90_95, value=np.inf)
    assert bound_text(bound_estimate(limit, nothing)) == "not demonstrated"
    assert bound_text(bound_estimate(limit, replace(limit.a90_95, value=14.5))) == ">\u00a014"


def test_hits_by_missing_returns_alone_are_noted(two: list[SetUpLimit]) -> None:
    inspected = two[0].record.inspected
    index = np.flatnonzero(inspected.hit)
    by_depth = inspected.hit.copy()
    by_depth[index[:3]] = False
    by_no_return = np.zeros_like(inspected.hit)
    by_no_return[index[:5]] = True
    split = replace(inspected, by_depth=by_depth, by_no_return=by_no_return)
    limit = replace(two[0], record=replace(two[0].record, inspected=split))
    assert f"3 of {limit.hits} hits by missing returns alone" in "; ".join(notes_of(limit))
    row = LIMITS.frame([limit]).iloc[0]
    assert row["hits_by_depth"] == limit.hits - 3
    assert row["hits_by_no_return"] == 5
    cells = LIMITS.grid([limit])
    text = cells.rows[0][cells.heads.index("found")].text
    assert text == (
        f"{limit.hits} of {limit.inspections} ({limit.hits - 3} by depth, 5 by missing returns)"
    )
    assert not any("missing returns" in note for note in notes_of(two[0]))
    assert "hits by missing returns" not in "; ".join(
        notes_of(
            replace(
                limit,
                record=replace(limit.record, inspected=replace(split, by_depth=inspected.hit)),
            )
        )
    )


# files


def test_every_column_of_a_limit_is_its_own_number(two: list[SetUpLimit]) -> None:
    limit = replace(two[0], size_error_mm=0.25, sized=7, seconds_detect=0.0423)
    row = LIMITS.frame([limit]).iloc[0]
    inspected = limit.record.inspected
    assert row["smallest_mm"] == inspected.diameter_mm.min()
    assert row["largest_mm"] == inspected.diameter_mm.max()
    assert row["over_boards_mm"] == limit.over_boards.value
    assert row["a50_low_mm"] == limit.a50_interval_mm.low
    assert row["a50_high_mm"] == limit.a50_interval_mm.high
    assert row["false_calls"] == limit.false_calls.calls
    assert row["false_calls_per_m2"] == limit.false_calls.rate_per_m2
    assert row["hole_free_m2"] == pytest.approx(12 * 0.25)
    assert row["inspections"] == limit.inspections
    assert row["design_effect"] == limit.design_effect
    assert row["threshold"] == limit.record.threshold
    assert row["calibration_runs"] == limit.record.calibration_runs
    assert (row["size_error_mm"], row["sized"], row["seconds_detect"]) == (0.25, 7, 0.0423)
    assert row["frames"] == 1
    assert row["is_at_most"] == limit.is_at_most
    assert row["detector"] == "plane"
    cells = LIMITS.grid([limit])
    texts = dict(zip(cells.heads, (cell.text for cell in cells.rows[0]), strict=True))
    assert texts["ms a cloud"] == "42"
    beyond = replace(limit, over_boards=replace(limit.over_boards, value=14.1))
    verdicts = LIMITS.frame([beyond]).iloc[0]
    assert verdicts["over_boards_verdict"] == "beyond the sizes inspected"
    assert verdicts["a90_95_verdict"] == "demonstrated"


def test_tables_hold_the_set_ups_they_are_of(two: list[SetUpLimit]) -> None:
    chance = ChanceHits(0.1, 9, 0.2, 30, 0.3, Interval(0.2, 0.4))
    set_ups = (
        SetUpResult(two[0], chance, None, None, None, None, ""),
        SetUpResult(two[1], None, None, None, None, None, ""),
    )
    result = StudyResult(study_record(), set_ups, tuple(two), axis_lines(two), (), {})
    tables = study_tables(result)
    assert tables[LIMITS] == two
    assert tables[THRESHOLDS] == two
    assert tables[CHANCE] == [set_ups[0]]
    assert tables[OPERATING] == list(set_ups)
    assert [row.value for row in tables[AXES]] == [1, 50]
    assert tables[DEPTH_LIMITS] == []
    row = CHANCE.frame(tables[CHANCE]).iloc[0]
    assert (row["shuffled_share"], row["expected_share"], row["places"]) == (0.1, 0.2, 30)
    assert row["unflawed_share"] == 0.3


def test_an_axis_is_numeric_if_all_its_lines_are(two: list[SetUpLimit]) -> None:
    (group,) = axis_groups(axis_lines(two))
    line = group.lines[""]
    mixed = replace(group, lines={"a": line, "b": replace(line, numeric=False)})
    assert group.numeric
    assert not mixed.numeric
    words = replace(line, fixed={"camera": "b"}, values=("off", 1), numeric=False)
    (joined,) = axis_groups([replace(line, fixed={"camera": "a"}, values=(50, 1)), words])
    assert joined.values == (50, 1, "off")
    assert list(joined.lines) == ["a", "b"]
    numbers = replace(line, fixed={"camera": "b"}, values=(7, 60))
    (joined,) = axis_groups([replace(line, fixed={"camera": "a"}), numbers])
    assert joined.values == (1, 7, 50, 60)
