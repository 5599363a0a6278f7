"""Glossy surfaces against a closed form and an independent Monte Carlo."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from scenes.optics import COARSE, Quadrilaterals
from scenes.render.direct import cast
from scenes.render.indirect import PathWork, gather_at_points
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.sensor.camera import load_camera
from scenes.target.mesh import TargetPart

CAMERA = load_camera("azure_kinect_nfov")
EMITTER = CAMERA.optics.emitter_m


def quad(
    name: str,
    corners: list[list[float]],
    albedo: float,
    gloss: tuple[float, float],
) -> TargetPart:
    mesh = trimesh.Trimesh(np.array(corners), [[0, 1, 2], [0, 2, 3]], process=False)
    return TargetPart(name, mesh, albedo, np.full(3, 0.5), gloss=gloss)


def lobe(
    gloss: tuple[float, float],
    normal: np.ndarray,
    viewer: np.ndarray,
    light: np.ndarray,
) -> np.ndarray:
    """The declared lobe, in NumPy."""
    mirrored = 2 * (viewer @ normal)[..., None] * normal - viewer
    cosine = np.maximum((mirrored * light).sum(axis=-1), 0)
    return 1 - gloss[0] + gloss[0] * (gloss[1] + 2) / 2 * cosine ** gloss[1]


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(
        vectors,
        axis=-1,
        keepdims=True,
    )


def test_direct_light_of_a_glossy_plane_is_that_of_the_closed_form():
    gloss = (0.4, 30.0)
    normal = np.array([0.0, 0.0, -1.0])
    wall = quad("board", [[-2, -2, 1], [2, -2, 1], [2, 2, 1], [-2, 2, 1]], 0.5, gloss)
    lit = lit_scene(load_mitsuba(), [wall], CAMERA.optics)
    lens = CAMERA.nominal_lens
    rows, cols = np.mgrid[150:430:7, 150:490:7].reshape(2, -1)
    footprint = Quadrilaterals(lens, lens.whole)
    slopes = footprint.slopes(rows, cols, footprint.grid())[:, COARSE]
    hits = cast(lit, slopes)
    points = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1)
    to_light = EMITTER - points
    distance = np.linalg.norm(to_light, axis=-1)
    reflected = lobe(gloss, normal, unit(-points), unit(to_light))
    expected = 0.5 * (to_light @ normal) / distance**3 * reflected
    assert hits.amplitude == pytest.approx(expected, rel=2e-4)
    assert expected.max() > 3 * expected.min()


@pytest.mark.parametrize("exponent", [1.0, 10.0, 200.0])
def test_no_more_light_leaves_than_the_albedo_says(exponent: float):
    """The lobe by itself, summed over the hemisphere: all of the light towards the normal, less at
    an angle."""
    rng = np.random.default_rng(5)
    radius = np.sqrt(rng.random(400_000))
    turn = 2 * np.pi * rng.random(400_000)
    light = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - radius**2)], axis=-1
    )
    normal = np.array([0.0, 0.0, 1.0])
    returned = []
    for angle in np.deg2rad([0, 30, 60, 85]):
        viewer = np.array([np.sin(angle), 0.0, np.cos(angle)])
        returned.append(lobe((1.0, exponent), normal, viewer, light).mean())
    assert returned[0] == pytest.approx(1.0, abs=0.03)
    assert all(later <= earlier + 0.03 for earlier, later in itertools.pairwise(returned))


def test_light_between_glossy_walls_is_that_of_an_independent_monte_carlo():
    """A corner of two walls, one bounce more than the first; directions drawn evenly over the
    hemisphere here, by the cosine there. The floor's own lobe, seen from the lens, counts too."""
    gloss = (0.6, 8.0)
    albedo = 0.5
    rng = np.random.default_rng(3)
    floor = quad(
        "board", [[-1, 0.3, 0.2], [1, 0.3, 0.2], [1, 0.3, 1.2], [-1, 0.3, 1.2]], albedo, gloss
    )
    wall = quad(
        "wall", [[-1, -0.7, 1.2], [1, -0.7, 1.2], [1, 0.3, 1.2], [-1, 0.3, 1.2]], albedo, gloss
    )
    lit = lit_scene(load_mitsuba(), [floor, wall], CAMERA.optics)
    start = np.array([0.0, 0.2999, 1.0])
    up = np.array([0.0, -1.0, 0.0])
    out = np.array([0.0, 0.0, -1.0])
    work = PathWork(
        CAMERA.frequencies_hz,
        bounces=1,
        seed=4,
    )
    traced = gather_at_points(lit, start[None], up[None], work, 65536)[:, -1, 0].real

    def drawn(normal: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Directions over the hemisphere, and their weights 2 cos."""
        d = unit(rng.standard_normal((count, 3)))
        d = np.where((d @ normal)[:, None] < 0, -d, d)
        return d, 2 * d @ normal

    def met(
        points: np.ndarray,
        d: np.ndarray,
        axis: int,
        at: float,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where rays meet a wall's plane, and whether within the wall."""
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - points[:, axis]) / d[:, axis]
            hit = points + t[:, None] * d
            low, high = ((-1, -0.7), (1, 0.3)) if axis == 2 else ((-1, 0.2), (1, 1.2))
            along_wall = hit[:, [0, 1]] if axis == 2 else hit[:, [0, 2]]
            return hit, (t > 1e-6) & (along_wall >= low).all(axis=1) & (along_wall <= high).all(
                axis=1
            )

    def lit_directly(
        points: np.ndarray,
        normal: np.ndarray,
        viewer: np.ndarray,
    ) -> np.ndarray:
        to_emitter = EMITTER - points
        distance = np.linalg.norm(to_emitter, axis=-1)
        towards = unit(to_emitter)
        cone = np.clip((-towards[:, 2] - lit.cos_cutoff) / (lit.cos_full - lit.cos_cutoff), 0, 1)
        return (
            albedo * cone * (towards @ normal) / distance**2 * lobe(gloss, normal, viewer, towards)
        )

    count = 1_000_000
    d, weight = drawn(up, count)
    weight = weight * lobe(gloss, up, np.broadcast_to(unit(-start), d.shape), d)
    on_wall, hit = met(np.broadcast_to(start, d.shape), d, 2, 1.2)
    first = np.where(hit, weight * lit_directly(on_wall, out, -d), 0)
    second_d, cosine_weight = drawn(out, count)
    weight = weight * albedo * cosine_weight * lobe(gloss, out, -d, second_d)
    on_floor, back = met(np.where(hit[:, None], on_wall, 0), second_d, 1, 0.3)
    second = np.where(hit & back, weight * lit_directly(on_floor, up, -second_d), 0)
    total = first + second
    error = np.hypot(total.std() / np.sqrt(count), traced.std(ddof=1) / np.sqrt(len(traced)))
    assert second.mean() > 10 * error
    assert traced.mean() == pytest.approx(total.mean(), abs=4 * error)
