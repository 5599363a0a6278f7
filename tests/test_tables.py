"""Records as tables: fixed order, numbers for None, every variant with its own reason."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness.engine.tables import tables_of
from harness.experiment.load import load_experiment

ROOT = Path(__file__).resolve().parents[1]


def hole(repeat: int, name: str, score: float | None) -> dict[str, object]:
    return {"variant": "main", "frames": 1, "repeat": repeat, "true_diameter_mm": 1.0, "hole": name, "score": score}


def probe(repeat: int, errors: list[int | None]) -> dict[str, object]:
    return {"variant": "main", "frames": 1, "repeat": repeat, "error_tenth_um": errors}


def test_order_of_records_does_not_matter_and_none_is_nan():
    experiment = load_experiment(ROOT / "experiments" / "smoke.yaml")
    records = [
        {
            "holes": [hole(1, "1", None)],
            "runs": [],
            "probes": [probe(1, [1000, None, 2000, 1500])],
            "noise": [],
            "registrations": [],
        },
        {
            "holes": [hole(0, "1", 2.0)],
            "runs": [],
            "probes": [probe(0, [3000, 10, 2000, 2500])],
            "noise": [],
            "registrations": [],
        },
    ]
    tables = tables_of(records, experiment)
    again = tables_of(records[::-1], experiment)
    assert list(tables.holes.repeat) == [0, 1]
    assert np.isnan(tables.holes.score[1])
    assert tables.holes.equals(again.holes)
    assert tables.probes.equals(again.probes)
    # tenths of a micrometre: the repeats' medians are 2250 and 1500, so the clouds lie 375 to either side of the middle
    probes = tables.probes
    assert abs(probes.mean_error_mm[0] - 0.2) < 1e-12  # mean of 3000 - 375 and 1000 + 375
    assert abs(probes.temporal_std_mm[0] - 0.0625 * np.sqrt(2)) < 1e-12
    assert np.allclose(probes.displacement_std_mm, 0.0375 * np.sqrt(2))
    assert np.isnan(probes.mean_error_mm[1])


def test_every_variant_has_the_reason_that_stands_beside_it():
    experiment = load_experiment(ROOT / "experiments" / "averaging.yaml")
    table = tables_of([], experiment).variants.set_index("variant").reason
    assert table["main"] == ""
    assert (table.drop("main") != "").all()
    assert table["the script as it stands, k = 1.2"].startswith("the main script has 1.2")
    assert table["source.target.distance_m=0.5"].startswith("not stated; the ends")


def test_set_ups_carry_their_place_on_the_axes_and_one_set_up_carries_nothing():
    several = load_experiment(ROOT / "experiments" / "cameras.yaml")
    variant = "camera=kinect_v2, distance=0.75 m"
    record = {
        "holes": [hole(0, "1", 2.0) | {"variant": variant}],
        "runs": [],
        "probes": [],
        "noise": [],
        "registrations": [],
    }
    tables = tables_of([record], several)
    assert list(tables.axes.path) == ["source.camera.name", "source.target.distance_m"]
    assert list(tables.axes.unit) == ["", "m"]
    row = tables.holes.iloc[0]
    assert (row["source.camera.name"], row["source.target.distance_m"]) == ("kinect_v2", 0.75)
    variants = tables.variants.set_index("variant")
    assert list(variants.reference[variants.is_variation]) == [
        "camera=kinect_v2, distance=0.5 m",
        *2 * ["camera=realsense_l515, distance=0.75 m"],
    ]

    alone = tables_of([record], load_experiment(ROOT / "experiments" / "averaging.yaml"))
    assert alone.axes.empty
    assert set(alone.holes.columns) == {"variant", "frames", "repeat", "true_diameter_mm", "hole", "score"}
