"""Figures of margins and thresholds show the numbers of the tables."""

import html
import json
import re
from typing import Any

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.summary import false_calls, noise_against_frames, summarise_holes
from harness.report.margins import margin_figure, threshold_figure
from tests.support.synthetic_tables import tables

FRAMES = (1, 10, 50)


@pytest.fixture(scope="module")
def summary() -> pd.DataFrame:
    holes = tables(frames=FRAMES).holes.copy()
    # of hole 4 with 50 frames: one repeat above, all others below
    chosen = (holes["hole"] == "4") & (holes["frames"] == 50)
    holes.loc[chosen, "signal"] = np.where(holes.loc[chosen, "repeat"] == 0, 12.0, 8.0)
    return summarise_holes(holes)


def lines_of(drawing: str) -> list[list[Any]]:
    """Return the lines of all panels: name, then drawn and true coordinates of each point."""
    values = re.search(r'data-values="([^"]*)"', drawing)
    assert values is not None
    panels = json.loads(html.unescape(values.group(1)))
    return [line for panel in panels for line in panel["lines"]]


def test_a_margin_is_the_highest_score_over_the_threshold(summary: pd.DataFrame) -> None:
    row = summary[(summary["hole"] == "4") & (summary["frames"] == 50)].iloc[0]
    assert row["margin_lowest"] == 8 / 4
    assert row["margin_highest"] == 12 / 4
    assert row["margin_mean"] == pytest.approx((12 / 4 + (row["n"] - 1) * 2) / row["n"])
    missed = summary[(summary["hole"] == "1") & (summary["frames"] == 50)].iloc[0]
    assert missed["margin_mean"] == 3 / 4


def test_each_size_has_a_panel_and_one_counts_the_holes(summary: pd.DataFrame) -> None:
    drawing = str(margin_figure(summary))
    lines = lines_of(drawing)
    margins = [line for line in lines if line[0] == "score / threshold"]
    assert len(margins) == 11
    of_hole_1 = np.reshape(margins[0][1:], (-1, 4))
    assert of_hole_1[:, 2].tolist() == list(FRAMES)
    assert of_hole_1[:, 3] == pytest.approx(3 / 4)
    # the panel, 82 high below its title, ends at a quarter beyond the lowest and highest margin
    log_low = np.log(summary["margin_lowest"].min() / 1.25)
    log_high = np.log(summary["margin_highest"].max() * 1.25)
    share = (np.log(3 / 4) - log_low) / (log_high - log_low)
    assert of_hole_1[0, 1] == pytest.approx(16 + 82 * (1 - share), abs=0.1)
    # an axis for all: the higher margin of hole 11 stands higher, by as much as the ticks say
    of_hole_11 = np.reshape(margins[-1][1:], (-1, 4))
    ticks = re.findall(r'<text x="-4" y="([\d.]+)" text-anchor="end">(\d+)<', drawing)
    y_px = {text: float(y) for y, text in ticks[:3]}
    px_per_log = (y_px["2"] - y_px["1"]) / np.log(2)
    panels_px = 2 * 106  # two rows of panels lie between
    risen_px = of_hole_11[0, 1] - panels_px - of_hole_1[0, 1]
    assert risen_px == pytest.approx(
        px_per_log * np.log(of_hole_11[0, 3] / of_hole_1[0, 3]), abs=0.3
    )
    (counts,) = [line for line in lines if line[0] == "holes found"]
    counts_found = [(summary["status"] == "found")[summary["frames"] == n].sum() for n in FRAMES]
    assert np.reshape(counts[1:], (-1, 4))[:, 3].tolist() == counts_found
    assert counts_found == [7, 8, 8]


def test_with_one_number_of_frames_margins_stand_over_the_size(summary: pd.DataFrame) -> None:
    drawing = str(margin_figure(summary[summary["frames"] == 50]))
    (line,) = lines_of(drawing)
    points = np.reshape(line[1:], (-1, 4))
    of_50 = summary[summary["frames"] == 50].sort_values("true_diameter_mm")
    assert points[:, 2] == pytest.approx(of_50["true_diameter_mm"].to_numpy(float), rel=1e-3)
    assert points[:, 3] == pytest.approx(of_50["margin_mean"].to_numpy(float), rel=1e-3)


def test_without_margins_there_is_no_figure(summary: pd.DataFrame) -> None:
    assert margin_figure(summary.assign(margin_mean=np.nan)) is None


def test_the_threshold_stands_in_millimetres_beside_the_noise() -> None:
    results = tables(frames=FRAMES)
    calls = false_calls(results.runs)
    noise = noise_against_frames(results.probes)
    drawn = {line[0]: line for line in lines_of(str(threshold_figure(calls, noise)))}
    assert set(drawn) == {"threshold", "fixed pattern", "noise of the average"}
    threshold = np.reshape(drawn["threshold"][1:], (-1, 4))
    damaged = calls[calls["role"] == "damaged"].sort_values("frames")
    assert threshold[:, 2].tolist() == list(FRAMES)
    assert threshold[:, 3] == pytest.approx(damaged["threshold_mm"].to_numpy(float), rel=1e-3)
    temporal = np.reshape(drawn["noise of the average"][1:], (-1, 4))
    assert temporal[:, 3] == pytest.approx(noise["temporal_rms_mm"].to_numpy(float), rel=1e-3)


def test_one_number_of_frames_has_no_figure_of_thresholds() -> None:
    results = tables(frames=(50,))
    drawing = threshold_figure(false_calls(results.runs), noise_against_frames(results.probes))
    assert drawing is None
