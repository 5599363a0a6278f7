"""Distances between scans and their level of detection are those of py4dgeo, and hold for noise
that neighbours share."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.surfaces.change import Distances, distances
from harness.vocabulary.geometry import MM

RNG = np.random.default_rng(3)
CORES_M = np.column_stack([RNG.uniform(-0.04, 0.04, (300, 2)), np.full(300, 0.5)])
ALONG_Z = np.tile([0.0, 0.0, 1.0], (300, 1))


def sheet(count: int, bump_mm: float = 0.0, noise_mm: float = 0.3) -> np.ndarray:
    """Points of a sheet at 0.5 m whose middle, 30 mm wide, lies farther away."""
    x_m, y_m = RNG.uniform(-0.05, 0.05, (2, count))
    z_m = 0.5 + bump_mm * MM * (np.hypot(x_m, y_m) < 15 * MM)
    return np.column_stack([x_m, y_m, z_m + noise_mm * MM * RNG.standard_normal(count)])


def compared(
    earlier_m: np.ndarray, later_m: np.ndarray, normals: np.ndarray = ALONG_Z, share: float = 1.0
) -> Distances:
    return distances(
        earlier_m,
        later_m,
        cores_m=CORES_M,
        normals=normals,
        radius_m=4 * MM,
        reach_m=50 * MM,
        registration_m=np.full(len(CORES_M), 0.1 * MM),
        shared=(share, share),
    )


def test_distances_and_levels_are_those_of_py4dgeo() -> None:
    pytest.importorskip("py4dgeo")
    from detectors.methods.peers import _py4dgeo

    py4dgeo = _py4dgeo()
    earlier_m = sheet(4000)
    later_m = sheet(3500, bump_mm=2.0)
    oracle = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(earlier_m), py4dgeo.Epoch(later_m)),
        corepoints=CORES_M,
        registration_error=0.1 * MM,
        normal_radii=(0.02,),
        cyl_radius=4 * MM,
        max_distance=50 * MM,
    )
    distance_m, uncertainty = oracle.run()
    measured = compared(earlier_m, later_m, np.asarray(oracle.directions()))
    assert measured.common_m == 0.0
    np.testing.assert_allclose(measured.distance_m, distance_m, atol=1e-12)
    np.testing.assert_allclose(measured.lod_m, uncertainty["lodetection"], atol=1e-12)


def test_an_unchanged_sheet_is_within_its_level_and_a_change_is_not() -> None:
    earlier_m = sheet(4000)
    unchanged = compared(earlier_m, sheet(4000))
    # the registration's share is not there, so that fewer than 5 % exceed the level
    assert unchanged.is_significant.mean() < 0.03
    changed = compared(earlier_m, sheet(4000, bump_mm=1.0))
    on_bump = np.hypot(*CORES_M[:, :2].T) < 10 * MM
    assert changed.is_significant[on_bump].all()
    assert np.median(changed.distance_m[on_bump]) == pytest.approx(1.0 * MM, rel=0.05)


def test_what_unchanged_places_differ_by_widens_the_level() -> None:
    earlier_m = sheet(4000)
    later_m = sheet(4000)
    # a pattern 20 mm long that no scatter in a cylinder shows
    later_m[:, 2] += 0.4 * MM * np.sin(later_m[:, 0] / (20 * MM) * 2 * np.pi)
    measured = compared(earlier_m, later_m)
    assert measured.common_m == pytest.approx(0.4 / np.sqrt(2) * MM, rel=0.35)
    assert measured.is_significant.mean() < 0.05


def test_shared_noise_counts_once() -> None:
    earlier_m = sheet(4000)
    later_m = sheet(4000)
    alone = compared(earlier_m, later_m)
    shared = compared(earlier_m, later_m, share=4.0)
    np.testing.assert_allclose(shared.noise_m, 2.0 * alone.noise_m, rtol=1e-9)


def test_noise_that_all_points_of_a_place_share_is_that_of_one_point() -> None:
    """Some 40 points lie in a cylinder, fewer than would share their noise."""
    measured = compared(sheet(8000), sheet(8000), share=1e4)
    assert np.median(measured.noise_m) == pytest.approx(0.3 * MM * np.sqrt(2.0), rel=0.03)


def test_a_place_with_few_points_is_not_judged() -> None:
    measured = compared(sheet(4000), sheet(60))
    assert np.isnan(measured.distance_m).mean() > 0.9
    assert not measured.is_significant[np.isnan(measured.distance_m)].any()
