"""``python -m harness.validate --capture``: from the files of a capture to the page beside its simulation."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.recordings import open_capture
from detectors.recordings.pictures import read_picture
from detectors.recordings.recording import Recording
from harness.report import canvas
from harness.report.blocks import template
from harness.scorecard.capture import Captured, Twin, captured_of, compared, twin_of
from harness.scorecard.plots import COLOURS
from harness.scorecard.program import told
from harness.scorecard.tables import BESIDE, Beside
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.lens import Lens
from harness.vocabulary.provenance import record
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION
from scenes.sensor.camera import camera_names, lens_named, lens_names, load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

METHOD = (
    "{frames} frames of a static scene. The planes in it were found, fitted and simulated in closed form, as many "
    "frames as were captured, with the capture's lens and an albedo of {albedo:g} for all surfaces; one analysis is "
    "applied to both. Nothing is fitted to make them agree. Not simulated: what is not flat, light that met more than "
    "one surface, the surfaces' relief and texture. Pixels within 3 px of a plane's rim, and pixels without a range in "
    "any frame, are left out."
)
CAPTION = (
    "Left: the planes that were found, coloured over the median depth (nearer is lighter). Middle: standard deviation "
    "over frames, rms over pixels, in bins of 0.1 m, with 95 % intervals of a jackknife over frames. Right: "
    "correlation of the temporal noise along x with each frame's mean taken off. Solid: measured; dashed: simulated."
)
NO_EDGE = "No straight edge of one plane before another, at least 30 lines of pixels long and 20 mm high, was found."
DRAWN_AS = {"measured": {"marker": "o", "linestyle": "-"}, "simulated": {"marker": "s", "linestyle": "--"}}


def run_capture(options: argparse.Namespace, command: str) -> int:
    """Compare, print, write capture.csv, capture.html and provenance.json. Returns 0.

    ``options.camera``: at most one; none for the one whose sensor has the capture's size. Raises UserError for what
    cannot be read or simulated: too few frames, another size, no plane, no lens.
    """
    if len(options.camera) > 1:
        raise UserError("--capture: one camera took it", fix="give --camera once, or not at all")
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}", legal="above 0 and up to 1")
    recording = _opened(options)
    captured = captured_of(recording, None if options.mask is None else read_mask(options.mask))
    name = options.camera[0] if options.camera else camera_of_size(captured.lens)
    twin = twin_of(name, captured.lens, options.albedo)
    rows = compared(captured, twin)
    print(f"{captured.name}: {len(captured.z_m)} frames beside {twin.camera.title}, albedo {options.albedo:g}")
    for remark in recording.notes:
        print(f"note: {remark}")
    BESIDE.show(rows)
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "camera": name,
        "files": [str(path) for path in recording.files],
    }
    BESIDE.write(options.out, rows)
    write_text(options.out / "capture.html", capture_html(captured, twin, rows, provenance))
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    print(f"wrote {options.out / 'capture.html'}")
    return 0


def _opened(options: argparse.Namespace) -> Recording:
    """The capture. Without a lens anywhere, the nominal one of the camera that the user names counts."""
    lens: Lens | None = None
    file: Path | None = None
    if options.intrinsics in lens_names():
        lens = lens_named(options.intrinsics)
    elif options.intrinsics is not None:
        file = Path(options.intrinsics)
        if not file.exists():
            legal = f"a file, or one of the cameras {', '.join(lens_names())}"
            raise UserError(f"--intrinsics {options.intrinsics}: no such file and no such camera", legal=legal)
    first = slice(options.frames) if options.frames else None
    paths = list(options.capture)
    try:
        return open_capture(paths, unit=options.unit, intrinsics=file, lens=lens, frames=first)
    except UserError:
        if not options.camera or options.intrinsics is not None:
            raise
        nominal = load_camera(options.camera[0]).nominal_lens
        recording = open_capture(paths, unit=options.unit, lens=nominal, frames=first)
        print(f"note: the capture names no lens; the nominal one of {options.camera[0]} counts", file=sys.stderr)
        return recording


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
    """(h, w) bool: the pixels of an image that are not black. Raises UserError where it cannot be read."""
    import cv2

    try:
        image = read_picture(path, cv2.IMREAD_GRAYSCALE)
    except UserError as error:
        raise UserError(
            f"--mask {path}: no image that can be read ({error.message.removeprefix(f'{path}: ')})",
            legal="a PNG of the frames' size, black = left out",
        ) from error
    return np.asarray(image > 0)


# ---- the page --------------------------------------------------------------------------------------------------------


def capture_html(captured: Captured, twin: Twin, rows: Sequence[Beside], provenance: Mapping[str, Any]) -> str:
    """The page as text."""
    whole = [row for row in rows if row.quantity == "temporal deviation" and row.at == "all"]
    ratios = ", ".join(f"{row.ratio:.2f} ({row.where})" for row in whole)
    answer = f"Temporal deviation, simulated by measured: {ratios}."
    answer = answer if whole else "The simulation sees none of the planes of this capture."
    drawn = canvas.svg(
        "capture", (12.0, 4.2), "Planes found, temporal deviation and correlation", lambda f: _draw(f, captured, rows)
    )
    return template("capture.html", Path(__file__).parent).render(
        name=captured.name,
        camera=twin.camera.title,
        answer=answer,
        method=METHOD.format(frames=len(captured.z_m), albedo=twin.albedo),
        figure=drawn,
        caption=CAPTION,
        heads=BESIDE.heads(),
        rows=[BESIDE.cells(row) for row in rows],
        edges=any("edge" in row.where for row in rows),
        no_edge=NO_EDGE,
        provenance=told(provenance),
    )


def _draw(figure: Canvas, captured: Captured, rows: Sequence[Beside]) -> None:
    """The planes that were found, temporal deviation against range, and the noise's correlation."""
    from matplotlib.colors import to_rgb

    left, middle, right = figure.subplots(1, 3)
    # the median depth, with each plane's pixels in its colour
    shade = captured.median_m
    low, high = np.nanpercentile(shade, [2, 98])
    grey = np.nan_to_num(np.clip((high - shade) / max(high - low, MM), 0, 1) * 0.5 + 0.45, nan=0.05)
    picture = np.repeat(grey[..., None], 3, axis=-1)
    for number, found in enumerate(captured.planes):
        tint = np.array(to_rgb(COLOURS[number % len(COLOURS)]))
        picture[found.mask] = 0.45 * picture[found.mask] + 0.55 * tint
    left.imshow(picture)
    left.set(title="planes found", xticks=[], yticks=[])
    left.grid(False)
    for number, name in enumerate(dict.fromkeys(row.where for row in rows if row.where.startswith("plane"))):
        own = [row for row in rows if row.where == name]
        bins = [row for row in own if row.quantity == "temporal deviation" and row.at != "all"]
        lags = [row for row in own if row.quantity == "noise correlation" and row.at.startswith("x")]
        for which, drawn_as in DRAWN_AS.items():
            style = {"color": COLOURS[number % len(COLOURS)], "markersize": 4, **drawn_as}
            readings = [getattr(row, which) for row in bins]
            values = np.array([reading.value for reading in readings])
            ends = np.array([[r.interval.low, r.interval.high] for r in readings]).reshape(-1, 2).T
            errors = np.nan_to_num(np.abs(ends - values))
            at = [float(row.at.split(" ")[0]) + 0.05 for row in bins]
            middle.errorbar(at, values, yerr=errors, label=f"{name}, {which}", **style)
            right.plot([int(row.at.split(" ")[-1]) for row in lags], [getattr(r, which).value for r in lags], **style)
    middle.set(title="temporal deviation", xlabel="z (m)", ylabel="deviation (mm)", ylim=(0, None))
    right.set(title="correlation, along x", xlabel="lag (pixels)", ylabel="correlation of the noise")
    right.axhline(0, color=canvas.GREY, linewidth=0.8)
    handles, labels = middle.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside upper right", ncols=len(handles), columnspacing=1.4)
