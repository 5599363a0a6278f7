"""The page of a study: complete, self-contained, honest about what is not demonstrated, and the
same every time."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure

from harness.evaluation.study.record import StudyRecord, Unflawed
from harness.evaluation.study.result import StudyResult, evaluate_study
from harness.records.trials import ResultTables
from harness.report.limits_figure import MOST_LETTERS, _draw_row, _drawn_names
from harness.report.study_page import _best, study_html, study_parts
from harness.tables.limits import limit_sentence
from harness.tables.study import DEPTH_LIMITS, depths_at
from harness.vocabulary.text import size, text_of, unbroken
from tests.harness.tables.test_study_limits_text import example
from tests.support.pages import first_words
from tests.support.synthetic_study import SetUp, Study, study_record, study_tables

PROVENANCE = {
    "command": "python -m harness.sweep experiments/x.yaml",
    "commit": "0" * 40,
    "dirty": False,
    "seed": 3,
    "seconds": {"render": 12.0, "trials": 30.0},
    "failures": [{"what": "board 3", "state": "failed", "why": "<&> fell over"}],
}
YAML = "name: limits # <few> & many\n"
SECTIONS = [
    "Detection limits",
    "Probability of detection",
    "Limits against each axis",
    "Size and depth",
    "False calls and chance hits",
    "Operating curves",
    "Examples",
    "Limits of validity",
    "Failures",
    "Provenance",
]


def judged(study: Study, **changed: object) -> StudyResult:
    record = study_record(study)
    tables = study_tables(study)
    record = replace(record, **changed)  # type: ignore[arg-type]
    return evaluate_study(record, tables, {}, draws=60)


def small(*set_ups: SetUp, **changed: object) -> Study:
    return replace(Study(set_ups=set_ups, boards=12, hole_free_boards=10, holes=6), **changed)  # type: ignore[arg-type]


def html(result: StudyResult, examples: tuple[object, ...] = (), title: str = "A study") -> str:
    return study_html(result, examples, PROVENANCE, YAML, title)  # type: ignore[arg-type]


def headings(page: str) -> list[str]:
    return re.findall(r"<h2>(.*?)</h2>", page)


def words(page: str) -> str:
    """The page's text alone."""
    return re.sub(r"\s+", " ", re.sub(r"<(svg|style).*?</\1>|<[^>]+>", " ", page, flags=re.DOTALL))


def section(page: str, heading: str) -> str:
    """The text of one section."""
    return words(page.split(f"<h2>{heading}</h2>")[1].split("<h2>")[0])


@pytest.fixture(scope="module")
def whole() -> StudyResult:
    set_ups = [
        SetUp(
            variant=f"depth <{name}>",
            frames=n,
            axes={"source.target.distance_m": distance_m},
            a50_mm=a,
            mm_per_depth_mm=0.3,
        )
        for name, distance_m, a in (("near", 0.5, 5.0), ("far", 1.0, 7.0))
        for n in (1, 50)
    ]
    return judged(small(*set_ups, depths_mm=(2.0, 10.0)))


@pytest.fixture(scope="module")
def page(whole: StudyResult) -> str:
    examples = tuple(
        example(variant="depth <near>", frames=n, where=where)
        for n in (1, 50)
        for where in ("below", "at", "above")
    )
    return html(whole, examples, "Limits of <cameras>")


