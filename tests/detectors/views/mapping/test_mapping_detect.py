"""Detectors on maps: the variance in the score, the hole model in a parallel projection, blur in
cells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.findings.hole_patch import lens_side
from detectors.findings.surroundings import HoleModelConfig, _lens_sides, blur_in_cells
from detectors.findings.viewpoints import straight_sight
from detectors.interface import Detection
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from detectors.views.mapping.merge import merge
from detectors.views.mapping.settings import FusedMerge, GridMerge
from harness.vocabulary.geometry import MM, Cloud, MapViews, Region, invert, transform_points
from tests.support.mapped_views import Hole, Plane, arc, reference, registered, seen

DETECTOR = ThesisDetector(ThesisConfig.from_data({"crop": {"kind": "none"}, "min_points": 3}))


def flat_map(sigma_m: np.ndarray, stated: bool = True) -> Cloud:
    """A map of a plane whose noise differs from cell to cell."""
    h, w = sigma_m.shape
    y, x = np.mgrid[:h, :w] * 1.4e-3
    z = 0.7 + sigma_m * np.random.default_rng(1).standard_normal(sigma_m.shape)
    flat = np.zeros(sigma_m.shape, dtype=np.uint8)
    return Cloud(
        points_m=np.stack([x, y, z], axis=-1),
        reason=flat,
        count=flat + np.int32(9),
        variance_m2=np.full(sigma_m.shape, np.nan),
        region=Region(0, h, 0, w),
        z_step_m=0.0,
        n_frames=9,
        projection="parallel",
        mean_variance_m2=sigma_m**2 / 4.0 if stated else None,
    )


def test_score_is_in_units_of_each_cells_own_deviation() -> None:
    sigma = np.full((100, 150), 0.1 * MM)
    sigma[:, 75:] = 0.4 * MM
    cloud = flat_map(sigma)
    evidence = DETECTOR.analyse(cloud)
    # the stated deviations are half of the true ones; the scale of the standardised residuals
    # makes up for it
    assert float(np.std(evidence.score[:, :75])) == pytest.approx(
        float(np.std(evidence.score[:, 75:])), rel=0.05
    )
    assert float(np.median(evidence.score)) == pytest.approx(0.6745, rel=0.02)
    scale = np.abs(evidence.residual_m) / evidence.score
    np.testing.assert_allclose(scale, sigma, rtol=0.03)
    assert evidence.scale_m == pytest.approx(float(np.median(scale)), rel=1e-9)


def test_use_variance_off_and_a_cloud_without_variance_score_alike() -> None:
    sigma = np.full((60, 80), 0.1 * MM)
    sigma[:, 40:] = 0.4 * MM
    off = ThesisDetector(ThesisConfig.from_data({"crop": {"kind": "none"}, "use_variance": False}))
    ignored = off.analyse(flat_map(sigma))
    np.testing.assert_array_equal(ignored.score, off.analyse(flat_map(sigma, stated=False)).score)
    np.testing.assert_array_equal(
        ignored.score, DETECTOR.analyse(flat_map(sigma, stated=False)).score
    )
    np.testing.assert_allclose(
        ignored.score * ignored.scale_m,
        np.abs(ignored.residual_m),
        rtol=1e-12,
    )


def test_scripts_scale_of_raw_z_knows_no_variance() -> None:
    script = ThesisDetector(
        ThesisConfig.from_data({"crop": {"kind": "none"}, "scale": "raw_z_std"})
    )
    sigma = np.full((60, 80), 0.2 * MM)
    sigma[:30] = 0.1 * MM
    np.testing.assert_array_equal(
        script.analyse(flat_map(sigma)).score, script.analyse(flat_map(sigma, False)).score
    )


def made_from(x_m: float, y_m: float) -> MapViews:
    return MapViews(np.eye(4)[None], np.ones(1), (x_m, y_m))


def test_blur_in_cells() -> None:
    cloud = replace(flat_map(np.full((10, 10), 1e-4)), map_views=made_from(2.8e-3, 2.1e-3))
    # five pixels of two cells each, interpolated: sqrt(25 + 2) pixels
    assert blur_in_cells(cloud, HoleModelConfig()) == pytest.approx(
        (2.0 * np.sqrt(27.0), 1.5 * np.sqrt(27.0)), rel=1e-9
    )
    # the lens blurs pixels of two cells and of one and a half
    sides = _lens_sides(
        cloud, HoleModelConfig(lens_px=0.3), blur_in_cells(cloud, HoleModelConfig())
    )
    assert sides == pytest.approx((lens_side(0.6), lens_side(0.45)))
    coarse = replace(cloud, map_views=made_from(0.7e-3, 0.7e-3))
    assert blur_in_cells(coarse, HoleModelConfig()) == pytest.approx(
        (np.sqrt(27.0 / 4.0 + 1.0),) * 2, rel=1e-9
    )
    assert blur_in_cells(replace(cloud, map_views=None), HoleModelConfig()) == (5.0, 5.0)


def test_straight_sight_sees_no_parallax_on_a_facing_surface() -> None:
    sight = straight_sight(np.array([[1.4e-3, 0, 0], [0, 1.4e-3, 0]]))
    np.testing.assert_allclose(sight, [1.0, 0, 0, 0, 0, 0, 1.0, 1.0], atol=1e-12)


# ---------------------------------------------------------------- a hole seen from several places

HOLE = Hole(14.0 * MM, 9.0 * MM, (5.3 * MM, -3.1 * MM))
SHARP_LENS = {"blur_px": 5, "lens_px": 0.0}


def hole_map(
    count: int,
    half_deg: float,
    config: FusedMerge | GridMerge,
) -> tuple[Cloud, np.ndarray, Plane]:
    plane = Plane(4.0, -6.0, HOLE)
    poses = arc(count, half_deg)
    rng = np.random.default_rng(5)
    views = [
        seen(plane, T, rng, noise_m=0.3 * MM, frames=25, blur=5, name=f"v{i}")
        for i, T in enumerate(poses)
    ]
    registrations = [reference(), *(registered(f"v{i}", T) for i, T in enumerate(poses) if i)]
    result = merge(views, registrations, config)
    return result.cloud, invert(plane.T_reference_plane) @ result.T_reference_cloud, plane


def strongest(cloud: Cloud, detector: ThesisDetector) -> tuple[Detection, object]:
    evidence = detector.analyse(cloud)
    detection = detector.find(cloud, evidence, 6.0)[0]
    return detection, detector.measure(cloud, evidence, detection)


@pytest.mark.parametrize(
    ("count", "half_deg", "cell_mm"), [(1, 0.0, None), (3, 25.0, 1.0), (5, 25.0, None)]
)
def test_hole_on_a_map_has_its_size_and_place(
    count: int,
    half_deg: float,
    cell_mm: float | None,
) -> None:
    cloud, T_plane_cloud, _ = hole_map(count, half_deg, FusedMerge(cell_mm=cell_mm))
    detector = ThesisDetector(
        ThesisConfig.from_data(
            {"crop": {"kind": "none"}, "min_points": 3, "hole_model": SHARP_LENS}
        )
    )
    _, measured = strongest(cloud, detector)
    assert measured.model_note == ""
    assert measured.model_diameter_m == pytest.approx(HOLE.diameter_m, rel=0.03)
    assert measured.model_depth_m == pytest.approx(HOLE.depth_m, rel=0.1)
    centre = transform_points(T_plane_cloud, measured.model_centre_m)
    np.testing.assert_allclose(centre[:2], HOLE.at, atol=0.25 * MM)
    assert abs(centre[2]) < 0.2 * MM
    assert 0 < measured.model_diameter_se_m < 0.05 * HOLE.diameter_m


def test_places_of_the_cameras_matter_to_the_size() -> None:
    """Without them the model takes the mean of shifted floors for a smaller and shallower hole."""
    cloud, _, _ = hole_map(5, 25.0, FusedMerge())
    detector = ThesisDetector(
        ThesisConfig.from_data(
            {"crop": {"kind": "none"}, "min_points": 3, "hole_model": SHARP_LENS}
        )
    )
    _, reference = strongest(cloud, detector)
    _, unknown = strongest(replace(cloud, map_views=None), detector)
    assert abs(reference.model_depth_m - HOLE.depth_m) < 0.5 * abs(
        unknown.model_depth_m - HOLE.depth_m
    )
    assert abs(reference.model_diameter_m - HOLE.diameter_m) < 0.5 * abs(
        unknown.model_diameter_m - HOLE.diameter_m
    )


def test_merged_points_without_a_grid_have_extents_only() -> None:
    cloud, T_plane_cloud, _ = hole_map(3, 15.0, GridMerge())
    detection, measured = strongest(cloud, DETECTOR)
    assert "extents only" in measured.model_note
    assert measured.extent_diameter_m == pytest.approx(HOLE.diameter_m, abs=6 * MM)
    centre = transform_points(T_plane_cloud, measured.extent_centre_m)
    np.testing.assert_allclose(centre[:2], HOLE.at, atol=3 * MM)
    assert len(detection.pixels) > 50
