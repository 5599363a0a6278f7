"""Renders kept by content: the key is everything that can change a number, the file carries its own checksum."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from harness.vocabulary.files import write_bytes
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import digest
from harness.vocabulary.sources import source_digest
from scenes.optics import Optics
from scenes.render.settings import RenderConfig
from scenes.render.view import render_view
from scenes.target.custom import TargetConfig
from scenes.target.mesh import build_target
from scenes.view import NoiseFreeView

CODE = (
    "scenes/render",
    "scenes/target",
    "scenes/optics.py",
    "scenes/field_of_view.py",
    "scenes/view.py",
    "harness/vocabulary",
)
PACKAGES = ("mitsuba", "drjit", "trimesh", "manifold3d", "numba", "numpy", "scipy")
"""What decides a render's numbers beside its declaration. The variant (GPU or processor) is left out: it changes them
by 1e-6."""

ARRAYS = tuple(f.name for f in fields(NoiseFreeView) if f.type == "np.ndarray")


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
    """The view of a declared target, and whether it came from the cache. A damaged file is rendered again.

    Raises UserError as `build_target` and `render_view` do, and where the folder cannot be written.
    """
    path = folder / f"{render_key(target, optics, config)}.npz"
    found = read_view(path)
    if found is not None:
        return found, True
    view = render_view(build_target(target), optics, config)
    write_view(path, view)
    return view, False


def write_view(path: Path, view: NoiseFreeView) -> None:
    """Store a view as .npz, atomically, with a checksum over its arrays."""
    arrays = {name: getattr(view, name) for name in ARRAYS}
    facts = {
        "region": asdict(view.region),
        "frequencies_hz": list(view.frequencies_hz),
        "surface_names": list(view.surface_names),
        "seconds": view.seconds,
        "variant": view.variant,
        "checksum": _checksum(arrays),
    }
    buffer = io.BytesIO()
    np.savez(buffer, facts=np.array(json.dumps(facts)), **arrays)
    write_bytes(path, buffer.getvalue())


def read_view(path: Path) -> NoiseFreeView | None:
    """A stored view, or None where the file is absent, truncated or does not match its checksum."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in ARRAYS}
            facts = json.loads(str(stored["facts"]))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, json.JSONDecodeError):
        return None
    if facts.get("checksum") != _checksum(arrays):
        return None
    return NoiseFreeView(
        region=Region(**facts["region"]),
        frequencies_hz=tuple(facts["frequencies_hz"]),
        surface_names=tuple(facts["surface_names"]),
        seconds=facts["seconds"],
        variant=facts["variant"],
        **arrays,
    )


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    """BLAKE2b over names, shapes and contents."""
    state = hashlib.blake2b(digest_size=16)
    for name in sorted(arrays):
        state.update(f"{name}{arrays[name].shape}{arrays[name].dtype}".encode())
        state.update(np.ascontiguousarray(arrays[name]).tobytes())
    return state.hexdigest()
