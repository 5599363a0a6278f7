"""Folders and lists of 16-bit depth PNGs: Open3D's recorder, Azure SDK exports, TUM RGB-D, or bare pictures.

What decides the layout: a sub-folder ``depth`` (with ``color`` or ``rgb`` beside it), names that hold "depth", names
that are numbers, else every 16-bit grey PNG. A ``depth.txt`` beside marks TUM RGB-D (5000 to the metre, colour matched
by time stamp); all others are millimetres unless a unit is given.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from detectors.recordings.distances import UNITS_M, frame_from_depth, rounding_step_m
from detectors.recordings.intrinsics import lens_file_beside, lens_of_size, no_lens, read_lens
from detectors.recordings.pictures import PNG_SIGNATURE, decoded, read_picture, refuse_broken_png
from detectors.recordings.recording import Recording
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import PICTURE_BYTES, bounded_bytes, refuse_pixels

COLOUR_FOLDERS = ("color", "colour", "rgb")
COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg")
TUM_MATCH_S = 0.02
"""Largest difference of time stamps of depth and colour that still belong together (the benchmark's own default)."""

LEGAL_PNG = "16-bit single-channel PNG (uint16, 0 = no depth)"


@dataclass(frozen=True)
class PngReader:
    """Streams depth pictures; ``colours`` names the colour picture of each, None where there is none."""

    depths: tuple[Path, ...]
    colours: tuple[Path | None, ...]
    scale_m: float

    def frames(self) -> Iterator[Frame]:
        """One frame a file. Raises UserError where a file is missing, truncated or not 16-bit grey."""
        for depth, colour in zip(self.depths, self.colours, strict=True):
            rgb = _colour(colour) if colour else None
            yield frame_from_depth(f"{depth.parent.name}/{depth.name}", read_depth_png(depth), self.scale_m, rgb=rgb)


def open_depth_folder(folder: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None) -> Recording:
    """Open a folder of depth PNGs. Raises UserError where none is in it, or their lens is not known."""
    inner = folder / "depth"
    depths = depth_files(inner if inner.is_dir() else folder)
    tum = (folder / "depth.txt").is_file() or (folder.parent / "depth.txt").is_file()
    if scale_m is None and tum:
        scale_m = UNITS_M["tum"]
    root = folder if inner.is_dir() or folder.name != "depth" else folder.parent
    pictures = _colour_pictures(root, depths)
    colours = _matched_colours(pictures, depths, TUM_MATCH_S if tum else 0.0)
    recording = _open(folder.name, depths, colours, scale_m, intrinsics, lens, root)
    recording = replace(recording, unit_from="depth.txt, which marks TUM RGB-D" if tum else "")
    without = sum(colour is None for colour in colours)
    if any(colours) and (without or len(pictures) != len(depths)):
        note = f"{len(depths)} depth and {len(pictures)} colour pictures: {without} depth pictures have no colour"
        return replace(recording, notes=(*recording.notes, note))
    if pictures and not any(colours):
        what = "time stamp" if tum else "number"
        note = f"none of {len(pictures)} colour pictures has the {what} of a depth picture in its name: no colour"
        return replace(recording, notes=(*recording.notes, note))
    return recording


def open_depth_list(
    paths: Sequence[Path], scale_m: float | None, intrinsics: Path | None, lens: Lens | None
) -> Recording:
    """Open depth PNGs in the order given. Raises UserError where their lens is not known."""
    name = paths[0].name if len(paths) == 1 else f"{paths[0].name} .. {paths[-1].name}"
    return _open(name, tuple(paths), (None,) * len(paths), scale_m, intrinsics, lens, paths[0].parent)


def _open(
    name: str,
    depths: tuple[Path, ...],
    colours: tuple[Path | None, ...],
    scale_m: float | None,
    intrinsics: Path | None,
    lens: Lens | None,
    root: Path,
) -> Recording:
    width, height = _common_size(depths)
    lens_file = intrinsics or (
        None if lens else lens_file_beside(root) or lens_file_beside(depths[0].parent) or lens_file_beside(root.parent)
    )
    lens = read_lens(lens_file, width, height) if lens_file else lens
    if lens is None:
        raise no_lens(f"{root}")
    lens = lens_of_size(name, lens, width, height)
    aligned, notes = _aligned(colours, width, height)
    if not any(lens.distortion):
        notes = (*notes, "no lens distortion is stated; the images are taken as undistorted")
    scale_m = scale_m or UNITS_M["mm"]
    files = (*depths, *(c for c in aligned if c), *([lens_file] if lens_file else []))
    reader = PngReader(depths, aligned, scale_m)
    step_m = _step_m(depths[0], scale_m)
    return Recording(name, reader, lens.whole, scale_m, z_step_m=step_m, files=files, lens=lens, notes=notes)


def _step_m(first: Path, scale_m: float) -> float:
    """The camera's rounding step: TUM's unit of 0.2 mm is finer than the steps of most cameras."""
    if scale_m != UNITS_M["tum"]:
        return scale_m
    return rounding_step_m(frame_from_depth(first.name, read_depth_png(first), scale_m).z_m) or scale_m


def depth_files(folder: Path) -> tuple[Path, ...]:
    """The depth pictures of a folder in the order of the numbers in their names; masks and previews are left out.

    Raises UserError where there is none.
    """
    pictures = [path for path in folder.iterdir() if path.suffix.lower() == ".png"]
    named = [path for path in pictures if "depth" in path.stem.lower()]
    numbered = [path for path in pictures if _is_number(path.stem)]
    chosen = named or numbered or [path for path in pictures if png_kind(path)[2:] == (16, 0)]
    if not chosen:
        raise UserError(f"{folder}: no depth picture in it ({len(pictures)} PNG files)", legal=LEGAL_PNG)
    return tuple(sorted(chosen, key=_natural))


def png_kind(path: Path) -> tuple[int, int, int, int]:
    """(width, height, bits, colour type) from the header of a PNG. Raises UserError where it is none, or too large."""
    try:
        with path.open("rb") as file:
            head = file.read(26)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_PNG) from error
    if len(head) < 26 or head[:8] != PNG_SIGNATURE or head[12:16] != b"IHDR":
        raise UserError(f"{path}: is no PNG, or is truncated", legal=LEGAL_PNG, fix="copy or export it again")
    width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
    refuse_pixels(str(path), width, height)
    return width, height, bits, kind


