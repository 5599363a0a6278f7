"""Claim C11: which of three cameras resolves damage best; one verdict over all set-ups of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from harness.evaluation.claim_rules import FEW, MANY, Verdict, decide
from harness.vocabulary.path_names import value_text

if TYPE_CHECKING:
    import pandas as pd

CAMERA = "source.camera.name"
"""The axis that this claim is about."""
BEST = "azure_kinect_nfov"
OTHERS = ("kinect_v2", "realsense_l515")
TEXT = "Of the three cameras, Azure Kinect resolves damage best."
RULE = (
    f"At each place (distance) the holes found with {MANY} frames are counted; undecided holes leave room for either "
    "count. Azure Kinect is ahead of another camera where it finds more whatever becomes of the undecided holes, and "
    "behind where it finds fewer. Borne out when it is ahead of each other camera at one place at least and behind at "
    "none; refuted when it is behind at any place, or surely ahead of some camera at none."
)


def claim_c11(summary: pd.DataFrame, axes: Sequence[str]) -> Verdict | None:
    """The verdict from summary rows of all set-ups, with a column for each of ``axes``; None where no axis holds the
    three cameras."""
    if CAMERA not in axes or not {BEST, *OTHERS} <= set(summary[CAMERA]):
        return None
    others = [path for path in axes if path != CAMERA]
    many = summary[summary["frames"] == MANY]
    if many.empty:
        return Verdict("C11", TEXT, "undecided", f"Not judged: no trial has {MANY} frames.", RULE)
    answers = [_against(many, camera, others) for camera in OTHERS]
    evidence = [_counts_text(summary, frames, others) for frames in (MANY, FEW)]
    standing = [_standing_text(many, camera, others) for camera in OTHERS]
    return Verdict("C11", TEXT, decide(answers), " ".join([*evidence, *standing]).strip(), RULE)


def _against(many: pd.DataFrame, camera: str, others: Sequence[str]) -> bool | None:
    """Whether the best camera is ahead of one other camera somewhere and behind nowhere."""
    standings = list(_standings(many, camera, others).values())
    if "behind" in standings:
        return False
    if "open" in standings:
        return None
    return "ahead" in standings if standings else None


def _standings(many: pd.DataFrame, camera: str, others: Sequence[str]) -> dict[str, str]:
    """For each place where both cameras were tried: ahead, behind, level (equal and sure) or open."""
    standings = {}
    for place, part in _places(many, others):
        if not {BEST, camera} <= set(part[CAMERA]):
            continue
        low, high = _bounds(part, BEST)
        other_low, other_high = _bounds(part, camera)
        sure = low == high and other_low == other_high
        standings[place] = (
            "ahead" if low > other_high else "behind" if high < other_low else "level" if sure else "open"
        )
    return standings


def _bounds(part: pd.DataFrame, camera: str) -> tuple[int, int]:
    """Fewest and most holes that a camera finds at a place."""
    status = part.loc[part[CAMERA] == camera, "status"]
    found, undecided = int((status == "found").sum()), int((status == "undecided").sum())
    return found, found + undecided


def _places(rows: pd.DataFrame, others: Sequence[str]) -> list[tuple[str, pd.DataFrame]]:
    if not others:
        return [("its one place", rows)]
    groups = rows.groupby(list(others), sort=False, dropna=False)
    return [
        (" and ".join(value_text(path, value) for path, value in zip(others, values, strict=True)), part)
        for values, part in groups
    ]


def _counts_text(summary: pd.DataFrame, frames: int, others: Sequence[str]) -> str:
    rows = summary[summary["frames"] == frames]
    if rows.empty:
        return ""
    said = []
    for place, part in _places(rows, others):
        counts = (_count_text(*_bounds(part, camera)) for camera in (BEST, *OTHERS))
        said.append(f"{place} {' / '.join(counts)}")
    plural = "s" if frames > 1 else ""
    return f"Holes found with {frames} frame{plural} by {BEST} / {' / '.join(OTHERS)}: {'; '.join(said)}."


def _count_text(low: int, high: int) -> str:
    return str(low) if low == high else f"{low} to {high}"


def _standing_text(many: pd.DataFrame, camera: str, others: Sequence[str]) -> str:
    standings = _standings(many, camera, others)
    said = [
        f"{word} at {', '.join(places)}"
        for word in ("ahead", "level", "behind", "open")
        if (places := [place for place, standing in standings.items() if standing == word])
    ]
    return f"Against {camera}: {'; '.join(said)}." if said else ""
