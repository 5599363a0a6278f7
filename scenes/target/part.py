"""Parts from mesh files as targets: a file is read, repaired or refused, and its front becomes a
height field.

The part's frame is the board's: its ``front`` axis is z, x and y are centred on its bounds, and z
= 0 is its foremost point. The front is the surface seen along z; damage lies there. Its heights
are sampled on a grid of `NODES` along the longer side, and interpolated bilinearly.

Not checked: neighbouring triangles that fold onto each other. Not modelled: steps of the front
within a step of the grid; pressed dents and chips, which need a sheet's back or a declared edge.
"""

from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numba
import numpy as np
from pydantic import Field
from scipy.ndimage import map_coordinates

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import file_digest
from harness.vocabulary.geometry import MM
from harness.vocabulary.meshes import FileUnit, FrontAxis, front_first, read_mesh
from scenes.target import custom

NODES = 1000


class MeshTargetConfig(custom.SetUpConfig):
    """A part from a mesh file, with damage at the declared places of its front."""

    name: Literal["mesh"]
    file: Annotated[
        str,
        Field(
            min_length=1,
            max_length=1000,
            description="a .stl, .ply, .obj or .glb file",
        ),
    ]
    unit: FileUnit = "mm"
    front: FrontAxis = "+z"
    material: custom.MaterialConfig = custom.MaterialConfig(grain_contrast=0.0)

    def declare(self) -> custom.TargetConfig:
        """Return the full declaration. Raises UserError if the file cannot be used."""
        shape = custom.MeshConfig(
            kind="mesh",
            file=self.file,
            unit=self.unit,
            front=self.front,
        )
        sizes = np.round(np.ptp(part_of(shape)[0], axis=0), 9) / MM
        width_mm, height_mm, thickness_mm = sizes.tolist()
        board = custom.BoardConfig(
            width_mm=width_mm,
            height_mm=height_mm,
            thickness_mm=thickness_mm,
            shape=shape,
        )
        return custom.TargetConfig(
            board=board,
            flaws=self.flaws,
            material=self.material,
            backing=self.backing,
            room=self.room,
            pose=self.pose,
            other_wavelengths=self.other_wavelengths,
        )


