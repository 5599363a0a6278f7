"""A real capture as the source of an experiment: opened once, known by the content of its files."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from harness.experiment.schema import CaptureSource
from scenes.sensor.camera import lens_named, lens_names, load_camera

if TYPE_CHECKING:
    from detectors.recordings import Recording


@lru_cache(maxsize=1000)
def recording_of(source: CaptureSource) -> Recording:
    """The recording behind a source, its first frame read and checked. Raises UserError for every fault of its files.

    ``intrinsics`` may name a camera, whose nominal lens then counts.
    """
    from detectors.recordings import open_capture  # brings the readers of every format

    name = source.intrinsics
    lens = lens_named(name) if name and name in lens_names() else None
    file = Path(name) if name and lens is None else None
    return open_capture([Path(path) for path in source.paths], unit=source.unit, intrinsics=file, lens=lens)


def content_of(source: CaptureSource) -> dict[str, object]:
    """All that decides a recording's numbers: its files by name and content, the unit, the lens where it is named."""
    files = [[file.name, _file_digest(file, *_state(file))] for file in recording_of(source).files]
    camera = lens_names().get(source.intrinsics or "")
    named = load_camera(camera).lens.to_data() if camera else None
    return {"kind": source.kind, "files": files, "unit": source.unit, "lens": named}


def _state(path: Path) -> tuple[int, int]:
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


@lru_cache(maxsize=100_000)
def _file_digest(path: Path, size: int, changed_ns: int) -> str:
    """Size and time of change are arguments so that a changed file is read again."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
