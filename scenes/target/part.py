"""Parts from mesh files as targets: read, repaired or refused, and their front as a height field.

The part's frame is the board's: its ``front`` axis is z, towards the camera, x and y are centred on its bounds, and
z = 0 is its foremost point. The front is what is seen along z; damage lies there. Its heights are read off the
triangles on a grid of `NODES` along the longer side, between which they are bilinear.

Not checked: surfaces that cross themselves. Not modelled: steps of the front within a step of the grid; pressed dents
and chips, which need a sheet's back or a declared edge."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numba
import numpy as np
from pydantic import Field
from scipy.ndimage import map_coordinates

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import file_digest
from harness.vocabulary.geometry import MM
from harness.vocabulary.meshes import FileUnit, FrontAxis, front_first, read_mesh
from scenes.target import custom

NODES = 1000


class MeshTargetConfig(Config):
    """A part from a mesh file, with damage at stated places of its front; the rest as in a whole declaration."""

    name: Literal["mesh"]
    file: Annotated[str, Field(min_length=1, max_length=1000, description=".stl, .ply, .obj or .glb")]
    unit: FileUnit = "mm"
    front: FrontAxis = "+z"
    flaws: Annotated[tuple[custom.AnyFlawConfig, ...], Field(max_length=500)] = ()
    material: custom.MaterialConfig = custom.MaterialConfig(grain_contrast=0.0)
    backing: custom.BackingConfig | None = None
    room: custom.RoomConfig | None = None
    pose: custom.PoseConfig = custom.PoseConfig()
    other_wavelengths: Annotated[tuple[custom.WavelengthConfig, ...], Field(max_length=20)] = ()

    def declare(self) -> custom.TargetConfig:
        """Return the full declaration. Raises UserError where the file cannot be used."""
        shape = custom.MeshConfig(kind="mesh", file=self.file, unit=self.unit, front=self.front)
        sizes = np.round(np.ptp(part_of(shape)[0], axis=0), 9) / MM
        board = dict(zip(("width_mm", "height_mm", "thickness_mm"), sizes.tolist(), strict=True))
        kept: dict[str, Any] = {key: getattr(self, key) for key in type(self).model_fields if key not in OF_MESH}
        return custom.TargetConfig(board=custom.BoardConfig(**board, shape=shape), **kept)


OF_MESH = ("name", "file", "unit", "front")


@lru_cache(maxsize=8)
def part_of(shape: custom.MeshConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and outward triangles (m, 3) of a closed part, board frame, metres. Equal vertices are
    joined, flat and doubled triangles left out, and a part that is inside out is turned. Raises UserError, with the
    place, for what is open, not manifold, not oriented or no mesh."""
    mesh = read_mesh(shape.file)
    if shape.content and file_digest(Path(shape.file)) != shape.content:
        raise UserError(f"{shape.file}: has changed since the experiment was declared")
    for count, what, fix in ((1, "open", "close its holes"), (3, "shared by three faces or more", "split them")):
        edges, index = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        wrong = edges[index == 1] if count == 1 else edges[index >= count]
        if len(wrong) or not len(mesh.faces):
            place = (
                ", ".join(f"{each:.4g}" for each in mesh.vertices[wrong].mean(axis=(0, 1))) if len(wrong) else "none"
            )
            where = f"{len(wrong)} edges of {shape.file} are {what}, about ({place}) {shape.unit} of the file"
            raise UserError(where, legal="a closed surface", fix=f"{fix} in a mesh editor, such as MeshLab")
    if not mesh.is_winding_consistent:
        said = f"{shape.file}: neighbouring triangles face in and out"
        raise UserError(said, fix="orient its faces in a mesh editor, such as MeshLab (Re-Orient All Faces Coherently)")
    if mesh.volume < 0:
        mesh.invert()
    points = front_first(mesh, shape.unit, shape.front)
    low, high = points.min(axis=0), points.max(axis=0)
    return points - [*(low[:2] + high[:2]) / 2, high[2]], np.asarray(mesh.faces, np.int64)


@lru_cache(maxsize=8)
def front_of(shape: custom.MeshConfig) -> tuple[np.ndarray, float]:
    """Return the front's heights and slopes (3, rows, columns) on a grid about the origin, NaN where the part is not,
    and the grid's spacing in metres."""
    vertices, faces = part_of(shape)
    half = np.abs(vertices[:, :2]).max(axis=0)
    step_m = 2 * float(half.max()) / NODES
    counts = [2 * int(np.ceil(each / step_m)) + 3 for each in half]
    heights = np.full((counts[1], counts[0]), -np.inf)
    _raise_to_triangles(heights, vertices[faces], step_m)
    heights[np.isinf(heights)] = np.nan
    slope_y, slope_x = np.gradient(heights, step_m)
    return np.stack([heights, slope_x, slope_y]), step_m


def front_derivatives(shape: custom.MeshConfig, x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return z, its slopes and its bends, taken as 0, of a part's front; NaN beyond it."""
    images, step_m = front_of(shape)
    rows, columns = images.shape[1:]
    places = [np.ravel(y_m) / step_m + rows // 2, np.ravel(x_m) / step_m + columns // 2]
    found = [map_coordinates(image, places, order=1, cval=np.nan).reshape(x_m.shape) for image in images]
    return (*found, *(np.zeros(x_m.shape) for _ in range(3)))


@numba.njit(cache=True, nogil=True)
def _raise_to_triangles(heights: np.ndarray, corners: np.ndarray, step: float) -> None:
    """Raise each node (rows, columns) to the highest of the triangles (n, 3, 3) above it."""
    rows, columns = heights.shape
    for n in range(len(corners)):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area <= 0.0:  # seen from behind or edge-on
            continue
        left, right = min(a[0], b[0], c[0]) / step + columns // 2, max(a[0], b[0], c[0]) / step + columns // 2
        low, high = min(a[1], b[1], c[1]) / step + rows // 2, max(a[1], b[1], c[1]) / step + rows // 2
        for i in range(max(int(np.ceil(low)), 0), min(int(np.floor(high)), rows - 1) + 1):
            for j in range(max(int(np.ceil(left)), 0), min(int(np.floor(right)), columns - 1) + 1):
                x, y = (j - columns // 2) * step, (i - rows // 2) * step
                u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
                v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
                if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                    z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
                    heights[i, j] = max(heights[i, j], z)