class Structure(HTMLParser):
    """Ids, references and pictures of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.labels: list[str] = []
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        self.tags.add(tag)
        self.ids += [attributes["id"] or ""] if "id" in attributes else []
        self.links += [
            value or "" for name, value in attrs if name in ("href", "src", "xlink:href")
        ]
        self.labels += [attributes.get("aria-label") or ""] if tag == "svg" else []


@pytest.fixture(scope="module")
def structure(page: str) -> Structure:
    parsed = Structure()
    parsed.feed(page)
    return parsed


def test_every_section_is_there(page: str) -> None:
    assert headings(page) == SECTIONS
    for name in (
        "limits",
        "sight",
        "overlay",
        "axis-1",
        "axis-2",
        "depth-limits",
        "operating",
        "examples-1",
        "examples-2",
    ):
        assert f'<figure id="{name}"' in page
    assert "No data for this figure" not in page


def test_the_best_set_up_is_sought_among_limits_of_the_same_size(whole: StudyResult) -> None:
    """A width of 2 mm is no better answer than a diameter of 6 mm."""
    examples = tuple(
        example(variant=f"depth <{variant}>", frames=frames)
        for variant in ("near", "far")
        for frames in (1, 50)
    )
    smallest = _best(whole.set_ups, examples)  # type: ignore[arg-type]
    assert smallest is not None
    limits_mm = [set_up.limit.a90_95.value for set_up in whole.set_ups]
    assert smallest.a90_95.value == min(limits_mm)
    of_widths = []
    for set_up in whole.set_ups:
        limit = set_up.limit
        if limit is smallest:
            inspected = replace(limit.record.inspected, size_of="width")
            limit = replace(limit, record=replace(limit.record, inspected=inspected))
        of_widths.append(replace(set_up, limit=limit))
    best = _best(of_widths, examples)  # type: ignore[arg-type]
    assert best is not None
    assert best.a90_95.value == sorted(limits_mm)[1]


def test_nothing_comes_from_outside(structure: Structure) -> None:
    assert not [link for link in structure.links if link.endswith(".js")]
    assert [
        link for link in structure.links if not link.startswith(("#", "data:image/png;base64,"))
    ] == []
    assert len(structure.ids) == len(set(structure.ids))
    assert {link[1:] for link in structure.links if link.startswith("#")} <= set(structure.ids)


def test_every_figure_has_words_for_those_who_cannot_see(
    structure: Structure, whole: StudyResult
) -> None:
    assert len(structure.labels) == 9
    assert all(len(label) > 40 for label in structure.labels)
    assert not [label for label in structure.labels if "nan" in label.split()]


def test_the_first_figure_shows_each_interval_of_a90_in_a_row_of_its_own(
    whole: StudyResult, page: str
) -> None:
    (figure,) = re.findall(r'<figure id="limits">.*?</figure>', page, re.DOTALL)
    (values,) = re.findall(r'data-values="([^"]+)"', figure)
    (panel,) = json.loads(unescape(values))
    rows = {name: (cells[2], cells[6], cells[3]) for name, *cells in panel["lines"]}
    expected = {
        limit.record.label: (limit.a90_interval_mm.low, limit.a90_interval_mm.high, row)
        for row, limit in enumerate(whole.limits)
    }
    assert rows.keys() == expected.keys()
    for name, (low_mm, high_mm, row) in expected.items():
        ends_mm = (low_mm, min(high_mm, whole.limits[row].largest_mm), row)
        assert rows[name] == pytest.approx(ends_mm, rel=1e-3)


def test_the_first_figure_marks_the_limit_to_quote_with_its_number(whole: StudyResult) -> None:
    limit = whole.limits[0]
    axes = Figure().subplots()
    _draw_row(axes, 0, limit, "a set-up", limit.largest_mm)
    _, estimate, bound = axes.get_lines()
    assert estimate.get_xdata()[0] == limit.a90_mm
    assert bound.get_xdata()[0] == limit.a90_95.value > limit.a90_mm
    assert [text.get_text() for text in axes.texts] == [size(limit.a90_95.value)]


def test_the_users_words_are_escaped(page: str) -> None:
    assert "<h1>Limits of &lt;cameras&gt;</h1>" in page
    assert "depth &lt;near&gt;, 1\u00a0frame" in page
    assert "board 3: failed: &lt;&amp;&gt; fell over" in page
    assert "&lt;few&gt; &amp; many" in page
    assert "<near>" not in page
    assert "<few>" not in page


def test_no_number_is_written_as_python_would(page: str) -> None:
    text = words(page)
    assert not re.search(r"\b(nan|inf|None|True)\b", text)
    assert not re.search(r"\d\.\d{6,}", text.split("Provenance")[0])


def test_the_limits_stand_in_their_table(whole: StudyResult, page: str) -> None:
    rows = section(page, "Detection limits")
    for limit in whole.limits:
        assert f"{size(limit.a90_95.value)} " in rows
        assert f"{limit.hits} of {limit.inspections}" in rows
    best = min(whole.limits, key=lambda limit: limit.a90_95.value)
    headline = first_words(page)[0]
    assert f"(a90/95): {size(best.a90_95.value)}\u00a0mm" in headline
    assert "within 15 mm of its own" in words(page)


def test_false_calls_stand_beside_the_wanted_rate(page: str) -> None:
    text = section(page, "False calls and chance hits")
    assert "Thresholds are calibrated to 1 false call per m² on separate undamaged boards" in text
    assert "shuffled positions" in text


@pytest.mark.usefixtures("unsaved")
def test_a_threshold_that_noise_cannot_set_is_warned_of_first() -> None:
    """In the first lines of the page and of the terminal, with the place; not at ten deviations,
    not where given."""
    result = judged(small(SetUp()))
    (set_up,) = result.record.set_ups

    def warned(threshold: float, **changed: object) -> StudyResult:
        assert set_up.calibrated is not None
        score = np.array([4.1, threshold, 60.0, 4.4])
        calibrated = replace(set_up.calibrated, score=score, **changed)  # type: ignore[arg-type]
        record = replace(set_up, threshold=threshold, calibrated=calibrated)
        # the curve stays, as no warning hangs on it: six more evaluations would take seconds
        limit = replace(result.limits[0], record=record)
        return replace(
            result,
            record=replace(result.record, set_ups=(record,)),
            set_ups=(replace(result.set_ups[0], limit=limit),),
            limits=(limit,),
        )

    high = warned(83.0)
    warning = (
        "1 frame: the threshold is 83 deviations, above 10: something other than noise sets it"
        " (calibration board 1, "
    )
    assert text_of(study_parts(high)).startswith(f"warning: {warning}at x, y = −120, 33 mm)")
    assert (
        f"warning: {warning}"
        in words(html(high)).replace("\u00a0", " ").partition("is found 90 %")[0]
    )
    off = np.full(4, np.nan)
    assert f"warning: {warning}off the board)" in text_of(
        study_parts(warned(83.0, x_mm=off, y_mm=off))
    )
    assert "warning" not in text_of(study_parts(warned(10.0)))
    without_calibration = replace(
        high.record, set_ups=(replace(high.record.set_ups[0], calibrated=None),)
    )
    told_nothing = evaluate_study(without_calibration, study_tables(small(SetUp())), {}, draws=20)
    assert "warning" not in text_of(study_parts(told_nothing))
    assert "What set each threshold" not in html(told_nothing)


@pytest.mark.usefixtures("unsaved")
def test_an_axis_may_hold_mappings() -> None:
    """Without a limit too, which is told above the figure at the value's place."""
    shapes = ({"kind": "flat"}, {"kind": "cylinder", "radius_mm": 300.0})
    set_ups = [
        SetUp(variant=shape["kind"], axes={"source.target.board.shape": shape}, a50_mm=a50)
        for shape, a50 in zip(shapes, (6.0, 60.0), strict=True)
    ]
    page = html(judged(small(*set_ups)))
    assert "cylinder" in section(page, "Limits against each axis")
    assert '<figure id="axis-1"' in page
    assert "every target was missed" in words(page)


