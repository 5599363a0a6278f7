"""Captures of iPhones and iPads: folders of Stray Scanner and .r3d files of Record3D.

Both store ARKit's depth (256 x 192, z along the optical axis), a confidence 0 to 2 of each pixel, the lens of the
colour camera at its own resolution, and the camera's poses. Pixels of confidence 0 are no return. The phone is held by
hand: its movement during the selected frames is computed from the poses, and warned of where it blurs their average.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from detectors.recordings.depth_images import depth_files, read_depth_png
from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.intrinsics import lens_for
from detectors.recordings.pictures import read_picture
from detectors.recordings.recording import Asked, Recording
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes, limited_memory, refuse_bytes, refuse_pixels

LEGAL_STRAY = "Stray Scanner's folder: depth/*.png, confidence/*.png, camera_matrix.csv, odometry.csv"
LEGAL_R3D = "Record3D's .r3d: metadata and rgbd/*.depth"
COLOUR_WIDTHS = (1920, 1280, 640, 3840)
"""Widths of the pictures that ARKit's lens may be of; all are 4 : 3, as its depth is."""
BLUR_PX = 0.5
"""Motion over this much of a pixel spreads an edge further than the sensor itself does."""
LZFSE_BLOCKS = 64
"""Most blocks in a frame: the coder fills a block with at least 10 kB of an iPhone's 196. A block unpacks to 24 MB at
most."""


# ---- Stray Scanner ---------------------------------------------------------------------------------------------------


def is_stray(folder: Path) -> bool:
    """Return whether a folder is Stray Scanner's."""
    return (folder / "camera_matrix.csv").is_file() and (folder / "depth").is_dir()


