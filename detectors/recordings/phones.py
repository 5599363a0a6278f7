"""Captures of iPhones and iPads: folders of Stray Scanner and .r3d files of Record3D.

Both store ARKit's depth (256 x 192, z along the optical axis), a confidence 0 to 2 of each pixel, the lens of the
colour camera at its own resolution, and the camera's poses. Pixels of confidence 0 are no return. The phone is held by
hand: how far it moved during the selected frames is told from the poses, and warned of where it blurs their average.
"""

from __future__ import annotations

import re
import struct
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from detectors.recordings.depth_images import depth_files, read_depth_png
from detectors.recordings.distances import UNITS_M, frame_from_depth
from detectors.recordings.intrinsics import read_lens
from detectors.recordings.pictures import read_picture
from detectors.recordings.recording import Recording
from harness.vocabulary.archives import DAMAGES, METHODS, refuse_long_list
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes, refuse_bytes, refuse_pixels

LEGAL_STRAY = "Stray Scanner's folder: depth/*.png, confidence/*.png, camera_matrix.csv, odometry.csv"
LEGAL_R3D = "Record3D's .r3d: metadata and rgbd/*.depth"
COLOUR_WIDTHS = (1920, 1280, 640, 3840)
"""Of the pictures that ARKit's lens may be of; all are 4 : 3, as its depth is."""
BLUR_PX = 0.5
"""Motion over this much of a pixel spreads an edge further than the sensor itself does."""
LZFSE_BLOCKS = 64
"""In a frame: the coder fills a block with at least 10 kB of an iPhone's 196. A block unpacks to 24 MB at most."""


@dataclass(frozen=True)
class StrayReader:
    """Streams a folder's depth pictures, each with its confidence where there is one."""

    depths: tuple[Path, ...]
    confidences: tuple[Path | None, ...]
    scale_m: float

    def frames(self) -> Iterator[Frame]:
        for depth, confidence in zip(self.depths, self.confidences, strict=True):
            sure = read_picture(confidence, cv2.IMREAD_UNCHANGED) if confidence else None
            yield _frame(f"{depth.parent.name}/{depth.name}", read_depth_png(depth), sure, self.scale_m)


def is_stray(folder: Path) -> bool:
    return (folder / "camera_matrix.csv").is_file() and (folder / "depth").is_dir()


