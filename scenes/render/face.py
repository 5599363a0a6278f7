"""Indirect light by way of the board's undamaged face.

It is smooth there, so it is gathered at the nodes of a coarse grid and interpolated."""

import numba
import numpy as np

from harness.vocabulary.geometry import MM, invert, rotate_vectors, transform_points
from scenes.optics import RenderConfig
from scenes.render.direct import FAST, DirectLight
from scenes.render.indirect import PathWork, gather_at_points
from scenes.render.range_noise import noise_lines, range_weights
from scenes.render.scene import LitScene
from scenes.target.mesh import Target
from scenes.target.truth import face_of

# vertices this close to the undamaged face lie on it: Booleans place them within 1 nm
FACE_WITHIN_M = 0.001 * MM
MESH_WITHIN_M = 0.05 * MM  # the same for a part from a mesh, whose heights lie on a grid
ABOVE_FACE_M = 1 * MM  # height of the nodes above the face, so that tape does not cover them
LEAST_NODES = 3  # along each side


def face_triangles(target: Target) -> list[np.ndarray]:
    """Return which triangles (n,) of each part lie on the undamaged face: the board's there, and
    all of tapes."""
    board = target.config.board
    mesh = target.parts[0].mesh
    vertices = transform_points(invert(target.T_camera_board), mesh.vertices)
    height_m = face_of(board).height_m(vertices[:, 0], vertices[:, 1])
    within_m = MESH_WITHIN_M if board.shape.kind == "mesh" else FACE_WITHIN_M
    on_face = np.abs(vertices[:, 2] - height_m) < within_m
    flags = [np.asarray(on_face[mesh.faces].all(axis=1))]
    for part in target.parts[1:]:
        flags.append(np.full(len(part.mesh.faces), part.name.startswith("tape")))
    return flags


