"""Rows of trials: a column is a field, and a record holds what its fields say."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np
import pytest

from harness.records.rows import (
    DamageRow,
    FindingRow,
    OperatingRow,
    Origin,
    RunRow,
    TrialRecord,
    row_data,
)
from harness.records.schema import Column, Table, declared_columns
from harness.records.trials import FINDINGS, NOISE, RUNS, TRIALS, ResultTables

ORIGIN = Origin(variant="main", frames=5, repeat=2, board=7)


@dataclass(frozen=True)
class Maker:
    maker: Annotated[str, "who made it"]


@dataclass(frozen=True)
class Device:
    made_by: Maker
    length_mm: Annotated[float, Column(note="its length", label="length (mm)")]
    spare: Annotated[int | None, "number of spare parts"] = None


def test_fields_declare_columns_with_note_unit_and_label() -> None:
    maker, length, spare = declared_columns(Device)
    assert (maker.name, maker.note, maker.unit, maker.label) == ("maker", "who made it", "", "")
    assert (length.name, length.note) == ("length_mm", "its length")
    assert (length.unit, length.label) == ("mm", "length (mm)")
    assert (spare.name, spare.note) == ("spare", "number of spare parts")
    table = Table("devices", "one row per device", declared_columns(Device))
    assert table.column("length_mm") is table.columns[1]
    with pytest.raises(KeyError):
        table.column("width_mm")


def test_a_row_is_flat_and_lacks_what_is_none() -> None:
    device = Device(Maker("ours"), 3.0)
    assert row_data(device) == {"maker": "ours", "length_mm": 3.0}
    assert row_data(Device(Maker("ours"), np.nan, 0)).keys() == {"maker", "length_mm", "spare"}


def test_a_record_has_the_tables_of_results() -> None:
    finding = FindingRow(origin=ORIGIN, role="damaged", x_mm=1.0, y_mm=-2.0, score=9.0, hole="3")
    data = TrialRecord(findings=[finding]).to_data()
    tables = {field.name for field in fields(ResultTables)}
    assert tables - data.keys() == {"variants", "axes"}
    assert data.keys() <= tables
    assert data["findings"] == [
        {
            "variant": "main",
            "frames": 5,
            "repeat": 2,
            "board": 7,
            "role": "damaged",
            "x_mm": 1.0,
            "y_mm": -2.0,
            "score": 9.0,
            "hole": "3",
        }
    ]
    assert list(data["findings"][0]) == [column.name for column in FINDINGS.columns]
    assert data["runs"] == []


def test_records_do_not_share_their_lists() -> None:
    first = TrialRecord()
    first.operating.append(
        OperatingRow(origin=ORIGIN, role="damaged", threshold=[1.0], findings=[2], hits=[1])
    )
    assert TrialRecord().operating == []


@pytest.mark.parametrize(("table", "row_type"), [(TRIALS, DamageRow), (RUNS, RunRow)])
def test_tables_have_the_columns_of_their_rows(table: Table, row_type: type) -> None:
    names = [column.name for column in table.columns]
    origin = [field.name for field in fields(Origin)]
    field_names = [field.name for field in fields(row_type)]
    index = field_names.index("origin")
    assert names == [*field_names[:index], *origin, *field_names[index + 1 :]]


def test_a_column_of_noise_has_a_note_for_each_lag() -> None:
    lags = [column for column in NOISE.columns if column.name.startswith("correlation_")]
    assert [column.name[-2:] for column in lags] == ["u1", "u2", "u3", "v1", "v2", "v3"]
    assert {column.note for column in lags} == {
        "correlation of that noise between pixels n columns (u) or rows (v) apart"
    }
