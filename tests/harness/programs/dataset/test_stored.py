"""What a data set must hold before maps are scored on it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.programs.dataset.stored import (
    IndexFacts,
    TruthFacts,
    refuse_odd_arrays,
    refuse_odd_facts,
)
from harness.vocabulary.errors import UserError

FILE = Path("dataset.json")
INDEX: dict[str, Any] = {
    "name": "tiny",
    "content": "0123",
    "samples": ["tiny/test/good/0000"],
    "categories": {"tiny": {"units": 1, "frames": 20, "camera": "a"}},
    "false_calls_per_m2": 1,
    "hit_radius_mm": 15.0,
    "hit_overlap": None,
    "licence": "CC-BY-4.0",
}
FLAW: dict[str, Any] = {
    "id": 1,
    "line_m": [[0.0, 0.01]],
    "diameter_mm": 5.0,
    "depth_mm": 0.0,
    "x_board_mm": 0.0,
    "y_board_mm": 10.0,
}
SHAPE = (6, 8)


def arrays() -> dict[str, np.ndarray]:
    return {
        "inspected": np.ones(SHAPE, bool),
        "board_xy_m": np.zeros((*SHAPE, 2)),
        "damage": np.zeros(SHAPE, np.uint16),
    }


def is_accepted(refuse: Callable[..., None], *arguments: Any) -> bool:
    try:
        refuse(FILE, *arguments)
    except UserError:
        return False
    return True


def test_what_the_program_writes_is_accepted():
    assert is_accepted(refuse_odd_facts, INDEX, IndexFacts)
    other_index = {**INDEX, "samples": None, "hit_overlap": 0.5}
    assert is_accepted(refuse_odd_facts, other_index, IndexFacts)
    truth = {"board": 0, "damages": [FLAW, {**FLAW, "id": 2, "size_of": "width"}]}
    assert is_accepted(refuse_odd_facts, truth, TruthFacts)
    assert is_accepted(refuse_odd_arrays, arrays())
    assert is_accepted(refuse_odd_arrays, {"points_m": np.zeros(3)})


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"samples": [["a"]]}, "samples.0"),
        ({"samples": ["tiny/test/../0000"]}, "samples.0"),
        ({"samples": ["../../etc/0000"]}, "samples.0"),
        ({"categories": {"tiny": {"units": 1}}}, "categories.tiny.frames"),
        ({"categories": []}, "categories"),
        ({"false_calls_per_m2": float("nan")}, "false_calls_per_m2"),
        ({"hit_radius_mm": "15"}, "hit_radius_mm"),
        ({"hit_overlap": 2.0}, "hit_overlap"),
        ({"name": None}, "name"),
    ],
)
def test_an_odd_index_is_refused(changes: dict[str, Any], place: str):
    with pytest.raises(UserError, match=rf"dataset\.json: {place}"):
        refuse_odd_facts(FILE, INDEX | changes, IndexFacts)


@pytest.mark.parametrize(
    ("changes", "place"),
    [
        ({"id": 0}, "id"),
        ({"line_m": []}, "line_m"),
        ({"line_m": [[0.0, 1.0, 2.0]]}, "line_m.0"),
        ({"line_m": [["a", 0.0]]}, "line_m.0.0"),
        ({"diameter_mm": -5.0}, "diameter_mm"),
        ({"depth_mm": None}, "depth_mm"),
    ],
)
def test_an_odd_truth_is_refused(changes: dict[str, Any], place: str):
    truth = {"board": 0, "damages": [FLAW | changes]}
    with pytest.raises(UserError, match=rf"damages\.0\.{place}"):
        refuse_odd_facts(FILE, truth, TruthFacts)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("inspected", np.ones(48, bool), "not a mask"),
        ("inspected", np.ones(SHAPE), "not a mask"),
        ("inspected", np.zeros(SHAPE, bool), "no pixel is inspected"),
        ("board_xy_m", np.zeros((2, *SHAPE)), "beside a mask"),
        ("board_xy_m", np.zeros((*SHAPE, 2), complex), "beside a mask"),
        ("board_xy_m", np.full((*SHAPE, 2), np.nan), "no pixel has a place"),
        ("damage", np.zeros((3, 3), int), "beside a mask"),
        ("damage", np.full(SHAPE, -1), "below 0"),
        ("damage", np.zeros(SHAPE), "beside a mask"),
    ],
)
def test_odd_arrays_are_refused(name: str, array: np.ndarray, message: str):
    with pytest.raises(UserError, match=message):
        refuse_odd_arrays(FILE, arrays() | {name: array})
