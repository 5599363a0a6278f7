"""MATLAB ``.mat`` files: arrays of Location and Color. A saved ``pointCloud`` is an object for MATLAB only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.matlab_elements import LEGAL_MAT, Variable, broken, variables_of
from harness.vocabulary.errors import UserError

EXPORT = "Location = pc.Location; Color = pc.Color; save('cloud.mat','Location','Color','-v7')"
"""The line for MATLAB that turns a point cloud ``pc`` into arrays."""

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def load_mat(path: Path) -> dict[str, np.ndarray]:
    """The numeric arrays of a ``.mat`` file by name; (h, w, 3, k) has its frames moved first.

    Raises UserError for -v7.3 (HDF5), for objects such as ``pointCloud``, and for a broken file.
    """
    _refuse_hdf5(path)
    stat = path.stat()
    variables = variables_of(path, stat.st_size, stat.st_mtime_ns)
    loaded = _loaded(path, [one.name for one in variables if one.is_numeric])
    arrays = {name: _frames_first(value) for name, value in loaded.items() if _is_numeric(value)}
    if not arrays:
        _refuse_objects(path, variables)
        raise UserError(f"{path}: holds no numeric array", legal=LEGAL_MAT, fix=f"in MATLAB: {EXPORT}")
    return arrays


def _refuse_hdf5(path: Path) -> None:
    with path.open("rb") as file:
        head = file.read(520)
    if HDF5_SIGNATURE in (head[:8], head[512:520]) or b"MATLAB 7.3" in head[:116]:
        raise UserError(
            f"{path}: is a -v7.3 file (HDF5)",
            legal=LEGAL_MAT,
            fix="save it with '-v7' in place of '-v7.3', for a cloud: " + EXPORT,
        )


def _loaded(path: Path, names: list[str]) -> dict[str, Any]:
    """The named variables; others (cells and structs, which nest) are left unread."""
    import scipy.io

    if not names:
        return {}
    try:
        return scipy.io.loadmat(str(path), squeeze_me=False, variable_names=names)
    except MemoryError as error:
        raise broken(path, "there is not memory enough for what it states") from error
    except Exception as error:  # a cut or foreign file fails anywhere in scipy's parser, with any type
        raise broken(path, f"{type(error).__name__}: {error}") from error


def _refuse_objects(path: Path, variables: tuple[Variable, ...]) -> None:
    opaque = next((one for one in variables if one.object_of), None)
    if opaque is not None:
        raise UserError(
            f"{path}: the variable {opaque.name} is a MATLAB object ({opaque.object_of}), which cannot be read outside"
            " MATLAB",
            legal=LEGAL_MAT,
            fix=f"in MATLAB, with the cloud named pc: {EXPORT}",
        )


def _is_numeric(value: Any) -> bool:
    # MATLAB's scalars are 1 x 1 arrays; text, cells, structs and objects have other kinds.
    return isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size > 1


def _frames_first(value: np.ndarray) -> np.ndarray:
    """(h, w, 3, k), MATLAB's habit of stacking along the last axis, as (k, h, w, 3)."""
    return np.moveaxis(value, -1, 0) if value.ndim == 4 and value.shape[2] == 3 and value.shape[3] != 3 else value
