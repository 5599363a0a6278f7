"""Built targets, a renderer's input: parts with meshes and reflectances, and the truth; as PLY,
GLB and JSON files.

A texture is (rows, columns[, channels]); u = x / width + 1/2 runs with the columns from the left
(-x), v = 1/2 - y / height runs with the rows from the top (+y): row 0 begins at v = 0. The centre
of texel (row, column) is at u = (column + 1/2) / columns, v = (row + 1/2) / rows; between centres
bilinear, beyond the outermost constant."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from scipy.ndimage import map_coordinates, zoom
from scipy.optimize import brentq

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import bounded_bytes, write_bytes, write_json
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.seeds import random_stream
from scenes.target.checks import check_target
from scenes.target.custom import DentConfig, HoleConfig, MaterialConfig, MeshConfig, TargetConfig
from scenes.target.flaws import FlawConfig, RoundConfig, closed_grid, turned
from scenes.target.part import part_of
from scenes.target.truth import (
    Damage,
    Face,
    face_of,
    outline_board_m,
    planes_of,
    relief_points,
    truth_of,
)

TEXEL_MM = (
    0.6  # finer than a pixel's footprint (1.4 mm at 0.7 m for the finest camera), made in 40 ms
)
MAX_TEXELS = 4096  # along a side: a board of metres gets coarser texels instead of gigabytes
MOST_IMAGE_BYTES = 1 << 28
# of growth lines and fibres in the pattern: guesses, as are the lengths below
LINE_WEIGHT = 0.8
FIBRE_WEIGHT = 0.6
# of growth lines: deviation, lengths across, along x
WANDER_MM = 6.0
WANDER_ACROSS_MM = 60.0
WANDER_ALONG_MM = 240.0
FIBRE_MM = 0.5, 12.0  # correlation lengths of the fibres across and along x


def grain(material: MaterialConfig, width_mm: float, height_mm: float) -> np.ndarray:
    """Return a board's grain: (rows, columns) float64, mean 0, deviation 1. Not modelled: knots,
    seams."""
    texel_mm = max(TEXEL_MM, width_mm / MAX_TEXELS, height_mm / MAX_TEXELS)
    shape = tuple(max(2, round(size / texel_mm)) for size in (height_mm, width_mm))
    stream = random_stream(material.grain_seed, "grain")
    # coarse noise through a cubic spline
    knots = [
        2 + round(n * texel_mm / s)
        for n, s in zip(shape, (WANDER_ACROSS_MM, WANDER_ALONG_MM), strict=True)
    ]
    coarse = stream.standard_normal(knots)
    finer = [n / k for n, k in zip(shape, knots, strict=True)]
    # along each axis in turn, by the spline's weights of the knots: zooming the array itself takes
    # five times as long
    down, across = (
        zoom(np.eye(k), (s, 1), order=3, mode="nearest") for k, s in zip(knots, finer, strict=True)
    )
    wander = _normalised(down @ coarse @ across.T)
    across_mm = (np.arange(shape[0])[:, None] + 0.5) * texel_mm + WANDER_MM * wander
    turns = across_mm / material.grain_period_mm + stream.uniform()
    # late wood: a thin dark line at the end of each ring, after a slow fall
    rise = turns % 1.0
    lines = _normalised(-rise * rise * rise)
    noise = stream.standard_normal(shape, dtype=np.float32)
    across, along = (
        cv2.getGaussianKernel(2 * int(3 * s + 0.5) + 1, s) for s in np.divide(FIBRE_MM, texel_mm)
    )
    fibres = cv2.sepFilter2D(noise, -1, along, across, borderType=cv2.BORDER_REFLECT)
    return _normalised(LINE_WEIGHT * lines + FIBRE_WEIGHT * _normalised(fibres))


def reflectance(pattern: np.ndarray, mean: float, contrast: float) -> np.ndarray:
    """Return albedo (rows, columns) float32 with exactly this mean: mean (1 + contrast pattern),
    clipped to 0..1. Where clipping would move the mean, the pattern is lifted to bring it back;
    the contrast then falls short."""
    raw = mean * (1 + contrast * pattern)
    lift = 0.0
    if raw.min() < 0.0 or raw.max() > 1.0:
        lift = float(
            brentq(
                lambda up: float(np.clip(raw + up, 0.0, 1.0).mean()) - mean, -2.0, 2.0, xtol=1e-9
            )
        )
    return np.clip(raw + lift, 0.0, 1.0).astype(np.float32)


def image_pattern(file: str) -> np.ndarray:
    """Return an image's brightness in linear light over its mean, less 1: (rows, columns),
    `MAX_TEXELS` at most."""
    try:
        image = cv2.imdecode(
            np.frombuffer(bounded_bytes(Path(file), MOST_IMAGE_BYTES), np.uint8),
            cv2.IMREAD_ANYDEPTH,
        )
    except (OSError, cv2.error) as error:
        raise UserError(f"target.material.texture: {file} cannot be read ({error})") from error
    if image is None or image.dtype.kind != "u" or min(image.shape) < 2 or not image.any():
        what = f"target.material.texture: {file} is not a readable image, or it is black"
        raise UserError(what, legal="a PNG, JPEG or TIFF image of 8 or 16 bits")
    encoded = image / (2.0 ** (8 * image.itemsize) - 1)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    fewer = min(1.0, MAX_TEXELS / max(linear.shape))
    linear = (
        cv2.resize(linear, None, fx=fewer, fy=fewer, interpolation=cv2.INTER_AREA)
        if fewer < 1
        else linear
    )
    return np.asarray(linear / linear.mean() - 1)


def look_up(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return bilinear values (...[, channels]) of a texture (rows, columns[, channels]) at ``uv``
    (..., 2)."""
    rows, columns = texture.shape[:2]
    places = np.stack([uv[..., 1] * rows - 0.5, uv[..., 0] * columns - 0.5])
    channels = texture.reshape(rows, columns, -1)
    values = [
        map_coordinates(channels[..., i], places, order=1, mode="nearest")
        for i in range(channels.shape[2])
    ]
    return np.stack(values, axis=-1) if texture.ndim == 3 else values[0]


