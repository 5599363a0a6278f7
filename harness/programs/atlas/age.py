"""The age of an atlas: whether its shards are of today's code and of today's numbers of cameras."""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any

from harness.vocabulary.provenance import ROOT, made_by
from harness.vocabulary.text import joined_words

FOLDERS = ("detectors", "scenes", "harness/trials", "harness/evaluation", "harness/experiment")
"""Folders whose sources decide limits, with `harness/runs` and `harness/vocabulary`."""
ALSO = ("harness/runs", "harness/vocabulary")
LAW = ("harness/programs/atlas/fitting.py", "harness/programs/atlas/law.py")
"""Sources that decide the law that is fitted to signals."""
NOT_CODE = "experiment "
"""Begins the name of a digest of settings: an atlas of other settings is not older."""


def sources_digest() -> str:
    """Return a digest of the bytes of all sources and camera files that may decide a limit. While
    it is the same, so are all digests by part, which take a second of processor time."""
    state = hashlib.blake2b(digest_size=8)
    paths = [ROOT / name for name in LAW]
    for folder in (*FOLDERS, *ALSO):
        paths += sorted((ROOT / folder).rglob("*"))
    for path in paths:
        if path.suffix in (".py", ".yaml", ".npz"):
            content = path.read_bytes()
            state.update(f"{path.relative_to(ROOT).as_posix()} {len(content)}\n".encode())
            state.update(content)
    return state.hexdigest()


def age_of(shards: Iterable[tuple[str, Mapping[str, Any]]]) -> str:
    """Return a sentence that says that shards are older than the code, or an empty text.

    ``shards``: the camera of each, and what it was computed with."""
    sources = sources_digest()
    doubtful = [pair for pair in shards if pair[1].get("sources") != sources]
    changed: dict[str, None] = {}
    made = ""
    for camera, about in doubtful:
        parts = _changed_parts(camera, about)
        if parts:
            changed.update(dict.fromkeys(parts))
            made = made or made_by(about)
    if not changed:
        return ""
    return (
        f"Older than the code: this atlas was computed by {made} with earlier code of"
        f" {joined_words(list(changed))}; today's limits may differ."
    )


def _changed_parts(camera: str, about: Mapping[str, Any]) -> list[str]:
    """Return the outermost rooms whose stored digests are not today's, with the camera's numbers
    as one; the whole project where none are stored."""
    from detectors import detector_names
    from harness.experiment.digests import CAMERA_PART, simulation_digests
    from harness.vocabulary.code_digests import changed_parts, file_digests
    from scenes.sensor.camera import camera_names

    stored = about.get("digests")
    if not isinstance(stored, Mapping):
        return ["tofpod"]
    code_parts = {part: text for part, text in stored.items() if not part.startswith(NOT_CODE)}
    cameras = [camera] if camera in camera_names() else []
    if not cameras:  # a camera of the user's own, whose file may be elsewhere by now
        code_parts = {k: v for k, v in code_parts.items() if not k.startswith(CAMERA_PART)}
    detectors = [name for name in [about.get("detector")] if name in detector_names()]
    today = simulation_digests(detectors, cameras) | file_digests(LAW)
    rooms = []
    for part in changed_parts(code_parts, today):
        rooms.append("cameras" if part.startswith(CAMERA_PART) else part.partition("/")[0])
    return list(dict.fromkeys(rooms))
