"""Lists of points as text (.xyz, .txt, .csv, .asc, .pts): a point a line, its numbers apart by blanks, tabs, commas or
semicolons.

Columns are x y z, then an intensity, or red green blue, or both; a line of names before the numbers says otherwise.
Lines that begin with # or // are comments. A comment with ``width`` and ``height``, a first line of two whole numbers,
a lens with as many pixels, or a sensor's usual size on which x/z and y/z rise evenly put the points on a pixel grid.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.recordings.arrays import SENSOR_SIZES
from detectors.recordings.distances import UNITS_M, frame_from_points, rounding_step_m
from detectors.recordings.recording import Recording
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.limits import TABLE_BYTES, bounded_bytes, refuse_pixels

POINT_LISTS = (".xyz", ".asc", ".pts", ".txt", ".csv")
LEGAL_LIST = "a point a line: x y z [intensity] [red green blue], apart by blanks, tabs, commas or semicolons"
MOST_COLUMNS = 20
HEAD_LINES = 200
"""Within which the numbers must begin."""
COLUMNS = {
    **dict.fromkeys(("intensity", "i", "amplitude", "scalar", "grey", "gray"), "i"),
    **{name: name[0] for name in ("x", "y", "z", "r", "g", "b", "red", "green", "blue")},
}
RASTER_CORRELATION = 0.999
"""Of x/z with the column and y/z with the row on a true pixel grid: a distorted lens bends 1 %."""


@dataclass(frozen=True)
class PointListReader:
    """Reads lists of points, one frame a file. ``lens`` only tells whether a list fills a pixel grid."""

    paths: tuple[Path, ...]
    scale_m: float
    lens: Lens | None

    def frames(self) -> Iterator[Frame]:
        for path in self.paths:
            columns, grid = _read(path, self.lens)
            points = np.stack([columns[axis] for axis in "xyz"], axis=-1).reshape(*grid, 3)
            rgb = None
            if set("rgb") <= set(columns):
                rgb = np.stack([columns[channel] for channel in "rgb"], axis=-1)
                rgb = np.nan_to_num(rgb * 255 if np.nanmax(rgb) <= 1 else rgb).clip(0, 255).astype(np.uint8)
            amplitude = columns["i"].astype(np.float32).reshape(grid) if "i" in columns else None
            rgb = None if rgb is None else rgb.reshape(*grid, 3)
            yield frame_from_points(path.name, points, self.scale_m, rgb=rgb, amplitude=amplitude)


def open_point_lists(paths: Sequence[Path], scale_m: float | None, lens: Lens | None, name: str) -> Recording:
    """Open lists of points in the order given, each a frame. Raises UserError where one cannot be read as numbers."""
    scale_m = scale_m or UNITS_M["m"]
    reader = PointListReader(tuple(paths), scale_m, lens)
    first = next(reader.frames())
    height, width = first.z_m.shape
    note = f"the points fill a grid of {width} x {height} pixels"
    return Recording(
        name=name,
        reader=reader,
        region=Region(0, height, 0, width),
        scale_m=scale_m,
        z_step_m=rounding_step_m(first.z_m),
        files=tuple(paths),
        organised=height > 1,
        notes=(note if height > 1 else "the cloud has no pixel grid; it is treated as single points",),
    )


def _read(path: Path, lens: Lens | None) -> tuple[dict[str, np.ndarray], tuple[int, int]]:
    """The named columns, each (n,), and the grid (h, w); (1, n) without one."""
    try:
        content = bounded_bytes(path, TABLE_BYTES)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_LIST) from error
    lines = content[:65536].decode("latin1").splitlines()[:HEAD_LINES]
    head = [bool(re.match(r"\s*(#|//|;|$)", line)) or _numbers(line) is None for line in lines]
    skipped = head.index(False) if False in head else len(lines)
    first = (_numbers(lines[skipped]) or []) if skipped < len(lines) else []
    size = [int(value) for value in first] if len(first) in (1, 2) and all(v == int(v) >= 1 for v in first) else []
    skipped += bool(size)
    if skipped >= len(lines):
        raise UserError(f"{path}: no line of numbers among its first {len(lines)}", legal=LEGAL_LIST)
    values = _table(path, content, skipped, lines[skipped])
    columns = _columns(path, values, lines[skipped - 1 - bool(size)] if skipped > bool(size) else "")
    width, height = size if len(size) == 2 else stated_size(lines[:skipped])
    points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    refuse_pixels(str(path), len(points), 1)
    is_stated = width * height == len(points) and height > 1
    return columns, (height, width) if is_stated else grid_of(points, lens)


def _numbers(line: str) -> list[float] | None:
    """The numbers of a line; None where something else stands there."""
    try:
        return [float(word) for word in re.split(r"[,;\s]+", line.strip(" \t\r,;")) if word]
    except ValueError:
        return None


def _table(path: Path, content: bytes, skipped: int, line: str) -> np.ndarray:
    """(n, columns) numbers. A comma within numbers that semicolons or tabs part is a decimal point."""
    import pandas

    is_decimal_comma = "," in line and "." not in line and re.search(r"[;\t]", line)
    content = content.translate(bytes.maketrans(b",;", b". " if is_decimal_comma else b"  "))
    try:
        table = pandas.read_csv(
            io.BytesIO(content),
            sep=r"\s+",
            header=None,
            skiprows=skipped,
            comment="#",
            dtype=np.float64,
            encoding="latin1",
        )
    except (ValueError, OverflowError, MemoryError) as error:  # pandas' own errors derive from ValueError
        raise UserError(
            f"{path}: cannot be read as points ({str(error).splitlines()[0][:200]})", legal=LEGAL_LIST
        ) from error
    values: np.ndarray = table.to_numpy()
    if values.shape[1] > MOST_COLUMNS:
        raise UserError(
            f"{path}: {values.shape[1]} numbers in a line are no point",
            legal=LEGAL_LIST,
            fix="of an image of depth: python -c \"import numpy; numpy.save('depth.npy', numpy.loadtxt("
            f"'{path}', delimiter='{',' if ',' in line else ' '}'))\", then name depth.npy",
        )
    if values.shape[1] < 3:
        raise UserError(f"{path}: {values.shape[1]} numbers in a line are no point", legal=LEGAL_LIST)
    return values


def _columns(path: Path, values: np.ndarray, line: str) -> dict[str, np.ndarray]:
    """Columns by name: x, y, z, i, r, g, b. ``line`` stands before the numbers and may name them."""
    bare = re.sub(r"\([^)]*\)|\[[^]]*\]", " ", line).strip(" #/\t\r,;").lower()
    names = [COLUMNS.get(word, "") for word in re.split(r"[,;\s]+", bare)]
    if len(names) == values.shape[1] and set("xyz") <= set(names):
        return {name: values[:, i] for i, name in reversed(list(enumerate(names))) if name}
    if "z" in names:
        raise UserError(
            f"{path}: names the columns {bare[:100]!r}, but its lines have {values.shape[1]} numbers", legal=LEGAL_LIST
        )
    count = values.shape[1]
    colour = {6: "rgb", 7: "irgb"}.get(count, "i" if count in (4, 5) else "")
    found = {name: values[:, i] for i, name in enumerate("xyz" + colour)}
    if "r" in found and ((beyond := values[:, count - 3 :]).min() < 0 or beyond.max() > 255 or (beyond % 1).any()):
        # normals, or another thing: no colour
        return {name: found[name] for name in found if name not in "rgb"}
    return found


def stated_size(lines: Sequence[str]) -> tuple[int, int]:
    """Width and height that lines of a header state, 0 where they do not."""
    text = "\n".join(lines).lower()
    names = (r"(?:num_)?(?:width|cols)", r"(?:num_)?(?:height|rows)")
    found = (re.search(rf"\b{name}\b\s*[:=]?\s*(\d{{1,9}})\b", text) for name in names)
    width, height = (int(match.group(1)) if match else 0 for match in found)
    return width, height


def grid_of(points: np.ndarray, lens: Lens | None = None) -> tuple[int, int]:
    """(h, w) of points (n, 3) whose grid nothing states: the lens', or a usual sensor's where they rise as its pixels
    do; (1, n) else."""
    count = len(points)
    if lens is not None and lens.width * lens.height == count:
        return lens.height, lens.width
    for width, height in SENSOR_SIZES:
        if width * height == count and _is_raster(points, height, width):
            return height, width
    return 1, count


def _is_raster(points: np.ndarray, height: int, width: int) -> bool:
    """Whether the points come row by row from a camera's pixels."""
    v, u = np.divmod(np.arange(height * width), width)
    z = points[:, 2]
    valid = np.isfinite(points).all(axis=1) & (z != 0)
    if valid.sum() < 100:
        return False
    slopes = points[valid, :2] / z[valid, None]
    turns = [np.corrcoef(slopes[:, axis], at[valid])[0, 1] for axis, at in enumerate((u, v))]
    return min(map(abs, turns)) > RASTER_CORRELATION
