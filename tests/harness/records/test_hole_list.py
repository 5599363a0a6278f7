"""Names of holes in words."""

from __future__ import annotations

import pytest

from harness.records.trials import hole_list


@pytest.mark.parametrize(
    ("names", "text"),
    [
        (["4", "5", "6", "9"], "4–6, 9"),
        (["11", "2", "1", "rim"], "1–2, 11, rim"),
        ([], "none"),
        (["b", "a"], "b, a"),
        (["7"], "7"),
    ],
)
def test_names_of_holes_as_runs_of_numbers(names: list[str], text: str) -> None:
    assert hole_list(names) == text
