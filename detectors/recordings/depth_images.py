"""Folders and lists of 16-bit depth PNGs: Open3D's recorder, Azure SDK exports, TUM RGB-D, or bare
pictures.

The layout is recognised by a sub-folder ``depth`` (with ``color`` or ``rgb`` beside it), by names
that contain "depth", or by names that are numbers; else every 16-bit grey PNG counts. A
``depth.txt`` marks TUM RGB-D. A picture's first bytes show its kind, and Pillow reads its header:
OpenCV would decode 30,000 x 30,000 pixels into gigabytes."""

import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import zip_longest
from pathlib import Path

import cv2
import numpy as np
from PIL import ImageFile, JpegImagePlugin, PngImagePlugin

from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.intrinsics import lens_for
from detectors.recordings.recording import CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import PICTURE_BYTES, bounded_bytes, refuse_pixels
from harness.vocabulary.geometry import Frame

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
LEGAL_PICTURE = "PNG or JPEG"


def read_picture(path: Path, flags: int) -> np.ndarray:
    """Return a PNG or JPEG decoded by OpenCV with its ``flags``: (h, w) or (h, w, 3), blue first.
    Raises UserError if it is another kind of file, cannot be decoded, or is too large."""
    with read_errors(f"{path}: cannot be read", LEGAL_PICTURE):
        content = bounded_bytes(path, PICTURE_BYTES)
    return decoded(str(path), content, flags)


def decoded(name: str, content: bytes, flags: int) -> np.ndarray:
    """Decode a file's content as `read_picture` does."""
    refuse_pixels(name, *_header(name, content).size)
    with read_errors(f"{name}: cannot be decoded", LEGAL_PICTURE):
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
        if picture is None:
            raise ValueError("its pixels are damaged")
    return picture


def refuse_broken_png(name: str, content: bytes) -> None:
    """Raise UserError if a PNG is truncated or a checksum fails: the decoder may fill the rest
    with zeros."""
    try:
        _header(name, content).verify()
    except (SyntaxError, OSError, ValueError) as error:
        is_damaged = "broken" in str(error) or "checksum" in str(error)
        state = "damaged" if is_damaged else "truncated"
        problem = f"{name}: is {state} ({error}; {len(content)} bytes)"
        raise UserError(problem, legal="a whole PNG", fix="copy or export it again") from error


def _header(name: str, content: bytes) -> ImageFile.ImageFile:
    """Read only the header of a picture, as the kind that its first bytes show."""
    problem = f"{name}: cannot be decoded: it is neither PNG nor JPEG, or it is truncated"
    with read_errors(problem, LEGAL_PICTURE):
        if content.startswith(PNG_SIGNATURE):
            return PngImagePlugin.PngImageFile(io.BytesIO(content))
        return JpegImagePlugin.JpegImageFile(io.BytesIO(content))


COLOUR_FOLDERS = ("color", "colour", "rgb")
COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg")
TUM_MATCH_S = 0.02
"""Largest difference of time stamps of depth and colour that belong together (the benchmark's own
default)."""
LEGAL_PNG = "16-bit single-channel PNG (uint16, 0 = no depth)"
PNG_CHANNELS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}
NUMBER = re.compile(r"\d+(?:\.\d+)?")
NOT_DEPTH = re.compile(
    r"(?i)(^|[/_.-])(ir|infra\w*|conf\w*|amplitude|intensity|reflectivity|mask)([/_.-]|\d|$)"
)
"""Words in the names of files and topics of other pictures that a depth camera writes in 16 bits
or floating point."""