def _normalised(values: np.ndarray) -> np.ndarray:
    centred = np.asarray(values, float) - np.mean(values, dtype=float)
    return centred / max(float(centred.std()), 1e-12)


# of facets on a bent face; under shallow dents depth / 400
COARSEST_SAGITTA_M = 2e-6
FINEST_SAGITTA_M = 0.1e-6
ROUGH_SAGITTA_M = 8e-5  # the same at the sharpest crest of a rough face; elsewhere a tenth of it
TAPE_SINK_M = 0.1e-3  # depth of a strip's underside in the board, so that no two surfaces coincide
# by which corners of a circle's polygon, of the same area, may stand out: 28 for 2 mm, 104 for 1
# in
CORNER_M = 4e-6
RINGS = 48  # steps of a dent's profile from pole to rim: volume short by 1 / (3 RINGS^2) = 0.014 %
CELL_M = 0.03
MOST_ALONG = 64
"""Longest edge of a damaged board's triangles, and the largest number of these along a side;
beyond it, edges are longer. Longer edges slow rays down, and a renderer in float32 misses their
plane, by 0.1 mm at 1 m."""
SPARE_M = 0.2 * MM  # least distance by which a cutter reaches beyond the face
MAX_CELLS = 1_000_000  # of a bent sheet: some 300 MB


@dataclass(frozen=True)
class TargetPart:
    """A surface. ``mesh``: camera frame, metres, normals outwards; sharp edges share vertices, so
    use face normals. ``albedo_850`` and ``rgb`` (3,) are the means of ``texture_850`` (h, w) and
    ``texture_rgb`` (h, w, 3), float32 linear reflectances, placed by ``uv`` (n_vertices, 2) in
    0..1 (see the module); all None if the part is plain. ``gloss``: share and exponent of its
    Phong lobe (`scenes.target.custom.GlossConfig`)."""

    name: str
    mesh: trimesh.Trimesh
    albedo_850: float
    rgb: np.ndarray
    uv: np.ndarray | None = None
    texture_850: np.ndarray | None = None
    texture_rgb: np.ndarray | None = None
    gloss: tuple[float, float] = (0.0, 1.0)

    def rgb_at(self, uv: np.ndarray) -> np.ndarray:
        """Return red, green and blue albedo (..., 3) at ``uv`` (..., 2); the mean where the part
        is plain."""
        if self.texture_rgb is None:
            return np.broadcast_to(self.rgb.astype(np.float32), (*uv.shape[:-1], 3))
        return look_up(self.texture_rgb, uv)


