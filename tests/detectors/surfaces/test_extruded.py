"""Extruded profiles: what they explain, what they do not swallow, and when faces are one part."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.surfaces import extruded, smooth_surfaces
from detectors.surfaces.background import background
from detectors.surfaces.extruded import (
    MOST_STRIPS,
    Profile,
    direction_of,
    explains_better,
    profiled,
    with_twist,
)
from detectors.surfaces.faces import turns_back
from detectors.surfaces.pieces import LEAST_PX, part_text, piece_facts
from detectors.surfaces.surface import SurfaceConfig, polynomial
from tests.detectors.test_crop import cloud_of

NOISE_M = 3e-4


def grooved(depth_m: float, seed: int = 0) -> np.ndarray:
    """z (150, 200) of a plane at 0.8 m with grooves of 12 mm every 64 mm along the columns."""
    columns = np.arange(200)
    groove = (columns % 20) < 4
    z_m = np.broadcast_to(0.8 + depth_m * groove, (150, 200)).copy()
    return z_m + NOISE_M * np.random.default_rng(seed).standard_normal(z_m.shape)


def test_grooves_are_fitted_and_a_hole_between_them_is_not() -> None:
    z_m = grooved(2e-3)
    z_m[70:76, 88:94] += 5e-3
    cloud = cloud_of(z_m)
    ground = background(cloud, cloud.valid, SurfaceConfig(shape="auto"))
    assert ground.notes["shape"] == "extruded profile along 90 degrees"
    rest_m = ground.residual_m
    assert abs(np.nanmedian(rest_m[:60, 100:104])) < 2e-4
    assert np.nanmedian(rest_m[71:75, 89:93]) > 4e-3
    assert np.isfinite(rest_m).mean() > 0.95


def spread_of(curve_m: np.ndarray, residuals_m: np.ndarray) -> np.ndarray:
    """The spread (k,) of a profile with knots 1 mm apart, seen along parallel rays by points with
    residuals (200, k) from it."""
    rows, columns = np.indices(residuals_m.shape)
    profile = Profile(
        along=np.array([0.0, 1.0, 0.0]),
        across=np.array([1.0, 0.0, 0.0]),
        ahead=np.array([0.0, 0.0, 1.0]),
        first=0.0,
        step=1e-3,
        curve=curve_m,
        central=False,
    )
    places_m = [1e-3 * columns, 1e-3 * rows, curve_m[columns] + residuals_m]
    points = np.stack([place_m.ravel() for place_m in places_m], axis=1)
    return profile.with_spread(points).spread_m


def test_scatter_on_a_smooth_curve_is_no_doubt_about_its_place() -> None:
    """A parabola bends as much over 2 knots as over 6 explains; a step of 3 mm does not."""
    random = np.random.default_rng(5)
    knots = np.arange(60)
    residuals_m = 1e-4 * random.standard_normal((200, 60))
    residuals_m[:, 28:33] *= 10.0
    curved_m = 0.8 + 1e-4 * (knots - 30.0) ** 2
    assert (spread_of(curved_m, residuals_m) == 0.0).all()
    stepped_m = 0.8 + 3e-3 * (knots >= 30)
    assert spread_of(stepped_m, residuals_m)[29:32] == pytest.approx([1e-3] * 3, rel=0.25)


def test_the_place_beside_a_step_is_uncertain_by_the_step_at_most() -> None:
    """Residuals of 12 mm beside a step of 3 mm have another cause: the bend of 3 mm counts."""
    random = np.random.default_rng(6)
    residuals_m = 1e-4 * random.standard_normal((200, 60))
    residuals_m[:, 30] += 12e-3
    stepped_m = 0.8 + 3e-3 * (np.arange(60) >= 30)
    assert spread_of(stepped_m, residuals_m)[30] == pytest.approx(3e-3, rel=0.15)


@pytest.mark.parametrize("central", [False, True])
@pytest.mark.parametrize("tilt_deg", [0.0, 60.0])
def test_a_step_of_a_tilted_sheet_is_higher_along_the_rays(central: bool, tilt_deg: float) -> None:
    """A step of 3 mm on a sheet that is tilted along its profile, about the optical axis: rays
    meet its sides 3 mm over the cosine of the tilt apart."""
    cosine = np.cos(np.radians(tilt_deg))
    sine = np.sin(np.radians(tilt_deg))
    curve_m = 0.8 * cosine + 3e-3 * (np.arange(60) >= 30)
    profile = Profile(
        along=np.array([0.0, cosine, sine]),
        across=np.array([1.0, 0.0, 0.0]),
        ahead=np.array([0.0, -sine, cosine]),
        first=-30e-3,
        step=1e-3,
        curve=1.0 / curve_m if central else curve_m,
        central=central,
    )
    rows, columns = np.indices((200, 60)).reshape(2, -1)
    z_m = 0.8 + 1e-4 * (rows - 99.5) * sine
    y_m = 1e-4 * (rows - 99.5) * cosine
    x_m = 1e-3 * (columns - 30.0) * (0.8 if central else 1.0)
    points = np.stack([x_m, y_m, z_m], axis=1)
    for _ in range(3):
        on_sheet_m = profile(points)
        if central:
            points = points * (on_sheet_m / points[:, 2])[:, None]
        else:
            points[:, 2] = on_sheet_m
    noise_m = 1e-4 * np.random.default_rng(6).standard_normal(len(points))
    off_m = noise_m + np.where(columns == 30, 20e-3, 0.0)
    if central:
        points = points * (1.0 + off_m / points[:, 2])[:, None]
    else:
        points[:, 2] += off_m
    spread_m = profile.with_spread(points).spread_m
    knot = int(np.median(profile.knots_of(points[columns == 30])))
    assert spread_m[knot] == pytest.approx(3e-3 / cosine, rel=0.2)


def test_a_profile_knows_how_little_its_place_is_known_beside_steps() -> None:
    """Three in ten pixels of the strips beside a groove are on its other side, in all bands; a
    dent of 8 mm in two of ten bands does not make its strips uncertain."""
    z_m = grooved(3e-3)
    rng = np.random.default_rng(1)
    for first in range(4, 200, 20):
        z_m[:, first] += 3e-3 * (rng.random(150) < 0.3)
    z_m[60:80, 90:98] += 8e-3
    cloud = cloud_of(z_m)
    ground = background(cloud, cloud.valid, SurfaceConfig(shape="auto"))
    assert np.median(ground.spread_m[:, 104]) == pytest.approx(3e-3 * 0.3**0.5, rel=0.2)
    assert ground.noise_m[5, 104] > 4.0 * ground.noise_m[5, 110]
    assert (ground.spread_m[:, 88:99] == 0.0).all()
    assert (ground.spread_m[:, 107:117] == 0.0).all()


def test_a_plane_is_no_profile() -> None:
    points = cloud_of(grooved(0.0)).points_m.reshape(-1, 3)
    plane = polynomial(points, np.ones(len(points)), degree=2)
    directed = direction_of(points, plane, 1 / 250, True)
    assert directed is None or not explains_better(with_twist(directed, points), plane, points)


@pytest.mark.parametrize(("depth_m", "is_sought"), [(0.0, False), (3e-4, True)])
def test_a_twist_is_sought_only_of_a_profile_that_is_there(
    depth_m: float, is_sought: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sought = []

    def search(profile: Profile, points: np.ndarray) -> Profile:
        sought.append(profile)
        return with_twist(profile, points)

    monkeypatch.setattr(extruded, "with_twist", search)
    cloud = cloud_of(grooved(depth_m))
    ground = background(cloud, cloud.valid, SurfaceConfig(shape="auto"))
    assert bool(sought) == is_sought
    assert ground.notes["shape"].startswith("extruded") == is_sought


@pytest.mark.parametrize("extent", [(0.0, 0.0), (0.2, 0.0), (0.0, 0.2)])
def test_points_in_one_place_or_in_a_plane_through_the_camera_have_no_direction(
    extent: tuple[float, float],
) -> None:
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (500, 3))
    points = points * (*extent, 0.1) + (0.0, 0.0, 0.5)
    if extent == (0.0, 0.0):
        points[:] = (0.0, 0.0, 0.5)
    base = polynomial(points, np.ones(500), degree=2)
    pitch = max(extent) / 100
    assert direction_of(points, base, pitch, True) is None


def test_the_direction_of_grooves_is_found() -> None:
    points = cloud_of(grooved(2e-3)).points_m.reshape(-1, 3)
    plane = polynomial(points, np.ones(len(points)), degree=2)
    directed = direction_of(points, plane, 1 / 250, True)
    assert directed is not None
    assert abs(directed.along[1]) > np.cos(np.radians(0.2))
    assert explains_better(with_twist(directed, points), plane, points)


def test_a_crease_of_a_bent_sheet_is_fitted_to_its_ends() -> None:
    # the sheet is bent by 24 mm along its crease, into a direction 14 degrees off its mean normal
    rng = np.random.default_rng(3)
    along_m = rng.uniform(-0.4, 0.4, 40_000)
    across_m = rng.uniform(-0.3, 0.3, 40_000)
    height_m = 0.5 * np.maximum(across_m - 0.1 * along_m, 0.0)
    height_m += 0.15 * along_m**2 + 0.3 * across_m**2
    points = np.column_stack([along_m, across_m, 0.9 + height_m])
    points *= 1.0 + 2e-4 * rng.standard_normal((40_000, 1))
    base = polynomial(points, np.ones(len(points)), degree=2)
    directed = direction_of(points, base, 1 / 300, True)
    assert directed is not None
    residuals_m = points[:, 2] - with_twist(directed, points)(points)
    is_end = np.abs(along_m) > 0.32
    is_crease = np.abs(across_m - 0.1 * along_m) < 0.02
    at_crease_m = float(np.sqrt(np.mean(residuals_m[is_end & is_crease] ** 2)))
    assert at_crease_m < 1.5 * 2e-4
    assert profiled(directed, base, points, 0.0) is not None


def test_a_trapezoid_turns_back_and_a_corner_does_not() -> None:
    columns = np.arange(200)
    web = 0.04 * (np.clip((columns - 60) / 10, 0, 1) - np.clip((columns - 130) / 10, 0, 1))
    corner = np.maximum(columns - 100, 0) * 0.0032
    for z_m, expected in ((0.8 + web, True), (0.8 + corner, False)):
        points = cloud_of(np.broadcast_to(z_m, (150, 200)).copy()).points_m.reshape(-1, 3)
        base = polynomial(points, np.ones(len(points)), degree=2)
        directed = direction_of(points, base, 1 / 250, True)
        assert directed is not None
        assert turns_back(directed.fitted(points), 35.0) == expected


def test_the_share_of_a_part_is_weighted_by_area() -> None:
    pieces = [
        {"area_m2": 0.3, "share": 1.0, "fit": "plane"},
        {"area_m2": 0.1, "share": 0.6, "fit": "plane"},
    ]
    assert part_text(pieces) == "part: 2 pieces, 0.4 m2 seen, 90 % of it judged"


def test_what_shows_far_behind_through_a_hole_does_not_turn_the_frame() -> None:
    """A plane with a tenth of its points four times as far away: the mean plane of all points
    would be seen edge on, and its places would not fit into the memory."""
    rng = np.random.default_rng(1)
    slopes = rng.uniform(-0.2, 0.2, (20_000, 2))
    z_m = 0.7 + 1e-3 * rng.standard_normal(20_000)
    z_m[np.hypot(slopes[:, 0] - 0.05, slopes[:, 1]) < 0.07] = 2.8
    points = np.column_stack([slopes * z_m[:, None], z_m])

    def base(points_m: np.ndarray) -> np.ndarray:
        return np.full(len(points_m), 0.7)

    assert direction_of(points, base, 0.0025, central=True) is None


def test_pieces_have_the_area_of_their_pixels_and_the_share_of_it_that_was_judged() -> None:
    """Pixels of the right half see twice as much; a row of each piece was not judged."""
    part = np.zeros((60, 100), bool)
    part[5:25, 10:30] = True
    part[5:35, 60:90] = True
    part[50, 50] = True

    assert 1 < LEAST_PX <= 400
    pixel_m2 = np.where(np.arange(100) < 50, 1e-6, 2e-6) * np.ones((60, 1))
    residual_m = np.zeros((60, 100))
    residual_m[5] = np.nan
    large, small = piece_facts(part, pixel_m2, residual_m, "plane")
    assert large["area_m2"] == pytest.approx(900 * 2e-6)
    assert large["share"] == pytest.approx(29 / 30)
    assert small["area_m2"] == pytest.approx(400 * 1e-6)
    assert small["share"] == pytest.approx(19 / 20)
    assert {large["fit"], small["fit"]} == {"plane"}


def test_a_grazing_view_of_a_profile_does_not_need_an_endless_curve() -> None:
    """One point whose ray is nearly parallel to the profile's plane lies a million steps across;
    the curve stays short, and the others keep their places."""
    profile = Profile(
        along=np.array([0.0, 1.0, 0.0]),
        across=np.array([1.0, 0.0, 0.0]),
        ahead=np.array([0.0, 0.0, 1.0]),
        first=0.0,
        step=0.001,
        curve=np.zeros(2),
        central=True,
    )
    slopes = np.linspace(-0.2, 0.2, 4001)
    points = np.column_stack([slopes * 0.7, np.zeros_like(slopes), np.full_like(slopes, 0.7)])
    grazing = np.array([[7e5 * 0.001, 0.0, 0.0007]])
    fitted = profile.fitted(np.vstack([points, grazing]))
    assert len(fitted.curve) <= MOST_STRIPS + 1
    np.testing.assert_allclose(fitted(points), 0.7, rtol=1e-9)


def test_the_steps_of_a_rounded_plane_are_no_profile_where_rounding_is_known() -> None:
    rows = np.indices((150, 200))[0]
    z_m = np.round(0.8 + 1.5e-5 * rows, 3)
    points = cloud_of(z_m).points_m.reshape(-1, 3)
    points = points + 1e-6 * np.random.default_rng(0).standard_normal(points.shape)
    plane = polynomial(points, np.ones(len(points)), degree=2)
    directed = direction_of(points, plane, 1 / 250, True)
    assert directed is not None
    profile = with_twist(directed, points)
    assert explains_better(profile, plane, points)
    assert not explains_better(profile, plane, points, rounding_m=1e-3 / np.sqrt(12))


@pytest.mark.parametrize(("width_px", "is_face"), [(16, False), (30, True)])
def test_a_strip_beside_a_rim_is_no_face(
    width_px: int, is_face: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blur and filter make a ramp of a small step: with what lies behind, it looks like a profile.
    The strip ends at the picture's edge."""
    height = 120
    surface = np.zeros((height, 100 + width_px), bool)
    surface[:, :100] = True
    unbroken = np.ones(surface.shape, np.int32)
    points_m = np.ones((*surface.shape, 3))
    monkeypatch.setattr(smooth_surfaces, "extruded_faces", lambda *_: unbroken > 0)
    (part,) = smooth_surfaces._with_faces(
        surface[None],
        unbroken,
        points_m,
        apart_m=0.005,
        crease_deg=35.0,
        central=True,
        reach=9,
    )
    assert part.all() == is_face
    assert part[:, :100].all()
