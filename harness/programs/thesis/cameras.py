"""The rule for the claim on cameras (C11), judged at each place of an experiment.

A place is a value of every axis but the camera and its unit. There, a camera's number of holes
found is a range over its units and variations, and over the holes that are undecided. The L515 is
not judged beyond 1 m: its noise is calibrated at 0.65 and 0.945 m, and by its model it grows with
the square of the range (1.1 mm at 2 m, 3.2 at 3.5), while a published evaluation has less than
0.5 mm up to 3.5 m (Breitbarth, SPIE 11782)."""

from collections.abc import Sequence

import pandas as pd

from harness.evaluation.maps import CAMERA_UNIT, MANY
from harness.programs.thesis.claims import FEWEST_UNITS, decide, verdict_of
from harness.programs.thesis.counts import STANDINGS, HoleCount, Standing
from harness.report.claims import Verdict
from harness.vocabulary.path_names import value_text

CAMERA = "source.camera.name"
BEST = "azure_kinect_nfov"
OTHERS = ("kinect_v2", "realsense_l515")
DISTANCE = "source.target.distance_m"
KNOWN_TO_M = {"realsense_l515": 1.0}
"""Distance up to which a camera's noise is known."""

CountsByConditions = dict[str, dict[str, HoleCount]]
"""The count of each camera (by name) at each place (as text)."""


def score_cameras(summary: pd.DataFrame, axes: Sequence[str]) -> list[Verdict]:
    """Return the verdict of `claim_c11`, if there is one."""
    verdict = claim_c11(summary, axes)
    return [] if verdict is None else [verdict]


def claim_c11(summary: pd.DataFrame, axes: Sequence[str]) -> Verdict | None:
    """Return the verdict from summary rows of all set-ups and variations; None if none of the
    ``axes`` holds the three cameras."""
    if CAMERA not in axes or not {BEST, *OTHERS} <= set(summary[CAMERA]):
        return None
    rows = summary[(summary["frames"] == MANY) & summary[CAMERA].isin((BEST, *OTHERS))]
    if rows.empty:
        return verdict_of("C11", "undecided", f"Not judged: no trial has {MANY} frames.")
    rows, withdrawn = _with_known_noise(rows)
    counts = _counts_by_conditions(rows, axes)
    evidence = withdrawn
    units = rows.groupby(CAMERA)[CAMERA_UNIT].nunique().min() if CAMERA_UNIT in axes else 1
    if units < FEWEST_UNITS:
        evidence.append(
            f"Only {units} of each camera's units: too few for a verdict on other units."
        )
    evidence.append(_counts_text(counts))
    answers: list[bool | None] = []
    for camera in OTHERS:
        conditions_of = _conditions_by_standing(counts, camera)
        answers.append(_is_better(conditions_of))
        texts = [
            f"{standing} at {', '.join(conditions)}"
            for standing, conditions in conditions_of.items()
            if conditions
        ]
        if texts:
            evidence.append(f"Against {camera}: {'; '.join(texts)}.")
    answer = decide(answers) if units >= FEWEST_UNITS else "undecided"
    return verdict_of("C11", answer, " ".join(evidence))


def _with_known_noise(rows: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Return the rows of places where the camera's noise is known, and a sentence for each camera
    that lost some."""
    sentences: list[str] = []
    if DISTANCE not in rows:
        return rows, sentences
    for camera, farthest_m in KNOWN_TO_M.items():
        is_beyond = (rows[CAMERA] == camera) & (rows[DISTANCE] > farthest_m)
        if is_beyond.any():
            rows = rows[~is_beyond]
            sentences.append(
                f"Withdrawn for {camera} beyond {farthest_m:g} m, where its noise is not known: "
                "the model's grows with the square of the range, a published evaluation's hardly."
            )
    return rows, sentences


def _counts_by_conditions(rows: pd.DataFrame, axes: Sequence[str]) -> CountsByConditions:
    varied = [path for path in axes if path not in (CAMERA, CAMERA_UNIT)]
    if not varied:
        return {"its one place": _counts_by_camera(rows)}
    counts: CountsByConditions = {}
    for values, part in rows.groupby(varied, sort=False, dropna=False):
        counts[" and ".join(map(value_text, varied, values))] = _counts_by_camera(part)
    return counts


def _counts_by_camera(rows: pd.DataFrame) -> dict[str, HoleCount]:
    return {str(camera): _count(part) for camera, part in rows.groupby(CAMERA)}


def _count(rows: pd.DataFrame) -> HoleCount:
    """Return the fewest and most holes that any unit or variation of a camera finds at a place."""
    certain = (rows["status"] == "found").groupby(rows["variant"]).sum()
    possible = (rows["status"] != "missed").groupby(rows["variant"]).sum()
    return HoleCount(fewest=int(certain.min()), most=int(possible.max()))


def _counts_text(counts: CountsByConditions) -> str:
    """Return the sentence with every count, in the order of the cameras' names."""
    texts = []
    for conditions, by_camera in counts.items():
        numbers = [
            by_camera[camera].text if camera in by_camera else "–" for camera in (BEST, *OTHERS)
        ]
        texts.append(f"{conditions} {' / '.join(numbers)}")
    cameras = f"{BEST} / {' / '.join(OTHERS)}"
    return f"Holes found with {MANY} frames by {cameras}: {'; '.join(texts)}."


def _conditions_by_standing(counts: CountsByConditions, camera: str) -> dict[Standing, list[str]]:
    """Return the places at which the Azure Kinect has each standing against another camera."""
    conditions_of: dict[Standing, list[str]] = {standing: [] for standing in STANDINGS}
    for conditions, by_camera in counts.items():
        if BEST in by_camera and camera in by_camera:
            standing = by_camera[BEST].against(by_camera[camera])
            conditions_of[standing].append(conditions)
    return conditions_of


def _is_better(conditions_of: dict[Standing, list[str]]) -> bool | None:
    """Return whether the Azure Kinect is ahead somewhere and behind nowhere; None if that is open
    or no place has both cameras."""
    if conditions_of["behind"]:
        return False
    if conditions_of["open"] or not any(conditions_of.values()):
        return None
    return bool(conditions_of["ahead"])
