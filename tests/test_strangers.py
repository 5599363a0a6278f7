"""The scorer of the strangers' recordings, by answers whose worth is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.strangers.__main__ import made
from tests.strangers.kinds import KINDS
from tests.strangers.recording import recorded
from tests.strangers.score import scored


def rows_of(truths):
    """What a perfect detector would write."""
    rows = []
    for truth in truths:
        x, y, z = 1e3 * np.asarray(truth.centre_m)
        depth = 1e3 * truth.depth_m[0] if math.isfinite(truth.depth_m[0]) else 0.0
        rows.append({"kind": truth.kind, "x_mm": f"{x}", "y_mm": f"{y}", "z_mm": f"{z}"})
        rows[-1] |= {
            "diameter_mm": f"{1e3 * truth.diameter_m[1]}",
            "depth_mm": f"{depth}",
            "u_px": "0",
            "v_px": "0",
            "certainty": "sure",
            "flags": "",
        }
    return rows


@pytest.fixture(scope="module")
def board():
    rng = np.random.default_rng(3)
    stranger = KINDS["fifty_frames"](rng)
    _, view, truths = recorded(stranger, rng)
    assert sum(truth.clear for truth in truths) >= 2
    return stranger, view, truths


def test_true_answers_are_right(board):
    score = scored(*board, 0, "", rows_of(board[2]))
    assert (score.verdict, score.why, score.needless) == ("right", (), False)
    assert scored(*board, 0, "warning: perhaps\n", rows_of(board[2])).needless


def test_wrong_answers_are_wrong(board):
    true = rows_of(board[2])
    clear = [row for row, truth in zip(true, board[2], strict=True) if truth.clear]
    clear.sort(key=lambda row: -float(row["diameter_mm"]))
    on_wall = {**clear[0], "x_mm": "-400", "y_mm": "-330", "z_mm": "1300"}
    opposite = {"hole": "bump", "bump": "hole"}[clear[0]["kind"]]
    answers = {
        "missed": [row for row in true if row is not clear[0]],
        "another surface": [*true, on_wall],
        f"a {opposite} where": [
            {**row, "kind": opposite} if row is clear[0] else row for row in true
        ],
        "diameter": [{**row, "diameter_mm": "200"} if row is clear[0] else row for row in true],
        "depth": [{**row, "depth_mm": "-500"} if row is clear[0] else row for row in true],
    }
    for why, rows in answers.items():
        score = scored(*board, 0, "", rows)
        assert score.verdict == "wrong" and why in score.why[0], (why, score.why)
        assert scored(*board, 0, "warning: not sure\n", rows).verdict == "warned"
        assert scored(*board, 0, "8 frames\nwarning: too late\n", rows).verdict == "wrong"


def test_a_wrong_size_is_warned_of_by_a_flag_that_says_why(board):
    true = rows_of(board[2])
    clear = [row for row, truth in zip(true, board[2], strict=True) if truth.clear]
    for flags, verdict in (
        ("at_rim", "warned"),
        ("open_behind faint", "warned"),
        ("size_from_contour", "wrong"),
    ):
        wide = {"diameter_mm": "200", "flags": flags}
        rows = [{**row, **wide} if row is clear[0] else row for row in true]
        assert scored(*board, 0, "", rows).verdict == verdict
        missing_too = [row for row in rows if row is not clear[1]]
        assert scored(*board, 0, "", missing_too).verdict == "wrong"


def test_three_doubtful_false_findings_are_right_and_four_are_not(board):
    true = rows_of(board[2])
    depth_mm = true[0]["z_mm"]
    centres = [{"x_mm": f"{x}", "y_mm": "30", "z_mm": depth_mm} for x in (-40, -10, 10, 40)]
    stray = [{**true[0], **centre, "certainty": "doubtful"} for centre in centres]
    assert scored(*board, 0, "", [*true, *stray[:3]]).verdict == "right"
    four = scored(*board, 0, "", [*true, *stray])
    assert four.verdict == "wrong" and four.why == ("4 doubtful ones false",)
    assert (four.doubtful, math.isnan(four.expected)) == (4, True)
    # an answer that states an interval is held to it
    said = "No damage is sure; 1.0 false calls expected (0 to {})."
    stated = scored(*board, 0, said.format(4), [*true, *stray])
    assert (stated.verdict, stated.doubtful, stated.expected) == ("right", 4, 1.0)
    assert scored(*board, 0, said.format(3), [*true, *stray]).verdict == "wrong"
    sure = [{**row, "certainty": "sure"} for row in stray[:2]]
    assert scored(*board, 0, "", [*true, *sure]).why == ("2 false",)


def test_a_refusal_is_a_warning_and_a_traceback_is_not(board):
    assert (
        scored(*board, 2, "error: no unit is known\n  fix: pass --unit\n", []).verdict == "warned"
    )
    assert scored(*board, 1, "Traceback ...\nKeyError\n", []).verdict == "wrong"


ANSWERED = (
    ("before_wall", 0), ("on_floor", 0), ("round_board", 0), ("tilted", 0), ("corner", 0), ("small_board", 0),
    ("object_on_plate", 0), ("no_return", 0), ("saddle", 0), ("slots", 0), ("bumps", 0), ("dents", 0),
    ("dropouts", 0), ("pipe_outside", 0), ("sphere", 0), ("dark_patch", 1),
    ("quarter_mm", 0), ("undamaged", 0), ("passer_by", 0), ("resolutions", 0), ("corrugated", 20),
    ("heavy_tails", 21), ("own_flat_field", 0), ("own_flat_field", 1), ("sphere", 50), ("drilled", 31),
)  # fmt: skip
QUICK = ("before_wall", "pipe_outside")
"""A board before a wall, missing returns, a curved part."""


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        pytest.param(*each, marks=[] if each[0] in QUICK else [pytest.mark.slow])
        for each in ANSWERED
    ],
)
def test_no_answer_is_wrong_without_a_word(kind, seed, tmp_path):
    score = made(kind, seed, tmp_path)
    assert score.verdict != "wrong", (score.why, score.output)
    assert not score.needless, score.warnings