@dataclass(frozen=True)
class Target:
    """A built target. ``parts``: "board", then "tape_1".., "backing", "floor", "back_wall" as
    declared. ``truth``: all damage in its order. ``outline_board_m`` (n, 3): the face's rim,
    counter-clockwise seen from the camera."""

    config: TargetConfig
    parts: tuple[TargetPart, ...]
    truth: tuple[Damage, ...]
    T_camera_board: np.ndarray
    outline_board_m: np.ndarray


def build_target(config: TargetConfig) -> Target:
    """Build a declaration. Raises UserError that names every part that does not fit
    (`scenes.target.checks`)."""
    check_target(config)
    T_camera_board = config.pose.T_camera_board
    board = config.board
    material = config.material
    truth = truth_of(config, T_camera_board)
    sagitta_m = _sagitta_m(config)
    mesh = board_solid(config, truth)
    plan = mesh.vertices[:, :2] / (board.width_mm * MM, board.height_mm * MM)
    mesh.apply_transform(T_camera_board)
    uv = texture_850 = texture_rgb = None
    if (image := material.texture) is not None or material.grain_contrast != 0:
        uv = np.clip(np.column_stack([0.5 + plan[:, 0], 0.5 - plan[:, 1]]), 0.0, 1.0)
        pattern = (
            grain(material, board.width_mm, board.height_mm)
            if image is None
            else image_pattern(image.file)
        )
        contrast = material.grain_contrast if image is None else 1.0
        texture_850 = reflectance(pattern, material.albedo_850, contrast)
        texture_rgb = np.stack(
            [reflectance(pattern, mean, contrast) for mean in material.rgb], axis=-1
        )
    own = material.albedo_850, np.array(material.rgb), uv, texture_850, texture_rgb
    gloss = (material.gloss.share, material.gloss.exponent) if material.gloss else (0.0, 1.0)
    parts = [TargetPart("board", mesh, *own, gloss)]
    for number, tape in enumerate(config.tapes, start=1):
        (width, height), (x, y), top_m = tape.size_mm, tape.centre_mm, tape.thickness_mm * MM
        size_m = (width * MM, height * MM)
        at = ((x * MM, y * MM), float(np.deg2rad(tape.angle_deg)))
        strip = sheet(face_of(board), size_m, top_m, -TAPE_SINK_M, sagitta_m, *at)
        strip.apply_transform(T_camera_board)
        parts.append(TargetPart(f"tape_{number}", strip, tape.albedo_850, np.array(tape.rgb)))
    for name, corners, albedo_850, rgb in planes_of(config):
        plane = trimesh.Trimesh(vertices=corners, faces=[(0, 1, 2), (0, 2, 3)], process=False)
        parts.append(TargetPart(name, plane, albedo_850, np.array(rgb)))
    return Target(config, tuple(parts), truth, T_camera_board, outline_board_m(board))


def board_solid(config: TargetConfig, truth: tuple[Damage, ...]) -> trimesh.Trimesh:
    """Return the board without its damage, watertight, board frame."""
    size_m = (config.board.width_mm * MM, config.board.height_mm * MM)
    thickness_m = config.board.thickness_mm * MM
    face = face_of(config.board)
    added: list[trimesh.Trimesh] = []
    cutters: list[trimesh.Trimesh] = []
    if isinstance(config.board.shape, MeshConfig):
        body = trimesh.Trimesh(*part_of(config.board.shape), process=False)
    else:
        body = sheet(face, size_m, 0.0, -thickness_m, _sagitta_m(config), flat_back=face.rough)
    for damage, item in zip(truth, config.damages, strict=True):
        if isinstance(item, FlawConfig):
            more, less = solids_of(item, face, thickness_m)
            added = added + more
            cutters = cutters + less
        else:
            cutters.append(cutter(damage, item))
    return subtract(body, cutters, added) if truth else body


