"""What filters cost, of studies with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import StudyRecord
from harness.programs.filters.costs import FilterCost, costs_of, filter_text
from harness.programs.filters.page import answer, filters_html
from harness.programs.filters.tables import FILTER_COSTS
from tests.support.synthetic_study import SetUp, Study, study_record

CAMERA = "source.camera.name"
FILTER = "capture.filter"
MEDIAN = {"name": "median", "settings": {}, "acts_on": "frames"}
SPATIAL = {"name": "spatial", "settings": {"filter_magnitude": 5}, "acts_on": "frames"}


@pytest.fixture(scope="module")
def study() -> StudyRecord:
    """A median filter that loses 1 mm, and a spatial one that changes nothing, by one camera; the
    median alone by another."""
    of_one = {CAMERA: "kinect_v2", FILTER: None}
    set_ups = (
        SetUp(variant="median", axes={**of_one, FILTER: MEDIAN}, a50_mm=7.0, own_noise=0.1),
        SetUp(variant="none", axes=of_one, own_noise=0.1),
        SetUp(variant="spatial", axes={**of_one, FILTER: SPATIAL}, own_noise=0.1),
        SetUp(variant="alone", axes={CAMERA: "pmd_flexx2", FILTER: MEDIAN}),
    )
    record = study_record(Study(set_ups, boards=40, hole_free_boards=12))
    thresholds = {"median": 4.0, "none": 5.0, "spatial": 6.0, "alone": 5.0}
    changed = [replace(set_up, threshold=thresholds[set_up.variant]) for set_up in record.set_ups]
    return replace(record, set_ups=tuple(changed))


@pytest.fixture(scope="module")
def costs(study: StudyRecord) -> dict[str, FilterCost]:
    holes = []
    runs = []
    for set_up in study.set_ups:
        table = set_up.inspected
        bias_mm = {"median": -0.5, "none": 0.25}.get(set_up.variant, 0.0)
        rows = pd.DataFrame({"board": table.board, "hole": table.hole, "repeat": table.repeat})
        rows["detected"] = table.hit
        rows["true_diameter_mm"] = table.diameter_mm
        rows["true_depth_mm"] = table.depth_mm
        rows["model_diameter_mm"] = table.diameter_mm + bias_mm + 0.1 * (table.board % 2)
        rows.loc[~table.hit, "model_diameter_mm"] = 99.0  # what was not found counts nowhere
        rows["model_depth_mm"] = np.nan
        holes.append(rows.assign(variant=set_up.variant, frames=1))
        quiet = {"median": [4.5, 5.5, 3.0], "none": [4.9, 4.0, 5.5]}.get(set_up.variant, [9.0] * 3)
        quiet_runs = pd.DataFrame({"role": "hole_free", "quiet_threshold": quiet})
        calibration = pd.DataFrame({"role": "calibration", "quiet_threshold": [99.0]})
        runs.append(pd.concat([quiet_runs, calibration]).assign(variant=set_up.variant, frames=1))
    limits = [limit_of(set_up) for set_up in study.set_ups]
    listed = costs_of(limits, pd.concat(holes), pd.concat(runs))
    assert [cost.limit.record.variant for cost in listed] == ["none", "median", "spatial"]
    return {cost.limit.record.variant: cost for cost in listed}


def test_the_change_of_a90_is_paired_over_boards(costs: dict[str, FilterCost]):
    median = costs["median"]
    assert median.change_mm == pytest.approx(1.0, abs=0.3)
    assert median.change_interval_mm.low < median.change_mm < median.change_interval_mm.high
    assert median.change_interval_mm.low > 0
    alone = median.limit.a90_draws_mm
    before = median.without.a90_draws_mm
    unpaired = np.quantile(alone, 0.975) - np.quantile(before, 0.025)
    assert median.change_interval_mm.high < unpaired
    spatial = costs["spatial"]
    assert spatial.change_interval_mm.low < 0 < spatial.change_interval_mm.high
    assert np.isnan(costs["none"].change_mm)


def test_inspections_that_one_alone_finds_are_counted(costs: dict[str, FilterCost]):
    median = costs["median"]
    hits = [limit.record.inspected.hit for limit in (median.without, median.limit)]
    assert median.lost == (hits[0] & ~hits[1]).sum() > median.gained == (hits[1] & ~hits[0]).sum()


def test_false_calls_at_the_old_threshold_are_those_of_hole_free_boards(
    costs: dict[str, FilterCost],
):
    """1 of 3 boards calls above 5.0, the threshold of no filter, with and without the median; all
    with the spatial one."""
    median = costs["median"]
    assert (median.calling_without, median.calling, median.hole_free) == (1, 1, 3)
    assert costs["spatial"].calling == 3


def test_biases_are_of_hits_over_boards(costs: dict[str, FilterCost]):
    bias = costs["median"].bias["diameter"]
    assert bias.hits == costs["median"].limit.hits
    assert bias.mean_mm == pytest.approx(-0.45, abs=0.01)
    assert bias.interval_mm.low == pytest.approx(-0.47, abs=0.02)
    assert np.isnan(costs["median"].bias["depth"].mean_mm)


def test_table_and_page_state_the_loss(study: StudyRecord, costs: dict[str, FilterCost]):
    listed = list(costs.values())
    sentence = answer(listed)
    median = costs["median"]
    assert sentence.startswith(
        f"No filter finds smaller holes. Largest loss: median, a90 from {median.without.a90_mm:.1f} to "
    )
    assert sentence.endswith("Of 2 changes, 1 cannot be told from none.")
    frame = FILTER_COSTS.frame(listed)
    assert frame["change_mm"].isna().tolist() == [True, False, False]
    page = filters_html(study, listed, "tofpod filters")
    assert "1 → 1 of 3 boards" in page
    assert "spatial, filter magnitude 5" in page


def test_filters_are_named_by_what_was_stated():
    assert filter_text(MEDIAN) == "median"
    average = {"name": "hole_filling", "settings": {"holes_fill": 2}, "acts_on": "average"}
    assert filter_text(average) == "hole filling, holes fill 2, on average"
