"""``tofpod validate --capture``: compares a static capture with the simulation of a known camera,
unchanged.

Measurement and simulation are those of `tofpod characterise`; nothing is fitted to make both
agree.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from detectors.recordings.depth_images import read_picture
from harness.inspection.arguments import opened_as, reading_of
from harness.inspection.output import print_notes, print_warnings
from harness.programs.camera.camera_file import camera_of_size, simulated, with_lens
from harness.programs.camera.measure import characteristics, read_still
from harness.programs.camera.page import MEASURED, SIMULATED, beside, write_page
from harness.vocabulary.errors import UserError


def run_capture(options: argparse.Namespace, command: str) -> int:
    """Compare, print, and write capture.html, the tables and provenance.json. Returns 0. Raises
    UserError for a capture that cannot be read or simulated: too few frames, another size, no
    plane, no lens."""
    if len(options.camera) > 1:
        raise UserError(
            "--capture: a capture comes from a single camera",
            fix="give --camera once, or not at all",
        )
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}", legal="a number above 0, up to 1")
    first = slice(options.max_frames) if options.max_frames else None
    camera_name = options.camera[0] if options.camera else None
    recording = opened_as(
        camera_name, options.capture, options.intrinsics, frames=first, **reading_of(options)
    )
    capture = read_still(recording, None if options.mask is None else read_mask(options.mask))
    name = camera_name or camera_of_size(capture.lens)
    camera = with_lens(name, capture.lens)
    measured = characteristics([capture])
    if not measured.surfaces:
        legal = "walls, boards, tables: flat surfaces that the simulation can repeat"
        fix = "check the lens (--intrinsics), or exclude other objects with --mask"
        raise UserError(f"{capture.name}: shows no flat surface", legal=legal, fix=fix)
    warnings = (*recording.warnings, *measured.doubts)
    print_warnings(warnings)
    print_notes(recording.notes)
    twin = characteristics(simulated(camera, measured, options.albedo))
    rows = beside(measured, twin, None)
    ratios = ", ".join(
        f"{row.ratio:.2f} ({row.where})" for row in rows if row.figure == "temporal noise"
    )
    answer = (
        f"Ratio of simulated to measured pixel noise: {ratios}. Albedo {options.albedo:g} is "
        "assumed."
    )
    title = f"{capture.name} compared with the simulated {camera.title}"
    facts = {
        "camera": name,
        "files": [path.as_posix() for path in recording.files],
        "notes": recording.notes,
    }
    sources = {MEASURED: measured, SIMULATED: twin}
    write_page(
        path=options.out / "capture.html",
        sources=sources,
        rows=rows,
        title=title,
        answer=answer,
        known_title="",
        command=command,
        facts=facts,
        warnings=warnings,
    )
    return 0


def read_mask(path: Path) -> np.ndarray:
    """Return the pixels of an image that are not black, (h, w) bool. Raises UserError if it cannot
    be read."""
    try:
        return np.asarray(read_picture(path, cv2.IMREAD_GRAYSCALE) > 0)
    except UserError as error:
        legal = "a PNG with the size of the frames; black excludes"
        why = error.message.removeprefix(f"{path}: ")
        raise UserError(f"--mask {path}: is not a readable image ({why})", legal=legal) from error
