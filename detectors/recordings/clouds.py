"""Point clouds as files: PLY and PCD by Open3D, and lists of points as text (.xyz, .txt, .csv,
.asc, .pts).

Open3D drops the grid and fills a truncated PLY with zeros, so the header is read here: a PCD is
organised if HEIGHT > 1, a PLY if it states num_cols and num_rows. A list has one point per line: x
y z, then an intensity, or red green blue, or both, unless a line of names says otherwise. Its grid
is stated by a comment or a first line of two whole numbers, or given by a lens with as many
pixels, or by a common sensor size on which x/z and y/z rise evenly."""

import codecs
import io
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detectors.open3d_library import load_open3d
from detectors.recordings.arrays import SENSOR_SIZES
from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.recording import NO_GRID, CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TABLE_BYTES, bounded_bytes, refuse_pixels
from harness.vocabulary.geometry import Frame, Lens

CLOUDS = (".ply", ".pcd")
POINT_LISTS = (".xyz", ".asc", ".pts", ".txt", ".csv")
RASTER_CORRELATION = 0.999
"""Correlation of x/z with the column and y/z with the row on a true pixel grid; a distorted lens
reduces it by 1 %."""


class Points(NamedTuple):
    """The content of one file."""

    # (n, 3), in stored units
    points: np.ndarray
    # height and width of the pixel grid; (1, n) without one
    grid: tuple[int, int]
    # (n, 3) uint8
    rgb: np.ndarray | None
    # (n,)
    amplitude: np.ndarray | None


def open_clouds(paths: Sequence[Path], options: CaptureOptions, name: str) -> Recording:
    """Open clouds in the order given, one frame each. Raises UserError for a broken file."""
    scale_m = options.scale_m or UNITS_M["m"]
    is_list = paths[0].suffix.lower() in POINT_LISTS
    reader = _read_list if is_list else _read_cloud
    read = partial(_frames, tuple(paths), reader, options.lens, scale_m)
    recording = Recording.begun(name, read, scale_m, files=tuple(paths))
    height, width = recording.shape
    note = ""
    if height == 1:
        note = NO_GRID
    elif is_list:
        note = f"the points fill a grid of {width} x {height} pixels"
    return replace(recording, organised=height > 1, notes=(note,))


def _frames(
    paths: tuple[Path, ...],
    reader: Any,
    lens: Lens | None,
    scale_m: float,
) -> Iterator[Frame]:
    """Yield one cloud per file, (h, w), or (1, n) without a grid. ``lens`` only tells if a list
    fills a pixel grid."""
    for path in paths:
        points, grid, rgb, amplitude = reader(path, lens)
        amplitude = None if amplitude is None else amplitude.astype(np.float32).reshape(grid)
        rgb = None if rgb is None else rgb.reshape(*grid, 3)
        yield frame_of(path.name, points.reshape(*grid, 3), scale_m, rgb, amplitude)


def _stated_size(lines: Sequence[str]) -> tuple[int, int]:
    """Return the width and height that lines of a header state, 0 if they do not."""
    text = "\n".join(lines).lower()
    size = []
    for name in (r"(?:num_)?(?:width|cols)", r"(?:num_)?(?:height|rows)"):
        match = re.search(rf"\b{name}\b\s*[:=]?\s*(\d{{1,9}})\b", text)
        size.append(int(match.group(1)) if match else 0)
    width, height = size
    return width, height


def _grid_of(points: np.ndarray, lens: Lens | None = None) -> tuple[int, int]:
    """Return (h, w) of points (n, 3) whose grid is not stated."""
    count = len(points)
    if lens is not None and lens.width * lens.height == count:
        return lens.height, lens.width
    valid = np.isfinite(points).all(axis=1) & (points[:, 2] != 0)
    if valid.sum() < 100:
        return 1, count
    for width, height in SENSOR_SIZES:
        if width * height == count:
            v, u = np.divmod(np.arange(count), width)
            slopes = points[valid, :2] / points[valid, 2, None]
            across = np.corrcoef(slopes[:, 0], u[valid])[0, 1]
            down = np.corrcoef(slopes[:, 1], v[valid])[0, 1]
            if min(abs(across), abs(down)) > RASTER_CORRELATION:
                return height, width
    return 1, count


