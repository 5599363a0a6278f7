"""Point clouds as files: PLY, PCD, and lists of points as text (.xyz, .txt, .csv, .asc, .pts).

A PCD is organised if HEIGHT > 1, a PLY if it states num_cols and num_rows. A list has one point per
line: x y z, then an intensity, or red green blue, or both, unless a line of names says otherwise.
Its grid is stated by a comment or a first line of two whole numbers, or given by a lens with as
many pixels, or by a common sensor size on which x/z and y/z rise evenly."""

import codecs
import io
import math
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detectors.recordings.arrays import SENSOR_SIZES
from detectors.recordings.distances import UNITS_M, frame_of
from detectors.recordings.lzf import unpack
from detectors.recordings.recording import NO_GRID, CaptureOptions, Recording, read_errors
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TABLE_BYTES, bounded_bytes, refuse_pixels
from harness.vocabulary.geometry import Frame, Lens

CLOUDS = (".ply", ".pcd")
POINT_LISTS = (".xyz", ".asc", ".pts", ".txt", ".csv")
RASTER_CORRELATION = 0.999
"""Correlation of x/z with the column and y/z with the row on a true pixel grid; a distorted lens
reduces it by 1 %."""
ORDER_SAMPLES = 8192  # points whose places tell whether their order is that of a pixel grid
LEAST_SIDE_PX = 32  # of a picture cut out of a larger one


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
    indices = np.flatnonzero(valid)
    if len(indices) > ORDER_SAMPLES:
        # not every n-th one: these may all lie in a few columns
        indices = np.random.default_rng(0).choice(indices, ORDER_SAMPLES, replace=False)
    slopes = points[indices, :2].astype(np.float64) / points[indices, 2, None]
    if not (np.isfinite(slopes).all() and np.ptp(slopes, axis=0).all()):
        return 1, count
    for width, height in _sizes_of(count):
        v, u = np.divmod(indices, width)
        across = np.corrcoef(slopes[:, 0], u)[0, 1]
        down = np.corrcoef(slopes[:, 1], v)[0, 1]
        if min(abs(across), abs(down)) > RASTER_CORRELATION:
            return height, width
    return 1, count


