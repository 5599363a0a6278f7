"""The posterior over set-ups on tables of known answer, its sentence and its page, and the random
draw of set-ups."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.summary import summarise_holes
from harness.experiment.load import load_experiment
from harness.programs.thesis.answers import THESIS
from harness.programs.thesis.inference import (
    KIND,
    SET_UP,
    _interval,
    borne_out_if,
    posterior_of,
)
from harness.report.sections import About
from harness.report.set_ups_page import Layout, set_ups_html
from tests.support.synthetic_tables import World, joined, provenance, tables

AXES = {
    "source.target.blind_depth_mm": (2.0, 4.0),
    "source.target.distance_m": tuple(0.5 + 0.01 * i for i in range(11)),
}
PATHS = list(AXES)


@pytest.fixture(scope="module")
def results():
    """22 set-ups; those 4 mm deep find hole 3 and all larger ones in every repeat, the others as
    the thesis did."""
    everything = World(repeats=4, rate=lambda hole, frames: float(hole >= 3))
    parts = []
    for depth in AXES[PATHS[0]]:
        for distance in AXES[PATHS[1]]:
            world = World(repeats=4) if depth == 2.0 else everything
            part = tables(world, (1, 50), f"{depth} at {distance:.2f}")
            settings = {PATHS[0]: depth, PATHS[1]: distance}
            placed = {
                name: getattr(part, name).assign(**settings)
                for name in ("holes", "runs", "probes", "noise")
            }
            variants = part.variants.assign(is_variation=False, reference="", **settings)
            parts.append(replace(part, variants=variants, **placed))
    names = [
        {"path": path, "name": name, "unit": ""}
        for path, name in zip(PATHS, ("depth", "distance"), strict=True)
    ]
    return replace(joined(*parts), axes=pd.DataFrame(names))


def test_the_posterior_by_hand(results):
    """A hole found 4 of 4 times has 0.9; other set-ups miss by hole 3 with 50 frames and by 3 and
    4 with one frame."""
    table = posterior_of(summarise_holes(results.holes, PATHS), PATHS)
    set_ups = table[table["axis"] == SET_UP]
    assert len(set_ups) == 22 and set_ups["posterior_share"].sum() == pytest.approx(1)
    right = 0.9**22
    wrong = 0.9**19 * 0.1**3
    assert set_ups["likelihood"].tolist() == pytest.approx([right] * 11 + [wrong] * 11)
    depth = table[table["value"].str.startswith("2") & (table["axis"] != SET_UP)].iloc[0]
    assert (depth["prior_share"], depth["likelihood"]) == (pytest.approx(0.5), pytest.approx(right))
    assert depth["posterior_share"] == pytest.approx(right / (right + wrong))
    sentence = borne_out_if(table)
    assert sentence.startswith(
        "Of what the thesis leaves open, its outcome speaks against blind depth of 4 mm, and "
        "does not decide distance (a value is doubtful"
    )
    assert "would need another cause" in sentence
    assert "probability of 0.098" in sentence
    certain_of_nothing = table.assign(posterior_share=table["prior_share"])
    assert "speaks against nothing" in borne_out_if(certain_of_nothing)
    of_few = table.assign(posterior_high=1.0)
    assert "speaks against nothing" in borne_out_if(of_few)


def test_the_interval_of_a_share_holds_for_all_values_jointly():
    """400 equally likely set-ups, half of which have the value: a binomial share, with the normal
    quantile of 0.95 for one value and of 1 - 0.05 / 20 for twenty."""
    has_value = np.arange(400) < 200
    for values, quantile in ((1, 1.960), (20, 3.023)):
        interval = _interval(np.ones(400), has_value, values)
        assert interval.low == pytest.approx(0.5 - quantile * 0.025, abs=0.005)
        assert interval.high == pytest.approx(0.5 + quantile * 0.025, abs=0.005)


def test_a_depth_of_blind_holes_says_nothing_of_through_holes(results):
    """Only set-ups 2 mm deep agree. If they are the through-holes, whose depth is no depth,
    nothing is said of it."""
    summary = summarise_holes(results.holes, PATHS)
    shallow = summary[PATHS[0]] == 2.0
    for agree, other_kind in (("blind", "through"), ("through", "blind")):
        kinds = shallow.map({True: agree, False: other_kind})
        table = posterior_of(summary.assign(**{KIND: kinds}), [*PATHS, KIND])
        depths = table[table["axis"] == "blind depth of blind holes"]
        assert depths["value"].tolist() == ["2 mm" if agree == "blind" else "4 mm"]
        assert (depths[["prior_share", "posterior_share"]] == 1).all(axis=None)
    kinds_by_distance = summary.assign(
        **{KIND: (summary[PATHS[1]] < 0.555).map({True: "blind", False: "through"})}
    )
    table = posterior_of(kinds_by_distance, [*PATHS, KIND])
    depths = table[table["axis"] == "blind depth of blind holes"]
    right = 0.9**22
    wrong = 0.9**19 * 0.1**3
    assert depths["prior_share"].tolist() == [0.5, 0.5]
    assert depths["posterior_share"].tolist() == pytest.approx(
        [right / (right + wrong), wrong / (right + wrong)]
    )
    assert "blind depth of blind holes of 4 mm" in borne_out_if(table)
    is_blind = table["value"] == "blind"
    without = table.assign(
        posterior_share=table["posterior_share"].mask(is_blind, 0.0),
        posterior_high=table["posterior_high"].mask(is_blind, 0.0),
    )
    sentence = borne_out_if(without)
    assert "speaks against hole kind of blind" in sentence
    assert "of blind holes" not in sentence


def test_no_posterior_of_few_set_ups_or_of_one_number_of_frames(results):
    summary = summarise_holes(results.holes, PATHS)
    assert posterior_of(summary[summary["frames"] == 50], PATHS) is None
    assert posterior_of(summary[summary[PATHS[0]] == 2.0], PATHS) is None


@pytest.mark.usefixtures("unsaved")
def test_a_posterior_takes_twenty_complete_set_ups(results):
    """Of 22, one lacks a hole, and is none."""
    summary = summarise_holes(results.holes, PATHS)
    names = list(dict.fromkeys(summary["variant"]))
    incomplete = summary[(summary["variant"] != names[5]) | (summary["hole"] != "7")]
    for left_out, known in ((1, True), (2, False)):
        part = incomplete[~incomplete["variant"].isin(names[:left_out])]
        table = posterior_of(part, PATHS)
        assert (table is not None) == known
        if table is not None:
            assert (table["axis"] == SET_UP).sum() == 20
            assert names[5] not in set(table["value"])


@pytest.mark.parametrize(("ratio", "doubted"), [(0.49, True), (0.51, False)])
def test_a_value_is_doubted_below_half_of_its_prior(results, ratio, doubted):
    table = posterior_of(summarise_holes(results.holes, PATHS), PATHS)
    shares = table["prior_share"].copy()
    is_deep = table["value"].str.startswith("4 mm")
    shares[is_deep] *= ratio
    sentence = borne_out_if(table.assign(posterior_share=shares))
    assert ("blind depth of 4 mm" in sentence) == doubted


def test_the_page_begins_with_the_sentence(results):
    page = set_ups_html(results, [], About(provenance(), "", "Inference", THESIS))
    answer = page.split('<p class="answer">')[1]
    assert (
        answer.startswith("Of what the thesis leaves open, its outcome speaks against")
        and "What would make the thesis true" in page
    )


def test_set_ups_that_fill_no_grid_stand_one_below_the_other(results):
    # as many as there are distances, but not one of each
    scattered = replace(results, variants=results.variants.iloc[[*range(10), 11]])
    layout = Layout.of(scattered)
    assert layout.columns == () and len(layout.rows) == 11


def test_set_ups_are_drawn_at_random_and_alike_ones_once(tmp_path):
    axes = {"sweep": {"source.target.distance_m": [0.6 + 0.01 * i for i in range(30)]}}
    text = Path("experiments/thesis_inference.yaml").read_text().partition("unknowns:")[0]
    frames = "  capture.frames: [1, 50]\n"
    values = axes["sweep"]["source.target.distance_m"]
    text += f"sweep:\n  source.target.distance_m: {values}\n{frames}"
    (tmp_path / "drawn.yaml").write_text(text)
    fewer = load_experiment(tmp_path / "drawn.yaml", ["draws=20"])
    further_draws = load_experiment(tmp_path / "drawn.yaml", ["draws=24"])
    names = [
        {point.variant for point in experiment.points} for experiment in (fewer, further_draws)
    ]
    assert names[0] < names[1] and len(names[1]) == 24
    assert len(fewer.points) == 2 * len(names[0])
    assert {point.config.capture.frames for point in fewer.points} == {1, 50}


def test_numbers_of_a_range_are_judged_in_three_parts(results):
    """22 set-ups, each at a distance of its own; those of the nearest third agree."""
    summary = summarise_holes(results.holes, PATHS)
    names = {name: number for number, name in enumerate(dict.fromkeys(summary["variant"]))}
    far = summary["variant"].map(names)
    table = posterior_of(summary.assign(**{PATHS[1]: 0.5 + 0.01 * far}), PATHS)
    parts = table[table["axis"] == "distance"]
    assert parts["value"].tolist() == ["0.5 to 0.57 m", "0.57 to 0.64 m", "0.64 to 0.71 m"]
    assert parts["prior_share"].sum() == pytest.approx(1)
    assert parts["posterior_share"].iloc[0] > parts["posterior_share"].iloc[2]
    assert (parts["posterior_low"] <= parts["posterior_share"]).all()
    assert (parts["posterior_share"] <= parts["posterior_high"]).all()
