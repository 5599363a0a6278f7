"""``tofpod flatfield``: measures a unit's fixed pattern on captures of a flat surface."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.inspection.arguments import (
    add_reading,
    crop_from_text,
    opened,
    read_poses,
    reading_of,
    refuse_repeats,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Lens
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from detectors.averages.flat_captures import FlatCapture
    from detectors.recordings import Recording

SHOWN_SIGMAS = 3.0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="captures, in any format that tofpod detect reads",
    )
    written = "the flat field; a .json of its figures and a .png of the map are written beside it"
    add("--out", type=Path, required=True, metavar="FILE.npz", help=written)
    add_reading(add)
    add(
        "--crop",
        default="auto",
        metavar="KIND",
        help="the part that shows the wall, as for tofpod detect",
    )
    poses = "camera poses, as for tofpod detect: the surface's shape is then not counted as noise"
    add("--poses", type=Path, metavar="FILE", help=poses)


@program(
    _options,
    "Measure the fixed pattern of a camera's unit, which is the range error of each pixel that is "
    "the same in every frame. Each PATH is a capture of 50 frames or more of a matte wall that "
    "fills the view. Record with a warm camera, several times at each of two distances, and move "
    "it by 30 mm or more between captures. Name the captures in the order of recording.",
    "tofpod flatfield near1 near2 far1 far2 --out unit.npz",
    "tofpod flatfield near1 near2 far1 far2 --unit mm --crop none --out unit.npz",
    epilog="Then: tofpod detect captures/board --flat-field unit.npz.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if the pattern is not stable), 2 for a user's mistake, 130
    after Ctrl-C."""
    from detectors.averages.flat_captures import separated
    from detectors.averages.flat_field import save_flat_field
    from harness.inspection.output import mm, print_warnings
    from harness.programs.camera.tables import FLAT_CAPTURES, FLAT_FIGURES, figures_of
    from harness.report.blocks import save_png
    from harness.vocabulary.files import write_json
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.text import show

    if options.out.suffix.lower() != ".npz":
        raise UserError(
            f"--out {options.out}: is not a name for a flat field", legal="a name that ends in .npz"
        )
    lens, captures, doubted, frames = _captures(options)
    separated_field = separated(captures, lens)
    warnings = (*doubted, *separated_field.field.warnings)
    field = replace(separated_field.field, warnings=warnings, frames=frames)
    nearest_m, farthest_m = field.distances_m
    distance = f"{nearest_m:.2f} to {farthest_m:.2f} m"
    if farthest_m < nearest_m * 1.01:
        distance = f"{nearest_m:.2f} m"
    pattern = f"fixed pattern {mm(field.rms_m)} rms"
    answer = f"{pattern} at {distance}, known to {mm(separated_field.noise_m)}"
    figures = list(figures_of(separated_field))
    error_m = field.error_m
    print_warnings(field.warnings)
    print(answer)
    show([FLAT_CAPTURES.grid(captures, terminal=True), FLAT_FIGURES.grid(figures, terminal=True)])
    data = options.out.with_suffix(".json")
    picture = options.out.with_suffix(".png")
    save_flat_field(options.out, field)
    facts = {
        "results_version": RESULTS_VERSION,
        "answer": answer,
        "warnings": field.warnings,
        "figures": FLAT_FIGURES.data(figures),
        "captures": FLAT_CAPTURES.data(captures),
        "provenance": record(command),
    }
    write_json(data, facts)
    save_png(picture, (7.0, 5.4), lambda figure: _draw(figure, error_m, answer))
    print(f"wrote {options.out}, {data.name}, {picture.name}")
    return 0


def _draw(figure: Figure, error_m: np.ndarray, title: str) -> None:
    axes = figure.subplots()
    limit_mm = SHOWN_SIGMAS * float(np.nanstd(error_m)) / MM
    shown = axes.imshow(
        error_m / MM, cmap="RdBu_r", vmin=-limit_mm, vmax=limit_mm, interpolation="nearest"
    )
    axes.set(xlabel="u, px", ylabel="v, px")
    axes.grid(visible=False)
    figure.colorbar(shown, ax=axes, extend="both").set_label("error of range, mm")
    figure.suptitle(title, fontsize=10, parse_math=False)


def _captures(
    options: argparse.Namespace,
) -> tuple[Lens, list[FlatCapture], list[str], frozenset[str]]:
    """Return the lens, the captures minus their smooth fits (a single capture as two halves, which
    show whether the pattern is stable), warnings about the recordings, and the digests of all
    frames. Raises UserError for faulty files or different cameras."""
    from detectors.averages.average import RECORDED, average
    from detectors.averages.flat_agreement import frame_digests
    from detectors.averages.flat_captures import flattened
    from detectors.crop import crop
    from detectors.methods.local import LocalConfig
    from harness.vocabulary.declaration.diagnose import settings_of

    settings = {"crop": crop_from_text(options.crop)}
    config = settings_of(LocalConfig, settings, f"--crop {options.crop}").crop
    poses: Sequence[np.ndarray | None] = (None,) * len(options.paths)
    if options.poses:
        poses = read_poses(options.poses, len(options.paths))
    refuse_repeats(options.paths)
    recordings = [
        opened([path], options.intrinsics, **reading_of(options)) for path in options.paths
    ]
    first = recordings[0]
    for path, recording in zip(options.paths, recordings, strict=True):
        if recording.lens is None:
            raise UserError(
                f"{path}: its lens is unknown", fix="name a file or a camera with --intrinsics"
            )
        if recording.lens != first.lens:
            raise UserError(
                f"{path}: has another lens than {options.paths[0]}",
                legal="captures of one unit and mode",
            )
    captures = []
    for recording, pose in zip(recordings, poses, strict=True):
        parts = list(_halves(recording)) if len(recordings) == 1 else [recording]
        for part in parts:
            cloud = average(part, RECORDED)
            captures.append(flattened(cloud, crop(cloud, config), part.name, pose))
    assert first.lens is not None
    doubts = [doubt for recording in recordings for doubt in recording.warnings]
    frames = frame_digests(frame for recording in recordings for frame in recording.selected())
    return first.lens, captures, doubts, frames


def _halves(recording: Recording) -> Iterator[Recording]:
    """Yield the first and second half of the frames; the whole recording if it is short."""
    from detectors.pixels.noise import LEAST_FRAMES

    count = sum(1 for _ in recording.selected())
    if count < 2 * LEAST_FRAMES:
        yield recording
        return
    halves = (("first half", slice(count // 2)), ("second half", slice(count // 2, None)))
    for name, part in halves:
        yield replace(recording, name=f"{recording.name}, {name}", selection=part)


if __name__ == "__main__":
    raise SystemExit(main())
