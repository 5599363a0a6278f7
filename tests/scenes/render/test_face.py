"""Light between nodes on the face: the compiled interpolation against NumPy, and the nodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import invert, transform_points
from scenes.optics import RenderConfig
from scenes.render import face
from scenes.render.direct import DirectLight
from scenes.render.face import (
    ABOVE_FACE_M,
    _above_face,
    _bounds_of_face,
    _node_line_m,
    between_nodes,
    face_light,
    face_triangles,
)
from scenes.render.indirect import PathWork
from scenes.render.range_noise import range_noise_m, range_weights
from scenes.sensor.camera import load_camera
from scenes.target.custom import (
    BoardConfig,
    HoleConfig,
    PoseConfig,
    SphereConfig,
    TapeConfig,
    TargetConfig,
)
from scenes.target.mesh import Target, build_target
from scenes.target.truth import face_of

COLUMNS = 5
ROWS = 4
FREQUENCIES_HZ = (20e6, 60e6, 100e6)
BATCHES = 8


def between_nodes_in_numpy(
    position: np.ndarray,
    batches: np.ndarray,
    share: np.ndarray,
    total: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return light (f + 1, n) and its noise of range (n,): batches (B, f + 1, rows, columns) are
    interpolated one by one, L(x, y) = sum of the corners' light times (1 - |x|) (1 - |y|)."""
    count = position.shape[1]
    light = np.zeros((len(batches), batches.shape[1], count), complex)
    for index in range(count):
        x, y = position[:, index]
        first_column = int(np.clip(np.floor(x), 0, COLUMNS - 2))
        first_row = int(np.clip(np.floor(y), 0, ROWS - 2))
        for row in (first_row, first_row + 1):
            for column in (first_column, first_column + 1):
                weight_x = 1 - (x - first_column) if column == first_column else x - first_column
                weight_y = 1 - (y - first_row) if row == first_row else y - first_row
                light[..., index] += weight_x * weight_y * batches[..., row, column]
    light *= share
    mean = light.mean(axis=0)
    noise_m = range_noise_m(light[:, :-1], total + mean[:-1], FREQUENCIES_HZ)
    return mean, noise_m


def test_light_between_nodes_is_that_of_the_reference() -> None:
    rng = np.random.default_rng(2)
    shape = (BATCHES, len(FREQUENCIES_HZ) + 1, ROWS, COLUMNS)
    batches = rng.random(shape) + 1j * rng.random(shape)
    position = rng.uniform(0, 1, (2, 40)) * np.array([[COLUMNS - 1], [ROWS - 1]])
    position[:, 0] = (0.0, 0.0)
    position[:, 1] = (COLUMNS - 1, ROWS - 1)
    share = rng.random((len(FREQUENCIES_HZ) + 1, 40)) + 0.5j
    total = 3 * rng.random((len(FREQUENCIES_HZ), 40)) + 1j
    mean = batches.mean(axis=0)
    by_node = np.moveaxis(batches, (2, 3), (0, 1)).reshape(ROWS * COLUMNS, BATCHES, -1)
    light, noise_m = between_nodes(
        position,
        (COLUMNS, ROWS),
        np.ascontiguousarray(mean.reshape(len(mean), -1).T),
        np.ascontiguousarray((by_node - by_node.mean(axis=1, keepdims=True))[..., :-1]),
        np.arange(len(FREQUENCIES_HZ)),
        range_weights(FREQUENCIES_HZ),
        share,
        total,
    )
    expected, expected_noise_m = between_nodes_in_numpy(position, batches, share, total)
    assert light == pytest.approx(expected, rel=1e-12)
    assert noise_m == pytest.approx(expected_noise_m, rel=1e-9)


def test_no_light_at_all_has_no_noise() -> None:
    dark = np.zeros((4, 1, 1), complex)
    light, noise_m = between_nodes(
        np.full((2, 1), 0.5),
        (2, 2),
        np.zeros((4, 2), complex),
        np.concatenate([dark, dark], axis=1),
        np.zeros(1, int),
        np.ones(1),
        np.ones((2, 1), complex),
        np.zeros((1, 1), complex),
    )
    assert (light == 0).all()
    assert noise_m.tolist() == [0.0]


def test_nodes_reach_both_ends_and_are_no_farther_apart_than_declared() -> None:
    line_m = _node_line_m(np.array([0.1, -0.2, 0.05]), 0.08)
    assert line_m == pytest.approx([-0.2, -0.125, -0.05, 0.025, 0.1])
    assert _node_line_m(np.array([0.0, 0.01]), 0.08) == pytest.approx([0.0, 0.005, 0.01])


@pytest.fixture(scope="module")
def target() -> Target:
    board = BoardConfig(
        width_mm=120.0,
        height_mm=80.0,
        thickness_mm=12.0,
        shape=SphereConfig(kind="sphere", radius_mm=300.0),
    )
    config = TargetConfig(
        board=board,
        holes=(
            HoleConfig(
                id=1,
                diameter_mm=20.0,
                centre_mm=(20.0, 5.0),
            ),
        ),
        tapes=(TapeConfig(centre_mm=(-30.0, 0.0), size_mm=(20.0, 10.0)),),
        pose=PoseConfig(
            distance_m=0.6,
            tilt_x_deg=10.0,
            offset_x_mm=30.0,
        ),
    )
    return build_target(config)


