"""A folder of frames that `tofpod detect` reads without an option."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.sources.interface import Stream
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes, write_json
from harness.vocabulary.geometry import Frame

LARGEST = 65534
"""Largest stored distance; the largest number of 16 bits means "no return"."""


class FrameFolder:
    """Writes ``depth/`` and, if there is any, ``amplitude/`` as PNG of 16 bits, ``intrinsic.json``
    with lens and unit, and ``recording.json``. Each frame is written when it comes, so that nothing
    is lost when a recording breaks off."""

    def __init__(self, folder: Path, stream: Stream) -> None:
        """Begin a folder. Raises UserError if it holds anything, or cannot be written."""
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            problem = f"{folder}: is there already; it was not changed"
            raise UserError(problem, fix="name a new folder with --out")
        self._folder = folder
        self._unit_m = stream.unit_m
        self._count = 0
        self.beyond = 0
        """Distances that were too large for the 16 bits of a picture, and are left out."""
        lens = stream.lens
        facts = {
            "width": lens.width,
            "height": lens.height,
            "fx": lens.fx,
            "fy": lens.fy,
            "cx": lens.cx,
            "cy": lens.cy,
            "distortion": lens.distortion,
            "depth_unit": f"{stream.unit_m:.9g} m",
        }
        write_json(folder / "intrinsic.json", facts)

    def add(self, frame: Frame) -> None:
        """Write the next frame."""
        stored = np.rint(np.nan_to_num(frame.z_m.astype(np.float64)) / self._unit_m)
        is_beyond = stored > LARGEST
        self.beyond += int(np.count_nonzero(is_beyond))
        stored[is_beyond] = 0
        self._write("depth", stored)
        if frame.amplitude is not None:
            self._write("amplitude", np.clip(np.rint(frame.amplitude), 0, 65535))
        self._count += 1

    def _write(self, kind: str, numbers: np.ndarray) -> None:
        _, content = cv2.imencode(".png", numbers.astype(np.uint16))
        path = self._folder / kind / f"{self._count:06d}.png"
        write_bytes(path, content.tobytes(), durable=False)

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Write what was seen."""
        write_json(self._folder / "recording.json", facts)