@lru_cache(maxsize=8)
def part_of(shape: custom.MeshConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) and outward triangles (m, 3) of a closed part, board frame, metres.
    Equal vertices are joined, flat and doubled triangles left out, and a part that is inside out
    is turned. Raises UserError, with the place, for a part that is open, not manifold, not
    oriented, crosses itself or is not a mesh."""
    mesh = read_mesh(shape.file)
    if shape.content and file_digest(Path(shape.file)) != shape.content:
        raise UserError(f"{shape.file}: has changed since the experiment was declared")

    def refuse(
        wrong: np.ndarray,
        what: str,
        fix: str,
    ) -> None:
        if len(wrong):
            first = mesh.vertices[wrong[0]].mean(axis=0)
            position = ", ".join(f"{value:.4g}" for value in first)
            raise UserError(
                f"{shape.file}: {what}: {len(wrong)}, "
                f"the first at ({position}) {shape.unit} of the file",
                legal="a closed surface",
                fix=f"{fix} in a mesh editor, such as MeshLab",
            )

    edges, counts = np.unique(
        mesh.edges_sorted,
        axis=0,
        return_counts=True,
    )
    refuse(edges[counts > 2], "edges that three faces or more share", "split them")
    refuse(edges[counts == 1], "open edges", "close them")
    if not len(mesh.faces):
        raise UserError(
            f"{shape.file}: is not a mesh: it holds no triangles", legal="a closed surface"
        )
    if not mesh.is_winding_consistent:
        raise UserError(
            f"{shape.file}: neighbouring triangles face opposite sides",
            fix="orient its faces in a mesh editor, "
            "such as MeshLab (Re-Orient All Faces Coherently)",
        )
    crossed = mesh.faces[crossing(mesh.triangles)]
    refuse(crossed, "triangles that cross others", "unite its overlapping shells")
    if mesh.volume < 0:
        mesh.invert()
    points = front_first(mesh, shape.unit, shape.front)
    low = points.min(axis=0)
    high = points.max(axis=0)
    middle = (low[:2] + high[:2]) / 2
    return points - np.append(middle, high[2]), np.asarray(mesh.faces, np.int64)


def crossing(corners: np.ndarray) -> np.ndarray:
    """Return the indices of the triangles (n, 3, 3) that cross another with which they share no
    corner; touching is not crossing. A sweep in strips along x compares only triangles whose
    extents overlap."""
    low = corners.min(axis=1)
    high = corners.max(axis=1)
    lowest = low[:, 1].min()
    strip_count = max(1, int(np.sqrt(len(corners)) / 8))
    strip_m = max(float(np.ptp(corners[..., 1])) / strip_count, 1e-12)
    # each triangle stands once in every strip that it meets
    first_strip = ((low[:, 1] - lowest) / strip_m).astype(np.int64)
    last_strip = ((high[:, 1] - lowest) / strip_m).astype(np.int64)
    counts = last_strip - first_strip + 1
    triangle = np.repeat(np.arange(len(corners)), counts)
    begins = np.repeat(np.cumsum(counts) - counts, counts)
    strips = first_strip[triangle] + np.arange(len(triangle)) - begins
    order = np.lexsort((low[triangle, 0], strips))
    triangle = triangle[order]
    crosses = np.zeros(len(triangle), bool)
    _sweep(corners[triangle], low[triangle], high[triangle], strips[order], crosses)
    return np.unique(triangle[crosses])


@numba.njit(cache=True, nogil=True)
def _sweep(
    corners: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    strips: np.ndarray,
    crosses: np.ndarray,
) -> None:
    """Mark in ``crosses`` (n,) the triangles that cross another of their strip; sorted by strip,
    then by their least x."""
    for i in range(len(corners)):
        for j in range(i + 1, len(corners)):
            if strips[j] != strips[i] or low[j, 0] > high[i, 0]:
                break
            if low[j, 1] > high[i, 1] or low[i, 1] > high[j, 1]:
                continue
            if low[j, 2] > high[i, 2] or low[i, 2] > high[j, 2]:
                continue
            joined = False
            for a in range(3):
                for b in range(3):
                    joined |= (corners[i, a] == corners[j, b]).all()
            if joined:
                continue
            if _pierces(corners[i], corners[j]) or _pierces(corners[j], corners[i]):
                crosses[i] = True
                crosses[j] = True


@numba.njit(cache=True, nogil=True)
def _pierces(edged: np.ndarray, triangle: np.ndarray) -> bool:
    """Return whether an edge of one triangle passes through the inside of another."""
    a = triangle[0]
    b = triangle[1]
    c = triangle[2]
    for k in range(3):
        p = edged[k]
        q = edged[(k + 1) % 3]
        if _volume(a, b, c, p) * _volume(a, b, c, q) < 0.0:
            first = _volume(p, q, a, b)
            second = _volume(p, q, b, c)
            third = _volume(p, q, c, a)
            if first > 0.0 and second > 0.0 and third > 0.0:
                return True
            if first < 0.0 and second < 0.0 and third < 0.0:
                return True
    return False


@numba.njit(cache=True, nogil=True)
def _volume(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    d: np.ndarray,
) -> float:
    """Return six times the signed volume of a tetrahedron."""
    u = b - a
    v = c - a
    w = d - a
    x = u[1] * v[2] - u[2] * v[1]
    y = u[2] * v[0] - u[0] * v[2]
    z = u[0] * v[1] - u[1] * v[0]
    return float(x * w[0] + y * w[1] + z * w[2])


@lru_cache(maxsize=8)
def front_of(shape: custom.MeshConfig) -> tuple[np.ndarray, float]:
    """Return the front's heights and slopes (3, rows, columns) about the origin, NaN beside it,
    and their spacing."""
    vertices, faces = part_of(shape)
    half = np.abs(vertices[:, :2]).max(axis=0)
    step_m = 2 * float(half.max()) / NODES
    columns = 2 * int(np.ceil(half[0] / step_m)) + 3
    rows = 2 * int(np.ceil(half[1] / step_m)) + 3
    heights = np.full((rows, columns), -np.inf)
    _raise_to_triangles(heights, vertices[faces], step_m)
    heights[np.isinf(heights)] = np.nan
    slope_y, slope_x = np.gradient(heights, step_m)
    return np.stack([heights, slope_x, slope_y]), step_m


def front_derivatives(
    shape: custom.MeshConfig,
    x_m: np.ndarray,
    y_m: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Return z, its slopes and its second derivatives (taken as 0) of a part's front; NaN beyond
    it."""
    images, step_m = front_of(shape)
    rows, columns = images.shape[1:]
    nodes = [np.ravel(y_m) / step_m + rows // 2, np.ravel(x_m) / step_m + columns // 2]
    derivatives = []
    for image in images:
        values = map_coordinates(
            image,
            nodes,
            order=1,
            cval=np.nan,
        )
        derivatives.append(values.reshape(x_m.shape))
    none = np.zeros(x_m.shape)
    return (*derivatives, none, none, none)


@numba.njit(cache=True, nogil=True)
def _raise_to_triangles(
    heights: np.ndarray,
    corners: np.ndarray,
    step: float,
) -> None:
    """Raise each node (rows, columns) to the highest of the triangles (n, 3, 3) above it."""
    rows, columns = heights.shape
    for n in range(len(corners)):
        a = corners[n, 0]
        b = corners[n, 1]
        c = corners[n, 2]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area <= 0.0:  # seen from behind or edge-on
            continue
        left = min(a[0], b[0], c[0]) / step + columns // 2
        right = max(a[0], b[0], c[0]) / step + columns // 2
        low = min(a[1], b[1], c[1]) / step + rows // 2
        high = max(a[1], b[1], c[1]) / step + rows // 2
        first_row = max(int(np.ceil(low)), 0)
        last_row = min(int(np.floor(high)), rows - 1)
        first_column = max(int(np.ceil(left)), 0)
        last_column = min(int(np.floor(right)), columns - 1)
        for row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                x = (column - columns // 2) * step
                y = (row - rows // 2) * step
                u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
                v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
                if u >= -1e-9 and v >= -1e-9 and u + v <= 1 + 1e-9:
                    z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2])
                    heights[row, column] = max(heights[row, column], z)
