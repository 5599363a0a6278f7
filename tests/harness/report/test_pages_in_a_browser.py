"""Every kind of page in a browser: it fits a telephone and a desktop, and is legible in the light
and in the dark."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from harness import detect
from harness.programs.atlas import ask
from harness.report.blocks import THEME, split_answer
from harness.report.page import report_html
from harness.report.perspectives import perspectives_html
from harness.report.sections import About
from harness.report.set_ups_page import set_ups_html
from tests.harness.report.test_perspectives_page import METHODS, examples
from tests.harness.report.test_set_ups_page import SMALLEST, clouds
from tests.harness.report.test_study_page import SetUp, html, judged, small
from tests.harness.report.test_study_page import example as study_example
from tests.support import recorded_plane
from tests.support.browser import Measured, measure
from tests.support.pages import first_words
from tests.support.synthetic_perspectives import MapWorld, perspectives
from tests.support.synthetic_tables import cameras, example, provenance, tables

PAGES = ("sweep", "set_ups", "perspectives", "study", "inspection", "atlas")
TALLEST_PX = 6000
"""Most of a page on a telephone, with its folds closed."""
STYLE = Path(__file__).parents[3] / "harness" / "report" / "style.css"


def page_texts() -> dict[str, str]:
    """Return the pages of experiments by name."""
    origin = About(provenance(), "name: x\n", "A title")
    maps = perspectives(MapWorld(), (1, 50), (1, 2, 9), METHODS, ("grid", "fusion"))
    set_ups = [
        SetUp(variant=f"camera {name}", frames=frames, a50_mm=a50_mm)
        for name, a50_mm in (("one", 4.0), ("two", 5.0), ("three", 6.0))
        for frames in (1, 10, 50)
    ]
    boards = tuple(
        study_example(variant="camera one", frames=50, where=where)
        for where in ("below", "at", "above")
    )
    return {
        "sweep": report_html(tables(frames=(1, 10, 50)), [example(50)], origin),
        "set_ups": set_ups_html(cameras(SMALLEST), clouds(), origin),
        "perspectives": perspectives_html(maps, examples(), origin),
        "study": html(judged(small(*set_ups)), boards),
    }


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The file of each page by name."""
    folder = tmp_path_factory.mktemp("pages")
    paths = {}
    for name, text in page_texts().items():
        paths[name] = folder / f"{name}.html"
        paths[name].write_text(text, encoding="utf-8")
    capture = recorded_plane.write_open3d_folder(folder / "plate", 4, noise_mm=0.6)
    assert detect.main([str(capture), "--out", str(folder / "inspected")]) == 0
    paths["inspection"] = folder / "inspected" / "report.html"
    question = ["--damage", "hole", "--size", "5mm", "--distance", "1m"]
    assert ask.main([*question, "--out", str(folder / "atlas")]) == 0
    paths["atlas"] = folder / "atlas" / "atlas.html"
    return paths


@pytest.fixture(scope="module")
def shown(
    written: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[Measured]]:
    """What the browser shows of each page by name."""
    measured = measure(list(written.values()), tmp_path_factory.mktemp("browser"))
    return {name: measured[path] for name, path in written.items()}


@pytest.mark.parametrize("name", PAGES)
def test_a_page_fits_every_window(shown: dict[str, list[Measured]], name: str) -> None:
    for page in shown[name]:
        assert (page.overflow_px, page.wide) == (0, []), page
        assert page.missing == [], page


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_legible_in_the_light_and_in_the_dark(
    shown: dict[str, list[Measured]], name: str
) -> None:
    assert {page.scheme for page in shown[name]} == {"light", "dark"}
    for page in shown[name]:
        assert page.faint == [], page


@pytest.mark.parametrize("name", PAGES)
def test_a_page_is_short_on_a_telephone(shown: dict[str, list[Measured]], name: str) -> None:
    heights_px = [page.height_px for page in shown[name] if page.width_px == 400]
    assert len(heights_px) == 2
    assert max(heights_px) <= TALLEST_PX


def test_the_first_clauses_of_an_answer_are_the_headline() -> None:
    clause = "One two three four five six seven eight nine ten eleven"
    assert split_answer(f"{clause}.") == (f"{clause}.", "")
    assert split_answer(f"{clause}; a b; c d.") == (f"{clause}; a b; c d.", "")
    assert split_answer(f"{clause}; {clause.lower()}; c.") == (
        f"{clause}.",
        f"{clause}; c.",
    )
    assert split_answer(f"{clause} {clause}. A b.") == (f"{clause} {clause}.", "A b.")


@pytest.mark.parametrize("name", [name for name in PAGES if name != "atlas"])
def test_a_headline_has_at_most_twenty_words(written: dict[str, Path], name: str) -> None:
    headline = first_words(written[name].read_text(encoding="utf-8"))[0]
    # a number and its unit, which a no-break space joins, count once
    assert len(headline.split(" ")) <= 20


def test_a_figure_takes_its_colours_from_the_page() -> None:
    """Without an image, which keeps its colours, a figure has no colour of its own."""
    page = page_texts()["study"]
    figures = re.findall(r'<figure id="(?:limits|overlay|axis-1)">.*?</figure>', page, re.S)
    assert len(figures) == 3
    for figure in figures:
        colours = re.findall(r"(?:fill|stroke): (#\w+)", figure)
        assert colours == []
        assert re.search(r"(?:fill|stroke): var\(--blue, #0072b2\)", figure)


@pytest.mark.parametrize("variable", sorted(set(THEME.values())))
def test_the_page_has_every_colour_for_the_light_and_for_the_dark(variable: str) -> None:
    light, dark = STYLE.read_text().split("prefers-color-scheme: dark")
    (bright,) = re.findall(rf"{variable}: (#\w+)", light)
    (in_the_dark,) = re.findall(rf"{variable}: (#\w+)", dark)
    assert bright != in_the_dark or variable == "--orange"
