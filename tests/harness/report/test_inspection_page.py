"""The page of an inspection: what it shows stands in the data files, and marks lie where the
findings are."""

from __future__ import annotations

import base64
import csv
import json
import re
from dataclasses import replace
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement
from harness import detect
from harness.report.blocks import split_answer
from harness.report.clouds import residual_norm, residual_rgb
from harness.report.findings import Judged, Remark
from harness.report.inspection_page import (
    best_view,
    class_sections,
    deviation_picture,
    deviation_view,
    numbered_picture,
)
from harness.vocabulary.geometry import Region
from tests.support import recorded_plane as plane
from tests.support.plain_clouds import cloud_of_points


def judged_of(rgb: bool = False, amplitude: bool = False, organised: bool = True) -> Judged:
    """A plane of 30 x 50 pixels that begins at row 100 and column 200, of which all but a margin of
    10 pixels is judged; a square of 4 x 4 pixels at row 110, column 220 is 5 mm deep."""
    v, u = np.mgrid[:30, :50]
    points = np.stack([(u - 25.0) / 500, (v - 15.0) / 500, np.full((30, 50), 1.0)], axis=-1)
    residual = np.full((30, 50), np.nan)
    residual[8:22, 10:40] = 0.0
    residual[10:14, 20:24] = 5e-3
    pixels = np.flatnonzero(residual.ravel() > 1e-3)
    cloud = cloud_of_points(
        points,
        region=Region(100, 130, 200, 250),
        rgb=np.full((30, 50, 3), 80.0) if rgb else None,
        amplitude=np.full((30, 50), 9.0) if amplitude else None,
    )
    if not organised:
        points = points.reshape(1, -1, 3)
        residual = residual.reshape(1, -1)
        cloud = replace(cloud, points_m=points, organised=False, region=Region(0, 1, 0, 1500))
    evidence = Evidence(residual, residual, points[..., 2], 1e-3)
    detection = Detection(9.0, pixels, np.array([-0.007, -0.007, 1.0]))
    measured = Measurement(221.5, 111.5, 16, 9.0, 0.008, np.array([-0.007, -0.007, 1.0]))
    measured = replace(measured, model_diameter_m=0.008, model_depth_m=0.005)
    remark = Remark(certainty="doubtful", flags="at_rim", term="hole")
    return Judged(cloud, evidence, (detection,), (measured,), remarks=(remark,))


