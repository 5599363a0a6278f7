"""The target that the automatic crop took: what it is, what else it could have been, and how to say so."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.tables.outputs import TARGETS
from harness.vocabulary.units import MM

if TYPE_CHECKING:
    from collections.abc import Callable

    from detectors.target import Candidate, Choice
    from harness.vocabulary.capture import Cloud


def choice_by(settings: object, cloud: Cloud) -> Choice | None:
    """What the automatic crop among a detector's or a mapping's settings chooses; None where they have another crop, or
    none. Raises UserError as the crop does."""
    from detectors.crop import AutoCrop, choice_of

    config = getattr(settings, "crop", None)
    if not isinstance(config, AutoCrop) or not cloud.valid.any():
        return None
    return choice_of(cloud, config)


def print_choice(choice: Choice | None) -> None:
    """The surface that was taken, and a line for each that could have been, with the option that takes it."""
    from detectors.target import described_text

    if choice is None or not choice.candidates:
        return
    for number, candidate in enumerate(choice.candidates, start=1):
        if number == choice.taken:
            print(f"target {number} of {len(choice.candidates)}: {described_text(candidate)}")
    for number, candidate in enumerate(choice.candidates, start=1):
        if number != choice.taken:
            print(f"  instead, with --target {number}: {described_text(candidate)}")


def choice_facts(choice: Choice | None) -> dict[str, Any] | None:
    """What the JSON says of the choice; None where there was none."""
    if choice is None:
        return None
    candidates = [{"number": n, **_facts(each)} for n, each in enumerate(choice.candidates, start=1)]
    return {"taken": choice.taken, "warnings": choice.warnings, "candidates": candidates}


def _facts(candidate: Candidate) -> dict[str, Any]:
    return {
        "distance_mm": candidate.distance_m / MM,
        "nearest_mm": candidate.nearest_m / MM,
        "farthest_mm": candidate.farthest_m / MM,
        "extent_mm": [side / MM for side in candidate.extent_m],
        "share_of_view": candidate.share,
        "tilt_deg": candidate.tilt_deg,
        "pixels": candidate.pixels,
    }


def pictures(choice: Choice | None, name: str = TARGETS.name) -> dict[str, Callable[[Path], object]]:
    """The numbered picture of the candidates, by its file's name, for `harness.report.findings.write_findings`."""
    from detectors.target import described_text
    from harness.report.targets_picture import save_targets

    if choice is None or not choice.candidates:
        return {}
    outlines = [candidate.outline for candidate in choice.candidates]
    texts = [described_text(candidate) for candidate in choice.candidates]
    return {name: lambda path: save_targets(path, choice.grid, outlines, texts, choice.taken)}