LEGAL_CLOUD = (
    "PLY (ASCII or binary) or PCD (ASCII, binary or compressed) with x, y, z for each point"
)
PLY_BYTES = {
    "char": 1,
    "uchar": 1,
    "short": 2,
    "ushort": 2,
    "int": 4,
    "uint": 4,
    "float": 4,
    "double": 8,
    "int8": 1,
    "uint8": 1,
    "int16": 2,
    "uint16": 2,
    "int32": 4,
    "uint32": 4,
    "float32": 4,
    "float64": 8,
}
HEADER_BYTES = 65536
COUNT = re.compile(r"\d{1,15}", re.ASCII)
"""A count in a header. No file has more digits, and Python refuses to read thousands of them."""
PCD_NUMBERS = 10_000  # numbers in one point; published clouds have descriptors with some hundred
LZF_STRONGEST = 100  # largest compression factor of LZF: three bytes represent at most 264


def _read_cloud(path: Path, _: Lens | None) -> Points:
    """Read one PLY or PCD. Raises UserError if it has no header or no points, or is truncated."""
    o3d = load_open3d()
    with read_errors(f"{path}: cannot be read", LEGAL_CLOUD), path.open("rb") as file:
        content = file.read(HEADER_BYTES)
    read_header = _ply_header if path.suffix.lower() == ".ply" else _pcd_header
    width, height, data_bytes = read_header(path, content)
    if width * height < 1:
        raise UserError(f"{path}: holds no points", legal=LEGAL_CLOUD)
    refuse_pixels(f"{path}: its cloud", width, height)
    file_bytes = path.stat().st_size
    if file_bytes < data_bytes:
        problem = f"{path}: is truncated: {file_bytes} of at least {data_bytes} bytes"
        raise UserError(problem, legal="a whole file", fix="copy or export it again")
    # Open3D prints warnings to the terminal; their causes are checked here and reported once
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(
            str(path), remove_nan_points=False, remove_infinite_points=False
        )
    attributes = {key.lower(): cloud.point[key].numpy() for key in cloud.point}
    points = attributes.get("positions", ())
    if len(points) != width * height:
        problem = (
            f"{path}: is truncated or damaged: {len(points)} of {width * height} points "
            "could be read"
        )
        raise UserError(problem, legal=LEGAL_CLOUD, fix="copy or export it again")
    rgb = attributes.get("colors")
    if rgb is not None and rgb.dtype != np.uint8:  # floating-point colours run from 0 to 1
        rgb = np.clip(np.rint(rgb * 255.0), 0, 255).astype(np.uint8)
    amplitude = None
    for key in ("amplitude", "intensities", "intensity"):
        amplitude = attributes.get(key, amplitude)
    grid = (height, width) if height > 1 else _grid_of(points)
    return Points(points, grid, rgb, amplitude)


def _ply_header(path: Path, content: bytes) -> tuple[int, int, int]:
    """Return width, height (1 without a grid) and the least number of bytes of a file with this
    header."""
    end = re.search(rb"end_header\r?\n", content)
    if not content.startswith(b"ply") or end is None:
        raise UserError(f"{path}: is not a PLY file, or its header is cut off", legal=LEGAL_CLOUD)
    lines = content[: end.start()].decode("latin1").split("\n")
    points = 0
    point_bytes = 0
    element = ""
    names = list[str]()
    for line in lines:
        words = line.split()
        if words[:1] == ["element"] and len(words) == 3:
            if words[1] == "vertex" and points:
                raise UserError(f"{path}: its header states its points twice", legal=LEGAL_CLOUD)
            element = words[1]
            if element == "vertex" and COUNT.fullmatch(words[2]):
                points = int(words[2])
        elif words[:1] == ["property"] and element == "vertex" and len(words) > 1:
            names.append(words[-1])
            point_bytes += PLY_BYTES.get(words[1], 0)
    if points and not {"x", "y", "z"} <= set(names):
        raise UserError(f"{path}: its points lack x, y or z", legal=LEGAL_CLOUD)
    data_bytes = points * point_bytes
    if any(line.split()[:2] == ["format", "ascii"] for line in lines):
        # Each number of an ASCII line takes at least a digit and a separator.
        data_bytes = points * 2 * len(names) - 1
    least = end.end() + data_bytes
    remarks = [line for line in lines if line.startswith(("obj_info", "comment"))]
    columns, rows = _stated_size(remarks)
    if columns * rows == points and rows > 1:
        return columns, rows, least
    return points, 1, least