def image_in(markup: str) -> np.ndarray:
    """The picture of a figure as (h, w, 3) RGB."""
    encoded = re.search(r'href="data:image/(?:png|jpeg);base64,([^"]+)"', markup)
    assert encoded
    data = np.frombuffer(base64.b64decode(encoded[1]), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert image is not None
    return image[..., ::-1]


def test_the_picture_is_colour_else_infrared_else_the_deviation() -> None:
    assert best_view(judged_of(rgb=True, amplitude=True))[0] == "colour picture"
    assert best_view(judged_of(amplitude=True))[0] == "infrared picture"
    assert best_view(judged_of())[0] == "distance from the surface"
    assert best_view(judged_of(organised=False))[0] == "distance from the surface"


def test_a_mark_lies_on_its_finding_in_the_cropped_picture() -> None:
    """The crop leaves a twelfth of the 30 judged columns about them: 2.5 pixels, from 7.5, so that
    pixel 7 is the first; the rows begin at pixel 5. The square's middle is then 21.5 - 7 + .5."""
    judged = judged_of()
    text = str(numbered_picture(judged, deviation_view(judged), "picture"))
    circle = re.search(r'<circle cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)"', text)
    assert circle
    x, y, radius = map(float, circle.groups())
    image = image_in(text)
    assert (x, y) == (15.0, 7.0) and radius > 1.5
    red = (image[..., 0] > image[..., 2].astype(int) + 50).nonzero()
    assert (red[1].min(), red[1].max() + 1) == (x - 2, x + 2)
    assert (red[0].min(), red[0].max() + 1) == (y - 2, y + 2)
    assert 'class="doubtful"' in text
    assert "<title>1: hole, 8.0 mm wide, 5.00 mm deep, doubtful</title>" in text


def test_a_cloud_without_a_grid_is_drawn_in_its_plan_view() -> None:
    judged = judged_of(organised=False)
    picture = deviation_view(judged)
    text = str(numbered_picture(judged, picture, "picture"))
    circle = re.search(r'<circle cx="([\d.]+)" cy="([\d.]+)"', text)
    assert circle
    x, y = map(float, circle.groups())
    red = (picture.rgb[..., 0] > picture.rgb[..., 2].astype(int) + 50).nonzero()
    assert red[1].min() - 1 <= x <= red[1].max() + 1
    assert red[0].min() - 1 <= y <= red[0].max() + 1


def test_red_is_behind_blue_before_and_grey_was_not_judged() -> None:
    residual_mm = np.array([5.0, -5.0, np.nan])
    behind, before, nothing = residual_rgb(residual_mm, residual_norm(residual_mm))
    assert behind[0] > 2 * behind[2] and before[2] > 2 * before[0]
    assert tuple(nothing) == (185, 190, 196)
    key = str(deviation_picture(judged_of()))
    assert '<span style="left:50.0%">0</span>' in key and "−10" in key


def test_each_class_has_its_own_table() -> None:
    finding = judged_of().findings[0]
    long = replace(finding, id=2, certainty="sure", length_mm=20.0, width_mm=3.0)
    text = "".join(map(str, class_sections([finding, long], {"sure": "real", "doubtful": "noise"})))
    assert text.index("Sure: 1") < text.index("20.0 × 3.0") < text.index("Doubtful: 1")
    assert "at rim" in text and "unknown" in text
    uncertain = replace(finding, diameter_se_mm=0.21, depth_se_mm=0.05, certainty="sure")
    text = "".join(map(str, class_sections([uncertain], {"sure": "real"})))
    assert "8.0\u00a0±\u00a00.2" in text and "5.00\u00a0±\u00a00.05" in text
    assert "Rim: none" in str(class_sections([finding], {"rim": "cut"})[0])
    findings = [replace(finding, id=n, certainty="sure") for n in range(1, 24)]
    assert "<summary>3 more</summary>" in "".join(
        map(str, class_sections(findings, {"sure": "real"}))
    )


@pytest.mark.usefixtures("unpictured")
def test_every_number_of_the_page_stands_in_a_data_file(tmp_path: Path) -> None:
    capture = plane.write_open3d_folder(tmp_path / "<b>plate", 4, noise_mm=0.6)
    out = tmp_path / "out"
    arguments = [str(capture), "--out", str(out), "--false-calls", "0.1"]
    assert detect.main(arguments) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    facts = json.loads((out / "findings.json").read_text())
    with (out / "findings.csv").open(newline="") as stream:
        (row,) = csv.DictReader(stream)
    verdict = facts["verdict"]
    headline, continuation = split_answer(verdict["sentence"])
    assert f'<p class="answer">{headline}</p>\n<p>{continuation}</p>' in page
    assert "<b>plate" not in page and "&lt;b&gt;plate" in page
    head, _, body = page.partition("<main>")
    assert verdict["sentence"].startswith("One hole found on ")
    assert f"{1e4 * verdict['judged_area_m2']:.4g} cm2" in head
    assert f"{100 * verdict['judged_share_of_outline']:.0f} %" in head
    assert verdict["counts"] == {"sure": 1, "doubtful": 0, "rim or blind": 0}
    cells = re.findall(r"<t[dh][^>]*>([^<]*)</t[dh]>", body[: body.index("The cloud")])
    for column, digits in (("diameter_mm", 1), ("depth_mm", 2), ("x_mm", 1), ("score", 2)):
        text = f"{float(row[column]):.{digits}f}"
        assert any(cell.split("\u00a0")[0] == text for cell in cells)
    assert "webgl" in unescape(page)
    assert not re.search(r'(src|href)="https?:', page)


@pytest.mark.usefixtures("unpictured")
def test_warnings_stand_first_and_nothing_found_is_said(tmp_path: Path) -> None:
    capture = plane.write_open3d_folder(tmp_path / "plain", 4, noise_mm=0.6, hole=False)
    out = tmp_path / "out"
    assert detect.main([str(capture), "--out", str(out), "--threshold", "20"]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "No damage found on " in page and "the number of false calls is unknown" in page
    assert "No findings." in page and "Sure: none" in page
    stored = np.zeros((72, 96), np.uint16)
    stored[10:13, 10:13] = 500
    np.save(tmp_path / "few.npy", stored)
    lens = ["--intrinsics", str(plane.write_lens(tmp_path / "lens.json")), "--crop", "none"]
    assert detect.main([str(tmp_path / "few.npy"), *lens, "--out", str(out)]) == 0
    page = (out / "report.html").read_text(encoding="utf-8")
    warning = page.index('<p class="fail">warning: 9 points are too few')
    assert warning < page.index('<p class="answer">')
