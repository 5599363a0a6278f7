"""``python -m harness.validate --capture``: from the files of a capture to the page beside its simulation."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.recordings import open_capture
from detectors.recordings.pictures import read_picture
from detectors.recordings.recording import Recording
from harness.scorecard.capture import Beside, Captured, Twin, captured_of, surface_rows, surfaces_of, twin_of
from harness.scorecard.capture_edges import edge_rows, edges_of
from harness.scorecard.capture_page import capture_csv, capture_html, plain_rows
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.lens import Lens
from harness.vocabulary.provenance import record
from harness.vocabulary.versions import RESULTS_VERSION
from scenes.sensor.camera import camera_names, lens_named, lens_names, load_camera


@dataclass(frozen=True)
class CaptureOptions:
    """What the user asked for. ``camera`` None: the one whose sensor has the capture's size."""

    paths: tuple[Path, ...]
    camera: str | None
    out: Path
    unit: str | None
    intrinsics: str | None
    frames: int | None
    mask: Path | None
    albedo: float
    command: str


def run_capture(options: CaptureOptions) -> int:
    """Compare, print, write capture.csv, capture.html and provenance.json. Returns 0.

    Raises UserError for what cannot be read or simulated: too few frames, another size, no plane, no lens.
    """
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}", legal="above 0 and up to 1")
    recording = _opened(options)
    captured = captured_of(recording, None if options.mask is None else read_mask(options.mask))
    name = options.camera or camera_of_size(captured.lens)
    twin = twin_of(name, captured.lens, options.albedo)
    rows = compared(captured, twin)
    print(f"{captured.name}: {len(captured.z_m)} frames beside {twin.camera.title}, albedo {options.albedo:g}")
    for note in recording.notes:
        print(f"note: {note}")
    print(plain_rows(rows))
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(options.command),
        "camera": name,
        "files": [str(path) for path in recording.files],
    }
    write_text(options.out / "capture.csv", capture_csv(rows))
    write_text(options.out / "capture.html", capture_html(captured, twin, rows, provenance))
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    print(f"wrote {options.out / 'capture.html'}")
    return 0


def compared(captured: Captured, twin: Twin) -> list[Beside]:
    """All comparisons: planes, then edges."""
    rows = [row for surface in surfaces_of(captured) for row in surface_rows(surface, twin)]
    return rows + [row for edge in edges_of(captured) for row in edge_rows(captured, edge, twin)]


def _opened(options: CaptureOptions) -> Recording:
    """The capture. Without a lens anywhere, the nominal one of the camera that the user names counts."""
    lens, file = _lens(options.intrinsics)
    first = slice(options.frames) if options.frames else None
    paths = list(options.paths)
    try:
        return open_capture(paths, unit=options.unit, intrinsics=file, lens=lens, frames=first)
    except UserError:
        if options.camera is None or options.intrinsics is not None:
            raise
        nominal = load_camera(options.camera).nominal_lens
        recording = open_capture(paths, unit=options.unit, lens=nominal, frames=first)
        print(f"note: the capture names no lens; the nominal one of {options.camera} counts", file=sys.stderr)
        return recording


def _lens(intrinsics: str | None) -> tuple[Lens | None, Path | None]:
    """A camera's nominal lens, or a file, from what the user wrote."""
    if intrinsics is None:
        return None, None
    if intrinsics in lens_names():
        return lens_named(intrinsics), None
    if not Path(intrinsics).exists():
        legal = f"a file, or one of the cameras {', '.join(lens_names())}"
        raise UserError(f"--intrinsics {intrinsics}: no such file and no such camera", legal=legal)
    return None, Path(intrinsics)


def camera_of_size(lens: Lens) -> str:
    """The one simulated camera with as many pixels. Raises UserError where there is none, or more than one."""
    sizes = {name: load_camera(name).nominal_lens for name in camera_names()}
    fitting = [name for name, own in sizes.items() if (own.width, own.height) == (lens.width, lens.height)]
    if len(fitting) == 1:
        return fitting[0]
    known = ", ".join(f"{name} {own.width} x {own.height}" for name, own in sizes.items())
    if not fitting:
        raise UserError(
            f"no simulated camera has {lens.width} x {lens.height} pixels",
            legal=known,
            fix="record the camera's own depth images, not ones aligned to a colour camera or of another mode",
        )
    raise UserError(
        f"several cameras have {lens.width} x {lens.height} pixels: {', '.join(fitting)}",
        legal=known,
        fix="name the one that took it with --camera",
    )


def read_mask(path: Path) -> np.ndarray:
    """(h, w) bool: what is not black in an image. Raises UserError where it cannot be read."""
    import cv2

    try:
        image = read_picture(path, cv2.IMREAD_GRAYSCALE)
    except UserError as error:
        raise UserError(
            f"--mask {path}: no image that can be read ({error.message.removeprefix(f'{path}: ')})",
            legal="a PNG of the frames' size, black = left out",
        ) from error
    return np.asarray(image > 0)
