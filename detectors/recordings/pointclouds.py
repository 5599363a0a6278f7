"""PLY and PCD point clouds by Open3D; organised ones keep their pixel grid.

Open3D reads the points but drops the grid, so the header is read here: a PCD is organised where HEIGHT > 1, a PLY
where it states num_cols and num_rows (as range scanners write). Open3D returns a cut PLY filled up with zeros, so the
header's promise is compared with the file first.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.open3d_library import load_open3d
from detectors.recordings.distances import UNITS_M, frame_from_points, rounding_step_m
from detectors.recordings.point_lists import grid_of, stated_size
from detectors.recordings.recording import Recording
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.limits import refuse_pixels

LEGAL_CLOUD = "PLY (ASCII or binary) or PCD (ASCII, binary or compressed) with x, y, z for each point"
PLY_BYTES = {"char": 1, "uchar": 1, "short": 2, "ushort": 2, "int": 4, "uint": 4, "float": 4, "double": 8} | {
    "int8": 1, "uint8": 1, "int16": 2, "uint16": 2, "int32": 4, "uint32": 4, "float32": 4, "float64": 8,
}  # fmt: skip
HEADER_BYTES = 65536
COUNT = re.compile(r"\d{1,15}", re.ASCII)
"""What a header may state as a count: more digits are no file's, and Python refuses to read thousands of them."""
PCD_SIZES = (1, 2, 4, 8)
"""Bytes that a number of a PCD may have."""
PCD_NUMBERS = 10_000
"""Numbers in one point: descriptors of some hundred stand in published clouds."""
LZF_STRONGEST = 100
"""Times that LZF can shorten anything: three bytes stand for at most 264."""


@dataclass(frozen=True)
class CloudHeader:
    """What a file's header promises. ``height`` is 1 without a grid; ``data_bytes`` the least that must follow it."""

    points: int
    width: int
    height: int
    header_bytes: int
    data_bytes: int


@dataclass(frozen=True)
class CloudReader:
    """Streams clouds, one frame a file."""

    paths: tuple[Path, ...]
    scale_m: float

    def frames(self) -> Iterator[Frame]:
        for path in self.paths:
            yield read_cloud(path, self.scale_m)


def open_clouds(paths: Sequence[Path], scale_m: float | None, name: str) -> Recording:
    """Open clouds in the order given, each a frame. Raises UserError on a broken file."""
    scale_m = scale_m or UNITS_M["m"]
    reader = CloudReader(tuple(paths), scale_m)
    first = read_cloud(paths[0], scale_m)
    height, width = first.z_m.shape
    return Recording(
        name=name,
        reader=reader,
        region=Region(0, height, 0, width),
        scale_m=scale_m,
        z_step_m=rounding_step_m(first.z_m),
        files=tuple(paths),
        organised=height > 1,
        notes=() if height > 1 else ("the cloud has no pixel grid; it is treated as single points",),
    )


def read_cloud(path: Path, scale_m: float) -> Frame:
    """One cloud as a frame (h, w), or (1, n) without a grid. Raises UserError on a broken file."""
    o3d = load_open3d()
    header = cloud_header(path)
    # Open3D's complaints go to the terminal; what they say is checked here and told once.
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(str(path), remove_nan_points=False, remove_infinite_points=False)
    count = len(cloud.point.positions) if "positions" in cloud.point else 0
    if count != header.points:
        raise UserError(
            f"{path}: is truncated or damaged: {count} of {header.points} points could be read",
            legal=LEGAL_CLOUD,
            fix="copy or export it again",
        )
    attributes = {key.lower(): cloud.point[key].numpy() for key in cloud.point}
    grid = (header.height, header.width) if header.height > 1 else grid_of(attributes["positions"])
    colours = attributes.get("colors")
    amplitude = next((attributes[k] for k in ("intensity", "intensities", "amplitude") if k in attributes), None)
    return frame_from_points(
        path.name,
        attributes["positions"].reshape(*grid, 3),
        scale_m,
        rgb=_bytes(colours).reshape(*grid, 3) if colours is not None else None,
        amplitude=amplitude.reshape(grid).astype(np.float32) if amplitude is not None else None,
    )


def cloud_header(path: Path) -> CloudHeader:
    """Read a header and compare it with the file. Raises UserError where it is none, empty, or cut off."""
    content = _head(path)
    header = _ply_header(path, content) if path.suffix.lower() == ".ply" else _pcd_header(path, content)
    if header.points < 1:
        raise UserError(f"{path}: holds no points", legal=LEGAL_CLOUD)
    refuse_pixels(f"{path}: its cloud", header.width, header.height)
    found = path.stat().st_size - header.header_bytes
    if found < header.data_bytes:
        raise UserError(
            f"{path}: is truncated: {found} of at least {header.data_bytes} bytes of points",
            legal="a whole file",
            fix="copy or export it again",
        )
    return header


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(HEADER_BYTES)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_CLOUD) from error