def face_light(
    lit: LitScene,
    target: Target,
    direct: DirectLight,
    slopes: np.ndarray,
    work: PathWork,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indirect light (f + 1, n) by way of the face (without its holes) in the pixels
    that see any of it, in the order of `numpy.nonzero` of ``direct.face[-1]``, and its noise of
    range (n,) in metres."""
    pixels = np.flatnonzero(direct.face[-1].real > 0)
    rays = np.ones((len(pixels), 3))
    rays[:, :2] = slopes.reshape(-1, 2)[pixels]
    lengths = np.sqrt(rays[:, 0] ** 2 + rays[:, 1] ** 2 + 1)
    rays *= (direct.face_range_m.ravel()[pixels] / lengths)[:, None]
    x_m, y_m, _ = transform_points(invert(target.T_camera_board), rays).T
    node_x_m = _node_line_m(x_m, config.face_spacing_mm * MM)
    node_y_m = _node_line_m(y_m, config.face_spacing_mm * MM)
    grid_x_m, grid_y_m = np.meshgrid(node_x_m, node_y_m)
    points_m, normals = _above_face(target, grid_x_m.ravel(), grid_y_m.ravel())
    bright = _bounds_of_face(target)
    light = gather_at_points(
        lit,
        points_m,
        normals,
        work,
        config.face_samples,
        bright,
    )

    lines = noise_lines(work.frequencies_hz)
    deviations = light[:, lines] - light[:, lines].mean(axis=0)
    column = (x_m - node_x_m[0]) / (node_x_m[1] - node_x_m[0])
    row = (y_m - node_y_m[0]) / (node_y_m[1] - node_y_m[0])
    return between_nodes(
        np.stack([column, row]),
        (len(node_x_m), len(node_y_m)),
        np.ascontiguousarray(light.mean(axis=0, dtype=complex).T),
        np.ascontiguousarray(np.moveaxis(deviations, 2, 0), complex),
        np.array(lines),
        range_weights(tuple(work.frequencies_hz[line] for line in lines)),
        direct.face.reshape(len(direct.face), -1)[:, pixels],
        direct.phasor.reshape(len(direct.phasor), -1)[:, pixels],
    )


def _node_line_m(values_m: np.ndarray, spacing_m: float) -> np.ndarray:
    """Return evenly spaced co-ordinates (k,) over the extent of values, no farther apart than
    ``spacing_m``."""
    low = values_m.min()
    high = values_m.max()
    count = int(np.ceil((high - low) / spacing_m)) + 1
    return np.linspace(low, high, max(count, LEAST_NODES))


def _above_face(
    target: Target,
    x_m: np.ndarray,
    y_m: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) above places of the face in plan, and its unit normals (n, 3) there, in
    the camera's frame."""
    face = face_of(target.config.board)
    normal = face.normal(x_m, y_m)
    point_m = face.point(x_m, y_m) + ABOVE_FACE_M * normal
    in_camera = transform_points(target.T_camera_board, point_m)
    return in_camera, rotate_vectors(target.T_camera_board, normal)


def _bounds_of_face(target: Target) -> np.ndarray:
    """Return the frame (4, 4) in which the face's bounds in plan are -1..1 in x and y: a source of
    light for the surfaces before it."""
    outline = target.outline_board_m[:, :2]
    low = outline.min(axis=0)
    high = outline.max(axis=0)
    middle = np.append((low + high) / 2, 0.0)
    frame = target.T_camera_board.copy()
    frame[:3, 3] = transform_points(target.T_camera_board, middle)
    frame[:3, :2] *= (high - low) / 2
    return frame


@numba.njit(**FAST)
def between_nodes(  # type: ignore[no-untyped-def]
    position,
    size,
    mean,
    deviations,
    lines,
    weights,
    share,
    total,
):
    """Interpolate light between nodes, bilinearly. Return it times ``share`` (f + 1, n), and its
    noise of range (n,) in metres when it is added to ``total``.

    The error is (s/D)^2/8 for a spacing s and a distance D of the light source: 2e-3 at 80 mm and
    0.7 m.

    ``position`` (2, n): columns and rows of the grid, with fractions.
    ``size``: the grid's columns and rows; node = row * columns + column.
    ``mean`` (nodes, f + 1): light, the mean over the batches, intensity last.
    ``deviations`` (nodes, B, l): of each batch from the mean.
    ``lines`` (l,): indices of the frequencies of these.
    ``weights`` (l,): their `range_weights`.
    ``share`` (f + 1, n): factor of the light.
    ``total`` (f, n): all other light."""
    batch_count, line_count = deviations.shape[1:]
    light = np.empty_like(share)
    noise_m = np.empty(position.shape[1])
    turn = np.zeros(line_count, np.complex128)
    for i in range(position.shape[1]):
        column = min(max(int(position[0, i]), 0), size[0] - 2)
        row = min(max(int(position[1, i]), 0), size[1] - 2)
        p = position[0, i] - column
        q = position[1, i] - row
        corner = row * size[0] + column
        below = (row + 1) * size[0] + column
        index = (corner, corner + 1, below, below + 1)
        weight = ((1 - q) * (1 - p), (1 - q) * p, q * (1 - p), q * p)
        for k in range(mean.shape[1]):
            value = 0j
            for n in range(4):
                value += weight[n] * mean[index[n], k]
            light[k, i] = share[k, i] * value
        # range changes by the imaginary part of turn times a change at the node
        for line in range(line_count):
            k = lines[line]
            phasor = total[k, i] + light[k, i]
            turn[line] = weights[line] * share[k, i] / phasor if phasor != 0 else 0j
        square = 0.0
        for batch in range(batch_count):
            change = 0.0
            for line in range(line_count):
                value = 0j
                for n in range(4):
                    value += weight[n] * deviations[index[n], batch, line]
                change += (turn[line] * value).imag
            square += change * change
        noise_m[i] = np.sqrt(square / (batch_count - 1) / batch_count)
    return light, noise_m
