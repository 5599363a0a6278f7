"""Families of figures: the mean ratio, the trend, and faulty declarations."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.programs.scorecard.families import FAMILIES, FamilyScore, family_scores
from harness.programs.scorecard.figures import FiguresFile, Score, read_figures
from harness.stills.statistics import Reading
from harness.vocabulary.errors import UserError

HEAD = """
families:
  - name: over_distance
    over: distance_m
    figures: [wall_1, wall_2, wall_4, wall_8]
figures:
"""
FIGURE = """
  - name: wall_{metres}
    camera: azure_kinect_nfov
    quantity: temporal_sigma_mm
    conditions: {{distance_m: {metres}, angle_deg: {angle}}}
    published: {{value: 2.0, tolerance: 0.1}}
    source: a wall
    tag: W
    calibration: false
"""
DISTANCES = (1, 2, 4, 8)


def text_of(angles: tuple[int, ...] = (0, 0, 0, 0)) -> str:
    figures = [
        FIGURE.format(metres=metres, angle=angle)
        for metres, angle in zip(DISTANCES, angles, strict=True)
    ]
    return HEAD + "".join(figures)


def read(folder: Path, text: str) -> FiguresFile:
    path = folder / "figures.yaml"
    path.write_text(text)
    return read_figures(path)


def family_of(folder: Path, ratios: list[float], text: str = "") -> FamilyScore:
    file = read(folder, text or text_of())
    scores = [
        Score(figure, Reading(2.0 * ratio))
        for figure, ratio in zip(file.figures, ratios, strict=True)
    ]
    (family,) = family_scores(file.families, scores)
    return family


def test_the_slope_is_that_of_a_power_law(tmp_path: Path) -> None:
    """Ratios 0.9 x^0.1: from 1 to 8 m the ratio grows by 8^0.1 = 1.231."""
    family = family_of(tmp_path, [0.9 * metres**0.1 for metres in DISTANCES])
    assert family.slope == pytest.approx(0.1)
    assert family.slope_half_width == pytest.approx(0.0, abs=1e-6)
    assert family.change == pytest.approx(8**0.1)
    assert family.mean == pytest.approx(0.9 * 8 ** (0.1 / 2))
    assert family.has_trend
    assert not family.is_off
    assert family.verdict == "trend (new)"
    assert family.fell_behind


def test_the_interval_is_students(tmp_path: Path) -> None:
    """By hand: x = -1.5 .. 1.5 ln 2, residuals d (1, -1, -1, 1), 2 degrees of freedom, t 4.303."""
    d = 0.02
    family = family_of(tmp_path, np.exp([d, -d, -d, d]).tolist())
    spread = np.log(2) * np.sqrt(5.0)
    error = np.sqrt(4 * d**2 / 2) / spread
    assert family.slope == pytest.approx(0.0, abs=1e-12)
    assert family.slope_half_width == pytest.approx(4.3027 * error, rel=1e-4)
    assert family.verdict == "agrees"
    assert family.slope_interval.low == pytest.approx(-family.slope_half_width)


def test_a_small_or_uncertain_slope_is_no_trend(tmp_path: Path) -> None:
    small = family_of(tmp_path, [metres**0.04 / 1.05 for metres in DISTANCES])
    assert abs(small.slope) > small.slope_half_width
    assert small.change == pytest.approx(8**0.04)  # 1.087
    assert small.verdict == "agrees"
    uncertain = family_of(tmp_path, [0.8, 1.2, 0.85, 1.25])
    assert uncertain.change > 1.1
    assert not uncertain.has_trend


@pytest.mark.parametrize(
    ("ratio", "is_off"), [(0.9, True), (0.92, False), (1.09, False), (1.11, True)]
)
def test_a_family_is_off_beyond_10_percent(tmp_path: Path, ratio: float, is_off: bool) -> None:
    family = family_of(tmp_path, [ratio] * 4)
    assert family.is_off == is_off
    assert family.verdict == ("off (new)" if is_off else "agrees")


def test_a_reason_tells_a_known_failure_from_a_new_one(tmp_path: Path) -> None:
    text = text_of().replace("over: distance_m", "over: distance_m\n    fails: the wall is dark")
    family = family_of(tmp_path, [0.7] * 4, text)
    assert family.verdict == "off"
    assert not family.fell_behind


def test_a_value_that_is_missing_makes_the_family_off(tmp_path: Path) -> None:
    family = family_of(tmp_path, [1.0, 1.0, float("nan"), 1.0])
    assert family.is_off
    assert not family.passes


def test_an_angle_counts_by_the_inverse_of_its_cosine(tmp_path: Path) -> None:
    text = text_of((0, 60, 45, 30)).replace("over: distance_m", "over: angle_deg")
    family = family_of(tmp_path, [1.0, 2.0**0.5, 2.0**0.25, (4 / 3) ** 0.25], text)
    assert family.slope == pytest.approx(0.5)


def test_a_family_is_judged_only_if_all_its_figures_were_scored(tmp_path: Path) -> None:
    file = read(tmp_path, text_of())
    scores = [Score(figure, Reading(2.0)) for figure in file.figures[:3]]
    assert family_scores(file.families, scores) == []


def test_the_table_states_mean_slope_and_verdict(tmp_path: Path) -> None:
    family = family_of(tmp_path, [0.9 * metres**0.1 for metres in DISTANCES])
    (row,) = FAMILIES.data([family])
    assert row["mean"] == pytest.approx(0.9986, rel=1e-3)
    assert row["figures"] == 4
    assert row["over"] == "distance_m 1 to 8"
    assert row["verdict"] == "trend (new)"
    assert row["use"] == "blind"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("wall_8]", "wall_9]", "names no figure of the file: wall_9"),
        (", wall_8]", "]", "at least 4"),
        ("over: distance_m", "over: albedo", "does not vary in albedo"),
        ("over: distance_m", "over: step_mm", "does not vary in step_mm"),
        ("calibration: false", "calibration: true", "mixes cameras, quantities or uses"),
        ("{value: 2.0, tolerance: 0.1}", "{below: 2.0}", "a figure without a value"),
    ],
)
def test_a_mistake_in_a_family_is_named_with_its_place(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    text = text_of()
    assert old in text
    with pytest.raises(UserError) as caught:
        read(tmp_path, text.replace(old, new, 1))
    assert says in str(caught.value)
    assert "figures.yaml:" in str(caught.value)


def test_the_projects_families_are_of_blind_figures() -> None:
    file = read_figures()
    use = {figure.name: figure.use for figure in file.figures}
    assert file.families
    for family in file.families:
        assert {use[name] for name in family.figures} == {"blind"}, family.name
