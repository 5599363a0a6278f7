"""Records as tables: fixed order, numbers for None, every variant with its own reason."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa

from harness.experiment.load import load_experiment
from harness.records import trials
from harness.records.schema import write_table
from harness.records.trials import ResultTables
from harness.runs.tables import tables_of

ROOT = Path(__file__).resolve().parents[3]


def hole(repeat: int, name: str, score: float | None) -> dict[str, object]:
    return {
        "variant": "main",
        "frames": 1,
        "repeat": repeat,
        "true_diameter_mm": 1.0,
        "hole": name,
        "score": score,
    }


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
    # tenths of a micrometre: the repeats' medians are 2250 and 1500, so the clouds lie 375 to
    # either side of the middle
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
    several = load_experiment(
        ROOT / "experiments" / "cameras.yaml", ["sweep.source.camera.unit_seed=[1]"]
    )
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
        *2 * ["camera=realsense_l515, distance=0.5 m"],
        "",
        "camera=azure_kinect_nfov, distance=0.5 m",
        *2 * ["camera=realsense_l515, distance=0.75 m"],
        "",
        "camera=azure_kinect_nfov, distance=0.75 m",
    ]

    alone = tables_of([record], load_experiment(ROOT / "experiments" / "averaging.yaml"))
    assert alone.axes.empty
    assert set(alone.holes.columns) == {
        "variant",
        "frames",
        "repeat",
        "true_diameter_mm",
        "hole",
        "score",
    }


def study_record(number: int) -> dict[str, list[dict[str, object]]]:
    """A trial of a study at 1 and 50 frames: one in four on a damaged board, one hole-free, two
    that calibrate."""
    role = ("damaged", "hole_free", "calibration", "calibration")[number % 4]
    stream = np.random.default_rng(number)
    numbers = dict.fromkeys([f"measure_{k}_mm" for k in range(20)], 0.0)
    record: dict[str, list[dict[str, object]]] = {}
    for frames in (1, 50):
        common = {"variant": "main", "frames": frames, "repeat": 0, "board": number, "role": role}
        rows = {"runs": [common | numbers]}
        if role != "calibration":
            listed = {
                "threshold": [0.5 * frames * k for k in range(21)],
                "findings": [3] * 21,
                "hits": [1] * 21,
            }
            rows["operating"] = [common | listed]
        if role == "damaged":
            above = [stream.integers(0, 30_000, 41).tolist() for _ in range(9)]
            grid = [0.25 * frames * k for k in range(41)]
            rows["holes"] = [hole(0, str(k), 1.0) | common | numbers for k in range(8)]
            rows["pixels"] = [
                common | {"hole": str(k), "pixels": 30_000, "threshold": grid, "above": counts}
                for k, counts in enumerate(above)
            ]
        for name, row in rows.items():
            record.setdefault(name, []).extend(row)
    return record


def test_a_trial_costs_a_few_kilobytes_of_memory():
    """Tables of 400 trials more need less than 5 kB for each, their making included."""
    experiment = load_experiment(ROOT / "experiments" / "smoke.yaml")

    def needed(trials: int) -> tuple[int, ResultTables]:
        before = pa.total_allocated_bytes()
        tracemalloc.start()
        tables = tables_of(map(study_record, range(trials)), experiment)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak + pa.total_allocated_bytes() - before, tables

    of_200, _ = needed(200)
    of_600, tables = needed(600)
    assert (of_600 - of_200) / 400 < 5000
    assert len(tables.pixels) == 150 * 2 * 9 and len(tables.holes) == 150 * 2 * 8


def test_lists_are_rows_of_the_files(tmp_path):
    records = [study_record(number) for number in (4, 1, 0)]
    tables = tables_of(records, load_experiment(ROOT / "experiments" / "smoke.yaml"))
    write_table(tmp_path, trials.PIXELS, tables.pixels)
    stored = pd.read_parquet(tmp_path / "pixels.parquet")
    rows = [row for record in records for row in record.get("pixels", ())]
    rows.sort(key=lambda row: (row["frames"], row["board"]))
    assert stored["above"].tolist() == [count for row in rows for count in row["above"]]
    assert stored["threshold"].tolist() == [
        threshold for row in rows for threshold in row["threshold"]
    ]
    assert stored["hole"].tolist() == [row["hole"] for row in rows for _ in row["above"]]
    assert stored["above"].dtype == np.int64
