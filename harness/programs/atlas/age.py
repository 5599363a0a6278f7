"""The age of an atlas, by the digests that it stores and by the versions of its detectors."""

from collections.abc import Mapping
from typing import Any

from detectors import detector_names, detector_type
from harness.experiment.digests import CAMERA_PART, EXPERIMENT, simulation_digests
from harness.programs.atlas.limits import CAMERA, DETECTOR
from harness.vocabulary.code_digests import changed_parts
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import made_by
from harness.vocabulary.text import joined_words

VERSION = "detector_version"


def age_of(limits: Any, about: Mapping[str, Any]) -> str:
    """Return a sentence that says that an atlas is older than the code, or an empty text.

    ``about``: what is stored beside the table. A table that states no code is older than the
    first version whose studies state it."""
    detector = DETECTOR if DETECTOR in limits else "detector"
    used = sorted(limits[detector].unique())
    changed = _changed_code(about.get("digests"), used, limits[CAMERA].unique())
    if not changed and set(used) <= set(detector_names()):
        return ""
    parts = []
    for name in used:
        rows = limits[limits[detector] == name]
        if _is_other_version(name, rows):
            parts.append(_versions(name, rows))
    if not parts:
        # the versions are today's, so the code that changed is named
        parts.append(f"earlier code of {joined_words(changed)}")
    return (
        f"Older than the code: this atlas was computed by {made_by(about)} with {', '.join(parts)};"
        " today's limits may differ."
    )


def _changed_code(stored: Any, detectors: Any, cameras: Any) -> list[str]:
    """Return the outermost rooms whose stored digests are not today's, with the cameras' numbers as
    one; the whole project where none are stored. The experiment's own settings do not count, as an
    atlas of other settings is not older."""
    if not isinstance(stored, Mapping):
        return ["tofpod"]
    code_parts = {}
    for part, digest in stored.items():
        if not part.startswith(EXPERIMENT):
            code_parts[part] = digest
    installed = [name for name in detectors if name in detector_names()]
    today = simulation_digests(installed, cameras)
    rooms = []
    for part in changed_parts(code_parts, today):
        rooms.append("cameras" if part.startswith(CAMERA_PART) else part.partition("/")[0])
    return list(dict.fromkeys(rooms))


def _is_other_version(detector: str, rows: Any) -> bool:
    """Return whether a detector's rows state no version, or not only today's."""
    if detector not in detector_names() or VERSION not in rows:
        return True
    return {int(number) for number in rows[VERSION]} != {detector_type(detector).version}


def _versions(detector: str, rows: Any) -> str:
    """Return ``version 7 of matched (now 10)``."""
    stored = "an unknown version"
    if VERSION in rows:
        numbers = sorted({int(number) for number in rows[VERSION]})
        versions = " and ".join(str(number) for number in numbers)
        stored = f"version {versions}"
    try:
        now = f"now {detector_type(detector).version}"
    except UserError:
        now = "not installed"
    return f"{stored} of {detector} ({now})"
