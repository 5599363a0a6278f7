"""Renders kept by content: the key is everything that can change a number, the file carries its own checksum."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import stat
import struct
import zipfile
from dataclasses import asdict, fields
from math import prod
from operator import index
from pathlib import Path
from typing import IO, Any

import numpy as np

from harness.vocabulary.files import write_bytes
from harness.vocabulary.geometry import Region
from harness.vocabulary.locks import one_at_a_time
from harness.vocabulary.seeds import digest
from harness.vocabulary.sources import source_digest
from scenes.optics import Optics
from scenes.render.settings import RenderConfig
from scenes.render.view import render_view
from scenes.target.custom import TargetConfig
from scenes.target.mesh import build_target
from scenes.view import NoiseFreeView

CODE = ("scenes.render.view", "scenes.target.mesh")
PACKAGES = ("mitsuba", "drjit", "trimesh", "manifold3d", "numba", "numpy", "scipy")
"""A render's numbers are decided, beside its declaration, by these modules with all that they import and by the
versions of these packages. The variant (GPU or processor) is left out: it changes them by 1e-6."""

VIEW_VERSION = 1
"""Stands in every file. One of another version counts as absent: rendering anew is always possible."""
RENDERING = ".rendering"
"""The file of which a process locks a byte while it renders a view."""
FACTS = "facts.json"
MOST_FACTS_BYTES = 1 << 20
"""They take some 500 bytes; names of ten thousand surfaces would take 200 kB."""
ARRAYS = tuple(f.name for f in fields(NoiseFreeView) if f.type == "np.ndarray")
AXES = {"phasor": "fhw", "phasor_direct": "fhw", "slopes": "hw2", "rgb": "hw3"}
"""Of the arrays: frequencies, rows and columns of the region; those not named have "hw"."""
TYPES = {np.dtype(name).str: np.dtype(name) for name in ("c8", "c16", "f4", "f8", "i2", "i4", "i8")}
MOST_PIXELS = 1 << 16
"""Across a region or down: ten times the largest sensor."""


def render_key(target: TargetConfig, optics: Optics, config: RenderConfig) -> str:
    """Digest of what a render depends on: target, optics of the camera, work, and the code itself.

    The sensor's noise and engine are left out: cameras that differ there share renders.
    """
    return digest(
        {
            "code": source_digest(CODE, PACKAGES),
            "target": target.to_data(),
            "optics": optics.content(),
            "render": config.to_data(),
        }
    )


def cached_view(target: TargetConfig, optics: Optics, config: RenderConfig, folder: Path) -> tuple[NoiseFreeView, bool]:
    """The view of a declared target, and whether it came from the cache. A damaged file is rendered again; a view that
    another process renders is waited for.

    Raises UserError as `build_target` and `render_view` do, and where the folder cannot be written.
    """
    key = render_key(target, optics, config)
    path = folder / f"{key}.npz"
    found = read_view(path)
    if found is not None:
        return found, True
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    with one_at_a_time(folder / RENDERING, int(key[:8], 16)):
        found = read_view(path)
        if found is not None:
            return found, True
        view = render_view(build_target(target), optics, config)
        write_view(path, view)
    return view, False


def write_view(path: Path, view: NoiseFreeView) -> None:
    """Store a view as .npz, not compressed, atomically, with a checksum over all that is in it."""
    arrays = {name: np.ascontiguousarray(getattr(view, name)) for name in ARRAYS}
    facts = {
        "version": VIEW_VERSION,
        "region": asdict(view.region),
        "frequencies_hz": list(view.frequencies_hz),
        "surface_names": list(view.surface_names),
        "seconds": view.seconds,
        "variant": view.variant,
        "types": {name: array.dtype.str for name, array in arrays.items()},
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(zipfile.ZipInfo(FACTS), json.dumps({**facts, "checksum": _checksum(facts, arrays)}))
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), _header(array.dtype, array.shape) + array.tobytes())
    write_bytes(path, buffer.getvalue(), durable=False)


def read_view(path: Path) -> NoiseFreeView | None:
    """A stored view, or None where the file is absent, truncated, damaged or of another version. A view that was read
    has been used: its file's time says so, for `scenes.render.store.trim_cache`."""
    view = stored_view(path)
    if view is not None:
        with contextlib.suppress(OSError):  # a cache that may only be read serves as well
            os.utime(path)
    return view


