"""Faults in files: in their bytes, their lines, the values of a tree, and the numbers of arrays
and tables."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Rng = np.random.Generator
ODD_VALUES: tuple[Any, ...] = (
    None,
    "",
    "x",
    "<b>",
    "\x00",
    "../..",
    -1,
    0,
    2,
    0.5,
    1e300,
    -1e300,
    5e-324,
    float("nan"),
    float("inf"),
    10**400,
    2**63,
    True,
    [],
    [[]],
    [1, 2],
    ["a", None],
    {},
    {"a": 1},
    {"kind": "x"},
)
ODD_NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"inf", b"99999999999999999999", b"1e-300", b"x", b"")
ODD_CELLS = ("", "nan", "inf", "-1", "0", "x", "1e999", '"', "1;2", "\x00", "yes", "9" * 400)
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
TREES = (".json", ".yaml", ".yml", ".intr")
ARRAYS = (".npy", ".npz")
TABLES = (".csv",)
TEXTS = (".txt", ".xyz", ".obj", ".pcd", ".ply", ".jsonl", *TREES, *TABLES)


def spoiled(path: Path, rng: Rng) -> None:
    """Put a fault into a file, of a kind that its type allows."""
    suffix = path.suffix.lower()
    kinds: list[Callable[[Path, Rng], None]] = [_spoil_bytes]
    if suffix in TREES:
        kinds += [_spoil_tree] * 6
    if suffix in ARRAYS:
        kinds += [_spoil_arrays] * 4
    if suffix in TABLES:
        kinds += [_spoil_cells] * 3
    if suffix == ".parquet":
        kinds += [_spoil_columns] * 6
    if suffix in TEXTS:
        kinds += [_spoil_lines, _spoil_numbers]
    kinds[rng.integers(len(kinds))](path, rng)


def _spoil_bytes(path: Path, rng: Rng) -> None:
    """Flip, cut, repeat, empty or overwrite bytes, most often near the beginning."""
    content = bytearray(path.read_bytes())
    kind = rng.integers(6)
    size = len(content)
    reach = max(1, min(size, int(rng.choice([64, 512, size or 1]))))
    if kind == 0 or not content:
        content = content[: rng.integers(reach)] if content else bytearray(b"\0")
    elif kind == 1:
        for index in rng.integers(reach, size=rng.integers(1, 9)):
            content[index] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        start = int(rng.integers(reach))
        length = int(rng.integers(1, 64))
        content[start : start + length] = rng.bytes(length)
    elif kind == 3:
        start = int(rng.integers(reach))
        content[start:start] = content[start : start + int(rng.integers(1, 256))]
    elif kind == 4:
        start = int(rng.integers(reach))
        del content[start : start + int(rng.integers(1, 64))]
    else:
        start = int(rng.integers(reach))
        fill = int(rng.choice([0, 255, 127]))
        content[start : start + 8] = bytes([fill]) * 8
    path.write_bytes(content)


def _spoil_lines(path: Path, rng: Rng) -> None:
    """Take out, repeat or exchange lines."""
    lines = path.read_bytes().split(b"\n")
    first = int(rng.integers(len(lines)))
    second = int(rng.integers(len(lines)))
    kind = rng.integers(3)
    if kind == 0:
        del lines[first]
    elif kind == 1:
        lines.insert(second, lines[first])
    else:
        lines[first], lines[second] = lines[second], lines[first]
    path.write_bytes(b"\n".join(lines))


def _spoil_numbers(path: Path, rng: Rng) -> None:
    """Replace a number of the text by an odd one, most often in the first lines."""
    content = path.read_bytes()
    spans = [match.span() for match in NUMBER.finditer(content[:200_000])]
    if not spans:
        return
    count = int(rng.choice([8, 40, len(spans)]))
    start, end = spans[int(rng.integers(min(count, len(spans))))]
    odd = ODD_NUMBERS[rng.integers(len(ODD_NUMBERS))]
    path.write_bytes(content[:start] + odd + content[end:])


def _spoil_tree(path: Path, rng: Rng) -> None:
    """Replace, drop, add or double a value of a JSON or YAML file."""
    text = path.read_text(errors="replace")
    is_json = text.lstrip().startswith(("{", "["))
    try:
        data = json.loads(text) if is_json else _from_yaml(text)
    except ValueError:
        _spoil_numbers(path, rng)
        return
    holders = list(_holders(data))
    if not holders:
        path.write_text("[]")
        return
    for _ in range(int(rng.choice([1, 1, 2]))):
        holder, key = holders[int(rng.integers(len(holders)))]
        try:
            _spoil_value(holder, key, rng)
        except (KeyError, IndexError, OverflowError):
            continue  # an earlier fault has taken it out, or made it too large
    path.write_text(json.dumps(data) if is_json else _as_yaml(data))


def _spoil_value(holder: Any, key: Any, rng: Rng) -> None:
    kind = rng.integers(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, dict):
        holder[f"{key}x"] = holder[key]
    elif kind == 2:
        holder[key] = [holder[key], holder[key]]
    elif kind == 3 and isinstance(holder[key], int | float):
        factor = float(rng.choice([-1, 0, 1e3, 1e-3, 1e12]))
        holder[key] = type(holder[key])(holder[key] * factor)
    else:
        holder[key] = ODD_VALUES[rng.integers(len(ODD_VALUES))]


def _holders(data: Any) -> Any:
    """Yield each mapping or list with each of its keys."""
    items: Any = ()
    if isinstance(data, dict):
        items = list(data.items())
    elif isinstance(data, list):
        items = list(enumerate(data[:30]))
    for key, value in items:
        yield data, key
        yield from _holders(value)


def _from_yaml(text: str) -> Any:
    from ruamel.yaml import YAML, YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except YAMLError as error:
        raise ValueError(str(error)) from error


def _as_yaml(data: Any) -> str:
    from ruamel.yaml import YAML

    stream = io.StringIO()
    YAML(typ="safe", pure=True).dump(data, stream)
    return stream.getvalue()


def _spoil_arrays(path: Path, rng: Rng) -> None:
    """Change the shape, the type or the numbers of an array, or take it out of its file."""
    try:
        if path.suffix == ".npy":
            np.save(path, _odd_array(np.load(path), rng))
            return
        with np.load(path) as stored:
            arrays = dict(stored)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile):
        _spoil_bytes(path, rng)
        return
    name = list(arrays)[int(rng.integers(len(arrays)))]
    if rng.random() < 0.2:
        del arrays[name]
    else:
        arrays[name] = _odd_array(arrays[name], rng)
    np.savez(path, **arrays)


def _odd_array(array: np.ndarray, rng: Rng) -> np.ndarray:
    kind = rng.integers(9)
    is_number = array.dtype.kind in "iufb"
    if kind == 0:
        return array.ravel()
    if kind == 1:
        return array[..., None]
    if kind == 2:
        return array[:0] if array.ndim else np.zeros(0)
    if kind == 3:
        return array.ravel()[:1].reshape(()) if array.size else np.zeros(())
    if kind == 4:
        return array.astype(rng.choice(["S8", "U8"]))
    if kind == 5 and is_number:
        return array.astype(str(rng.choice(["f2", "f8", "i1", "u8", "c16", "b1", "i8"])))
    if kind == 6 and is_number:
        fill = float(rng.choice([np.nan, np.inf, -1.0, 0.0, 1e30, 1e-30]))
        return np.full(array.shape, fill)
    if kind == 7 and array.ndim > 1:
        return np.swapaxes(array, 0, -1)
    if is_number and array.size:
        changed = array.astype(float).ravel()
        indices = rng.integers(changed.size, size=max(1, changed.size // 3))
        changed[indices] = float(rng.choice([np.nan, np.inf, -np.inf, 1e300, -5.0, 0.0]))
        return changed.reshape(array.shape)
    return array[..., ::2] if array.ndim else array


def _spoil_cells(path: Path, rng: Rng) -> None:
    """Replace a cell, or take out a column or a row, of a CSV."""
    rows = list(csv.reader(io.StringIO(path.read_text())))
    row = int(rng.integers(len(rows)))
    kind = rng.integers(4)
    if kind == 0:
        column = int(rng.integers(max(1, len(rows[0]))))
        rows = [cells[:column] + cells[column + 1 :] for cells in rows]
    elif kind == 1:
        rows = rows[: row + 1]
    else:
        for _ in range(int(rng.choice([1, 5]))):
            row = int(rng.integers(len(rows)))
            if rows[row]:
                column = int(rng.integers(len(rows[row])))
                rows[row][column] = ODD_CELLS[rng.integers(len(ODD_CELLS))]
    stream = io.StringIO()
    csv.writer(stream).writerows(rows)
    path.write_text(stream.getvalue())


def _spoil_columns(path: Path, rng: Rng) -> None:
    """Change a column of a Parquet table, or the JSON beside its columns; the bytes of a table
    that an earlier fault made unreadable, or that cannot hold the change."""
    import pyarrow as pa

    content = path.read_bytes()
    try:
        _change_column(path, rng)
    except (pa.ArrowException, OSError, ValueError):
        path.write_bytes(content)
        _spoil_bytes(path, rng)


def _change_column(path: Path, rng: Rng) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    name = table.column_names[int(rng.integers(table.num_columns))]
    column = table.column_names.index(name)
    values = table.column(name).to_pylist()
    kind = rng.integers(6)
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.slice(0, int(rng.integers(3)))
    elif kind == 2:
        metadata = dict(table.schema.metadata or {})
        metadata[b"tofpod"] = [b"[]", b"{", b"null", b'{"experiment": 3}'][rng.integers(4)]
        table = table.replace_schema_metadata(metadata)
    else:
        odd = ODD_VALUES[rng.integers(len(ODD_VALUES))]
        if isinstance(odd, int) and abs(odd) > 2**63 - 1:
            odd = -7
        if kind == 3:
            values = [odd] * len(values)
        elif all(isinstance(value, float) for value in values):
            values[int(rng.integers(len(values)))] = odd if isinstance(odd, float) else None
        else:
            values = [str(value) for value in values]
            values[int(rng.integers(len(values)))] = str(odd)
        table = table.set_column(column, name, pa.array(values))
    pq.write_table(table, path)