def open_stray(folder: Path, asked: Asked) -> Recording:
    """Open Stray Scanner's folder. Raises UserError where a file is broken or the lens' resolution cannot be told."""
    depths = depth_files(folder / "depth")
    stored = read_depth_png(depths[0])
    height, width = stored.shape
    beside = [folder / "confidence" / path.name for path in depths]
    confidences = tuple(path if path.is_file() else None for path in beside)
    scale_m = asked.scale_m or UNITS_M["mm"]
    matrix, odometry = folder / "camera_matrix.csv", folder / "odometry.csv"
    notes: list[str] = []

    def own() -> tuple[Lens, None]:
        k = _table(matrix)
        if k.shape != (3, 3):
            raise UserError(f"{matrix}: holds no 3 x 3 matrix", legal=LEGAL_STRAY, fix="pass --intrinsics FILE")
        across = next((w for w in COLOUR_WIDTHS if abs(2 * k[0, 2] - w) < 0.05 * w), None)
        if across is None:
            raise UserError(
                f"{matrix}: cx = {k[0, 2]:g} is the centre of no picture of ARKit",
                legal=f"the lens of pictures {', '.join(map(str, COLOUR_WIDTHS))} pixels wide",
                fix="pass --intrinsics FILE with the lens of the depth pictures",
            )
        notes.append(f"lens scaled from {across} x {across * 3 // 4} colour pixels to {width} x {height}")
        return _scaled(str(matrix), k, (across, across * 3 // 4), (width, height)), None

    lens, lens_files = lens_for(str(folder), asked, width, height, own)
    if not all(confidences):
        notes.append(f"{confidences.count(None)} of {len(depths)} depth pictures have no confidence picture")
    # x y z, then the quaternion
    poses = _table(odometry)[:, 2:9] if odometry.is_file() else np.zeros((0, 7))
    median_m = scale_m * float(np.median(stored[stored > 0])) if (stored > 0).any() else 1.0
    lens_files = lens_files or (matrix,)
    return Recording(
        name=folder.name,
        read=partial(_stray_frames, depths, confidences, scale_m),
        shape=(height, width),
        scale_m=scale_m,
        z_step_m=scale_m,
        files=(*depths, *filter(None, confidences), *lens_files, *([odometry] if odometry.is_file() else [])),
        lens=lens,
        unit_from="Stray Scanner, which writes millimetres",
        notes=tuple(notes),
        warnings=_motion_warnings(poses[:, :3], poses[:, 3:], asked.frames, lens, median_m, odometry.name),
    )


def _stray_frames(depths: tuple[Path, ...], confidences: tuple[Path | None, ...], scale_m: float) -> Iterator[Frame]:
    for depth, confidence in zip(depths, confidences, strict=True):
        sure = read_picture(confidence, cv2.IMREAD_UNCHANGED) if confidence else None
        yield _frame(f"{depth.parent.name}/{depth.name}", read_depth_png(depth), sure, scale_m)


def _table(path: Path) -> np.ndarray:
    """Return the numbers of a small CSV, (rows, columns), without its line of names."""
    try:
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        lines = (line.strip(" ,\r") for line in text.splitlines() if re.match(r"\s*[-+.\d]", line))
        table = np.array([[float(cell) for cell in re.split(r"[,;\s]+", line) if cell] for line in lines], float)
        if table.ndim != 2 or (path.stem == "odometry" and table.shape[1] < 9):
            raise ValueError("its lines differ in length or are too short")
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as a table of numbers ({error})", legal=LEGAL_STRAY) from error
    return table


# ---- Record3D --------------------------------------------------------------------------------------------------------


def open_r3d(path: Path, asked: Asked) -> Recording:
    """Open Record3D's .r3d. Raises UserError where it is broken or pyliblzfse, which unpacks its depth, is missing."""
    with _archive(path) as archive:
        if "metadata" not in archive.namelist() or not _depth_names(archive):
            held = ", ".join(archive.namelist()[:6]) or "nothing"
            raise UserError(f"{path}: holds no capture of Record3D ({held[:200]})", legal=LEGAL_R3D)
        content = _content(path, archive, "metadata")
    try:
        told = strict_json(content)
        k = np.array([float(x) for x in told["K"]]).reshape(3, 3).T
        width, height = int(told.get("dw", 192)), int(told.get("dh", 256))
        colour = int(told["w"]), int(told["h"])
        poses = np.array(told.get("poses") or np.zeros((0, 7)), float).reshape(-1, 7)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        what = f"{path}: its metadata cannot be read ({type(error).__name__}: {error})"
        raise UserError(what, legal=LEGAL_R3D) from error
    refuse_pixels(str(path), width, height)

    def own() -> tuple[Lens, None]:
        return _scaled(f"{path}: metadata", k, colour, (width, height)), None

    lens, lens_files = lens_for(str(path), asked, width, height, own)
    scale_m = asked.scale_m or UNITS_M["m"]
    read = partial(_r3d_frames, path, (width, height), scale_m)
    z_m = next(read()).z_m
    median_m = float(np.median(z_m[np.isfinite(z_m)])) if np.isfinite(z_m).any() else 1.0
    return Recording(
        name=path.name,
        read=read,
        shape=(height, width),
        scale_m=scale_m,
        z_step_m=0.0,
        files=(path, *lens_files),
        lens=lens,
        unit_from="Record3D, which writes metres",
        notes=(f"lens scaled from {colour[0]} x {colour[1]} colour pixels to {width} x {height}",),
        warnings=_motion_warnings(poses[:, 4:], poses[:, :4], asked.frames, lens, median_m, "its metadata"),
    )


def _r3d_frames(path: Path, size: tuple[int, int], scale_m: float) -> Iterator[Frame]:
    """Yield the frames of one .r3d, ``size`` (width, height), each unpacked when it is reached."""
    width, height = size
    with _archive(path) as archive:
        for name in _depth_names(archive):
            packed = _content(path, archive, name)
            stored = np.frombuffer(_lzfse(f"{path}: {name}", packed, 4 * width * height), "<f4")
            sure = None
            if (beside := f"{name.removesuffix('.depth')}.conf") in archive.namelist():
                packed = _content(path, archive, beside)
                sure = np.frombuffer(_lzfse(f"{path}: {beside}", packed, width * height), np.uint8)
                sure = sure.reshape(height, width)
            yield _frame(f"{path.name} {name}", stored.reshape(height, width), sure, scale_m)


@contextmanager
def _damage_told(what: str) -> Iterator[None]:
    """Turn what a damaged archive raises into a UserError that begins with ``what``, and limit its memory."""
    damages = (OSError, ValueError, EOFError, LookupError, RuntimeError, MemoryError, struct.error, zlib.error)
    try:
        with limited_memory():
            yield
    except (zipfile.BadZipFile, *damages) as error:
        raise UserError(f"{what} ({error})", legal=LEGAL_R3D, fix="copy it again") from error


def _archive(path: Path) -> zipfile.ZipFile:
    with _damage_told(f"{path}: is no archive of Record3D, or is cut off"):
        return zipfile.ZipFile(path)


def _depth_names(archive: zipfile.ZipFile) -> list[str]:
    found = [name for name in archive.namelist() if re.fullmatch(r"(?:.*/)?\d{1,9}\.depth", name)]
    return sorted(found, key=lambda name: int(Path(name).stem))


def _content(path: Path, archive: zipfile.ZipFile, name: str) -> bytes:
    """Return an entry's bytes, no more than `limits.TEXT_BYTES`: depth of an iPhone has 0.1 MB."""
    refuse_bytes(f"{path}: {name}", archive.getinfo(name).file_size, TEXT_BYTES)
    with _damage_told(f"{path}: {name} cannot be read"), archive.open(name) as stream:
        return stream.read(TEXT_BYTES)


def _lzfse(name: str, packed: bytes, expected: int) -> bytes:
    """Unpack Apple's LZFSE. Raises UserError where it does not unpack to as many bytes as expected.

    The blocks' headers are read first, as Apple's lzfse_internal.h lays them out: the library unpacks a bomb for
    minutes before it fails for want of memory.
    """
    try:
        import liblzfse  # type: ignore[import-not-found]
    except ImportError as error:
        raise UserError(
            f"{name}: is compressed by LZFSE, and the package that unpacks it is not installed",
            fix="pip install pyliblzfse, or export the capture from Record3D as PLY",
        ) from error
    at = stated = blocks = 0
    try:
        while (magic := packed[at : at + 4]) != b"bvx$" and blocks <= LZFSE_BLOCKS:
            (raw,) = struct.unpack_from("<I", packed, at + 4)
            if magic == b"bvx-":
                at += 8 + raw
            elif magic == b"bvxn":
                at += 12 + struct.unpack_from("<I", packed, at + 8)[0]
            elif magic == b"bvx2":
                literals, matches, header = struct.unpack_from("<QQQ", packed, at + 8)
                at += (header & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF)
            else:
                raise struct.error("no block of LZFSE")
            stated, blocks = stated + raw, blocks + 1
    except struct.error:
        stated, blocks = -1, 0
    if stated != expected or blocks > LZFSE_BLOCKS:
        raise UserError(f"{name}: is damaged: {stated} bytes in {blocks} blocks, not {expected} bytes", legal=LEGAL_R3D)
    try:
        unpacked: bytes = liblzfse.decompress(packed)
    except (liblzfse.error, MemoryError) as error:
        raise UserError(f"{name}: is damaged, its LZFSE data cannot be unpacked", legal=LEGAL_R3D) from error
    if len(unpacked) != expected:
        raise UserError(f"{name}: is damaged: {len(unpacked)} bytes, not {expected}", legal=LEGAL_R3D)
    return unpacked


# ---- what both share -------------------------------------------------------------------------------------------------


def _frame(name: str, stored: np.ndarray, confidence: np.ndarray | None, scale_m: float) -> Frame:
    if confidence is not None:
        if confidence.shape != stored.shape:
            raise UserError(f"{name}: its confidence has {confidence.shape} pixels, the depth {stored.shape}")
        stored = np.where(confidence > 0, stored, stored.dtype.type(0))
    return frame_of(name, stored, scale_m)


def _scaled(name: str, k: np.ndarray, colour: tuple[int, int], size: tuple[int, int]) -> Lens:
    """Scale the lens of a colour picture to the depth picture of the same view."""
    across, down = size[0] / max(colour[0], 1), size[1] / max(colour[1], 1)
    fx, fy, cx, cy = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    good = np.isfinite(k).all() and 0.1 < across * fx / size[0] < 100 and abs(across / down - 1) < 0.02
    if not good or not (0 < cx < colour[0] and 0 < cy < colour[1] and fy > 0):
        raise UserError(
            f"{name}: fx {fx:g}, cx {cx:g}, cy {cy:g} of {colour[0]} x {colour[1]} pixels is no lens of depth pictures"
            f" of {size[0]} x {size[1]}",
            fix="pass --intrinsics FILE with the lens of the depth pictures",
        )
    # positions count from the first pixel's centre
    return Lens(*size, fx * across, fy * down, (cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)


def _motion_warnings(
    places_m: np.ndarray, turns: np.ndarray, frames: slice | None, lens: Lens, median_m: float, source: str
) -> tuple[str, ...]:
    """Warn where the selected poses (quaternions in ``turns``) differ by more than `BLUR_PX` on the target."""
    chosen = frames or slice(None)
    places_m, turns = places_m[chosen], turns[chosen]
    if len(places_m) < 2 or not np.isfinite([*places_m.ravel(), *turns.ravel()]).all():
        return ()
    moved_m = float(np.linalg.norm(places_m - places_m[0], axis=1).max())
    unit = turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
    turned = float(2 * np.arccos(np.clip(np.abs(unit @ unit[0]), 0, 1)).max())
    blur_px = lens.fx * (turned + moved_m / median_m)
    if blur_px <= BLUR_PX:
        return ()
    return (
        f"the camera moved by {1e3 * moved_m:.3g} mm and {np.degrees(turned):.2g} degrees during the {len(places_m)}"
        f" frames ({source}), up to {blur_px:.2g} pixels on the target, so their average is blurred: --max-frames 1"
        " takes the first frame alone",
    )