def stored_view(path: Path) -> NoiseFreeView | None:
    """As `read_view`, without a trace. Nothing of a file is believed before it is checked: a part is read only if it is
    not compressed, lies in the file and has just the size that its array takes, so that memory is bounded by the file's
    size; nothing is unpickled, and nothing parsed but the facts."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return None  # reading a pipe would wait for ever
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            length = archive.getinfo(FACTS).file_size
            facts = json.loads(_part(archive, file, FACTS, min(length, MOST_FACTS_BYTES)))
            arrays = {name: _array(archive, file, name, facts) for name in ARRAYS}
            told, version = facts.pop("checksum"), facts["version"]
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, struct.error, zipfile.BadZipFile):
        return None  # RuntimeError: what zipfile cannot do, and JSON that is nested too deeply
    if version != VIEW_VERSION or told != _checksum(facts, arrays):
        return None
    return NoiseFreeView(
        region=_region(facts),
        frequencies_hz=tuple(facts["frequencies_hz"]),
        surface_names=tuple(facts["surface_names"]),
        seconds=facts["seconds"],
        variant=facts["variant"],
        **arrays,
    )


def view_bytes(region: Region, frequencies: int) -> int:
    """What a render takes on the disk, within 1 %, before it is made."""
    h, w = region.shape
    return h * w * (2 * 8 * frequencies + 3 * 8 + 2 + 4 + 3 * 4 + 2 * 8) + 4096


def _array(archive: zipfile.ZipFile, file: IO[bytes], name: str, facts: dict[str, Any]) -> np.ndarray:
    """An array as the facts describe it. Raises ValueError, KeyError or TypeError where it is anything else."""
    h, w = _region(facts).shape
    if not 0 < h <= MOST_PIXELS or not 0 < w <= MOST_PIXELS:
        raise ValueError("region: of no sensor")
    lengths = {"f": len(facts["frequencies_hz"]), "h": h, "w": w, "2": 2, "3": 3}
    shape = tuple(lengths[axis] for axis in AXES.get(name, "hw"))
    dtype = TYPES[facts["types"][name]]
    header = _header(dtype, shape)
    content = _part(archive, file, f"{name}.npy", len(header) + prod(shape) * dtype.itemsize)
    if not content.startswith(header):
        raise ValueError(f"{name}: is another array than the facts say")
    return np.frombuffer(bytearray(content), dtype, offset=len(header)).reshape(shape)


def _region(facts: dict[str, Any]) -> Region:
    """Raises KeyError or TypeError where there is none."""
    return Region(*(index(facts["region"][f.name]) for f in fields(Region)))


def _part(archive: zipfile.ZipFile, file: IO[bytes], name: str, size: int) -> bytes:
    """A part of an archive. Raises ValueError where it is compressed, or not of this size."""
    part = archive.getinfo(name)
    sizes = {part.compress_size, part.file_size, size}
    if part.compress_type != zipfile.ZIP_STORED or len(sizes) > 1 or size > os.fstat(file.fileno()).st_size:
        raise ValueError(f"{name}: is compressed, or of another size than its array")
    return archive.read(part)


def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """What stands before an array in a .npy file."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype.str, "fortran_order": False, "shape": shape})
    return header.getvalue()


def _checksum(facts: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """BLAKE2b over the facts, and over names, shapes and contents of the arrays."""
    state = hashlib.blake2b(json.dumps(facts, sort_keys=True).encode(), digest_size=16)
    for name in sorted(arrays):
        state.update(f"{name}{arrays[name].shape}{arrays[name].dtype}".encode())
        state.update(arrays[name].data)
    return state.hexdigest()
