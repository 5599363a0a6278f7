"""The depth of a dent in a board that is tilted and off the optical axis, where the line of sight
and the optical axis meet the board in different places."""

from __future__ import annotations

import numpy as np
import pytest

from detectors import load_detector
from detectors.surfaces.surface import along_rays
from harness.vocabulary.geometry import Cloud, Lens, rays_of
from tests.support.plain_clouds import cloud_of_points

SHAPE = (90, 120)
LENS = Lens(SHAPE[1], SHAPE[0], 500.0, 500.0, -120.0, 44.5)
"""The board is seen 13 to 26 degrees off the axis."""
NORMAL = np.array([-1.0, 0.0, 2.0]) / np.sqrt(5.0)
"""The board is tilted by 27 degrees, so that it is seen at about 45."""
DISTANCE_M = 0.5
"""The board's distance from the camera along its normal."""
DEPTH_M = 4e-3
RADIUS_M = 15e-3
NOISE_M = 2e-4


def dented_board() -> Cloud:
    """Return a plane with a flat-bottomed dent of `DEPTH_M` along its normal."""
    slopes = LENS.region_slopes(LENS.whole)
    rays = rays_of(slopes)
    opening = rays @ NORMAL
    face = rays * (DISTANCE_M / opening)[..., None]
    middle = face[SHAPE[0] // 2, SHAPE[1] // 2]
    is_dent = np.linalg.norm(face - middle, axis=-1) < RADIUS_M
    z = (DISTANCE_M + DEPTH_M * is_dent) / opening
    z = z + NOISE_M * np.random.default_rng(1).standard_normal(SHAPE)
    return cloud_of_points(
        rays * z[..., None],
        count=np.full(SHAPE, 20),
        variance_m2=np.full(SHAPE, 20 * NOISE_M**2),
        n_frames=20,
        lens=LENS,
    )


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("local", {"crop": {"kind": "none"}}),
        ("local", {"crop": {"kind": "none"}, "surface": {"degree": 1}}),
        ("thesis", {"crop": {"kind": "none"}, "surface": {"degree": 1}}),
    ],
)
def test_the_depth_is_normal_to_the_board_whatever_the_surface(
    name: str, settings: dict[str, object]
) -> None:
    cloud = dented_board()
    detector = load_detector(name, settings)
    evidence = detector.analyse(cloud)
    strongest = detector.find(cloud, evidence, 8.0)[0]
    measured = detector.measure(cloud, evidence, strongest)
    # the sizes' model also departs from the floor by some 8 %, as its average holds round bottoms
    floor_m = float(np.median(evidence.residual_m.ravel()[strongest.pixels]))
    assert floor_m * measured.normal_share == pytest.approx(DEPTH_M, rel=0.02)
    assert measured.normal_depth_m == pytest.approx(DEPTH_M, rel=0.12)
    ray = measured.model_centre_m / np.linalg.norm(measured.model_centre_m)
    assert floor_m * measured.sight_share == pytest.approx(DEPTH_M / (ray @ NORMAL), rel=0.02)


def test_a_fit_along_rays_meets_a_plane_exactly() -> None:
    random = np.random.default_rng(2)
    points = np.column_stack([random.uniform(-0.5, 0.5, (50, 2)), random.uniform(0.5, 0.8, 50)])

    def plane(places: np.ndarray) -> np.ndarray:
        return 0.6 + 0.4 * places[:, 0] - 0.2 * places[:, 1]

    z = along_rays(plane)(points)
    on_rays = points * (z / points[:, 2])[:, None]
    np.testing.assert_allclose(plane(on_rays), z, rtol=1e-9)
