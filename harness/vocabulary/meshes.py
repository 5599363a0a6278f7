"""Reads meshes of parts from files of limited size, in metres and with the front facing the
camera."""

import io
import logging
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import Field

from harness.vocabulary import lengths
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import bounded_bytes, limited_memory

MOST_BYTES = 1 << 29
LARGEST = 1e9
"""Largest coordinate, in any unit."""
FILES = ".stl, .ply, .obj or .glb"
FrontAxis = Annotated[
    Literal["+x", "-x", "+y", "-y", "+z", "-z"],
    Field(description="the file's axis that points at the camera"),
]
FileUnit = Literal["mm", "cm", "m", "in"]
UNITS_M = {unit: lengths.UNITS_M[unit] for unit in get_args(FileUnit)}
FRONTS = {
    "+x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "+y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "+z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
}
"""Rows: the part's x, y and z in the file's axes."""


def read_mesh(file: str) -> Any:
    """Return a file's triangles as a `trimesh.Trimesh`, without degenerate or duplicate triangles.
    Raises UserError."""
    import trimesh

    path = Path(file)
    if path.suffix.lower() in (".step", ".stp", ".iges", ".igs"):
        fix = (
            "convert it to triangles, for instance in FreeCAD: Mesh, Create mesh from shape, "
            "export as .stl"
        )
        raise UserError(f"{file}: holds CAD surfaces, not triangles", legal=FILES, fix=fix)
    try:
        content = bounded_bytes(path, MOST_BYTES)
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    kind = path.suffix.lower().removeprefix(".")
    # without a handler, the library prints the tracebacks of its own attempts
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    try:
        with limited_memory():
            mesh: Any = trimesh.load(io.BytesIO(content), file_type=kind, force="mesh")
            corners = np.asarray(mesh.vertices, float).reshape(-1, 3)
            faces = np.asarray(mesh.faces).reshape(-1, 3)
    except Exception as error:  # the library raises errors of any kind on a damaged file
        reason = str(error)[:200] or type(error).__name__
        raise UserError(f"{file}: is not a readable mesh ({reason})", legal=FILES) from error
    _refuse_odd(file, corners, faces)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return mesh


def _refuse_odd(file: str, corners: np.ndarray, faces: np.ndarray) -> None:
    """Raise UserError if faces (m, 3) are not of these corners (n, 3), or corners have no place."""
    fix = "export it again"
    if not len(faces):
        raise UserError(f"{file}: holds no triangles", legal=FILES, fix=fix)
    if faces.min() < 0 or faces.max() >= len(corners):
        problem = f"{file}: its triangles name corner {faces.max()} of {len(corners)}"
        raise UserError(problem, legal=f"corners from 0 to {len(corners) - 1}", fix=fix)
    used = corners[np.unique(faces)]
    if not (np.abs(used) < LARGEST).all():
        problem = f"{file}: a corner of its triangles is not a place"
        raise UserError(problem, legal=f"coordinates within {LARGEST:g}", fix=fix)


def front_first(mesh: Any, unit: str, front: str) -> np.ndarray:
    """Return a mesh's vertices (n, 3) in metres, with z along its front axis and y as close to
    upright as possible."""
    return np.asarray(
        np.asarray(mesh.vertices, float) @ np.array(FRONTS[front], float).T * UNITS_M[unit]
    )
