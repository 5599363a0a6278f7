"""The report: complete, self-contained, the same bytes twice, and honest about what is missing or
failed."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.answers import THESIS
from harness.report.page import answer_sentence, report_html, write_report
from harness.report.sections import About, holes_grid
from harness.vocabulary.errors import UserError
from harness.vocabulary.text import inches
from tests.support.pages import first_words
from tests.support.synthetic_tables import Tables, World, example, joined, provenance, tables

YAML = "name: averaging\nsweep:\n  capture.frames: [1, 50]  # <few> & many\n"
VOID = {"meta", "br", "img", "hr", "link", "input"}


class Outline(HTMLParser):
    """Headings, open tags that were never closed, and every address that a browser would load."""

    def __init__(self) -> None:
        super().__init__()
        self.headings: list[str] = []
        self.stack: list[str] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.labels = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = dict(attrs)
        if tag not in VOID:
            self.stack.append(tag)
        self.addresses += [
            value or "" for name, value in attrs if name in ("src", "href", "xlink:href", "data")
        ]
        self.ids += [attributes["id"] or ""] if "id" in attributes else []
        self.labels += tag == "svg" and bool(attributes.get("aria-label"))

    def handle_endtag(self, tag: str) -> None:
        assert self.stack.pop() == tag

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.stack.pop()

    def handle_data(self, data: str) -> None:
        if self.stack and self.stack[-1] == "h2":
            self.headings.append(data)


@pytest.fixture(scope="module")
def results() -> Tables:
    far = tables(
        World(rate=lambda hole, frames: float(hole >= 6)),
        frames=(1, 50),
        variant="distance 1100 mm",
    )
    return joined(tables(frames=(1, 10, 50)), far)


@pytest.fixture(scope="module")
def page(results: Tables) -> str:
    return report_html(
        results,
        [example(50), example(1, noise_mm=0.9)],
        About(provenance(), YAML, "Averaging", THESIS),
    )


@pytest.fixture(scope="module")
def outline(page: str) -> Outline:
    outline = Outline()
    outline.feed(page)
    return outline


def test_sections_come_in_order(outline: Outline) -> None:
    assert outline.headings == [
        "What the camera saw",
        "Holes against frames",
        "Sizes and positions",
        "Noise against frames",
        "The thesis' claims",
        "If the facts were different",
        "False calls",
        "Failures",
        "Provenance",
    ]
    assert outline.stack == []


def test_nothing_is_loaded_from_elsewhere(page: str, outline: Outline) -> None:
    assert outline.addresses
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in outline.addresses)
    assert (
        "<script src" not in page and page.count("<script>") == 1
    )  # the page's own: contents, sorting
    assert not re.search(r"url\((?!#)", page)
    assert "@import" not in page


def test_ids_are_unique_and_references_resolve(page: str, outline: Outline) -> None:
    assert len(outline.ids) == len(set(outline.ids))
    wanted = set(re.findall(r"url\(#([^)]+)\)", page)) | {
        a[1:] for a in outline.addresses if a.startswith("#")
    }
    assert wanted
    assert wanted <= set(outline.ids)


def test_every_figure_is_well_formed_and_has_words_for_those_who_cannot_see(
    page: str, outline: Outline
) -> None:
    figures = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(figures) == outline.labels == 4
    for figure in figures:
        ET.fromstring(figure)


def test_the_same_input_gives_the_same_bytes(page: str, results: Tables) -> None:
    again = report_html(
        results,
        [example(50), example(1, noise_mm=0.9)],
        About(provenance(), YAML, "Averaging", THESIS),
    )
    assert again == page


def test_answer_counts_and_verdicts_are_told(page: str) -> None:
    assert first_words(page) == [
        "With 50 averaged frames the camera finds 8 of 11 holes, from 6.35 mm (1/4 in).",
        "With one frame, 7 of 11 holes, from 7.94 mm (5/16 in).",
    ]
    assert "Of 8 claims, 8 are borne out (C1, C1b, C2, C3, C4, C5, C6, C9). Each criterion" in page
    assert page.count("✓ borne out") == 8
    assert page.count(">50/50 <small>") == 7 + 8 + 8
    assert "0.93–1.00" in page
    assert "capture.frames: [1, 50]  # &lt;few&gt; &amp; many" in page
    assert "python -m harness.sweep experiments/averaging.yaml" in page
    assert "No trial failed." in page


@pytest.mark.usefixtures("unsaved")
def test_a_page_of_another_target_does_not_mention_the_thesis(results: Tables, page: str) -> None:
    page_without_claims = report_html(
        results, [example(50), example(1, noise_mm=0.9)], About(provenance(), YAML, "Dents")
    )
    assert "thesis" in page
    assert "thesis" not in page_without_claims.lower()
    assert not re.search(
        r"\bC[1-9]\b", re.sub(r"<svg.*?</svg>", "", page_without_claims, flags=re.DOTALL)
    )
    assert "The thesis' claims" not in page_without_claims
    assert "If the facts were different" in page_without_claims


@pytest.mark.usefixtures("unsaved")
def test_a_claim_that_fails_is_shown_as_failing() -> None:
    world = World(rate=lambda hole, frames: float(hole >= 2), size_bias_mm=lambda diameter: 3.0)
    failures = [{"what": "repeat 7", "state": "crashed", "why": "<out of memory>"}]
    failures += [
        {"what": f"repeat {number}", "state": "failed", "why": "boom"} for number in range(5)
    ]
    origin = provenance() | {"failures": failures}
    page = report_html(
        tables(world, frames=(1, 50)),
        [example(50, "cylinder")],
        About(origin, YAML, "Averaging", THESIS),
    )
    assert page.count("✗ not borne out") >= 4
    assert "More than the thesis: 2–3" in page
    assert "6 parts of the experiment failed" in page
    assert "repeat 7: crashed: &lt;out of memory&gt;" in page
    assert "repeat 0, repeat 1, repeat 2 and 2 others: failed: boom" in page


@pytest.mark.usefixtures("unsaved")
def test_little_data_still_make_a_page() -> None:
    results = tables(World(repeats=1, rate=lambda hole, frames: 0.0), frames=(1,))
    page = report_html(results, [], About({}, "", "Averaging", THESIS))
    assert "With one frame the camera finds 0 of 11 holes, 1–11 undecided.</p>" in page
    assert "Of 8 claims, 8 are undecided" in page
    assert "The one repeat is" in page
    assert "No data for this figure were stored." in page
    assert "not recorded" in page
    nothing = dataclasses.replace(
        results, holes=pd.DataFrame(), runs=results.runs[:0], probes=results.probes[:0]
    )
    assert "No trial of the main experiment finished" in report_html(
        nothing, [], About(provenance(), YAML, "Averaging")
    )


def test_an_all_invalid_cloud_is_drawn() -> None:
    cloud = example(50)
    blank = dataclasses.replace(
        cloud,
        residual_mm=np.full_like(cloud.residual_mm, np.nan),
        detected=np.zeros_like(cloud.detected),
    )
    page = report_html(tables(frames=(50,)), [blank], About(provenance(), YAML, "Averaging"))
    assert "0 of 11 holes marked" in page
    drawings = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    (figure,) = [drawing for drawing in drawings if "0 of 11 holes marked" in drawing]
    ET.fromstring(figure)


@pytest.mark.usefixtures("unsaved")
def test_the_file_is_written_whole_or_refused(tmp_path: Path) -> None:
    one_set_up = tables(frames=(50,))
    path = write_report(tmp_path / "new", one_set_up, [], provenance(), YAML, "Averaging")
    assert path == tmp_path / "new" / "report.html"
    assert path.read_text(encoding="utf-8").endswith("</html>\n")
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"]
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError):
        write_report(tmp_path / "file", one_set_up, [], provenance(), YAML, "Averaging")


def test_answer_tells_what_is_undecided() -> None:
    results = tables(
        World(rate=lambda hole, frames: 0.5 if hole == 5 else float(hole > 5)), frames=(1, 50)
    )
    sentence = answer_sentence(summarise_holes(results.holes))
    expected = "With one frame and with 50 the camera finds the same: 6 of 11 holes, from 9.52 mm"
    assert sentence == f"{expected} (3/8 in), 5 undecided."


def test_answer_of_one_number_of_frames() -> None:
    sentence = answer_sentence(summarise_holes(tables(frames=(50,)).holes))
    expected = "With 50 averaged frames the camera finds 8 of 11 holes, from 6.35 mm (1/4 in)."
    assert sentence == expected


def test_terminal_table_and_its_plain_twin_say_the_same() -> None:
    from rich.console import Console

    summary = summarise_holes(tables().holes)
    plain = holes_grid(summary, terminal=True).lines()
    assert plain[0].split()[:9] == [
        "hole",
        "drill",
        "mm",
        "N=1",
        "N=2",
        "N=5",
        "N=10",
        "N=20",
        "N=50",
    ]
    assert plain[4].split()[:9] == [
        "4",
        '1/4"',
        "6.35",
        "0/50",
        "0/50",
        "0/50",
        "50/50",
        "50/50",
        "50/50",
    ]
    assert len(plain) == 12
    console = Console(width=80, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(holes_grid(summary, terminal=True).rich())
    drawn = [line.split() for line in console.export_text().splitlines() if line.strip()]
    assert [line for line in drawn if line and line[0].isdecimal()] == [
        line.split() for line in plain[1:]
    ]


def test_inches() -> None:
    assert inches(25.4 / 16) == "1/16 in"
    assert inches(25.4) == "1 in"
    assert inches(20.0) == ""