def _sagitta_m(config: TargetConfig) -> float:
    if face_of(config.board).rough:
        return ROUGH_SAGITTA_M
    depths_m = [
        bowl.depth_mm * MM for bowl in (*config.dents, *config.flaws) if bowl.depth_mm is not None
    ]
    return float(np.clip(min(depths_m, default=np.inf) / 400, FINEST_SAGITTA_M, COARSEST_SAGITTA_M))


def sheet(
    face: Face,
    size_m: tuple[float, float],
    top_m: float,
    bottom_m: float,
    sagitta_m: float,
    centre_m: tuple[float, float] = (0.0, 0.0),
    angle_rad: float = 0.0,
    flat_back: bool = False,
) -> trimesh.Trimesh:
    """Return a watertight sheet over a rectangle in plan, between two parallels of the face
    (offsets along normals). Its facets stay within ``sagitta_m`` of the face; a flat sheet has 12
    triangles. ``flat_back``: its lower side is a plane. Board frame. Raises UserError if the face
    needs more than MAX_CELLS."""
    turn = turned(angle_rad)

    def plan(columns: int, rows: int) -> np.ndarray:
        steps = (
            np.linspace(-0.5, 0.5, n + 1) * size
            for n, size in zip((columns, rows), size_m, strict=True)
        )
        return np.stack(np.meshgrid(*steps), axis=-1) @ turn.T + centre_m

    # Linear interpolation on a right triangle of legs a, b errs by (|f_aa| a^2 + 2 |f_ab| ab +
    # |f_bb| b^2) / 8 or less. Legs with a^2 (|f_aa| + |f_ab|) = b^2 (|f_bb| + |f_ab|) = 4 sagitta
    # keep that below the
    # sagitta.
    places = plan(64, 64)
    fxx, fxy, fyy = np.moveaxis(face.bend(places[..., 0], places[..., 1]), -1, 0)
    hessian = turn.T @ np.stack([np.stack([fxx, fxy], -1), np.stack([fxy, fyy], -1)], -2) @ turn
    bends = np.abs(hessian).sum(axis=-1).max(axis=(0, 1))
    # 1e-9 per metre: rounding of a turned straight direction must not cut it into cells.
    lengths = np.where(bends > 1e-9, np.sqrt(4 * sagitta_m / np.maximum(bends, 1e-9)), np.inf)
    columns, rows = (
        max(1, int(np.ceil(size / length))) for size, length in zip(size_m, lengths, strict=True)
    )
    if columns * rows > MAX_CELLS:
        needs = f"{columns} x {rows} cells for an error below {sagitta_m / MM * 1e3:.3g} um"
        fix = "make the board smaller or bend it less"
        raise UserError(
            f"board: its face needs {needs}", legal=f"at most {MAX_CELLS} cells", fix=fix
        )
    places = plan(columns, rows)
    points = face.point(places[..., 0], places[..., 1])
    normals = face.normal(places[..., 0], places[..., 1])
    lower = (
        np.dstack([places, np.full(places.shape[:2], bottom_m)])
        if flat_back
        else points + bottom_m * normals
    )
    vertices, faces = closed_grid(points + top_m * normals, lower)
    return trimesh.Trimesh(vertices=vertices, faces=faces, process=False)


def solids_of(
    item: FlawConfig, face: Face, thickness_m: float
) -> tuple[list[trimesh.Trimesh], list[trimesh.Trimesh]]:
    """Return the solids that a flaw adds to the board and those that it takes away, in this order,
    board frame. A pressed sheet moves its back too: the volume that one side loses, the other side
    gains."""
    points, depth_m, axis, across = relief_points(item, face, thickness_m)
    relief = item.relief()
    spare_m = SPARE_M + float(np.ptp(points @ axis))
    if relief.open_row:  # beyond the board's edge
        points = np.concatenate([points, points[-1:] + spare_m * across])
        depth_m = np.concatenate([depth_m, depth_m[-1:]])

    def between(upper_m: np.ndarray | float, lower_m: np.ndarray | float) -> trimesh.Trimesh:
        """Return the solid between two heights over the face, along the axis."""
        heights = (
            np.broadcast_to(height, depth_m.shape)[..., None] for height in (upper_m, lower_m)
        )
        return trimesh.Trimesh(
            *closed_grid(*(points + height * axis for height in heights)), process=False
        )

    out = bool(depth_m.min() < 0)
    if not (isinstance(item, RoundConfig) and item.pressed):
        if out:
            return [between(-depth_m, -min(spare_m, thickness_m / 2))], []
        return [], [
            between(spare_m, -depth_m - (spare_m if np.isnan(relief.depth_m).any() else 0.0))
        ]
    # the back is the face moved by the thickness along its own normals
    normals = face.normal(points[..., 0], points[..., 1])
    back = points - thickness_m * normals
    middle = points + -thickness_m / 2 * normals
    moved = back - depth_m[..., None] * axis
    front = between(-depth_m, -thickness_m / 2) if out else between(spare_m, -depth_m)
    rear = closed_grid(moved, back - spare_m * axis) if out else closed_grid(middle, moved)
    solid = trimesh.Trimesh(*rear, process=False)
    return ([front], [solid]) if out else ([solid], [front])