def test_nodes_stand_a_millimetre_above_the_face(target: Target) -> None:
    """The face is part of a sphere of 300 mm, whose centre is 300 mm behind its middle."""
    x_m = np.array([0.0, 0.05, -0.03])
    y_m = np.array([0.0, 0.01, 0.02])
    points_m, normals = _above_face(target, x_m, y_m)
    centre = target.T_camera_board @ [0.0, 0.0, -0.3, 1.0]
    from_centre = points_m - centre[:3]
    assert np.linalg.norm(from_centre, axis=1) == pytest.approx(np.full(3, 0.301))
    assert normals == pytest.approx(from_centre / 0.301)


def test_the_bounds_of_the_face_are_its_outline_in_plan(target: Target) -> None:
    corners = np.array([(-1.0, -1.0, 0.0), (1.0, 1.0, 0.0)])
    on_board = transform_points(
        invert(target.T_camera_board), transform_points(_bounds_of_face(target), corners)
    )
    assert on_board == pytest.approx(np.array([(-0.06, -0.04, 0.0), (0.06, 0.04, 0.0)]), abs=1e-12)


def test_triangles_of_the_face_lie_on_it_and_those_of_tape_count(target: Target) -> None:
    on_board, on_tape = face_triangles(target)
    mesh = target.parts[0].mesh
    centres = transform_points(invert(target.T_camera_board), mesh.triangles_center)
    off_sphere_m = np.linalg.norm(centres - [0.0, 0.0, -0.3], axis=1) - 0.3
    assert np.abs(off_sphere_m[on_board]).max() < 3e-6
    # the rim of the hole lies on facets, up to 2 um below the face
    at_rim = np.linalg.norm(centres[:, :2] - [0.02, 0.005], axis=1) < 0.0125
    assert np.abs(off_sphere_m[~on_board & ~at_rim]).min() > 1e-3
    assert mesh.area_faces[on_board].sum() == pytest.approx(0.12 * 0.08, rel=0.06)
    assert on_tape.all()


def test_each_pixel_gets_the_light_of_its_place_on_the_face(
    target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Light that grows evenly over the board, by two batches of equal noise: pixels of the face get
    that of the point which they see."""
    optics = load_camera("azure_kinect_nfov_binned").optics
    T_board_camera = invert(target.T_camera_board)
    requests: list[Any] = []

    def gather(
        lit: Any,
        points_m: np.ndarray,
        normals: np.ndarray,
        work: PathWork,
        samples: int,
        bright: np.ndarray,
    ) -> np.ndarray:
        requests.append((work, samples, bright))
        x_m, y_m, _ = transform_points(T_board_camera, points_m - ABOVE_FACE_M * normals).T
        light = evenly(x_m, y_m)
        return np.stack([light - 0.01j, light + 0.01j])[:, None].repeat(4, axis=1)

    def evenly(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        return 2 + 10 * x_m - 20 * y_m + 0j

    monkeypatch.setattr(face, "gather_at_points", gather)
    x_m, y_m = np.meshgrid(np.linspace(-0.05, 0.05, 7), np.linspace(-0.03, 0.03, 5))
    points = transform_points(target.T_camera_board, face_of(target.config.board).point(x_m, y_m))
    sees_face = np.ones(x_m.shape)
    sees_face[2, 3] = 0.0
    none: Any = None
    direct = DirectLight(
        phasor=np.full((3, *x_m.shape), 8.0 + 0j),
        intensity=none,
        range_m=none,
        surface=none,
        uv=none,
        coverage=none,
        fine=none,
        face=np.broadcast_to(0.5 * sees_face, (4, *x_m.shape)).astype(complex),
        face_range_m=np.linalg.norm(points, axis=-1),
        off_face=none,
    )
    slopes = points[..., :2] / points[..., 2:]
    work = PathWork(optics.frequencies_hz, bounces=3, seed=2)
    config = RenderConfig(face_spacing_mm=30.0, face_samples=77)
    light, noise_m = face_light(none, target, direct, slopes, work, config)
    is_seen = sees_face > 0
    expected = 0.5 * evenly(x_m[is_seen], y_m[is_seen])
    assert light == pytest.approx(np.broadcast_to(expected, (4, is_seen.sum())), rel=1e-6)
    turned = np.full((2, 3, 1), 0.005j) * np.array([[[-1]], [[1]]])
    total = 8.0 + np.broadcast_to(expected, (3, is_seen.sum()))
    expected_noise_m = range_noise_m(turned, total, optics.frequencies_hz)
    assert noise_m == pytest.approx(expected_noise_m, rel=1e-3)
    assert requests[0][:2] == (work, 77)
    assert requests[0][2] == pytest.approx(_bounds_of_face(target))
