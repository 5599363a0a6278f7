"""The page of several views and its table for a terminal: complete, self-contained, honest about
what is missing."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape

import pytest

from harness.evaluation.maps import compare_maps
from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.answers import THESIS
from harness.report.page import write_report
from harness.report.perspectives import map_files, perspectives_html
from harness.report.sections import About, ways_grid
from tests.support.pages import first_words
from tests.support.synthetic_perspectives import (
    MapWorld,
    map_example,
    name_of,
    perspectives,
    with_variation,
)
from tests.support.synthetic_tables import provenance

YAML = "name: perspectives # <few> & many\n"
METHODS = ("icp", "cpd", "marks")


def size_bias_mm(diameter_mm: float, views: int, method: str, merge: str) -> float:
    if views == 1:
        return 1.0
    return 1.4 if diameter_mm < 9 else 0.6


@pytest.fixture(scope="module")
def found():
    world = MapWorld(
        first=lambda views, method, merge, frames: (
            4 + (frames == 1) - (views == 9 and merge == "fusion")
        ),
        size_bias_mm=size_bias_mm,
        failing={"icp": 0.25},
    )
    tables = perspectives(world, (1, 50), (1, 2, 9), METHODS, ("grid", "fusion"))
    slam = MapWorld(surface_mm=lambda *which: 1.0, first=lambda *which: 7)
    return with_variation(
        tables,
        slam,
        "SLAM along a hand-held path",
        (24, "odometry", "volume"),
        (1,),
        of=name_of(2, "cpd", "grid"),
    )


@pytest.fixture(scope="module")
def small():
    return perspectives(MapWorld(), (50,), (1, 2), ("cpd",), ("grid", "fusion"))


def examples():
    return [map_example(2), map_example(9, "fusion", registration="marks")]


@pytest.fixture(scope="module")
def page(found):
    return perspectives_html(
        found, examples(), About(provenance(), YAML, "Several perspectives", THESIS)
    )


def headings(page: str) -> list[str]:
    return [unescape(text) for text in re.findall(r"<h2>(.*?)</h2>", page)]


def text_of(page: str) -> str:
    return re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)


def test_every_section_is_there_and_nothing_comes_from_outside(page):
    assert headings(page) == [
        "The thesis' claims and its proposal",
        "Holes found",
        "Registration error",
        "Merged clouds",
        "Results of each map",
        "If the facts were different",
        "Failures",
        "Provenance",
    ]
    assert '<figure id="tre">' in page
    assert "No data for this figure" not in page
    assert (
        "<script src" not in page and page.count("<script>") == 1
    )  # the page's own: contents, sorting
    assert not re.findall(r'(?:src|href)="(?:https?:)?//(?!www\.w3\.org)', page)
    assert "&lt;few&gt; &amp; many" in page
    assert "None" not in text_of(page)
    assert ">nan" not in page


def test_the_answer_counts_holes_and_says_every_verdict(page):
    answer = " ".join(first_words(page))
    assert "With 50 frames a view one view finds 8 of 11 holes, 9 views (ICP, fusion) 9." in answer
    assert re.search(r"Of 4 claims, .*\(.*H1.*\)", page)


def test_the_same_input_gives_the_same_bytes(small):
    origin = About(provenance(), YAML, "T")
    first = perspectives_html(small, [map_example(2)], origin)
    second = perspectives_html(small, [map_example(2)], origin)
    assert first == second


@pytest.mark.usefixtures("unsaved")
def test_a_page_of_another_target_does_not_mention_the_thesis(small):
    page = perspectives_html(small, [], About(provenance(), YAML, "Several perspectives"))
    assert "thesis" not in page.lower()
    answer = " ".join(first_words(page))
    assert answer == "With 50 frames a view one view finds 8 of 11 holes, 2 views (CPD, grid) 8."


def test_failed_registrations_are_shown_with_their_reason(page):
    # a quarter of 12 repeats, two boards, eight views
    assert re.search(
        r"<td[^>]*>48</td>.*the residual is too large \(48\)|the residual is too large <small>",
        page,
    )


def test_a_variation_stands_beside_its_set_up_though_its_frames_differ(page):
    row = page[page.index(">SLAM along a hand-held path<") :]
    row = text_of(row[: row.index("</tbody>")])
    assert ">≠<" in row
    assert "5 of 11 <small>7–11" in row


@pytest.mark.usefixtures("unsaved")
def test_nothing_finished_is_said(found):
    empty = replace(
        found, **{name: getattr(found, name).iloc[:0] for name in ("holes", "runs", "probes")}
    )
    page = perspectives_html(empty, [], About(provenance(), YAML, "T", THESIS))
    assert "No trial of any set-up finished" in page
    assert page.count("? undecided</td>") == 4


@pytest.mark.usefixtures("unsaved")
def test_a_missing_set_up_leaves_a_dash(small):
    gone = name_of(2, "cpd", "fusion")
    names = ("holes", "runs", "probes")
    part = replace(
        small,
        **{name: getattr(small, name)[getattr(small, name)["variant"] != gone] for name in names},
    )
    page = perspectives_html(part, [], About(provenance(), YAML, "T"))
    assert "–</td>" in page
    assert ">nan" not in page


@pytest.mark.usefixtures("unsaved")
def test_the_report_has_a_page_for_each_map_that_turns(small, tmp_path):
    path = write_report(tmp_path, small, [*examples(), map_example(2)], provenance(), YAML, "T")
    files = sorted(file.name for file in tmp_path.iterdir())
    assert files == [
        "map-2-views-cpd-grid-50-frames-2.html",
        "map-2-views-cpd-grid-50-frames.html",
        "map-9-views-marks-fusion-50-frames.html",
        "report.html",
    ]
    links = re.findall(r'<a href="([^"]+)"', path.read_text())
    assert sorted(links) == files[:3]
    assert sorted(map_files([*examples(), map_example(2)])) == files[:3]


def test_the_terminal_shows_counts_of_both_numbers_of_frames(found):
    summary = summarise_holes(found.holes, list(found.axes["path"]))
    compared = compare_maps(found, summary)
    lines = ways_grid(compared).lines()
    assert len(lines) == 1 + 6
    assert re.match(r"registration, merge +1 view +2 views +9 views$", lines[0])
    assert re.match(r"marks, fusion +7 / 8 +7 / 8 +8 / 9$", lines[-1])
    assert "of 11 with N=1 / N=50 frames per view" in ways_grid(compared).title
    half = found.holes["hole"].eq("4") & found.holes["repeat"].lt(6)
    unsure = replace(found, holes=found.holes.assign(detected=found.holes["detected"] & ~half))
    again = compare_maps(unsure, summarise_holes(unsure.holes, list(found.axes["path"])))
    assert re.match(r"icp, grid +7 / 7\+1 +7 / 7\+1 +7 / 7\+1$", ways_grid(again).lines()[1])
