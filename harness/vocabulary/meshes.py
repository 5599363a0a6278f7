"""Reads meshes of parts from files of limited size, in metres and with the front facing the
camera."""

import io
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import bounded_bytes, limited_memory

MOST_BYTES = 1 << 29
FILES = ".stl, .ply, .obj or .glb"
FrontAxis = Annotated[
    Literal["+x", "-x", "+y", "-y", "+z", "-z"],
    Field(description="the file's axis that points at the camera"),
]
FileUnit = Literal["mm", "cm", "m", "in"]
UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
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
        with limited_memory():
            mesh: Any = trimesh.load(
                io.BytesIO(content), file_type=path.suffix.lower().removeprefix("."), force="mesh"
            )
    except OSError as error:
        raise UserError(f"{file}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, IndexError, TypeError, NotImplementedError) as error:
        raise UserError(f"{file}: is not a readable mesh ({error})", legal=FILES) from error
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces() & mesh.unique_faces())
    return mesh


def front_first(mesh: Any, unit: str, front: str) -> np.ndarray:
    """Return a mesh's vertices (n, 3) in metres, with z along its front axis and y as close to
    upright as possible."""
    return np.asarray(
        np.asarray(mesh.vertices, float) @ np.array(FRONTS[front], float).T * UNITS_M[unit]
    )