def cutter(damage: Damage, declared: HoleConfig | DentConfig) -> trimesh.Trimesh:
    """Return the solid that a damage takes away, board frame; it sticks out of the face, a
    through-hole's of the back. Its radius is the declared one: on a bent face a dent's rim, which
    the truth holds, is not that of its ball."""
    depth_m = damage.depth_m
    radius_m = declared.radius_m
    # A face or back that bends to a radius of twice the damage's lies 0.27 radius off the tangent
    # plane at the rim.
    spare_m = SPARE_M + 0.5 * radius_m
    if isinstance(declared, DentConfig):
        # a ball from pole to rim and on above the face, then straight up, then a lid
        ball_m = declared.ball_m
        middle_m = declared.ball_m - depth_m
        rim = np.arctan2(radius_m, middle_m)
        top = np.arccos(max(middle_m - spare_m, 0.0) / ball_m)
        angles = np.linspace(0.0, rim, RINGS + 1)
        if top > rim + 1e-6:
            angles = np.concatenate([angles, np.linspace(rim, top, RINGS // 4)[1:]])
        profile = np.column_stack([ball_m * np.sin(angles), middle_m - ball_m * np.cos(angles)])
        profile[0, 0] = 0.0
        if profile[-1, 1] < spare_m:
            profile = np.vstack([profile, (profile[-1, 0], spare_m)])
        profile = np.vstack([profile, (0.0, spare_m)])
    else:
        bottom_m = -depth_m - (spare_m if damage.kind == "through" else 0.0)
        mouth_m = declared.mouth_m
        edge = [(radius_m, radius_m - mouth_m), (mouth_m, 0.0)] if mouth_m > radius_m else []
        profile = np.array(
            [(0.0, bottom_m), (radius_m, bottom_m), *edge, (mouth_m, spare_m), (0.0, spare_m)]
        )
    sides = 4 * int(np.ceil(np.pi / 2 * np.sqrt(radius_m / (12 * CORNER_M))))
    angle = 2 * np.pi / sides
    equal_area = np.sqrt(angle / np.sin(angle))
    # In millimetres: trimesh takes areas below 1e-8 for nothing, and in m2 that is a facet of a
    # small hole.
    solid = trimesh.creation.revolve(profile / MM * (equal_area, 1.0), sections=sides)
    across = np.cross([0.0, 1.0, 0.0], damage.axis_board)
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = MM * np.column_stack(
        [across, np.cross(damage.axis_board, across), damage.axis_board]
    )
    pose[:3, 3] = damage.centre_board_m
    return solid.apply_transform(pose)


def subtract(
    body: trimesh.Trimesh, cutters: Sequence[trimesh.Trimesh], added: Sequence[trimesh.Trimesh] = ()
) -> trimesh.Trimesh:
    """Return body and what is added, minus cutters, by Manifold, watertight; not by trimesh's
    wrapper, which rounds to float32: 30 nm on a board of 0.6 m, 1e-3 of the facets of a 1/16 in
    hole."""
    import manifold3d  # type: ignore[import-not-found]

    longest_m = max(CELL_M, float(np.ptp(body.vertices, axis=0).max()) / MOST_ALONG)
    solids = []
    for mesh in (body, *added, *cutters):
        vertices = np.array(mesh.vertices, float)
        faces = np.array(mesh.faces, np.uint64)
        if mesh is body:
            fine = (
                manifold3d.Manifold(manifold3d.Mesh64(vertices, faces))
                .refine_to_length(longest_m)
                .to_mesh64()
            )
            vertices = np.array(fine.vert_properties[:, :3], order="C")
            faces = np.array(fine.tri_verts, order="C")
        # edges between faces of different numbers stay; others within a plane are dissolved
        numbers = np.arange(len(faces), dtype=np.uint64)
        solids.append(manifold3d.Manifold(manifold3d.Mesh64(vertices, faces, face_id=numbers)))
    broken = [solid.status() for solid in solids if solid.status() != manifold3d.Error.NoError]
    if broken:
        raise RuntimeError(f"a solid is not closed: {broken}")
    whole = manifold3d.Manifold.batch_boolean(solids[: 1 + len(added)], manifold3d.OpType.Add)
    left = [whole, *solids[1 + len(added) :]]
    result = manifold3d.Manifold.batch_boolean(left, manifold3d.OpType.Subtract).to_mesh64()
    return trimesh.Trimesh(
        result.vert_properties[:, :3], result.tri_verts.astype(np.int64), process=False
    )


MESH_SUFFIXES = (".glb", ".ply")


def write_mesh(target: Target, path: Path) -> None:
    """Write all parts, in metres, by the suffix of ``path``; colours are sRGB. ``.ply``: one
    binary mesh in the camera's frame (z forward, y down), each part's mean colour at its vertices.
    ``.glb``: one node a part, the grain as a texture, in glTF's frame (y up, the camera at the
    origin looks along -z). Raises UserError for another suffix."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise UserError(
            f"{path}: no mesh format is called {suffix or 'nothing'!r}",
            legal=" or ".join(MESH_SUFFIXES),
        )
    write_bytes(path, _ply(target) if suffix == ".ply" else _glb(target))


def write_truth(target: Target, path: Path) -> None:
    """Write as JSON: version, declaration, ``T_camera_board`` (metres) and one row in millimetres
    per damage."""
    data = {"results_version": RESULTS_VERSION, "target": target.config.to_data()}
    data |= {
        "T_camera_board": target.T_camera_board.tolist(),
        "damages": [each.to_row() for each in target.truth],
    }
    write_json(path, data)


def _ply(target: Target) -> bytes:
    coloured = []
    for part in target.parts:
        colours = np.tile(
            np.append(_srgb_bytes(part.rgb), np.uint8(255)), (len(part.mesh.vertices), 1)
        )
        coloured.append(
            trimesh.Trimesh(
                part.mesh.vertices, part.mesh.faces, vertex_colors=colours, process=False
            )
        )
    return trimesh.util.concatenate(coloured).export(None, file_type="ply")


def _glb(target: Target) -> bytes:
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    scene = trimesh.Scene()
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    for part in target.parts:
        colour: dict[str, Any] = {"baseColorFactor": [*part.rgb, 1.0]}
        uv = np.zeros((len(part.mesh.vertices), 2))
        if part.uv is not None and part.texture_rgb is not None:
            colour = {"baseColorTexture": Image.fromarray(_srgb_bytes(part.texture_rgb))}
            uv = part.uv * (1, -1) + (0, 1)  # trimesh counts v upwards from the image's lower edge
        material = PBRMaterial(**colour, metallicFactor=0.0, roughnessFactor=1.0, name=part.name)
        visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        mesh = trimesh.Trimesh(part.mesh.vertices, part.mesh.faces, visual=visual, process=False)
        # No normals: glTF viewers then shade each facet flat, which keeps the rims of holes sharp.
        scene.add_geometry(mesh, node_name=part.name, geom_name=part.name, transform=upright)
    return scene.export(file_type="glb", include_normals=False)


def _srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Return linear reflectance in 0..1 as 8-bit sRGB (IEC 61966-2-1)."""
    linear = np.asarray(linear, dtype=float)
    encoded = np.where(
        linear <= 0.0031308,
        12.92 * linear,
        1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055,
    )
    return np.round(255 * encoded).astype(np.uint8)