def test_validity_is_the_results_own(whole: StudyResult, page: str) -> None:
    text = section(page, "Limits of validity")
    for heading, sentences in whole.validity:
        assert heading in text
        assert len(sentences) > 0
    assert "@media print" in page
    assert '<section class="sheet">' in page


@pytest.mark.usefixtures("unsaved")
def test_where_nothing_is_found_the_page_says_so() -> None:
    page = html(judged(small(SetUp(a50_mm=60.0))))
    left_out = ("Limits against each axis", "Size and depth", "Examples")
    assert headings(page) == [name for name in SECTIONS if name not in left_out]
    assert "a90/95 is not demonstrated: every target was missed" in words(page)
    assert "nan" not in words(page).split()


@pytest.mark.usefixtures("unsaved")
def test_where_everything_is_found_the_bound_needs_no_curve() -> None:
    result = judged(small(SetUp(a50_mm=-60.0)))
    page = html(result)
    assert result.limits[0].a90_95.demonstrated
    assert unbroken(limit_sentence(result.limits[0])) in page
    assert "all found: binomial on the 29 smallest" in section(page, "Detection limits")


def test_the_depths_that_are_drawn_stand_in_their_file(whole: StudyResult) -> None:
    frame = DEPTH_LIMITS.frame(depths_at(whole.set_ups))
    for set_up in whole.set_ups:
        rows = frame[frame["set_up"] == set_up.limit.record.label]
        assert rows["diameter_mm"].tolist() == set_up.surface.diameter_mm.tolist()
        for name, column in (
            ("depth_mm", "d90_mm"),
            ("depth_low_mm", "d90_low_mm"),
            ("depth_high_mm", "d90_high_mm"),
        ):
            np.testing.assert_array_equal(rows[name], getattr(set_up.surface, column))


