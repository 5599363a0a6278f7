"""Claim C11: which of three cameras resolves damage best; one verdict over all set-ups of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from harness.thesis.verdicts import FEW, MANY, Verdict, decide
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

    def places(rows: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
        if not others:
            return [("its one place", rows)]
        groups = rows.groupby(others, sort=False, dropna=False)
        return [
            (" and ".join(value_text(path, value) for path, value in zip(others, values, strict=True)), part)
            for values, part in groups
        ]

    many = summary[summary["frames"] == MANY]
    if many.empty:
        return Verdict("C11", TEXT, "undecided", f"Not judged: no trial has {MANY} frames.", RULE)
    evidence = []
    for frames in (MANY, FEW):
        rows = summary[summary["frames"] == frames]
        counts = [
            f"{place} {' / '.join(_count_text(*_bounds(part, camera)) for camera in (BEST, *OTHERS))}"
            for place, part in places(rows)
        ]
        if len(rows):
            plural = "s" if frames > 1 else ""
            heads = f"{BEST} / {' / '.join(OTHERS)}"
            evidence.append(f"Holes found with {frames} frame{plural} by {heads}: {'; '.join(counts)}.")
    answers: list[bool | None] = []
    for camera in OTHERS:
        standings: dict[str, list[str]] = {word: [] for word in ("ahead", "level", "behind", "open")}
        for place, part in places(many):
            if not {BEST, camera} <= set(part[CAMERA]):
                continue
            (low, high), (other_low, other_high) = _bounds(part, BEST), _bounds(part, camera)
            sure = low == high and other_low == other_high
            word = "ahead" if low > other_high else "behind" if high < other_low else "level" if sure else "open"
            standings[word].append(place)
        answers.append(False if standings["behind"] else None if standings["open"] else bool(standings["ahead"]))
        if not any(standings.values()):
            answers[-1] = None
        else:
            said = (f"{word} at {', '.join(where)}" for word, where in standings.items() if where)
            evidence.append(f"Against {camera}: {'; '.join(said)}.")
    return Verdict("C11", TEXT, decide(answers), " ".join(evidence), RULE)


def _bounds(part: pd.DataFrame, camera: str) -> tuple[int, int]:
    """Fewest and most holes that a camera finds at a place."""
    status = part.loc[part[CAMERA] == camera, "status"]
    found, undecided = int((status == "found").sum()), int((status == "undecided").sum())
    return found, found + undecided


def _count_text(low: int, high: int) -> str:
    return str(low) if low == high else f"{low} to {high}"
