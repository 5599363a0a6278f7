"""Cameras as sources of frames, live or from a recording that their makers' packages play.

They are found by name: the built-in ones below, others through the entry point group
``tofpod.sources``. No built-in one has been run on a camera."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import cast

from detectors.sources.interface import OpenStream, Stream
from harness.vocabulary.errors import UserError
from harness.vocabulary.plug_ins import PlugIns

GROUP = "tofpod.sources"
"""Entry points of this group name an `OpenStream`."""

BUILT_IN = {
    "femto": "detectors.sources.femto:open_femto",
    "k4a": "detectors.sources.k4a:open_k4a",
    "oak": "detectors.sources.oak:open_oak",
    "realsense": "detectors.sources.realsense:open_realsense",
}

SOURCES = PlugIns(GROUP, "camera to record with", lambda: BUILT_IN)


def open_source(name: str, path: Path | None) -> AbstractContextManager[Stream]:
    """Return the stream of the source of that name: of its live camera, or of a recording at
    ``path``. Raises UserError for an unknown name and for a plug-in that is no function."""
    offer = SOURCES.offer(name)
    loaded = SOURCES.load(offer)
    if not callable(loaded):
        raise SOURCES.broken(offer, "it is not a function")
    if path is not None and not path.is_file():
        raise UserError(f"--from {path}: there is no such file")
    return cast("OpenStream", loaded)(path)