def _pcd_header(path: Path, content: bytes) -> tuple[int, int, int]:
    """Return the same values as `_ply_header` for a PCD."""
    end = re.search(rb"^DATA\s+(\w+)\s*?\r?\n", content, re.MULTILINE)
    if end is None:
        raise UserError(f"{path}: is not a PCD file, or its header is cut off", legal=LEGAL_CLOUD)
    fields: dict[str, list[str]] = {}
    for line in content[: end.start()].decode("latin1").split("\n"):
        words = line.split()
        if words and not line.startswith("#"):
            fields[words[0]] = words[1:]

    with read_errors(f"{path}: its PCD header cannot be read", LEGAL_CLOUD):
        width = _count(fields["WIDTH"][0])
        height = _count(fields["HEIGHT"][0])
        points = _count(fields["POINTS"][0]) if "POINTS" in fields else width * height
        sizes = [_count(text) for text in fields["SIZE"]]
        counts = [1] * len(sizes)
        if "COUNT" in fields:
            counts = [_count(text) for text in fields["COUNT"]]
        if not len(fields["FIELDS"]) == len(fields["TYPE"]) == len(sizes) == len(counts):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
        if not set(sizes) <= {1, 2, 4, 8} or sum(counts) > PCD_NUMBERS:
            raise ValueError(f"sizes {sorted(set(sizes))}, {sum(counts)} numbers in a point")
        if width * height != points:
            raise ValueError(f"it states {width} x {height} but {points} points")
    point_bytes = sum(size * times for size, times in zip(sizes, counts, strict=True))
    unpacked = points * point_bytes
    form = end.group(1)
    if form == b"binary":
        least = unpacked
    elif form == b"ascii":
        least = points * 2 * len(sizes) - 1
    else:
        least = _packed_bytes(path, end.end(), unpacked)
    return width, height, end.end() + least


def _count(text: str) -> int:
    """Parse a count in a PCD header. Raises ValueError for anything else."""
    if not COUNT.fullmatch(text):
        raise ValueError(f"{text[:20]!r} is not a count")
    return int(text)


def _packed_bytes(path: Path, start: int, unpacked: int) -> int:
    """Return the bytes of a compressed PCD from ``start`` on: two sizes, then the points. Raises
    UserError if it states another size than ``unpacked``, or one that LZF cannot reach."""
    with path.open("rb") as file:
        file.seek(start)
        sizes = file.read(8)
    packed, stated = struct.unpack("<II", sizes.ljust(8, b"\0"))
    if len(sizes) == 8 and (stated != unpacked or stated > LZF_STRONGEST * packed):
        problem = (
            f"{path}: its points would have {unpacked} bytes, "
            f"but it states {stated} packed into {packed}"
        )
        raise UserError(problem, legal=LEGAL_CLOUD, fix="copy or export it again")
    return 8 + int(packed)


LEGAL_LIST = (
    "one point per line: x y z [intensity] [red green blue], "
    "separated by blanks, tabs, commas or semicolons"
)
MOST_COLUMNS = 20
HEAD_LINES = 200  # lines within which the numbers must begin
COLUMNS = {
    **dict.fromkeys(("intensity", "i", "amplitude", "scalar", "grey", "gray"), "i"),
    **{name: name[0] for name in ("x", "y", "z", "r", "g", "b", "red", "green", "blue")},
}


