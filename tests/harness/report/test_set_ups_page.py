"""The page and the final table of several set-ups: complete, self-contained, honest about what
failed."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.set_ups import compare_set_ups, set_ups_of
from harness.evaluation.summary import summarise_holes
from harness.programs.thesis.answers import THESIS
from harness.report.page import write_report
from harness.report.sections import About, set_ups_grid
from harness.report.set_ups_page import Layout, set_ups_html
from harness.trials.clouds import pair_noise
from harness.vocabulary.path_names import camera_title, in_words
from tests.harness.evaluation.test_limits import switched
from tests.support.pages import first_words
from tests.support.synthetic_tables import (
    CAMERAS,
    World,
    cameras,
    example,
    joined,
    placed,
    provenance,
    set_up_name,
    tables,
)

AXES = ["source.camera.name", "source.target.distance_m"]
SMALLEST = {"azure_kinect_nfov": (3, 4), "kinect_v2": (4, 5), "realsense_l515": (4, 4)}
YAML = "name: cameras # <few> & many\n"


def clouds(distances=(0.5, 1.0)):
    return [
        replace(example(frames), variant=set_up_name(camera, distance))
        for camera in CAMERAS
        for distance in distances
        for frames in (1, 50)
    ]


@pytest.fixture(scope="module")
def varied():
    beam = tables(
        World(repeats=12, rate=lambda hole, frames: float(hole >= 3)),
        (1, 50),
        "L515 at 0.5 m, beam of 0.7 mrad",
    )
    return joined(
        cameras(SMALLEST),
        placed(beam, "realsense_l515", 0.5, of=set_up_name("realsense_l515", 0.5)),
    )


@pytest.fixture(scope="module")
def page(varied):
    return set_ups_html(varied, clouds(), About(provenance(), YAML, "Three cameras", THESIS))


def headings(page: str) -> list[str]:
    return [unescape(text) for text in re.findall(r"<h2>(.*?)</h2>", page)]


def test_rows_name_their_axes_beside_a_variation_that_leaves_them_empty():
    results = {
        "source.camera.name": ["kinect_v2"] * 4 + [None],
        "source.camera.unit_seed": [1, 1, 2, 2, None],
    }
    results |= {
        "source.target.distance_m": [0.5, 1.0, 0.5, 1.0, None],
        "is_variation": [False] * 4 + [True],
    }
    axes = pd.DataFrame(
        {
            "path": list(results)[:3],
            "name": ["camera", "unit seed", "distance"],
            "unit": ["", "", "m"],
        }
    )
    layout = Layout.of(
        replace(
            tables(World()), variants=pd.DataFrame({"variant": [*"abcde"], **results}), axes=axes
        )
    )
    assert layout.rows == {
        "Kinect v2, unit seed 1": ["a", "b"],
        "Kinect v2, unit seed 2": ["c", "d"],
    }
    assert layout.columns == ("0.5 m", "1 m")


def test_every_section_is_there_and_nothing_comes_from_outside(page):
    assert headings(page) == [
        "Holes found",
        "Sizes and positions",
        "Errors of each camera",
        "The thesis' claim",
        "If the facts were different",
        "Thresholds and false calls",
        "Failures",
        "Provenance",
    ]
    assert '<figure id="limits">' in page
    assert "No data for this figure" not in page
    assert (
        "<script src" not in page and page.count("<script>") == 1
    )  # the page's own: contents, sorting
    assert not re.findall(r'(?:src|href)="(?:https?:)?//(?!www\.w3\.org)', page)
    assert "&lt;few&gt; &amp; many" in page
    assert "None" not in re.sub(r"<svg.*?</svg>", "", page, flags=re.DOTALL)
    assert ">nan" not in page


def test_the_same_input_gives_the_same_bytes(varied, page):
    assert (
        set_ups_html(varied, clouds(), About(provenance(), YAML, "Three cameras", THESIS)) == page
    )


@pytest.mark.usefixtures("unsaved")
def test_a_page_of_another_target_does_not_mention_the_thesis():
    page_without_claims = set_ups_html(
        cameras(SMALLEST), [], About(provenance(), YAML, "Three cameras")
    )
    assert "thesis" not in page_without_claims.lower() and "C11" not in page_without_claims


def test_the_answer_says_what_each_camera_finds_and_the_verdict(page):
    expected = "with 50 averaged frames: Azure Kinect DK NFOV unbinned: 9, 8."
    headline, continuation = first_words(page)
    assert headline == f"Found of 11 holes at 0.5 m, 1 m {expected}"
    assert continuation == "Kinect v2: 8, 7; RealSense L515 XGA: 8, 8."
    # one unit of each camera
    assert "Of 1 claim, 1 is undecided (C11)." in page


def test_a_variation_is_shown_beside_its_set_up(page):
    row = page[page.index("L515 at 0.5 m, beam of 0.7 mrad</th>") :]
    row = row[: row.index("</tr>")]
    assert in_words(set_up_name("realsense_l515", 0.5)) in row
    assert ">≠<" in row and "9 of 11 <small>3–11" in row
    assert "7 of 11 <small>5–11" in row  # the set-up's own, with one frame


def test_a_camera_s_file_is_named_by_its_name():
    assert camera_title("kinect_v2").startswith("Kinect")
    assert camera_title("/home/me/my_camera.yaml") == "my camera"


def test_the_table_has_the_counts_of_both_numbers_of_frames():
    results = cameras(SMALLEST)
    compared = compare_set_ups(results, summarise_holes(results.holes, AXES), set_ups_of(results))
    layout = Layout.of(results)
    assert list(layout.rows) == [camera_title(camera) for camera in CAMERAS]
    assert (layout.columns, layout.column_name, layout.column_values) == (
        ("0.5 m", "1 m"),
        "distance (m)",
        (0.5, 1.0),
    )
    rows = [[cell.text for cell in row] for row in set_ups_grid(compared).rows]
    assert rows[4][:4] == ["Kinect v2, distance 0.5 m", "1", "7 of 11\n5–11", "7.94"]
    lines = set_ups_grid(compared, terminal=True).lines()
    assert len(lines) == 1 + 12
    assert re.match(r"Kinect v2, distance 0.5 m +50 +8 of 11 4–11 +6.35$", lines[6])


@pytest.mark.usefixtures("unsaved")
def test_failures_and_missing_set_ups_are_told():
    results = cameras(SMALLEST)
    gone = set_up_name("kinect_v2", 1.0)
    parts = ("holes", "runs", "probes", "noise")
    results = replace(
        results,
        **{
            name: getattr(results, name)[getattr(results, name)["variant"] != gone]
            for name in parts
        },
    )
    expected = provenance() | {
        "failures": [{"what": "damaged-00001", "state": "failed", "why": "ValueError: empty crop"}]
    }
    kept = [cloud for cloud in clouds() if cloud.variant != gone]
    page = set_ups_html(results, kept, About(expected, YAML, "Three cameras"))
    assert "damaged-00001: failed: ValueError: empty crop" in page
    assert gone not in page
    assert ">nan" not in page


def test_effects_have_a_figure_and_a_table():
    names = ("noise", "fixed_pattern")
    results = switched({(): 3, ("noise",): 5, ("fixed_pattern",): 4, names: 6}, names)
    cloud = [replace(example(50), variant="noise+fixed_pattern")]
    page = set_ups_html(results, cloud, About(provenance(), YAML, "Anatomy"))
    assert "Loss due to each effect" in headings(page)
    assert '<figure id="effects">' in page
    # noise alone, with 1 and 50 frames, in the answer and in the table: 2/16 in, which is 3.175 mm
    assert re.sub(r"</?small>", "", page).count("+3.18 mm (+3.18 to +3.18)") == 4
    # alone and last, where the last bit decides how 3.175 is rounded
    assert len(re.findall(r"\+3\.1[78] mm <small>\(\+3\.1[78] to \+3\.1[78]\)", page)) == 4
    assert "all effects together change the 50 % size by +4.76 mm" in page


@pytest.mark.usefixtures("unsaved")
def test_the_page_of_several_set_ups_is_chosen_by_the_tables(tmp_path):
    several = write_report(
        tmp_path / "a", cameras(SMALLEST), [], provenance(), YAML, "T"
    ).read_text()
    assert "Holes found" in headings(several)
    plain_page = write_report(tmp_path / "b", tables(), [], provenance(), YAML, "T").read_text()
    assert "Holes against frames" in headings(plain_page)


def test_pair_noise_finds_the_grain_of_a_known_filter():
    rng = np.random.default_rng(5)

    def frame(shift_m: float) -> np.ndarray:
        white = rng.normal(0, 1e-3, (2, 204, 302))[0]
        return (white[:, :-2] + white[:, 1:-1] + white[:, 2:]) / np.sqrt(3) + 0.7 + shift_m

    everywhere = np.ones((204, 300), bool)
    # the second is displaced as a whole
    first = frame(0.0)
    second = frame(0.017)
    first[:3] = np.nan
    results = pair_noise(first, second, everywhere)
    # three of 60,000 pixels' worth of averages: 1 mm, 2/3, 1/3 and 0 to four standard errors of
    # about 0.01
    assert results["single_frame_mm"] == pytest.approx(1.0, abs=0.02)
    assert results["correlation_u1"] == pytest.approx(2 / 3, abs=0.02)
    assert results["correlation_u2"] == pytest.approx(1 / 3, abs=0.03)
    assert results["correlation_u3"] == pytest.approx(0.0, abs=0.03)
    assert results["correlation_v1"] == pytest.approx(0.0, abs=0.03)
    nowhere = pair_noise(first, second, np.zeros_like(everywhere))
    assert all(np.isnan(value) for value in nowhere.values())
    assert set(nowhere) == set(results)
    assert json.dumps(
        {key: value for key, value in results.items()}
    )  # plain numbers, for the journal
