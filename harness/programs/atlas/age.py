"""The age of an atlas, by the digests that it stores and by the versions of its detectors."""

from collections.abc import Mapping
from typing import Any

from detectors import detector_names, detector_type
from harness.experiment.digests import EXPERIMENT, simulation_digests
from harness.programs.atlas.limits import CAMERA, DETECTOR
from harness.vocabulary.code_digests import changed_parts
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import made_by

VERSION = "detector_version"


def age_of(limits: Any, about: Mapping[str, Any]) -> str:
    """Return a sentence that says that an atlas is older than the code, or an empty text.

    ``about``: what is stored beside the table. A table that states no code is older than the
    first version whose studies state it."""
    detector = DETECTOR if DETECTOR in limits else "detector"
    used = sorted(limits[detector].unique())
    is_current = set(used) <= set(detector_names()) and _states_todays_code(
        about.get("digests"), used, limits[CAMERA].unique()
    )
    if is_current:
        return ""
    compared = ", ".join(_versions(name, limits[limits[detector] == name]) for name in used)
    return (
        f"Older than the code: this atlas was computed by {made_by(about)} with {compared};"
        " today's limits may differ."
    )


def _states_todays_code(stored: Any, detectors: Any, cameras: Any) -> bool:
    """Return whether stored digests are those of today's code and cameras. The experiment's own
    settings do not count, as an atlas of other settings is not older."""
    if not isinstance(stored, Mapping):
        return False
    code_parts = {}
    for part, digest in stored.items():
        if not part.startswith(EXPERIMENT):
            code_parts[part] = digest
    today = simulation_digests(detectors, cameras)
    return not changed_parts(code_parts, today)


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
