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
from harness.vocabulary.extras import load_extra
from harness.vocabulary.files import bounded_bytes, write_bytes, write_json
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.seeds import random_stream
from scenes.target.checks import check_target
from scenes.target.custom import (
    CastingConfig,
    DentConfig,
    HoleConfig,
    MaterialConfig,
    MeshConfig,
    TapeConfig,
    TargetConfig,
)
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

# finer than a pixel's footprint (1.4 mm at 0.7 m for the finest camera), made in 40 ms
TEXEL_MM = 0.6
MAX_TEXELS = 4096  # along a side: a board of metres gets coarser texels instead of gigabytes
MOST_IMAGE_BYTES = 1 << 28
# of growth lines and fibres in the pattern: guesses, as are the lengths below
LINE_WEIGHT = 0.8
FIBRE_WEIGHT = 0.6
# of growth lines: deviation, lengths across, along x
WANDER_MM = 6.0
WANDER_ACROSS_MM = 60.0
WANDER_ALONG_MM = 240.0
# correlation lengths of the fibres
FIBRE_ACROSS_MM = 0.5
FIBRE_ALONG_MM = 12.0


def grain(
    material: MaterialConfig,
    width_mm: float,
    height_mm: float,
) -> np.ndarray:
    """Return a board's grain: (rows, columns) float64, mean 0, deviation 1. Not modelled: knots,
    seams."""
    texel_mm = max(TEXEL_MM, width_mm / MAX_TEXELS, height_mm / MAX_TEXELS)
    rows = max(2, round(height_mm / texel_mm))
    columns = max(2, round(width_mm / texel_mm))
    stream = random_stream(material.grain_seed, "grain")
    # coarse noise through a cubic spline, along each axis in turn by the spline's weights of the
    # knots: zooming the array itself takes five times as long
    coarse_rows = 2 + round(rows * texel_mm / WANDER_ACROSS_MM)
    coarse_columns = 2 + round(columns * texel_mm / WANDER_ALONG_MM)
    coarse = stream.standard_normal((coarse_rows, coarse_columns))
    down = _spline_weights(coarse_rows, rows)
    across = _spline_weights(coarse_columns, columns)
    wander = _normalised(down @ coarse @ across.T)
    across_mm = (np.arange(rows)[:, None] + 0.5) * texel_mm + WANDER_MM * wander
    turns = across_mm / material.grain_period_mm + stream.uniform()
    # late wood: a thin dark line at the end of each ring, after a slow fall
    rise = turns % 1.0
    lines = _normalised(-rise * rise * rise)
    noise = stream.standard_normal((rows, columns), dtype=np.float32)
    along_kernel = _gaussian_kernel(FIBRE_ALONG_MM / texel_mm)
    across_kernel = _gaussian_kernel(FIBRE_ACROSS_MM / texel_mm)
    fibres = cv2.sepFilter2D(noise, -1, along_kernel, across_kernel, borderType=cv2.BORDER_REFLECT)
    return _normalised(LINE_WEIGHT * lines + FIBRE_WEIGHT * _normalised(fibres))


def _spline_weights(knots: int, count: int) -> np.ndarray:
    """Return the weights (count, knots) of a cubic spline's knots in evenly spaced values."""
    weights: np.ndarray = zoom(
        np.eye(knots),
        (count / knots, 1),
        order=3,
        mode="nearest",
    )
    return weights


def _gaussian_kernel(deviation: float) -> np.ndarray:
    return cv2.getGaussianKernel(2 * int(3 * deviation + 0.5) + 1, deviation)


def reflectance(
    pattern: np.ndarray,
    mean: float,
    contrast: float,
) -> np.ndarray:
    """Return albedo (rows, columns) float32 with exactly this mean: mean (1 + contrast pattern),
    clipped to 0..1. Where clipping would move the mean, the pattern is lifted to bring it back;
    the contrast then falls short."""
    raw = mean * (1 + contrast * pattern)

    def excess(lift: float) -> float:
        return float(np.clip(raw + lift, 0.0, 1.0).mean()) - mean

    lift = 0.0
    if raw.min() < 0.0 or raw.max() > 1.0:
        lift = float(brentq(excess, -2.0, 2.0, xtol=1e-9))
    return np.clip(raw + lift, 0.0, 1.0).astype(np.float32)


