"""Views of planes in closed form, against sums over single rays that are written out."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Region
from scenes.closed_form import Plane, image_view, layered_view, plane_view
from scenes.optics import footprint_of
from scenes.sensor.camera import load_camera

CAMERA = load_camera("azure_kinect_nfov_binned")
LENS = CAMERA.nominal_lens
EMITTER = CAMERA.optics.emitter_m
REGION = Region(140, 152, 150, 170)


def ray_light(
    slope: np.ndarray,
    plane: Plane,
    albedo: float,
) -> tuple[np.ndarray, float, float]:
    """Return where a ray meets a plane, its light and its path, step by step."""
    z = plane.distance_m / (1 - plane.slope_x * slope[0] - plane.slope_y * slope[1])
    point = z * np.array([slope[0], slope[1], 1.0])
    to_emitter = EMITTER - point
    leg = np.sqrt((to_emitter**2).sum())
    normal = np.array([plane.slope_x, plane.slope_y, -1.0])
    normal /= np.sqrt((normal**2).sum())
    cosine = (to_emitter / leg) @ normal
    return point, albedo * cosine / leg**2, leg + np.sqrt((point**2).sum())


def phasors(light: float, path_m: float) -> np.ndarray:
    """Return the phasor of one path at each of the camera's frequencies."""
    frequencies_hz = np.array(CAMERA.optics.frequencies_hz)
    return light * np.exp(2j * np.pi * frequencies_hz * path_m / SPEED_OF_LIGHT_AIR)


def test_a_ray_meets_a_plane_before_the_lens_only() -> None:
    plane = Plane(0.8, 0.5, -0.25)
    slopes = np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4], [2.0, 0.0], [3.0, 0.0]])
    z_m = plane.z_along_m(slopes)
    assert z_m[:3] == pytest.approx([0.8, 0.8 / 0.8, 0.8 / 1.1])
    assert np.isnan(z_m[3:]).all()


def test_a_planes_normal_is_a_unit_vector_towards_the_camera() -> None:
    plane = Plane(0.8, 0.5, -0.25)
    along_x = np.array([1.0, 0.0, 0.5])
    along_y = np.array([0.0, 1.0, -0.25])
    assert plane.normal @ along_x == pytest.approx(0.0)
    assert plane.normal @ along_y == pytest.approx(0.0)
    assert np.linalg.norm(plane.normal) == pytest.approx(1.0)
    assert plane.normal[2] < 0


def test_a_plane_is_seen_at_pixel_centres() -> None:
    plane = Plane(0.6, 0.3, -0.2)
    view = plane_view(
        CAMERA,
        REGION,
        0.6,
        0.7,
        0.3,
        -0.2,
    )
    for row, col in ((0, 0), (5, 13), (11, 19)):
        u = np.array(float(REGION.col0 + col))
        v = np.array(float(REGION.row0 + row))
        point, light, path_m = ray_light(LENS.slopes(u, v), plane, 0.7)
        assert view.range_m[row, col] == pytest.approx(np.linalg.norm(point), rel=1e-12)
        assert view.intensity[row, col] == pytest.approx(light, rel=1e-12)
        assert view.phasor[:, row, col] == pytest.approx(phasors(light, path_m), rel=1e-9)
    assert np.array_equal(view.phasor, view.phasor_direct)
    assert (view.surface == 0).all()
    assert (view.coverage == 1).all()
    assert (view.indirect_noise_m == 0).all()
    assert view.rgb.shape == (*REGION.shape, 3)
    assert np.array_equal(view.slopes, LENS.region_slopes(REGION))


def test_a_plane_between_lens_and_emitter_is_dark() -> None:
    slope_x = -0.1 / EMITTER[0]
    view = plane_view(CAMERA, REGION, 0.05, 0.7, slope_x)
    assert np.isfinite(view.range_m).all()
    assert (view.intensity == 0.0).all()
    assert (view.phasor == 0.0).all()