def open_depth_folder(folder: Path, options: CaptureOptions) -> Recording:
    """Open a folder of depth PNGs. Raises UserError if it has none, or their lens is unknown."""
    inner = folder / "depth"
    depths = depth_files(inner if inner.is_dir() else folder)
    root = folder if inner.is_dir() or folder.name != "depth" else folder.parent
    is_tum = any((parent / "depth.txt").is_file() for parent in (folder, folder.parent))
    pictures = _colour_pictures(root, depths)
    colours = _colours_of(depths, pictures, TUM_MATCH_S if is_tum else 0.0)
    note = ""
    if pictures and (None in colours or len(pictures) != len(depths)):
        without = f"{colours.count(None)} depth pictures have no colour"
        note = f"{len(depths)} depth and {len(pictures)} colour pictures: {without}"
    recording = open_depth_list(depths, options, folder.name, root, colours, is_tum, note)
    inner = root / "amplitude"
    if not inner.is_dir():
        return recording
    amplitudes = [inner / path.name for path in depths if (inner / path.name).is_file()]
    read = partial(_with_amplitudes, recording.read, depths, inner)
    return replace(recording, read=read, files=(*recording.files, *amplitudes))


def _with_amplitudes(
    read: Callable[[], Iterator[Frame]], depths: Sequence[Path], folder: Path
) -> Iterator[Frame]:
    """Yield frames with the amplitude pictures of the same names that `tofpod record` writes; those
    of another size are left out."""
    for frame, depth in zip(read(), depths, strict=True):
        path = folder / depth.name
        amplitude = read_depth_png(path).astype(np.float32) if path.is_file() else None
        if amplitude is not None and amplitude.shape != frame.z_m.shape:
            amplitude = None
        yield replace(frame, amplitude=amplitude)


def _colour_pictures(root: Path, depths: Sequence[Path]) -> list[Path]:
    """Return a capture's colour pictures: in a folder of their own, or beside the depth."""
    folders = [root / name for name in COLOUR_FOLDERS if (root / name).is_dir()]
    if folders:
        candidates = shown(folders[0])
    else:
        candidates = [
            path
            for path in shown(root)
            if re.search("colou?r|rgb", path.stem.lower()) and path not in depths
        ]
    return [path for path in candidates if path.suffix.lower() in COLOUR_SUFFIXES]


def _colours_of(
    depths: Sequence[Path],
    pictures: Sequence[Path],
    tolerance: float,
) -> list[Path | None]:
    """Return the colour picture of each depth picture: the same number in its name, or the nearest
    time stamp within the tolerance."""
    stamps: dict[float, Path] = {}
    for path in pictures:
        stamp = _last_number(path)
        if stamp is not None:
            stamps[stamp] = path
    colours: list[Path | None] = []
    for depth in depths:
        number = _last_number(depth)
        colour = None
        if number is not None and stamps:
            differences = {abs(stamp - number): path for stamp, path in stamps.items()}
            nearest = min(differences)
            if nearest <= tolerance:
                colour = differences[nearest]
        colours.append(colour)
    return colours


def open_depth_list(
    depths: Sequence[Path],
    options: CaptureOptions,
    name: str,
    root: Path | None = None,
    colours: Sequence[Path | None] = (),
    is_tum: bool = False,
    note: str = "",
) -> Recording:
    """Open depth PNGs in the order given. ``root``: folder of the capture, in or beside which
    their lens is sought. ``colours``: the colour picture of each, if any. Raises UserError if
    their lens is not known."""
    root = root or depths[0].parent
    width, height = _depth_size(depths[0])
    beside = (root, depths[0].parent, root.parent)
    lens, lens_files = lens_for(str(root), options, width, height, beside=beside)
    notes = [note]
    first = next((path for path in colours if path), None)
    if first is not None:
        rows, columns, _ = _colour(first).shape
        if (rows, columns) != (height, width):
            colours = ()
            notes = [
                f"colour pictures of {columns} x {rows} pixels are not aligned with the depth "
                "and are not used"
            ]
    if not any(lens.distortion):
        notes.append("no lens distortion is stated; the images are assumed to be undistorted")
    scale_m = options.scale_m or UNITS_M["tum" if is_tum else "mm"]
    recording = Recording.begun(
        name,
        partial(_frames, depths, colours, scale_m),
        scale_m,
        # TUM's unit of 0.2 mm is finer than the steps of most cameras
        is_whole=scale_m != UNITS_M["tum"],
        files=(*depths, *filter(None, colours), *lens_files),
        lens=lens,
        notes=tuple(notes),
        unit_from="depth.txt, which marks TUM RGB-D" if is_tum else "",
    )
    return replace(recording, z_step_m=recording.z_step_m or scale_m)