def image_pattern(file: str) -> np.ndarray:
    """Return an image's brightness in linear light over its mean, less 1: (rows, columns),
    `MAX_TEXELS` at most."""
    try:
        content = np.frombuffer(bounded_bytes(Path(file), MOST_IMAGE_BYTES), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_ANYDEPTH)
    except (OSError, cv2.error) as error:
        raise UserError(f"target.material.texture: {file} cannot be read ({error})") from error
    if image is None or image.dtype.kind != "u" or min(image.shape) < 2 or not image.any():
        raise UserError(
            f"target.material.texture: {file} is not a readable image, or it is black",
            legal="a PNG, JPEG or TIFF image of 8 or 16 bits",
        )
    encoded = image / (2.0 ** (8 * image.itemsize) - 1)
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    fewer = MAX_TEXELS / max(linear.shape)
    if fewer < 1:
        linear = cv2.resize(
            linear,
            None,
            fx=fewer,
            fy=fewer,
            interpolation=cv2.INTER_AREA,
        )
    return np.asarray(linear / linear.mean() - 1)


def look_up(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return bilinear values (...[, channels]) of a texture (rows, columns[, channels]) at ``uv``
    (..., 2)."""
    rows, columns = texture.shape[:2]
    texels = np.stack([uv[..., 1] * rows - 0.5, uv[..., 0] * columns - 0.5])
    if texture.ndim == 2:
        return np.asarray(
            map_coordinates(
                texture,
                texels,
                order=1,
                mode="nearest",
            )
        )
    values = []
    for channel in np.moveaxis(texture, -1, 0):
        values.append(
            map_coordinates(
                channel,
                texels,
                order=1,
                mode="nearest",
            )
        )
    return np.stack(values, axis=-1)


def _normalised(values: np.ndarray) -> np.ndarray:
    centred = np.asarray(values, float) - np.mean(values, dtype=float)
    return centred / max(float(centred.std()), 1e-12)


# of facets on a bent face; under shallow dents depth / 400
COARSEST_SAGITTA_M = 2e-6
FINEST_SAGITTA_M = 0.1e-6
RIBBED_SAGITTA_M = 2e-5  # of a casting: at 0.5 um its flanks and fillets need a million cells
ROUGH_SAGITTA_M = 8e-5  # the same at the sharpest crest of a rough face; elsewhere a tenth of it
TAPE_SINK_M = 0.1e-3  # depth of a strip's underside in the board, so that no two surfaces coincide
# by which corners of a circle's polygon, of the same area, may stand out: 28 corners for 2 mm, 104
# for 1 in
CORNER_M = 4e-6
RINGS = 48  # steps of a dent's profile from pole to rim: volume short by 1 / (3 RINGS^2) = 0.014 %
# Longer edges slow rays down, and a renderer in float32 misses their plane, by 0.1 mm at 1 m.
CELL_M = 0.03  # longest edge of a damaged board's triangles
MOST_ALONG = 64  # and the largest number of these along a side; beyond it, edges are longer
SPARE_M = 0.2 * MM  # least distance by which a cutter reaches beyond the face
MAX_CELLS = 1_000_000  # of a bent sheet: some 300 MB
EVEN_CELLS = 10_000  # up to which a sheet's cells are all alike
LOOKED_AT = 257  # places along a side at which a face's bend is looked at, for uneven cells


@dataclass(frozen=True)
class TargetPart:
    """A surface of a target."""

    name: str
    """Name, as in `Target.parts`."""
    mesh: trimesh.Trimesh
    """Camera frame, metres, normals outwards; sharp edges share vertices, so use face normals."""
    albedo_850: float
    """Mean of ``texture_850``."""
    rgb: np.ndarray
    """(3,): mean of ``texture_rgb``."""
    uv: np.ndarray | None = None
    """(n_vertices, 2): texture co-ordinates in 0..1 (see the module); None if the part is plain.
    """
    texture_850: np.ndarray | None = None
    """(h, w) float32: linear reflectance at 850 nm; None if the part is plain."""
    texture_rgb: np.ndarray | None = None
    """(h, w, 3) float32: linear reflectance; None if the part is plain."""
    gloss: tuple[float, float] = (0.0, 1.0)
    """Share and exponent of its Phong lobe (`scenes.target.custom.GlossConfig`)."""

    def rgb_at(self, uv: np.ndarray) -> np.ndarray:
        """Return red, green and blue albedo (..., 3) at ``uv`` (..., 2); the mean where the part
        is plain."""
        if self.texture_rgb is None:
            return np.broadcast_to(self.rgb.astype(np.float32), (*uv.shape[:-1], 3))
        return look_up(self.texture_rgb, uv)


@dataclass(frozen=True)
class Target:
    """A built target."""

    config: TargetConfig
    """Its declaration."""
    parts: tuple[TargetPart, ...]
    """"board", then "tape_1".., "backing", "floor", "back_wall" as declared."""
    truth: tuple[Damage, ...]
    """All damage in the order of the declaration."""
    T_camera_board: np.ndarray
    """(4, 4): from the board's frame to the camera's."""
    outline_board_m: np.ndarray
    """(n, 3): the face's rim, counter-clockwise seen from the camera."""


def build_target(config: TargetConfig) -> Target:
    """Build a declaration. Raises UserError that names every part that does not fit
    (`scenes.target.checks`)."""
    check_target(config)
    T_camera_board = config.pose.T_camera_board
    truth = truth_of(config, T_camera_board)
    parts = [_board_part(config, truth)]
    for number, tape in enumerate(config.tapes, start=1):
        strip = _tape_strip(config, tape)
        strip.apply_transform(T_camera_board)
        parts.append(TargetPart(f"tape_{number}", strip, tape.albedo_850, np.array(tape.rgb)))
    for name, corners, albedo_850, rgb in planes_of(config):
        plane = trimesh.Trimesh(
            vertices=corners,
            faces=[(0, 1, 2), (0, 2, 3)],
            process=False,
        )
        parts.append(TargetPart(name, plane, albedo_850, np.array(rgb)))
    outline = outline_board_m(config.board)
    return Target(
        config=config,
        parts=tuple(parts),
        truth=truth,
        T_camera_board=T_camera_board,
        outline_board_m=outline,
    )


def _board_part(config: TargetConfig, truth: tuple[Damage, ...]) -> TargetPart:
    """Return the board with its reflectance, in the camera's frame."""
    board = config.board
    material = config.material
    mesh = board_solid(config, truth)
    plan = mesh.vertices[:, :2] / (board.width_mm * MM, board.height_mm * MM)
    mesh.apply_transform(config.pose.T_camera_board)
    uv = None
    texture_850 = None
    texture_rgb = None
    pattern = None
    contrast = material.grain_contrast
    if material.texture is not None:
        pattern = image_pattern(material.texture.file)
        contrast = 1.0
    elif contrast != 0:
        pattern = grain(material, board.width_mm, board.height_mm)
    if pattern is not None:
        uv = np.clip(np.column_stack([0.5 + plan[:, 0], 0.5 - plan[:, 1]]), 0.0, 1.0)
        texture_850 = reflectance(pattern, material.albedo_850, contrast)
        colours = [reflectance(pattern, mean, contrast) for mean in material.rgb]
        texture_rgb = np.stack(colours, axis=-1)
    gloss = (0.0, 1.0)
    if material.gloss:
        gloss = (material.gloss.share, material.gloss.exponent)
    return TargetPart(
        name="board",
        mesh=mesh,
        albedo_850=material.albedo_850,
        rgb=np.array(material.rgb),
        uv=uv,
        texture_850=texture_850,
        texture_rgb=texture_rgb,
        gloss=gloss,
    )


def _tape_strip(config: TargetConfig, tape: TapeConfig) -> trimesh.Trimesh:
    """Return a strip of tape, board frame."""
    width_mm, height_mm = tape.size_mm
    x_mm, y_mm = tape.centre_mm
    return sheet(
        face_of(config.board),
        (width_mm * MM, height_mm * MM),
        top_m=tape.thickness_mm * MM,
        bottom_m=-TAPE_SINK_M,
        sagitta_m=_sagitta_m(config),
        centre_m=(x_mm * MM, y_mm * MM),
        angle_rad=float(np.deg2rad(tape.angle_deg)),
    )


def board_solid(
    config: TargetConfig,
    truth: tuple[Damage, ...],
) -> trimesh.Trimesh:
    """Return the board without its damage, watertight, board frame."""
    board = config.board
    thickness_m = board.thickness_mm * MM
    face = face_of(board)
    if isinstance(board.shape, MeshConfig):
        vertices, faces = part_of(board.shape)
        body = trimesh.Trimesh(vertices, faces, process=False)
    else:
        body = sheet(
            face,
            (board.width_mm * MM, board.height_mm * MM),
            top_m=0.0,
            bottom_m=-thickness_m,
            sagitta_m=_sagitta_m(config),
            flat_back=face.rough,
        )
    added: list[trimesh.Trimesh] = []
    cutters: list[trimesh.Trimesh] = []
    for damage, item in zip(truth, config.damages, strict=True):
        if isinstance(item, FlawConfig):
            item_added, item_cutters = solids_of(item, face, thickness_m)
            added += item_added
            cutters += item_cutters
        else:
            cutters.append(cutter(damage, item))
    return subtract(body, cutters, added) if truth else body


def _sagitta_m(config: TargetConfig) -> float:
    """Return how far facets may lie off the face."""
    if face_of(config.board).rough:
        return ROUGH_SAGITTA_M
    if isinstance(config.board.as_drawn.shape, CastingConfig):
        return RIBBED_SAGITTA_M
    shallowest_m = np.inf
    for bowl in (*config.dents, *config.flaws):
        if bowl.depth_mm is not None:
            shallowest_m = min(shallowest_m, bowl.depth_mm * MM)
    return float(np.clip(shallowest_m / 400, FINEST_SAGITTA_M, COARSEST_SAGITTA_M))


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

    def plan(across: np.ndarray, down: np.ndarray) -> np.ndarray:
        corners = np.stack(np.meshgrid(across * size_m[0], down * size_m[1]), axis=-1)
        return corners @ turn.T + centre_m

    looked_at = np.linspace(-0.5, 0.5, 65)
    bends = _bends(face, plan(looked_at, looked_at), turn)
    counts = [_cells(bend.max(), size, sagitta_m) for bend, size in zip(bends, size_m, strict=True)]
    lines = [np.linspace(-0.5, 0.5, count + 1) for count in counts]
    if np.prod(counts) > EVEN_CELLS and not face.rough:
        looked_at = np.linspace(-0.5, 0.5, LOOKED_AT)
        bends = _bends(face, plan(looked_at, looked_at), turn)
        lines = [_uneven(bend, size, sagitta_m) for bend, size in zip(bends, size_m, strict=True)]
    columns, rows = (len(line) - 1 for line in lines)
    if columns * rows > MAX_CELLS:
        raise UserError(
            f"board: its face needs {columns} x {rows} cells "
            f"for an error below {sagitta_m / MM * 1e3:.3g} um",
            legal=f"at most {MAX_CELLS} cells",
            fix="make the board smaller or bend it less",
        )
    plan_m = plan(*lines)
    points = face.point(plan_m[..., 0], plan_m[..., 1])
    normals = face.normal(plan_m[..., 0], plan_m[..., 1])
    lower = points + bottom_m * normals
    if flat_back:
        lower = np.dstack([plan_m, np.full(plan_m.shape[:2], bottom_m)])
    vertices, faces = closed_grid(points + top_m * normals, lower)
    return trimesh.Trimesh(
        vertices=vertices,
        faces=faces,
        process=False,
    )


def _bends(face: Face, places: np.ndarray, turn: np.ndarray) -> list[np.ndarray]:
    """Return the largest bend of a sheet's face along x at each of its columns (m,), and along y at
    each of its rows (n,).

    Linear interpolation on a right triangle of legs a, b errs by (|f_aa| a^2 + 2 |f_ab| ab +
    |f_bb| b^2) / 8 or less. Legs with a^2 (|f_aa| + |f_ab|) = b^2 (|f_bb| + |f_ab|) = 4 sagitta
    keep that below the sagitta: these sums are the bends.

    ``places`` (n, m, 2): where the face is looked at. ``turn`` (2, 2): the sheet's axes in
    plan."""
    fxx, fxy, fyy = np.moveaxis(face.bend(places[..., 0], places[..., 1]), -1, 0)
    first_row = np.stack([fxx, fxy], -1)
    second_row = np.stack([fxy, fyy], -1)
    hessian = np.stack([first_row, second_row], -2)
    bends = np.abs(turn.T @ hessian @ turn).sum(axis=-1)
    return [bends[..., 0].max(axis=0), bends[..., 1].max(axis=1)]


def _cells(bend: float, size_m: float, sagitta_m: float) -> int:
    """Return the number of equal cells along a side that keep facets within the sagitta."""
    # 1e-9 per metre: rounding of a turned straight direction must not cut it into cells.
    if bend <= 1e-9:
        return 1
    return max(1, int(np.ceil(size_m / np.sqrt(4 * sagitta_m / bend))))


def _uneven(bends: np.ndarray, size_m: float, sagitta_m: float) -> np.ndarray:
    """Return the lines of a grid along a side, -1/2 to 1/2 of it, as close as the bend there asks.
    ``bends`` (n,): the largest at even places of the side."""
    # between two places the bend may be larger than at either
    widened = np.pad(bends, 1, mode="edge")
    largest = np.maximum(np.maximum(widened[:-2], widened[2:]), bends)
    cells_per_side = size_m * np.sqrt(np.maximum(largest, 1e-9) / (4 * sagitta_m))
    places = np.linspace(-0.5, 0.5, len(bends))
    steps = np.maximum(cells_per_side[:-1], cells_per_side[1:]) / (len(bends) - 1)
    passed = np.concatenate([[0.0], np.cumsum(steps)])
    count = max(1, int(np.ceil(passed[-1])))
    return np.interp(np.linspace(0.0, passed[-1], count + 1), passed, places)


def solids_of(
    item: FlawConfig,
    face: Face,
    thickness_m: float,
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

    def between(
        upper_m: np.ndarray | float,
        lower_m: np.ndarray | float,
    ) -> trimesh.Trimesh:
        """Return the solid between two heights over the face, along the axis."""
        upper = np.broadcast_to(upper_m, depth_m.shape)[..., None]
        lower = np.broadcast_to(lower_m, depth_m.shape)[..., None]
        return _solid(points + upper * axis, points + lower * axis)

    raised = bool(depth_m.min() < 0)
    if not (isinstance(item, RoundConfig) and item.pressed):
        if raised:
            return [between(-depth_m, -min(spare_m, thickness_m / 2))], []
        beyond_back_m = spare_m if np.isnan(relief.depth_m).any() else 0.0
        return [], [between(spare_m, -depth_m - beyond_back_m)]
    # the back is the face moved by the thickness along its own normals
    normals = face.normal(points[..., 0], points[..., 1])
    back = points - thickness_m * normals
    moved_back = back - depth_m[..., None] * axis
    if raised:
        front = between(-depth_m, -thickness_m / 2)
        return [front], [_solid(moved_back, back - spare_m * axis)]
    middle = points + -thickness_m / 2 * normals
    return [_solid(middle, moved_back)], [between(spare_m, -depth_m)]


def _solid(upper: np.ndarray, lower: np.ndarray) -> trimesh.Trimesh:
    """Return the solid between two grids of points (rows, columns, 3)."""
    vertices, faces = closed_grid(upper, lower)
    return trimesh.Trimesh(vertices, faces, process=False)


def cutter(damage: Damage, declared: HoleConfig | DentConfig) -> trimesh.Trimesh:
    """Return the solid that a damage takes away, board frame; it sticks out of the face, a
    through-hole's of the back. Its radius is the declared one: on a bent face a dent's rim, which
    the truth holds, is not that of its ball."""
    radius_m = declared.radius_m
    # A face or back that bends to a radius of twice the damage's lies 0.27 radius off the tangent
    # plane at the rim.
    spare_m = SPARE_M + 0.5 * radius_m
    if isinstance(declared, DentConfig):
        profile = _ball_profile(declared, damage.depth_m, spare_m)
    else:
        bottom_m = -damage.depth_m
        if damage.kind == "through":
            bottom_m -= spare_m
        mouth_m = declared.mouth_m
        corners = [(0.0, bottom_m), (radius_m, bottom_m)]
        if mouth_m > radius_m:
            corners += [(radius_m, radius_m - mouth_m), (mouth_m, 0.0)]
        corners += [(mouth_m, spare_m), (0.0, spare_m)]
        profile = np.array(corners)
    sides = 4 * int(np.ceil(np.pi / 2 * np.sqrt(radius_m / (12 * CORNER_M))))
    angle = 2 * np.pi / sides
    equal_area = np.sqrt(angle / np.sin(angle))
    # In millimetres: trimesh takes areas below 1e-8 for nothing, and in m2 that is a facet of a
    # small hole.
    solid = trimesh.creation.revolve(profile / MM * (equal_area, 1.0), sections=sides)
    axis = damage.axis_board
    across = np.cross([0.0, 1.0, 0.0], axis)
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = MM * np.column_stack([across, np.cross(axis, across), axis])
    pose[:3, 3] = damage.centre_board_m
    return solid.apply_transform(pose)


def _ball_profile(
    dent: DentConfig,
    depth_m: float,
    spare_m: float,
) -> np.ndarray:
    """Return the profile (n, 2) of a dent's cutter, radius and height: a ball from pole to rim and
    on above the face, then straight up, then a lid at ``spare_m``."""
    ball_m = dent.ball_m
    middle_m = ball_m - depth_m
    rim = np.arctan2(dent.radius_m, middle_m)
    top = np.arccos(max(middle_m - spare_m, 0.0) / ball_m)
    angles = np.linspace(0.0, rim, RINGS + 1)
    if top > rim + 1e-6:
        angles = np.concatenate([angles, np.linspace(rim, top, RINGS // 4)[1:]])
    profile = np.column_stack([ball_m * np.sin(angles), middle_m - ball_m * np.cos(angles)])
    profile[0, 0] = 0.0
    if profile[-1, 1] < spare_m:
        profile = np.vstack([profile, (profile[-1, 0], spare_m)])
    return np.vstack([profile, (0.0, spare_m)])


def subtract(
    body: trimesh.Trimesh,
    cutters: Sequence[trimesh.Trimesh],
    added: Sequence[trimesh.Trimesh] = (),
) -> trimesh.Trimesh:
    """Return body and what is added, minus cutters, by Manifold, watertight; not by trimesh's
    wrapper, which rounds to float32: 30 nm on a board of 0.6 m, 1e-3 of the facets of a 1/16 in
    hole."""
    manifold3d = load_extra("manifold3d", "building a target")
    longest_m = max(CELL_M, float(np.ptp(body.vertices, axis=0).max()) / MOST_ALONG)
    fine = _manifold(body.vertices, body.faces).refine_to_length(longest_m).to_mesh64()
    solids = [_manifold(fine.vert_properties[:, :3], fine.tri_verts)]
    solids += [_manifold(mesh.vertices, mesh.faces) for mesh in (*added, *cutters)]
    broken = [solid.status() for solid in solids if solid.status() != manifold3d.Error.NoError]
    if broken:
        raise RuntimeError(f"a solid is not closed: {broken}")
    count = 1 + len(added)
    uncut = manifold3d.Manifold.batch_boolean(solids[:count], manifold3d.OpType.Add)
    cut = manifold3d.Manifold.batch_boolean([uncut, *solids[count:]], manifold3d.OpType.Subtract)
    result = cut.to_mesh64()
    vertices = result.vert_properties[:, :3]
    return trimesh.Trimesh(vertices, result.tri_verts.astype(np.int64), process=False)


def _manifold(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Return a Manifold solid. Edges between faces of different numbers stay; others within a
    plane are dissolved."""
    manifold3d = load_extra("manifold3d", "building a target")
    numbers = np.arange(len(faces), dtype=np.uint64)
    mesh = manifold3d.Mesh64(
        np.array(vertices, float, order="C"),
        np.array(faces, np.uint64, order="C"),
        face_id=numbers,
    )
    return manifold3d.Manifold(mesh)


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
    data = {
        "results_version": RESULTS_VERSION,
        "target": target.config.to_data(),
        "T_camera_board": target.T_camera_board.tolist(),
        "damages": [damage.to_row() for damage in target.truth],
    }
    write_json(path, data)


def _ply(target: Target) -> bytes:
    coloured = []
    for part in target.parts:
        mesh = part.mesh
        opaque = np.append(_srgb_bytes(part.rgb), np.uint8(255))
        colours = np.tile(opaque, (len(mesh.vertices), 1))
        coloured.append(
            trimesh.Trimesh(
                mesh.vertices,
                mesh.faces,
                vertex_colors=colours,
                process=False,
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
        mesh = trimesh.Trimesh(
            part.mesh.vertices,
            part.mesh.faces,
            visual=visual,
            process=False,
        )
        # No normals: glTF viewers then shade each facet flat, which keeps the rims of holes sharp.
        scene.add_geometry(
            mesh,
            node_name=part.name,
            geom_name=part.name,
            transform=upright,
        )
    return scene.export(file_type="glb", include_normals=False)


def _srgb_bytes(linear: np.ndarray) -> np.ndarray:
    """Return linear reflectance in 0..1 as 8-bit sRGB (IEC 61966-2-1)."""
    linear = np.asarray(linear, dtype=float)
    knee = 0.0031308
    bright = 1.055 * np.maximum(linear, knee) ** (1 / 2.4) - 0.055
    encoded = np.where(linear <= knee, 12.92 * linear, bright)
    return np.round(255 * encoded).astype(np.uint8)