def read_depth_png(path: Path) -> np.ndarray:
    """The stored numbers (h, w) uint16. Raises UserError where the file is broken or not 16-bit grey."""
    _refuse_wrong_bits(path)
    content = bounded_bytes(path, PICTURE_BYTES)
    refuse_broken_png(str(path), content)
    return decoded(str(path), content, cv2.IMREAD_UNCHANGED)


def _refuse_wrong_bits(path: Path) -> None:
    _, _, bits, kind = png_kind(path)
    if (bits, kind) != (16, 0):
        channels = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}.get(kind, f"type {kind}")
        raise UserError(
            f"{path}: {bits} bits a channel, {channels}: a picture or a mask, not a depth image",
            legal=LEGAL_PNG,
            fix="export the depth itself; a preview scaled to 0..255 has lost it",
        )


def _common_size(depths: tuple[Path, ...]) -> tuple[int, int]:
    first = png_kind(depths[0])[:2]
    for path in depths:
        _refuse_wrong_bits(path)
        size = png_kind(path)[:2]
        if size != first:
            raise UserError(
                f"{path}: {size[0]} x {size[1]} pixels, but {depths[0].name} has {first[0]} x {first[1]}",
                legal="frames of one size, from one camera that did not move",
                fix="run the differing frames on their own",
            )
    return first


def _colour_pictures(root: Path, depths: tuple[Path, ...]) -> list[Path]:
    """The pictures in a folder for colour, or beside the depth pictures with the word in their names."""
    folder = next((root / name for name in COLOUR_FOLDERS if (root / name).is_dir()), None)
    if folder is not None:
        return [path for path in folder.iterdir() if path.suffix.lower() in COLOUR_SUFFIXES]
    words = [path for path in root.iterdir() if re.search("colou?r|rgb", path.stem.lower())]
    return [path for path in words if path.suffix.lower() in COLOUR_SUFFIXES and path not in depths]


def _matched_colours(pictures: Sequence[Path], depths: tuple[Path, ...], within_s: float) -> tuple[Path | None, ...]:
    """The colour picture of each depth picture: the same number in its name, or the nearest time stamp."""
    stamps = {number: path for path in pictures if (number := _last_number(path.stem)) is not None}
    return tuple(_nearest(stamps, _last_number(path.stem), within_s) for path in depths)


def _nearest(stamps: dict[float, Path], number: float | None, within: float) -> Path | None:
    if number is None or not stamps:
        return None
    best = min(stamps, key=lambda stamp: abs(stamp - number))
    return stamps[best] if abs(best - number) <= within else None


def _aligned(
    colours: tuple[Path | None, ...], width: int, height: int
) -> tuple[tuple[Path | None, ...], tuple[str, ...]]:
    """The colour pictures where they lie on the depth pixels, and a note where they do not."""
    first = next((path for path in colours if path), None)
    if first is None:
        return colours, ()
    found = _colour(first).shape
    if found[:2] == (height, width):
        return colours, ()
    note = f"colour pictures of {found[1]} x {found[0]} pixels do not lie on the depth pixels and are not used"
    return (None,) * len(colours), (note,)


def _colour(path: Path) -> np.ndarray:
    return cv2.cvtColor(read_picture(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _is_number(stem: str) -> bool:
    return re.fullmatch(r"\d+(\.\d+)?", stem) is not None


def _last_number(stem: str) -> float | None:
    numbers = re.findall(r"\d+(?:\.\d+)?", stem)
    return float(numbers[-1]) if numbers else None


def _natural(path: Path) -> tuple[object, ...]:
    """Sorts 9 before 10."""
    return tuple(float(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+(?:\.\d+)?)", path.stem)))
