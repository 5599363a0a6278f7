"""What `ask` says of facts that nobody has measured."""

from __future__ import annotations

import json

import pyarrow.parquet as pq
import pytest

from harness.programs.atlas.assumptions import DAMAGE_COLUMN, STORED_UNKNOWNS, assumed
from harness.vocabulary.files import shipped

BACKING = "source.target.backing"
BLUR = "source.camera.numbers.scatter.blur_px"
ALBEDO = "source.target.material.albedo_850"


def rows(kind, detector, frames, factors):
    """Two values of each unknown, largest factor first."""
    listed = []
    stated = {BACKING: "distance 20 mm", BLUR: "0 px", ALBEDO: "0.6"}
    for rank, (key, factor, beyond_chance) in enumerate(factors, start=1):
        for value in ("a", "b"):
            row = {
                "key": key,
                "value": value,
                "rank": rank,
                "factor": factor,
                "beyond_chance": beyond_chance,
                "stated": stated[key],
                "detector": detector,
                "frames": frames,
                DAMAGE_COLUMN: json.dumps({"kind": kind}),
            }
            listed.append(row)
    return listed


@pytest.fixture
def table():
    first = rows("through", "matched", 1, [(BLUR, 1.2, False), (BACKING, 1.1, False)])
    many = rows(
        "through",
        "matched",
        50,
        [(BACKING, 1.7, True), (BLUR, 1.4, True), (ALBEDO, 1.1, False)],
    )
    other = rows("through", "thesis", 50, [(BACKING, 2.5, True)])
    return first + many + other


def test_the_stated_values_and_the_factors(table):
    stated, moved = assumed(table, "through", "matched", 50)
    assert stated == ("Assumed, not measured: blur 0 px, backing distance 20 mm.")
    assert moved == (
        "They move a90 (through-holes, matched, 50 frames): backing × 1.70, blur × 1.40."
    )


def test_the_nearest_set_up_answers(table):
    for frames, first in ((5, "none beyond chance (at most blur, 1.20)"), (40, "backing ×")):
        _, moved = assumed(table, "through", "matched", frames)
        assert f"): {first}" in moved
    _, moved = assumed(table, "through", "thesis", 50)
    assert "(through-holes, thesis, 50 frames): backing × 2.50." in moved


def test_what_is_asked_is_not_assumed(table):
    stated, moved = assumed(table, "through", "matched", 50)
    assert "albedo" not in stated and "albedo" not in moved


def test_other_damage_is_not_computed(table):
    _, moved = assumed(table, "dent", "matched", 50)
    assert moved == "How far these move limits of dents is not computed."


def test_the_table_that_comes_with_tofpod():
    table = pq.read_table(shipped("baselines") / STORED_UNKNOWNS).to_pylist()
    _, moved = assumed(table, "through", "matched", 50)
    assert "backing" in moved