@pytest.mark.usefixtures("unsaved")
def test_depths_without_a_surface_say_why() -> None:
    page = html(judged(small(SetUp(a50_mm=60.0), depths_mm=(2.0, 10.0))))
    assert "No surface: all damages had the same outcome" in section(page, "Size and depth")


@pytest.fixture(scope="module")
def beyond() -> StudyResult:
    """Half of the largest damage is found: every a90/95 lies beyond the 14 mm inspected, some with
    a50 within."""
    set_ups = [SetUp(frames=n, a50_mm=size) for n, size in ((1, 14.0), (10, 13.0), (50, 11.0))]
    return judged(small(*set_ups, depths_mm=(2.0, 10.0)))


@pytest.mark.usefixtures("unsaved")
def test_no_number_on_the_page_lies_beyond_the_sizes_inspected(beyond: StudyResult) -> None:
    page = html(beyond, (example(where="at"),))
    largest = beyond.limits[0].largest_mm
    assert all(limit.beyond(limit.a90_95.value) for limit in beyond.limits)
    assert (
        " ".join(first_words(page))
        .replace("\u00a0", " ")
        .count(f"no limit (a90/95) within the sizes inspected (1 to {largest:.3g}")
        == 3
    )
    rows = section(page, "Detection limits")
    assert rows.replace("&gt;", ">").count(f"> {largest:.3g}") >= 9
    for part in ("Detection limits", "Limits against each axis", "Size and depth"):
        sizes = [
            float(number)
            for number in re.findall(
                r"\d+\.\d\d\b", section(page, part).partition("no regression")[0]
            )
        ]
        assert max(sizes, default=0.0) <= largest, part
        assert "e+" not in section(page, part)
        assert "∞" not in section(page, part)
    assert "6.2 mm, middle, hit" in page


@pytest.fixture(scope="module")
def single() -> StudyResult:
    return judged(small(SetUp()))


@pytest.fixture(scope="module")
def single_page(single: StudyResult) -> str:
    return html(single)


def test_one_set_up_has_no_axis_and_one_depth_no_surface(single_page: str) -> None:
    page = single_page
    assert 'id="axis-1"' not in page
    assert 'id="depth-limits"' not in page
    assert "Size and depth" not in headings(page)


@pytest.mark.usefixtures("unsaved")
def test_given_thresholds_and_no_hole_free_boards() -> None:
    study = small(SetUp())
    record: StudyRecord = study_record(study)
    no_counts = np.zeros(0, int)
    nothing = Unflawed(board=no_counts, repeat=no_counts, calls=no_counts, area_m2=np.zeros(0))
    set_up = replace(record.set_ups[0], unflawed=nothing, calibration_runs=0)
    record = replace(record, false_calls_per_m2=None, set_ups=(set_up,))
    tables: ResultTables = study_tables(study)
    damaged = {name: getattr(tables, name) for name in ("runs", "findings", "operating")}
    tables = replace(
        tables,
        sites=tables.sites.iloc[:0],
        **{n: t[t["role"] == "damaged"] for n, t in damaged.items()},
    )
    page = html(evaluate_study(record, tables, {}, draws=40))
    text = section(page, "False calls and chance hits")
    assert "No undamaged board was inspected" in text
    assert "none: given" in text
    assert "Thresholds were given, not calibrated" in text


def test_the_same_input_gives_the_same_page(single: StudyResult, single_page: str) -> None:
    assert study_html(single, (), PROVENANCE, YAML, "A study") == single_page


def test_names_in_the_figure_say_what_differs_and_fit() -> None:
    labels = ["flat board, no reference, 20 frames", "door panel, no reference, 20 frames"]
    names = _drawn_names({label: label for label in labels})
    assert list(names.values()) == ["flat board", "door panel"]
    (alone,) = _drawn_names({labels[0]: labels[0]}).values()
    assert alone == labels[0]
    (long,) = _drawn_names({"a": "x" * 100}).values()
    assert len(long) == MOST_LETTERS
