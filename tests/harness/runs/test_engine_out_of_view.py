"""A board that exceeds the view, run as a user runs it: what the camera does not see is no target."""

from __future__ import annotations

import pandas as pd
import pytest

from tests.support.tiny_sweep import TINY, finished, results

WIDE = """{name: custom, board: {width_mm: 1500.0, height_mm: 900.0, thickness_mm: 12.7}, holes: [
    {id: 1, diameter_mm: 30.0, centre_mm: [-60.0, 20.0]}, {id: 2, diameter_mm: 30.0, centre_mm: [700.0, 0.0]},
    {id: 3, diameter_mm: 30.0, centre_mm: [80.0, -40.0], chamfer_mm: 1.0}],
    backing: {distance_mm: 20.0}, pose: {distance_m: 0.45}}"""


@pytest.mark.slow
def test_damage_out_of_view_is_no_target(tmp_path):
    text = TINY.replace("{name: thesis}", WIDE, 1).replace(
        "azure_kinect_nfov", "azure_kinect_nfov_binned"
    )
    out = results(finished(tmp_path, text))
    holes = pd.read_parquet(out / "trials.parquet")
    assert set(holes["hole"].astype(str)) == {"1", "3"}
    assert holes["detected"].all()