def _read_list(path: Path, lens: Lens | None) -> Points:
    """Read one list of points. Raises UserError if it cannot be read as numbers."""
    with read_errors(f"{path}: cannot be read", LEGAL_LIST):
        content = bounded_bytes(path, TABLE_BYTES).removeprefix(codecs.BOM_UTF8)
    lines = content[:65536].decode("latin1").splitlines()[:HEAD_LINES]
    skipped = 0
    while skipped < len(lines) and _is_remark(lines[skipped]):
        skipped += 1
    # a first line of one or two whole numbers states how many points follow
    first = (_numbers(lines[skipped]) or []) if skipped < len(lines) else []
    size = []
    if len(first) in (1, 2) and all(value >= 1 and value.is_integer() for value in first):
        size = [int(value) for value in first]
    names_end = skipped
    skipped += bool(size)
    if skipped >= len(lines):
        problem = f"{path}: no line of numbers among its first {len(lines)}"
        raise UserError(problem, legal=LEGAL_LIST)
    values = _table(path, content, skipped, lines[skipped])
    columns = _columns(path, values, lines[names_end - 1] if names_end else "")
    width, height = size if len(size) == 2 else _stated_size(lines[:skipped])
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    refuse_pixels(str(path), len(points), 1)
    rgb = None
    if set("rgb") <= set(columns):
        rgb = np.stack([columns[channel] for channel in "rgb"], axis=-1)
        levels = rgb * 255 if np.nanmax(rgb) <= 1 else rgb
        rgb = np.nan_to_num(levels).clip(0, 255).astype(np.uint8)
    grid = (height, width)
    if width * height != len(points) or height <= 1:
        grid = _grid_of(points, lens)
    return Points(points, grid, rgb, columns.get("i"))


def _is_remark(line: str) -> bool:
    return bool(re.match(r"\s*(#|//|;|$)", line)) or _numbers(line) is None


def _numbers(line: str) -> list[float] | None:
    """Return the numbers of a line; None if it holds anything else."""
    try:
        return [float(word) for word in re.split(r"[,;\s]+", line.strip(" \t\r,;")) if word]
    except ValueError:
        return None


def _table(path: Path, content: bytes, skipped: int, line: str) -> np.ndarray:
    """Return numbers (n, columns). A comma within numbers that semicolons or tabs separate is a
    decimal point."""
    import pandas

    is_decimal_comma = "," in line and "." not in line and re.search(r"[;\t]", line)
    content = content.translate(bytes.maketrans(b",;", b". " if is_decimal_comma else b"  "))
    with read_errors(f"{path}: cannot be read as points", LEGAL_LIST):
        table = pandas.read_csv(
            io.BytesIO(content),
            skiprows=skipped,
            sep=r"\s+",
            header=None,
            comment="#",
            dtype=np.float64,
            encoding="latin1",
        )
    count = table.shape[1]
    if 3 <= count <= MOST_COLUMNS:
        return np.asarray(table.to_numpy())
    fix = None
    if count > MOST_COLUMNS:
        fix = "if it is a depth image, save it by numpy.save('depth.npy', ..), then name depth.npy"
    problem = f"{path}: {count} numbers in a line are not a point"
    raise UserError(problem, legal=LEGAL_LIST, fix=fix)


def _columns(path: Path, values: np.ndarray, line: str) -> dict[str, np.ndarray]:
    """Return columns by name: x, y, z, i, r, g, b. ``line`` precedes the numbers and may name
    them."""
    bare = re.sub(r"\([^)]*\)|\[[^]]*\]", " ", line).strip(" #/\t\r,;").lower()
    names = [COLUMNS.get(word, "") for word in re.split(r"[,;\s]+", bare)]
    count = values.shape[1]
    if len(names) == count and set("xyz") <= set(names):
        # the first of several columns of one name counts
        return {name: values[:, i] for i, name in reversed(list(enumerate(names))) if name}
    if "z" in names:
        problem = f"{path}: names the columns {bare[:100]!r}, but its lines have {count} numbers"
        raise UserError(problem, legal=LEGAL_LIST)
    extra = {4: "i", 5: "i", 6: "rgb", 7: "irgb"}.get(count, "")
    if extra.endswith("rgb"):
        colour = values[:, count - 3 :]
        if colour.min() < 0 or colour.max() > 255 or (colour % 1).any():
            # normals or something else, but no colour
            extra = extra.removesuffix("rgb")
    return {name: values[:, i] for i, name in enumerate("xyz" + extra)}
