"""MATLAB ``.mat`` files: arrays of Location and Color. A saved ``pointCloud`` is an object for MATLAB only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.arrays import Stack, named_stack
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens

EXPORT = "Location = pc.Location; Color = pc.Color; save('cloud.mat','Location','Color','-v7')"
"""The line for MATLAB that turns a point cloud ``pc`` into arrays."""

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
LEGAL_MAT = "MATLAB 5 to 7 files (-v6, -v7) of numeric arrays: Location (h, w, 3), (n, 3) or (k, n, 3), and Color"


def load_mat(path: Path, lens: Lens | None) -> Stack:
    """The arrays of a ``.mat`` file as `named_stack` takes them; (h, w, 3, k) has its frames moved first.

    Raises UserError for -v7.3 (HDF5), for objects such as ``pointCloud``, and for a broken file.
    """
    _refuse_hdf5(path)
    variables = _loaded(path)
    _refuse_objects(path, variables)
    arrays = {name: _frames_first(value) for name, value in variables.items() if _is_numeric(value)}
    if not arrays:
        raise UserError(f"{path}: holds no numeric array", legal=LEGAL_MAT, fix=f"in MATLAB: {EXPORT}")
    return named_stack(str(path), arrays, lens)


def _refuse_hdf5(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(520)
    if HDF5_SIGNATURE in (head[:8], head[512:520]) or b"MATLAB 7.3" in head[:116]:
        raise UserError(
            f"{path}: is a -v7.3 file (HDF5)",
            legal=LEGAL_MAT,
            fix="save it with '-v7' in place of '-v7.3', for a cloud: " + EXPORT,
        )


def _loaded(path: Path) -> dict[str, Any]:
    import scipy.io

    try:
        return scipy.io.loadmat(str(path), squeeze_me=False)
    except MemoryError:
        raise
    except Exception as error:  # a cut or foreign file fails anywhere in scipy's parser, with any type
        raise UserError(
            f"{path}: cannot be read as a MATLAB file ({type(error).__name__}: {error})",
            legal=LEGAL_MAT,
            fix="save it again with '-v7', or copy it again if it was cut off",
        ) from error


def _refuse_objects(path: Path, variables: dict[str, Any]) -> None:
    from scipy.io.matlab import MatlabOpaque

    named = {name: value for name, value in variables.items() if not name.startswith("__")}
    if any(_is_numeric(value) for value in named.values()):
        return
    opaque = next((value for value in named.values() if isinstance(value, MatlabOpaque)), None)
    if opaque is not None:
        name, _, kind = (bytes(opaque[0][field]).decode() for field in ("s0", "s1", "s2"))
        raise UserError(
            f"{path}: the variable {name} is a MATLAB object ({kind}), which cannot be read outside MATLAB",
            legal=LEGAL_MAT,
            fix=f"in MATLAB, with the cloud named pc: {EXPORT}",
        )


def _is_numeric(value: Any) -> bool:
    # MATLAB's scalars are 1 x 1 arrays; text, cells, structs and objects have other kinds.
    return isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size > 1


def _frames_first(value: np.ndarray) -> np.ndarray:
    """(h, w, 3, k), MATLAB's habit of stacking along the last axis, as (k, h, w, 3)."""
    return np.moveaxis(value, -1, 0) if value.ndim == 4 and value.shape[2] == 3 and value.shape[3] != 3 else value