def open_stray(
    folder: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None, frames: slice | None
) -> Recording:
    """Open Stray Scanner's folder. Raises UserError where a file is broken or the lens' resolution cannot be told."""
    depths = depth_files(folder / "depth")
    stored = read_depth_png(depths[0])
    height, width = stored.shape
    beside = [folder / "confidence" / path.name for path in depths]
    confidences = tuple(path if path.is_file() else None for path in beside)
    notes: list[str] = []
    matrix = folder / "camera_matrix.csv"
    if intrinsics is not None:
        lens = read_lens(intrinsics, width, height)
    if lens is None:
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
        lens = _scaled(str(matrix), k, (across, across * 3 // 4), (width, height))
        notes.append(f"lens scaled from {across} x {across * 3 // 4} colour pixels to {width} x {height}")
    if not all(confidences):
        notes.append(f"{confidences.count(None)} of {len(depths)} depth pictures have no confidence picture")
    odometry = folder / "odometry.csv"
    poses = _table(odometry)[:, 2:9] if odometry.is_file() else np.zeros((0, 7))
    # x y z, then the quaternion
    warnings = _of_motion(
        poses[:, :3], poses[:, 3:], frames, lens, _median_m(stored, scale_m or UNITS_M["mm"]), odometry.name
    )
    files = (*depths, *(path for path in confidences if path), intrinsics or matrix)
    reader = StrayReader(depths, confidences, scale_m or UNITS_M["mm"])
    return Recording(
        name=folder.name,
        reader=reader,
        region=lens.whole,
        scale_m=reader.scale_m,
        z_step_m=reader.scale_m,
        files=(*files, odometry) if odometry.is_file() else files,
        lens=lens,
        unit_from="Stray Scanner, which writes millimetres",
        notes=tuple(notes),
        warnings=warnings,
    )


@dataclass(frozen=True)
class R3dReader:
    """Streams the frames of one .r3d, ``size`` (width, height), each unpacked when it is reached."""

    path: Path
    size: tuple[int, int]
    scale_m: float

    def frames(self) -> Iterator[Frame]:
        width, height = self.size
        with _archive(self.path) as archive:
            names = {entry.filename: entry for entry in archive.infolist()}
            for name in _depth_names(names):
                packed = _content(self.path, archive, names[name])
                stored = np.frombuffer(_lzfse(f"{self.path}: {name}", packed, 4 * width * height), "<f4")
                sure = None
                if (beside := f"{name.removesuffix('.depth')}.conf") in names:
                    packed = _content(self.path, archive, names[beside])
                    sure = np.frombuffer(_lzfse(f"{self.path}: {beside}", packed, width * height), np.uint8)
                    sure = sure.reshape(height, width)
                yield _frame(f"{self.path.name} {name}", stored.reshape(height, width), sure, self.scale_m)


def open_r3d(
    path: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None, frames: slice | None
) -> Recording:
    """Open Record3D's .r3d. Raises UserError where it is broken or pyliblzfse, which unpacks its depth, is missing."""
    with _archive(path) as archive:
        names = {entry.filename: entry for entry in archive.infolist()}
        if "metadata" not in names or not _depth_names(names):
            held = ", ".join(list(names)[:6]) or "nothing"
            raise UserError(f"{path}: holds no capture of Record3D ({held[:200]})", legal=LEGAL_R3D)
        try:
            told = strict_json(_content(path, archive, names["metadata"]))
            k = np.array([float(x) for x in told["K"]]).reshape(3, 3).T
            size = int(told.get("dw", 192)), int(told.get("dh", 256))
            colour = int(told["w"]), int(told["h"])
            poses = np.array(told.get("poses") or np.zeros((0, 7)), float).reshape(-1, 7)
        except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
            raise UserError(
                f"{path}: its metadata cannot be read ({type(error).__name__}: {error})", legal=LEGAL_R3D
            ) from error
    refuse_pixels(str(path), *size)
    if intrinsics is not None:
        lens = read_lens(intrinsics, *size)
    lens = lens or _scaled(f"{path}: metadata", k, colour, size)
    reader = R3dReader(path, size, scale_m or UNITS_M["m"])
    first = next(reader.frames())
    median_m = float(np.median(first.z_m[np.isfinite(first.z_m)])) if np.isfinite(first.z_m).any() else 1.0
    return Recording(
        name=path.name,
        reader=reader,
        region=lens.whole,
        scale_m=reader.scale_m,
        z_step_m=0.0,
        files=(path, *([intrinsics] if intrinsics else [])),
        lens=lens,
        unit_from="Record3D, which writes metres",
        notes=(f"lens scaled from {colour[0]} x {colour[1]} colour pixels to {size[0]} x {size[1]}",),
        warnings=_of_motion(poses[:, 4:], poses[:, :4], frames, lens, median_m, "its metadata"),
    )


# ---- what both share -------------------------------------------------------------------------------------------------


def _frame(name: str, stored: np.ndarray, confidence: np.ndarray | None, scale_m: float) -> Frame:
    if confidence is not None:
        if confidence.shape != stored.shape:
            raise UserError(f"{name}: its confidence has {confidence.shape} pixels, the depth {stored.shape}")
        stored = np.where(confidence > 0, stored, stored.dtype.type(0))
    return frame_from_depth(name, stored, scale_m)


def _scaled(name: str, k: np.ndarray, colour: tuple[int, int], size: tuple[int, int]) -> Lens:
    """The lens of a colour picture, scaled to the depth picture of the same view."""
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


def _median_m(stored: np.ndarray, scale_m: float) -> float:
    return scale_m * float(np.median(stored[stored > 0])) if (stored > 0).any() else 1.0


def _of_motion(
    places_m: np.ndarray, turns: np.ndarray, frames: slice | None, lens: Lens, median_m: float, source: str
) -> tuple[str, ...]:
    """A warning where the selected poses (quaternions in ``turns``) differ by more than `BLUR_PX` on the target."""
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


def _table(path: Path) -> np.ndarray:
    """The numbers of a small CSV, (rows, columns), its line of names left out."""
    try:
        text = bounded_bytes(path, TEXT_BYTES).decode("utf-8-sig")
        rows = [
            [float(cell) for cell in re.split(r"[,;\s]+", line.strip(" ,\r")) if cell]
            for line in text.splitlines()
            if re.match(r"\s*[-+.\d]", line)
        ]
        table = np.array(rows, float)
        if table.ndim != 2 or (path.stem == "odometry" and table.shape[1] < 9):
            raise ValueError("its lines differ in length or are too short")
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as a table of numbers ({error})", legal=LEGAL_STRAY) from error
    return table


# ---- Record3D's archive ----------------------------------------------------------------------------------------------


def _archive(path: Path) -> zipfile.ZipFile:
    try:
        refuse_long_list(path)
        return zipfile.ZipFile(path)
    except DAMAGES as error:
        raise UserError(
            f"{path}: is no archive of Record3D, or is cut off ({error})", legal=LEGAL_R3D, fix="copy it again"
        ) from error


def _depth_names(names: dict[str, Any]) -> list[str]:
    found = [name for name in names if re.fullmatch(r"(?:.*/)?\d{1,9}\.depth", name)]
    return sorted(found, key=lambda name: int(Path(name).stem))


def _content(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """An entry's bytes, no more than `limits.TEXT_BYTES`: depth of an iPhone has 0.1 MB."""
    refuse_bytes(f"{path}: {entry.filename}", entry.file_size, TEXT_BYTES)
    try:
        if entry.compress_type not in METHODS:
            raise ValueError(f"packed by method {entry.compress_type}")
        with archive.open(entry) as stream:
            return stream.read(TEXT_BYTES)
    except DAMAGES as error:
        raise UserError(
            f"{path}: {entry.filename} cannot be read ({error})", legal=LEGAL_R3D, fix="copy it again"
        ) from error


def _lzfse(name: str, packed: bytes, expected: int) -> bytes:
    """Unpacked bytes of Apple's LZFSE. Raises UserError where they are not as many as expected."""
    try:
        import liblzfse  # type: ignore[import-not-found]
    except ImportError as error:
        raise UserError(
            f"{name}: is compressed by LZFSE, and the package that unpacks it is not installed",
            fix="pip install pyliblzfse, or export the capture from Record3D as PLY",
        ) from error
    stated, blocks = _lzfse_sizes(packed)
    if stated != expected or blocks > LZFSE_BLOCKS:
        raise UserError(f"{name}: is damaged: {stated} bytes in {blocks} blocks, not {expected} bytes", legal=LEGAL_R3D)
    try:
        unpacked: bytes = liblzfse.decompress(packed)
    except (liblzfse.error, MemoryError) as error:
        raise UserError(f"{name}: is damaged, its LZFSE data cannot be unpacked", legal=LEGAL_R3D) from error
    if len(unpacked) != expected:
        raise UserError(f"{name}: is damaged: {len(unpacked)} bytes, not {expected}", legal=LEGAL_R3D)
    return unpacked


def _lzfse_sizes(packed: bytes) -> tuple[int, int]:
    """(bytes that the blocks say they unpack to, number of blocks) by their headers, as Apple's lzfse_internal.h lays
    them out; (-1, 0) where they are none."""
    at = stated = blocks = 0
    try:
        while (magic := packed[at : at + 4]) != b"bvx$":
            (raw,) = struct.unpack_from("<I", packed, at + 4)
            if magic == b"bvx-":
                at += 8 + raw
            elif magic == b"bvxn":
                at += 12 + struct.unpack_from("<I", packed, at + 8)[0]
            elif magic == b"bvx2":
                literals, matches, header = struct.unpack_from("<QQQ", packed, at + 8)
                at += (header & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (matches >> 40 & 0xFFFFF)
            else:
                return -1, 0
            stated += raw
            blocks += 1
            if blocks > LZFSE_BLOCKS:
                break
    except struct.error:
        return -1, 0
    return stated, blocks
