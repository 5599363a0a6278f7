"""The shape of a hole: exact bowls and floors, and the undamaged face under them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.evaluation.profile import (
    ExampleCloud,
    HoleInView,
    HoleShape,
    bowl,
    hole_shape,
    hole_shapes,
    relative_radius,
    true_residual_mm,
)

HEIGHT = 40
WIDTH = 60
DEPTH_MM = 8.0
V, U = np.indices((HEIGHT, WIDTH), dtype=float)
FACE_MM = 900.0 + 0.1 * U - 0.2 * V + 0.003 * U * V + 0.002 * U**2
LARGE = HoleInView("large", 20.0, 18.0, 6.0, 12.0, DEPTH_MM)
SMALL = HoleInView("small", 45.0, 20.0, 3.0, 6.0, DEPTH_MM)


def rho_of(hole: HoleInView) -> np.ndarray:
    return np.hypot(U - hole.u_px, V - hole.v_px) / hole.radius_px


def cloud(measured: str, *holes: HoleInView) -> ExampleCloud:
    """A curved face with flat-bottomed holes that were measured as ``bowl`` or ``floor``."""
    residual = np.zeros((HEIGHT, WIDTH))
    z_truth = FACE_MM.copy()
    for hole in holes:
        inside = rho_of(hole) < 1
        shape = np.sqrt(np.clip(1 - rho_of(hole) ** 2, 0, None)) if measured == "bowl" else inside
        residual += 0.5 * DEPTH_MM * shape
        z_truth[inside] += DEPTH_MM
    all_pixels = np.ones((HEIGHT, WIDTH), bool)
    return ExampleCloud(50, "main", residual, ~all_pixels, all_pixels, holes, z_truth)


def rms_about(values: np.ndarray, shape: np.ndarray) -> float:
    scale = np.linalg.lstsq(shape[:, None], values, rcond=None)[0]
    return float(np.sqrt(np.mean((values - scale * shape) ** 2)))


def test_distances_are_in_radii_of_the_hole() -> None:
    radius = relative_radius(cloud("bowl", LARGE), LARGE)
    assert radius[18, 20] == 0.0
    assert radius[18, 26] == radius[24, 20] == radius[12, 20] == 1.0
    assert radius[21, 24] == pytest.approx(5 / 6)


def test_a_bowl_is_a_hemisphere() -> None:
    assert bowl(np.array([0.0, 0.6, 0.8, 1.0, 1.5])).tolist() == pytest.approx(
        [1.0, 0.8, 0.6, 0.0, 0.0]
    )


@pytest.mark.parametrize("measured", ["bowl", "floor"])
def test_misfits_are_those_of_least_squares(measured: str) -> None:
    scene = cloud(measured, LARGE)
    shape = hole_shape(scene, LARGE)
    assert shape is not None
    inside = rho_of(LARGE) < 1
    values = scene.residual_mm[inside]
    rho = rho_of(LARGE)[inside]
    hemisphere = np.sqrt(1 - rho**2)
    flat = np.ones_like(rho)
    assert shape.pixels == inside.sum()
    assert shape.bowl_rms_mm == pytest.approx(rms_about(values, hemisphere), abs=1e-9)
    assert shape.cylinder_rms_mm == pytest.approx(rms_about(values, flat), abs=1e-9)
    assert shape.looks == ("bowl" if measured == "bowl" else "cylinder")
    # the true hole has a flat floor
    assert shape.true_cylinder_rms_mm == pytest.approx(0.0, abs=1e-6)
    expected = rms_about(np.full(inside.sum(), DEPTH_MM), hemisphere)
    assert shape.true_bowl_rms_mm == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("bowl_rms", "cylinder_rms", "looks"),
    [
        (0.8, 1.0, "bowl"),
        (0.81, 1.0, "neither"),
        (1.0, 0.81, "neither"),
        (1.0, 0.8, "cylinder"),
    ],
)
def test_a_shape_fits_clearly_better_from_four_fifths(
    bowl_rms: float,
    cylinder_rms: float,
    looks: str,
) -> None:
    assert HoleShape("a", 40, cylinder_rms, bowl_rms, 0.0, 0.0).looks == looks


def test_a_hole_needs_twelve_pixels_and_half_of_them_valid() -> None:
    scene = cloud("bowl", LARGE)
    inside = np.argwhere(rho_of(LARGE) < 1)
    half = len(inside) // 2 + len(inside) % 2

    def with_valid(count: int) -> ExampleCloud:
        residual = scene.residual_mm.copy()
        for v, u in inside[count:]:
            residual[v, u] = np.nan
        return replace(scene, residual_mm=residual)

    assert hole_shape(with_valid(half - 1), LARGE) is None
    shape = hole_shape(with_valid(half), LARGE)
    assert shape is not None
    assert shape.pixels == half
    tiny = HoleInView("tiny", 45.0, 20.0, 1.9, 4.0, DEPTH_MM)
    assert (rho_of(tiny) < 1).sum() == 9
    assert hole_shape(cloud("bowl", tiny), tiny) is None
    round_ = HoleInView("round", 45.5, 20.5, 2.0, 4.0, DEPTH_MM)
    assert (rho_of(round_) < 1).sum() == 12
    assert hole_shape(cloud("bowl", round_), round_) is not None


def test_the_face_is_continued_over_the_hole_and_leaves_other_holes_out() -> None:
    scene = cloud("bowl", LARGE, replace(SMALL, u_px=31.0))
    depth = true_residual_mm(scene, LARGE)
    inside = rho_of(LARGE) < 1
    assert depth[inside] == pytest.approx(DEPTH_MM, abs=1e-6)
    assert depth[~inside & (rho_of(LARGE) < 1.5)] == pytest.approx(0.0, abs=1e-6)


def test_only_pixels_of_the_crop_within_three_radii_make_the_face() -> None:
    scene = cloud("bowl", LARGE)
    far = rho_of(LARGE) > 3.05
    spoiled = replace(scene, z_truth_mm=np.where(far, 0.0, scene.z_truth_mm))
    inside = rho_of(LARGE) < 1
    assert true_residual_mm(spoiled, LARGE)[inside] == pytest.approx(DEPTH_MM, abs=1e-6)
    outer = (rho_of(LARGE) > 2.7) & (rho_of(LARGE) < 3.0)
    spoiled_inside = replace(scene, z_truth_mm=np.where(outer, 0.0, scene.z_truth_mm))
    assert abs(true_residual_mm(spoiled_inside, LARGE)[inside] - DEPTH_MM).max() > 1.0
    cropped = replace(spoiled_inside, inside=~outer)
    assert true_residual_mm(cropped, LARGE)[inside] == pytest.approx(DEPTH_MM, abs=1e-6)


def test_a_small_hole_has_a_face_four_pixels_wide() -> None:
    """1.2 x 2 + 4 = 6.4 pixels, which is more than 3 radii."""
    hole = HoleInView("small", 30.0, 20.0, 2.0, 4.0, DEPTH_MM)
    scene = cloud("bowl", hole)
    distance_px = rho_of(hole) * hole.radius_px
    for low, high, matters in ((6.05, 6.4, True), (6.45, 7.0, False)):
        ring = (distance_px > low) & (distance_px <= high)
        assert ring.any()
        spoiled = replace(scene, z_truth_mm=np.where(ring, 0.0, scene.z_truth_mm))
        error = float(abs(true_residual_mm(spoiled, hole)[rho_of(hole) < 1] - DEPTH_MM).max())
        assert (error > 0.1) is matters


def test_without_a_face_nothing_is_known() -> None:
    scene = cloud("bowl", LARGE)
    ring = np.argwhere(rho_of(LARGE) > 1.3)
    eleven_pixels = np.zeros((HEIGHT, WIDTH), bool)
    for v, u in ring[:11]:
        eleven_pixels[v, u] = True
    assert np.isnan(true_residual_mm(replace(scene, inside=eleven_pixels), LARGE)).all()


def test_holes_come_smallest_first() -> None:
    shapes = hole_shapes(cloud("bowl", LARGE, SMALL))
    assert [shape.hole for shape in shapes] == ["small", "large"]
    invisible = replace(SMALL, hole="gone", u_px=500.0)
    assert [shape.hole for shape in hole_shapes(cloud("bowl", LARGE, invisible))] == ["large"]