def test_parts_of_a_pixel_add_up_and_the_first_has_the_range() -> None:
    z_m = np.full((2, *REGION.shape), 0.5)
    z_m[1] = 0.75
    z_m[0, 0, 0] = np.nan
    light = np.full((2, *REGION.shape), 0.2)
    light[1] = 0.1
    view = image_view(CAMERA, REGION, z_m, light)
    slope = LENS.region_slopes(REGION)[3, 4]
    first = 0.5 * np.append(slope, 1.0)
    second = 0.75 * np.append(slope, 1.0)
    expected = phasors(0.2, np.linalg.norm(first) + np.linalg.norm(EMITTER - first))
    expected = expected + phasors(0.1, np.linalg.norm(second) + np.linalg.norm(EMITTER - second))
    assert view.phasor[:, 3, 4] == pytest.approx(expected, rel=1e-9)
    assert view.intensity[3, 4] == pytest.approx(0.3)
    assert view.range_m[3, 4] == pytest.approx(np.linalg.norm(first))
    # the part that is missing gives no light and no range
    assert view.intensity[0, 0] == pytest.approx(0.1)
    assert np.isnan(view.range_m[0, 0])
    assert view.surface[0, 0] == -1
    assert view.surface[3, 4] == 0


FRONT = Plane(0.6, 0.1, -0.05)
BACK = Plane(0.66)
EDGE = 0.004


def left_of_edge(slopes: np.ndarray) -> np.ndarray:
    assert slopes.shape[-1] == 2
    return slopes[..., 0] < EDGE


def test_each_footprint_of_a_layered_view_is_summed_ray_by_ray() -> None:
    """Light of the front, of the back, and none where the front's shadow lies on the back; the
    emitter stands to the left, so that the shadow falls to the right of the edge."""
    view = layered_view(
        CAMERA,
        REGION,
        FRONT,
        BACK,
        left_of_edge,
        0.5,
    )
    footprint = footprint_of(LENS, REGION, CAMERA.optics.beam_fwhm_rad)
    shadowed_rays = 0
    for row in (2, 9):
        for col in range(7, 14):
            rays = footprint.slopes(np.array([row]), np.array([col]), footprint.lattice())[0]
            total = np.zeros(len(CAMERA.optics.frequencies_hz), complex)
            intensity = 0.0
            on_front = 0
            for ray in rays:
                if left_of_edge(ray):
                    _, light, path_m = ray_light(ray, FRONT, 0.5)
                    on_front += 1
                else:
                    point, light, path_m = ray_light(ray, BACK, 0.5)
                    if shadowed(point):
                        light = 0.0
                        shadowed_rays += 1
                total += phasors(light, path_m) / len(rays)
                intensity += light / len(rays)
            mixed = 0 < on_front < len(rays)
            tolerance = 1e-9 if mixed else 1e-4  # elsewhere fewer rays are summed
            assert np.abs(view.phasor[:, row, col] - total).max() < tolerance
            assert abs(view.intensity[row, col] - intensity) < tolerance
            central = view.slopes[row, col, 0] < EDGE
            share = on_front / len(rays)
            expected_coverage = share if central else 1 - share
            assert view.surface[row, col] == (0 if central else 1)
            assert view.coverage[row, col] == pytest.approx(expected_coverage)
            plane = FRONT if central else BACK
            point, _, _ = ray_light(view.slopes[row, col], plane, 0.5)
            assert view.range_m[row, col] == pytest.approx(np.linalg.norm(point))
    assert shadowed_rays > 256


def shadowed(point: np.ndarray) -> bool:
    """Return whether the way from a point to the emitter crosses the front."""
    off_point = above_front(point)
    off_emitter = above_front(EMITTER)
    share = off_point / (off_point - off_emitter)
    x, _, z = point + share * (EMITTER - point)
    return bool(off_point > 0 > off_emitter and x / z < EDGE)


def above_front(point: np.ndarray) -> float:
    x, y, z = point
    return float(z - FRONT.distance_m - FRONT.slope_x * x - FRONT.slope_y * y)
