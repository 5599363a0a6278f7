"""A small study of filters from end to end: a built-in one and a function of this process."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import tofpod
from harness.programs.filters.filters import main

pytestmark = pytest.mark.slow  # renders and judges 12 boards

SMALL = (
    "study.boards=6",
    "study.hole_free_boards=2",
    "threshold.calibrate={boards: 4, false_calls_per_m2: 20}",
    "source.target.board={width_mm: 190, height_mm: 130, thickness_mm: 12.7}",
    "source.target.damage={kind: blind, per_board: 4, diameter_mm: [2, 14], depth_mm: [6, 6]}",
    "source.render={bounces: 0}",
    "sweep={source.camera.name: [femto_bolt_nfov], capture.filter: [null], capture.frames: [1]}",
)


def test_a_function_and_a_built_in_filter_are_judged_on_the_same_boards(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def raised(z_m: np.ndarray) -> np.ndarray:
        """Moves all depth alike, which changes nothing that is found."""
        return z_m + np.float32(0.05)

    def flattened(z_m: np.ndarray) -> np.ndarray:
        """Leaves no hole."""
        return np.full_like(z_m, 0.7)

    small = {"experiment": "filters", "changes": SMALL, "out": tmp_path}
    rows = tofpod.filters(raised, flattened, "median", **small)
    assert list(rows["filter"]) == ["none", "raised", "flattened", "median"]
    by_name = rows.set_index("filter")
    assert by_name.loc["raised", "lost"] + by_name.loc["raised", "gained"] <= 1
    assert by_name.loc["flattened", "gained"] == 0
    assert by_name.loc["flattened", "lost"] > 5
    page = next((tmp_path / "filters").glob("*/filters.html")).read_text()
    assert "What does a filter cost?" in page

    # the program finds the trials without a filter and with the median done
    settings = [word for change in SMALL for word in ("--set", change)]
    arguments = ["--filter", "median", "--out", str(tmp_path), "--serial", *settings]
    assert main(arguments) == 0
    assert "filters.html" in capsys.readouterr().out
    assert main(["averaging", "--out", str(tmp_path)]) == 2