def _sizes_of(count: int) -> list[tuple[int, int]]:
    """Return the widths and heights of pictures with so many pixels: those of usual cameras first,
    then those of crops."""
    sizes = [size for size in SENSOR_SIZES if size[0] * size[1] == count]
    for side in range(LEAST_SIDE_PX, math.isqrt(count) + 1):
        if count % side == 0:
            sizes += [(count // side, side), (side, count // side)]
    return sizes


LEGAL_CLOUD = (
    "PLY (ASCII or binary) or PCD (ASCII, binary or compressed) with x, y, z for each point"
)
PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
HEADER_BYTES = 65536
COUNT = re.compile(r"\d{1,15}", re.ASCII)
"""A count in a header. No file has more digits, and Python refuses to read thousands of them."""
PCD_NUMBERS = 10_000  # numbers in one point; published clouds have descriptors with some hundred
LZF_STRONGEST = 100  # largest compression factor of LZF: three bytes represent at most 264


class Header(NamedTuple):
    """Statements of the header of a PLY or PCD."""

    # pixels of the grid; height 1 without one
    width: int
    height: int
    # bytes up to the first point
    begin: int
    # "ascii", "binary", or "packed": by field, compressed
    form: str
    # numbers of a point in the file's order, each with NumPy's name of its type and its count
    fields: tuple[tuple[str, str, int], ...]

    @property
    def point_bytes(self) -> int:
        """Bytes of a point without compression."""
        return sum(np.dtype(kind).itemsize * count for _, kind, count in self.fields)

    @property
    def text_columns(self) -> int:
        """Numbers in an ASCII line."""
        return sum(count for _, _, count in self.fields)


def _read_cloud(path: Path, _: Lens | None) -> Points:
    """Read one PLY or PCD. Raises UserError if it has no header or no points, or is truncated."""
    with read_errors(f"{path}: cannot be read", LEGAL_CLOUD), path.open("rb") as file:
        content = file.read(HEADER_BYTES)
    read_header = _ply_header if path.suffix.lower() == ".ply" else _pcd_header
    header = read_header(path, content)
    points_stated = header.width * header.height
    if points_stated < 1:
        raise UserError(f"{path}: holds no points", legal=LEGAL_CLOUD)
    refuse_pixels(f"{path}: its cloud", header.width, header.height)
    least_bytes = header.begin + _data_bytes(path, header)
    file_bytes = path.stat().st_size
    if file_bytes < least_bytes:
        problem = f"{path}: is truncated: {file_bytes} of at least {least_bytes} bytes"
        raise UserError(problem, legal="a whole file", fix="copy or export it again")
    with read_errors(f"{path}: its points cannot be read", LEGAL_CLOUD):
        columns = _columns_of(path, header)
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    if points.dtype.kind != "f":
        points = points.astype(np.float64)
    if len(points) != points_stated:
        problem = (
            f"{path}: is truncated or damaged: {len(points)} of {points_stated} points "
            "could be read"
        )
        raise UserError(problem, legal=LEGAL_CLOUD, fix="copy or export it again")
    amplitude = None
    for key in ("amplitude", "intensities", "intensity"):
        amplitude = columns.get(key, amplitude)
    grid = (header.height, header.width) if header.height > 1 else _grid_of(points)
    return Points(points, grid, _colours(columns), amplitude)


def _colours(columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return red, green and blue (n, 3) uint8 of a PLY's three columns or a PCD's packed one."""
    packed = columns.get("rgb", columns.get("rgba"))
    if packed is not None and packed.dtype.itemsize == 4:
        # 0xRRGGBB, often declared as the floating-point number of the same bits
        codes = np.ascontiguousarray(packed).view(np.uint32)
        red = (codes >> 16) & 255
        green = (codes >> 8) & 255
        blue = codes & 255
        return np.stack([red, green, blue], axis=-1).astype(np.uint8)
    if not {"red", "green", "blue"} <= set(columns):
        return None
    rgb = np.stack([columns[name] for name in ("red", "green", "blue")], axis=-1)
    if rgb.dtype.kind == "f":  # floating-point colours run from 0 to 1
        rgb = np.clip(np.rint(np.nan_to_num(rgb) * 255.0), 0, 255)
    return rgb.astype(np.uint8)


def _columns_of(path: Path, header: Header) -> dict[str, np.ndarray]:
    """Return the single numbers of points (n,) by lower-case name, in the types that they have in
    the file. Raises any exception if the data are damaged."""
    points = header.width * header.height
    singles = {
        name.lower(): number for number, (name, _, count) in enumerate(header.fields) if count == 1
    }
    # names may occur twice, such as PCD's "_" for padding
    layout = np.dtype(
        [(f"{number}", kind, (count,)) for number, (_, kind, count) in enumerate(header.fields)]
    )
    with path.open("rb") as file:
        file.seek(header.begin)
        if header.form == "ascii":
            text = np.loadtxt(file, comments=None, max_rows=points, ndmin=2, encoding="latin1")
            starts = np.cumsum([0, *(count for _, _, count in header.fields)])
            if text.shape[1] != header.text_columns:
                raise ValueError(f"{text.shape[1]} numbers in a line, {header.text_columns} stated")
            return {
                name: text[:, starts[number]].astype(header.fields[number][1])
                for name, number in singles.items()
            }
        if header.form == "binary":
            rows = np.frombuffer(file.read(points * layout.itemsize), layout)
            return {
                name: np.ascontiguousarray(rows[f"{number}"][:, 0])
                for name, number in singles.items()
            }
        packed_bytes, unpacked_bytes = struct.unpack("<II", file.read(8))
        unpacked = unpack(file.read(packed_bytes), unpacked_bytes)
    columns = {}
    start = 0
    for number, (name, kind, count) in enumerate(header.fields):
        column = np.frombuffer(unpacked, kind, points * count, start)
        start += column.nbytes
        if singles.get(name.lower()) == number:
            columns[name.lower()] = column
    return columns


def _ply_header(path: Path, content: bytes) -> Header:
    """Parse the header of a PLY."""
    end = re.search(rb"end_header\r?\n", content)
    if not content.startswith(b"ply") or end is None:
        raise UserError(f"{path}: is not a PLY file, or its header is cut off", legal=LEGAL_CLOUD)
    lines = content[: end.start()].decode("latin1").splitlines()
    points = 0
    elements = list[str]()
    form = "ascii"
    order = "<"
    fields = list[tuple[str, str, int]]()
    for line in lines:
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1 and words[1] in PLY_ORDERS:
            form = "binary"
            order = PLY_ORDERS[words[1]]
        elif words[:1] == ["element"] and len(words) == 3:
            if words[1] == "vertex" and "vertex" in elements:
                raise UserError(f"{path}: its header states its points twice", legal=LEGAL_CLOUD)
            elements.append(words[1])
            if words[1] == "vertex" and COUNT.fullmatch(words[2]):
                points = int(words[2])
        elif words[:1] == ["property"] and elements[-1:] == ["vertex"] and len(words) > 2:
            kind = PLY_TYPES.get(words[1])
            if kind is None:
                problem = f"{path}: a number of its points is of the type {words[1][:20]!r}"
                raise UserError(problem, legal=", ".join(PLY_TYPES))
            fields.append((words[-1], order + kind, 1))
    if points and not {"x", "y", "z"} <= {name.lower() for name, _, _ in fields}:
        raise UserError(f"{path}: its points lack x, y or z", legal=LEGAL_CLOUD)
    if points and elements[0] != "vertex":
        problem = f"{path}: its points follow another list, {elements[0][:20]!r}"
        raise UserError(problem, legal="a PLY that begins with its points", fix="export it again")
    remarks = [line for line in lines if line.startswith(("obj_info", "comment"))]
    columns, rows = _stated_size(remarks)
    if columns * rows != points or rows < 2:
        columns = points
        rows = 1
    return Header(columns, rows, end.end(), form, tuple(fields))


def _pcd_header(path: Path, content: bytes) -> Header:
    """Parse the header of a PCD."""
    end = re.search(rb"^DATA\s+(\w+)\s*?\r?\n", content, re.MULTILINE)
    if end is None:
        raise UserError(f"{path}: is not a PCD file, or its header is cut off", legal=LEGAL_CLOUD)
    stated: dict[str, list[str]] = {}
    for line in content[: end.start()].decode("latin1").split("\n"):
        words = line.split()
        if words and not line.startswith("#"):
            stated[words[0]] = words[1:]

    with read_errors(f"{path}: its PCD header cannot be read", LEGAL_CLOUD):
        width = _count(stated["WIDTH"][0])
        height = _count(stated["HEIGHT"][0])
        points = _count(stated["POINTS"][0]) if "POINTS" in stated else width * height
        sizes = [_count(text) for text in stated["SIZE"]]
        counts = [1] * len(sizes)
        if "COUNT" in stated:
            counts = [_count(text) for text in stated["COUNT"]]
        if not len(stated["FIELDS"]) == len(stated["TYPE"]) == len(sizes) == len(counts):
            raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
        if not set(sizes) <= {1, 2, 4, 8} or sum(counts) > PCD_NUMBERS:
            raise ValueError(f"sizes {sorted(set(sizes))}, {sum(counts)} numbers in a point")
        if width * height != points:
            raise ValueError(f"it states {width} x {height} but {points} points")
        kinds = [
            np.dtype(f"<{PCD_KINDS[kind]}{size}").str
            for kind, size in zip(stated["TYPE"], sizes, strict=True)
        ]
        fields = tuple(zip(stated["FIELDS"], kinds, counts, strict=True))
        if not {"x", "y", "z"} <= {name.lower() for name, _, count in fields if count == 1}:
            raise ValueError("its points lack x, y or z")
    form = end.group(1).decode("latin1")
    if form not in ("ascii", "binary"):
        form = "packed"
    return Header(width, height, end.end(), form, fields)


def _data_bytes(path: Path, header: Header) -> int:
    """Return the least number of bytes of a file's points."""
    points = header.width * header.height
    if header.form == "ascii":
        # each number takes at least a digit and a separator
        return points * 2 * header.text_columns - 1
    unpacked = points * header.point_bytes
    if header.form == "binary":
        return unpacked
    return _packed_bytes(path, header.begin, unpacked)


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
    units = r"\([^)]*\)|\[[^]]*\]"
    bare = re.sub(units, " ", line).strip(" #/\t\r,;").lower()
    names = [COLUMNS.get(word, "") for word in re.split(r"[,;\s]+", bare)]
    count = values.shape[1]
    if len(names) == count and set("xyz") <= set(names):
        columns: dict[str, np.ndarray] = {}
        for i, name in enumerate(names):
            # the first of several columns of one name counts
            if name and name not in columns:
                columns[name] = values[:, i]
        return columns
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