def _frames(
    depths: Sequence[Path],
    colours: Sequence[Path | None],
    scale_m: float,
) -> Iterator[Frame]:
    """Yield one frame per file. Raises UserError if a file is missing, truncated or not 16-bit
    grey."""
    for depth, colour in zip_longest(depths, colours):
        rgb = _colour(colour) if colour else None
        yield frame_of(f"{depth.parent.name}/{depth.name}", read_depth_png(depth), scale_m, rgb)


def shown(folder: Path) -> list[Path]:
    """Return the contents of a folder, in order, without hidden files."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def depth_files(folder: Path) -> tuple[Path, ...]:
    """Return a folder's depth pictures by their numbers, without masks. Raises UserError if there
    is none."""
    pictures = [path for path in shown(folder) if path.suffix.lower() == ".png"]
    candidates = [path for path in pictures if NUMBER.fullmatch(path.stem)]
    if not candidates:
        # a 16-bit infrared picture looks like depth
        candidates = [path for path in pictures if png_kind(path)[2:] == (16, 0)]
    chosen = depth_named(pictures, candidates)
    if not chosen:
        problem = f"{folder}: contains no depth picture ({len(pictures)} PNG files)"
        raise UserError(problem, legal=LEGAL_PNG)
    return chosen


def depth_named(paths: Sequence[Path], candidates: Sequence[Path]) -> tuple[Path, ...]:
    """Return the files whose names contain "depth", else ``candidates`` without `NOT_DEPTH`,
    sorted by number."""
    chosen = [path for path in paths if "depth" in path.stem.lower()]
    if not chosen:
        chosen = [path for path in candidates if not NOT_DEPTH.search(path.stem)]

    def natural(path: Path) -> tuple[object, ...]:  # 9 before 10
        parts = re.split(f"({NUMBER.pattern})", path.stem)
        return tuple(float(part) if i % 2 else part for i, part in enumerate(parts))

    return tuple(sorted(chosen, key=natural))


def png_kind(path: Path) -> tuple[int, int, int, int]:
    """Return (width, height, bits, colour type) of a PNG. Raises UserError if it is not a PNG, or
    too large."""
    with read_errors(f"{path}: cannot be read", LEGAL_PNG), path.open("rb") as file:
        head = file.read(26)
    if len(head) < 26 or head[:8] != PNG_SIGNATURE or head[12:16] != b"IHDR":
        problem = f"{path}: is not a PNG, or is truncated"
        raise UserError(problem, legal=LEGAL_PNG, fix="copy or export it again")
    width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
    refuse_pixels(str(path), width, height)
    return width, height, bits, kind


def read_depth_png(path: Path) -> np.ndarray:
    """Return the stored numbers (h, w) uint16. Raises UserError if the file is broken or not
    16-bit grey."""
    _depth_size(path)
    content = bounded_bytes(path, PICTURE_BYTES)
    refuse_broken_png(str(path), content)
    return decoded(str(path), content, cv2.IMREAD_UNCHANGED)


def _depth_size(path: Path) -> tuple[int, int]:
    width, height, bits, kind = png_kind(path)
    if (bits, kind) != (16, 0):
        channels = PNG_CHANNELS.get(kind, f"type {kind}")
        raise UserError(
            f"{path}: {bits} bits per channel, {channels}: a picture or a mask, not a depth image",
            legal=LEGAL_PNG,
            fix="export the depth itself; a preview scaled to 0..255 has lost it",
        )
    return width, height


def _colour(path: Path) -> np.ndarray:
    return cv2.cvtColor(read_picture(path, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)


def _last_number(path: Path) -> float | None:
    numbers = NUMBER.findall(path.stem)
    return float(numbers[-1]) if numbers else None