def _ply_header(path: Path, content: bytes) -> CloudHeader:
    end = re.search(rb"end_header\r?\n", content)
    if not content.startswith(b"ply") or end is None:
        raise UserError(f"{path}: is no PLY, or its header is cut off", legal=LEGAL_CLOUD)
    lines = content[: end.start()].decode("latin1").split("\n")
    points, bytes_each, fields = 0, 0, 0
    element, names = "", set[str]()
    for words in (line.split() for line in lines if line.strip()):
        if words[0] == "element" and len(words) == 3:
            if words[1] == "vertex" and points:
                raise UserError(f"{path}: its header states its points twice", legal=LEGAL_CLOUD)
            element = words[1]
            points = int(words[2]) if element == "vertex" and COUNT.fullmatch(words[2]) else points
        elif words[0] == "property" and element == "vertex" and len(words) > 1:
            names.add(words[-1])
            fields += 1
            bytes_each += PLY_BYTES.get(words[1], 0)
    if points and not {"x", "y", "z"} <= names:
        raise UserError(f"{path}: its points lack x, y or z", legal=LEGAL_CLOUD)
    ascii_text = any(line.split()[:2] == ["format", "ascii"] for line in lines)
    # Each number of an ASCII line takes at least a digit and a separator.
    least = points * (2 * fields if ascii_text else bytes_each)
    columns, rows = stated_size([line for line in lines if line.startswith(("obj_info", "comment"))])
    gridded = columns * rows == points and rows > 1
    width, height = (columns, rows) if gridded else (points, 1)
    return CloudHeader(points, width, height, end.end(), least - 1 if ascii_text else least)


def _pcd_header(path: Path, content: bytes) -> CloudHeader:
    end = re.search(rb"^DATA\s+(\w+)\s*?\r?\n", content, re.MULTILINE)
    if end is None:
        raise UserError(f"{path}: is no PCD, or its header is cut off", legal=LEGAL_CLOUD)
    lines = content[: end.start()].decode("latin1").split("\n")
    fields = {words[0]: words[1:] for line in lines if (words := line.split()) and not line.startswith("#")}
    try:
        width, height = _count(fields["WIDTH"][0]), _count(fields["HEIGHT"][0])
        points = _count(fields["POINTS"][0]) if "POINTS" in fields else width * height
        bytes_each = _point_bytes(fields)
    except (KeyError, IndexError, ValueError) as error:
        raise UserError(f"{path}: its PCD header cannot be read ({error!r})", legal=LEGAL_CLOUD) from error
    if width * height != points:
        raise UserError(
            f"{path}: its header states {width} x {height} but {points} points", legal="WIDTH * HEIGHT = POINTS"
        )
    least = {b"binary": points * bytes_each, b"ascii": points * 2 * len(fields["SIZE"]) - 1}.get(end.group(1))
    if least is None:
        least = _compressed_bytes(path, end.end(), points * bytes_each)
    return CloudHeader(points, width, height, end.end(), least)


def _count(text: str) -> int:
    if not COUNT.fullmatch(text):
        raise ValueError(f"{text[:20]!r} is no count")
    return int(text)


def _point_bytes(fields: dict[str, list[str]]) -> int:
    """Bytes of one point, by its fields' sizes and counts. Raises ValueError or KeyError where they are no PCD's."""
    sizes = [_count(text) for text in fields["SIZE"]]
    counts = [_count(text) for text in fields["COUNT"]] if "COUNT" in fields else [1] * len(sizes)
    if not len(fields["FIELDS"]) == len(fields["TYPE"]) == len(sizes) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    if not set(sizes) <= set(PCD_SIZES) or sum(counts) > PCD_NUMBERS:
        raise ValueError(f"sizes {sorted(set(sizes))}, {sum(counts)} numbers in a point")
    return sum(size * count for size, count in zip(sizes, counts, strict=True))


def _compressed_bytes(path: Path, start: int, unpacked: int) -> int:
    """Bytes of compressed points, with the two sizes before them. Raises UserError where these sizes cannot be."""
    with path.open("rb") as file:
        file.seek(start)
        sizes = file.read(8)
    if len(sizes) < 8:
        return 8
    packed, states = struct.unpack("<II", sizes)
    if states != unpacked or states > LZF_STRONGEST * packed:
        raise UserError(
            f"{path}: its points would have {unpacked} bytes, but it states {states} packed into {packed}",
            legal=LEGAL_CLOUD,
            fix="copy or export it again",
        )
    return 8 + packed


def _bytes(colours: np.ndarray) -> np.ndarray:
    """Colours as uint8; floating-point ones run from 0 to 1."""
    return colours if colours.dtype == np.uint8 else np.clip(np.rint(colours * 255.0), 0, 255).astype(np.uint8)
