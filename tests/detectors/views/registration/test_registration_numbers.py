"""Numbers of a registration against plain ones: the covariance of ICP, the sandwich, limits of
trust, widening, sampling."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import block_diag
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from detectors.rigid_motion import moved_by
from detectors.views.marks.mark import Mark, MarkSet, off_line_problem
from detectors.views.registration import register, registered
from detectors.views.registration.by_marks import JointState, ViewData
from detectors.views.registration.by_points import (
    LEAST_VARIANCE,
    _covariance,
    coherent_point_drift,
)
from detectors.views.registration.pairing import FIT_CHI2, pair_marks
from detectors.views.registration.settings import CpdRegistration
from detectors.views.view import PreparedView, View
from harness.vocabulary.geometry import Cloud, Lens, transform_points
from tests.support.plain_clouds import cloud_of_points

PITCH_M = 2e-3


def sheet(seed: int, points: int = 500) -> np.ndarray:
    """Points (n, 3) of a bent sheet of 0.2 m x 0.1 m."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(-1.0, 1.0, (2, points)) * [[0.1], [0.05]]
    z = 0.7 + 0.02 * np.sin(30 * x) * np.cos(40 * y)
    return np.stack([x, y, z], axis=1) + 3e-4 * random.standard_normal((points, 3))


def plain_sandwich(
    curvature: np.ndarray,
    scores: np.ndarray,
    points: np.ndarray,
    pitch_m: float,
) -> np.ndarray:
    """H^-1 S H^-1, S from cubes of five pitches."""
    corner = points.min(axis=0)
    sums: dict[tuple, np.ndarray] = {}
    for point, score in zip(points, scores, strict=True):
        cube = tuple(np.floor((point - corner) / (5 * pitch_m)).astype(int).tolist())
        sums[cube] = sums.get(cube, np.zeros(6)) + score
    scatter = sum(np.outer(total, total) for total in sums.values())
    inverse = np.linalg.inv(curvature)
    return inverse @ (scatter * len(sums) / (len(sums) - 1)) @ inverse


def test_the_covariance_of_icp_is_that_of_its_cost() -> None:
    """Curvature by differences of the cost with new pairs, over motions that move the points by
    one pitch, root mean square; the scatter of the gradients by cubes."""
    fixed = sheet(1, 900)
    moved = np.concatenate([sheet(2, 600), sheet(3, 30) + np.array([0.0, 0.3, 0.0])])
    pitch_m = 2 * PITCH_M
    limit_m = 3 * pitch_m
    centre = moved.mean(axis=0)
    arm = moved - centre

    def displacements(motion: np.ndarray) -> np.ndarray:
        return np.cross(motion[:3], arm) + motion[3:]

    def cost(motion: np.ndarray) -> float:
        nearest = cdist(moved + displacements(motion), fixed).min(axis=1)
        return 0.5 * float(np.sum(np.minimum(nearest, limit_m) ** 2))

    steps = []
    for unit in np.eye(6):
        size = np.sqrt(np.mean(np.sum(displacements(unit) ** 2, axis=1)))
        steps.append(unit * pitch_m / size)
    curvature = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            first = 0.5 * steps[i] if i == j else steps[i]
            second = 0.5 * steps[j] if i == j else steps[j]
            mixed = cost(first + second) + cost(-first - second)
            mixed -= cost(first - second) + cost(second - first)
            curvature[i, j] = mixed / (4 * first[i] * second[j])
    distances = cdist(moved, fixed)
    nearest = distances.argmin(axis=1)
    off = moved - fixed[nearest]
    off[distances.min(axis=1) >= limit_m] = 0.0
    assert 0 < (off == 0).all(axis=1).sum() < 200
    scores = np.concatenate([np.cross(arm, off), off], axis=1)
    scores -= scores.mean(axis=0)
    expected = plain_sandwich(curvature, scores, moved, pitch_m)
    result = _covariance(cKDTree(fixed), moved, limit_m, pitch_m)
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_a_sandwich_is_that_of_sums_over_cubes() -> None:
    random = np.random.default_rng(3)
    points = random.uniform(0.0, 0.06, (200, 3))
    scores = random.standard_normal((200, 6)) * [1.0, 2.0, 0.5, 30.0, 10.0, 20.0]
    root = random.standard_normal((6, 6))
    curvature = root @ root.T + 3.0 * np.eye(6)
    result = registered.clustered_sandwich(curvature, scores, points, PITCH_M)
    expected = plain_sandwich(curvature, scores, points, PITCH_M)
    np.testing.assert_allclose(result, expected, rtol=1e-9)
    np.testing.assert_array_equal(result, result.T)
    # the objective's unit does not matter, nor that of length
    for unit in (1e-14, 1e14):
        scaled = registered.clustered_sandwich(unit * curvature, unit * scores, points, PITCH_M)
        np.testing.assert_allclose(scaled, result, rtol=1e-9)
    longer = np.array([1.0] * 3 + [1e6] * 3)
    scaled = registered.clustered_sandwich(
        curvature / np.outer(longer, longer), scores / longer, 1e6 * points, 1e6 * PITCH_M
    )
    np.testing.assert_allclose(scaled / np.outer(longer, longer), result, rtol=1e-7)


def test_a_sandwich_needs_seven_cubes_and_a_definite_curvature() -> None:
    random = np.random.default_rng(4)
    corners = np.arange(7)[:, None] * [5.01 * PITCH_M, 0.0, 0.0]
    points = np.repeat(corners, 3, axis=0)
    scores = random.standard_normal((21, 6))
    definite = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert np.isfinite(registered.clustered_sandwich(definite, scores, points, PITCH_M)).all()
    of_few = registered.clustered_sandwich(definite, scores[:18], points[:18], PITCH_M)
    assert np.isnan(of_few).all()
    for worst in (-1e-3, 0.0):
        indefinite = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, worst])
        assert np.isnan(registered.clustered_sandwich(indefinite, scores, points, PITCH_M)).all()


def test_clouds_that_coincide_have_the_least_width() -> None:
    """The drift ends at half of its least variance, in units of the fixed cloud's size."""
    points = sheet(5, 60)
    drift = coherent_point_drift(
        points, points, CpdRegistration(outlier_ratio=0.0, tolerance=1e-300)
    )
    scale = np.sqrt(np.sum(np.var(points, axis=0)))
    assert pytest.approx(10 * np.finfo(float).eps) == LEAST_VARIANCE
    assert drift.sigma_m == pytest.approx(scale * np.sqrt(5 * np.finfo(float).eps), rel=1e-6)
    assert drift.converged


# --- trust ---


def agreement(**values: float) -> register.Agreement:
    fields = {
        "beside": 1.0,
        "overlap": 1.0,
        "apart_m": 0.0,
        "marks_m": float("nan"),
        "pitch_m": 1e-3,
        "noise_m": 1.5e-3,
        "grids_m": 1e-3 / np.sqrt(6.0),
        "scatter": 0.2,
        "marks_scatter": 0.3,
    }
    return register.Agreement(**{**fields, **values})


@pytest.mark.parametrize(
    ("values", "limit_mm", "what"),
    [
        # noise of 1.5 mm and 2 mm of blur: 2.5 mm, plus a fifth
        ({}, 3.0, "surfaces"),
        # pixels coarser than the blur
        ({"pitch_m": 3.6e-3}, 3.9 * 1.2, "surfaces"),
        # marks: also two grids of 1 mm / sqrt 6
        ({}, np.hypot(2.5, 1 / np.sqrt(6.0)) * 1.3, "marks"),
    ],
)
def test_views_farther_apart_than_their_noise_and_the_blur_are_refused(values, limit_mm, what):
    field = "apart_m" if what == "surfaces" else "marks_m"
    for factor, is_refused in ((0.999, False), (1.001, True)):
        text = register._apart(agreement(**{**values, field: factor * limit_mm * 1e-3}))
        assert bool(text) == is_refused
        if is_refused:
            assert what in text
            assert f"(up to {limit_mm:.1f} mm are merged)" in text


def test_a_covariance_is_widened_by_what_noise_does_not_explain() -> None:
    """Noise 1 mm and a predicted error of 0.5 mm across explain 1.118 mm of 2 mm; with the rest,
    0.4 mm within and 0.3 mm of the grids, 2.1 mm of the marks' 5 mm is explained."""
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) * 1e-8
    registration = registered.Registration("v", "marks", np.eye(4), covariance=covariance)
    normal = np.array([0.6, 0.0, -0.8])
    measured = agreement(noise_m=1e-3, grids_m=3e-4, apart_m=2e-3, marks_m=5e-3)
    result = register._widened(registration, normal, 4e-4, 5e-4, measured)
    across_mm2 = 4.0 - (1.0 + 0.25)
    within_mm2 = 25.0 - (1.0 + 0.25 + 0.16 + 0.09 + across_mm2)
    along = np.outer(normal, normal)
    added = across_mm2 * along + 0.5 * within_mm2 * (np.eye(3) - along)
    expected = covariance.copy()
    expected[3:, 3:] += 1e-6 * added
    np.testing.assert_allclose(result.covariance, expected, rtol=1e-12, atol=1e-18)
    sizes = f"{np.sqrt(across_mm2):.2g} mm across and {np.sqrt(within_mm2):.2g} mm along"
    assert sizes in result.notes[0]
    # what the scatter allows is no such error
    quiet = replace(measured, apart_m=1.19 * np.hypot(1e-3, 5e-4), marks_m=1.29e-3 * np.sqrt(1.5))
    assert register._widened(registration, normal, 4e-4, 5e-4, quiet) is registration
    loud = replace(quiet, apart_m=1.21 * np.hypot(1e-3, 5e-4))
    widened = register._widened(registration, normal, 4e-4, 5e-4, loud)
    beyond_mm2 = 1.25 * (1.21**2 - 1.0)
    np.testing.assert_allclose(
        (widened.covariance - covariance)[3:, 3:], 1e-6 * beyond_mm2 * along, atol=1e-18
    )
    assert "along" not in widened.notes[0]


def view_of(points_m: np.ndarray, guess: np.ndarray | None = None) -> PreparedView:
    """A view of points without a grid."""
    count = len(points_m)
    flat = np.zeros((1, count), np.uint8)
    cloud = Cloud(
        points_m=points_m[None],
        reason=flat,
        count=flat + 1,
        variance_m2=np.full((1, count), np.nan),
        region=Lens(count, 1, 1.0, 1.0, 0.0, 0.0).whole,
        z_step_m=0.0,
        n_frames=1,
        organised=False,
    )
    return PreparedView(View("v", cloud, guess), cloud.valid, MarkSet((), np.zeros(0, int)))


@pytest.mark.parametrize(
    ("turn_deg", "shift_m", "is_credible"),
    [
        (29.9, 0.0, True),
        (30.1, 0.0, False),
        (0.0, 0.099, True),
        (0.0, 0.101, False),
        (29.9, 0.099, True),
    ],
)
def test_a_pose_far_from_its_guess_is_not_credible(turn_deg, shift_m, is_credible) -> None:
    """By 30 degrees, or by 0.1 m at the target's middle: the guess is in the first view's frame."""
    points = sheet(6) + np.array([0.3, 0.0, 0.0])
    first_guess = moved_by(np.array([0.2, 0.1, -0.3, 1.0, 2.0, 3.0]), np.zeros(3))
    guess = moved_by(np.array([0.1, -0.2, 0.1, 0.5, -0.1, 0.2]), np.zeros(3))
    reference = view_of(points, first_guess)
    view = view_of(points, first_guess @ guess)
    placed = transform_points(guess, points.mean(axis=0))
    axis = np.array([0.6, 0.0, 0.8])
    motion = np.concatenate([np.deg2rad(turn_deg) * axis, shift_m * np.array([0.0, -0.6, 0.8])])
    registration = registered.Registration("v", "icp", moved_by(motion, placed) @ guess)
    text = register._jump(registration, reference, view)
    assert (text == "") == is_credible
    if text:
        assert text.startswith(f"is {turn_deg:.0f} degrees and {1e3 * shift_m:.0f} mm away")
    assert register._jump(registration, view_of(points), view) == ""


# --- sampling ---


def test_a_plane_through_points_faces_the_camera() -> None:
    random = np.random.default_rng(7)
    normal = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])
    basis = Rotation.align_vectors([normal], [[0.0, 0.0, 1.0]])[0].as_matrix()
    plane = random.uniform(-0.1, 0.1, (50, 2)) @ basis[:, :2].T + [0.0, 0.1, 0.8]
    centre, found_normal = registered.plane_through(plane)
    np.testing.assert_allclose(found_normal, normal, atol=1e-9)
    np.testing.assert_allclose(centre, plane.mean(axis=0))
    centre, found_normal = registered.plane_through(plane[:2])
    np.testing.assert_allclose(found_normal, [0.0, 0.0, -1.0])
    np.testing.assert_allclose(centre, plane[:2].mean(axis=0))
    centre, found_normal = registered.plane_through(np.empty((0, 3)))
    np.testing.assert_array_equal(centre, np.zeros(3))
    np.testing.assert_array_equal(found_normal, [0.0, 0.0, -1.0])


def gridded(noise_m: float, tilt: float, lens: Lens, step_m: float = 0.0) -> PreparedView:
    slopes = lens.region_slopes(lens.whole)
    z_m = 0.8 / (1.0 - tilt * slopes[..., 0])
    z_m = z_m + noise_m * np.random.default_rng(8).standard_normal(z_m.shape)
    points_m = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    count = np.full(z_m.shape, 9)
    cloud = cloud_of_points(points_m, count=count, n_frames=9, z_step_m=step_m, lens=lens)
    return PreparedView(View("v", cloud, None), cloud.valid, MarkSet((), np.zeros(0, int)))


@pytest.mark.parametrize("tilt", [0.0, 0.8])
def test_the_sampling_of_a_grid_is_that_of_its_coarser_axis(tilt: float) -> None:
    """Pixels twice as wide as high, or tilted about y."""
    for fx, fy in ((200.0, 400.0), (400.0, 400.0)):
        lens = Lens(61, 51, fx, fy, 30.0, 25.0)
        view = gridded(2e-4, tilt, lens)
        sampling = registered.sampling_of(view)
        across = 0.8 / fx * np.hypot(1.0, tilt)
        assert sampling.pitch_m == pytest.approx(max(across, 0.8 / fy), rel=0.03)
        points = view.points_m
        diagonal = np.linalg.norm(points.max(axis=0) - points.min(axis=0))
        assert sampling.extent_m == pytest.approx(diagonal / 2)
        np.testing.assert_allclose(sampling.centre_m, points.mean(axis=0))
        if tilt == 0.0:
            assert sampling.noise_m == pytest.approx(2e-4, rel=0.06)


def test_the_pitch_of_a_grid_of_which_no_neighbours_are_known_is_that_of_its_points() -> None:
    """Every second pixel of both axes is known: still enough, six pixels apart, for the noise."""
    lens = Lens(121, 101, 400.0, 400.0, 60.0, 50.0)
    view = gridded(2e-4, 0.0, lens)
    is_known = np.zeros((101, 121), bool)
    is_known[::2, ::2] = True
    sparse_cloud = replace(view.view.cloud, reason=np.where(is_known, 0, 1).astype(np.uint8))
    sparse = replace(view, view=replace(view.view, cloud=sparse_cloud), inside=is_known)
    sampling = registered.sampling_of(sparse)
    assert sampling.pitch_m == pytest.approx(2 * 0.8 / 400.0, rel=0.02)
    assert sampling.noise_m == pytest.approx(2e-4, rel=0.06)


def test_the_noise_is_no_less_than_rounding_leaves_in_the_mean() -> None:
    lens = Lens(61, 51, 400.0, 400.0, 30.0, 25.0)
    coarse = registered.sampling_of(gridded(0.0, 0.0, lens, step_m=6e-3))
    assert coarse.noise_m == pytest.approx(6e-3 / np.sqrt(12.0 * 9))


@pytest.mark.parametrize(("count", "limit", "kept"), [(10, 10, 10), (11, 10, 6), (25, 10, 9)])
def test_thinned_points_are_evenly_strided(count: int, limit: int, kept: int) -> None:
    points = np.arange(3.0 * count).reshape(count, 3)
    result = registered.thinned(points, limit)
    assert len(result) == kept
    np.testing.assert_array_equal(result, points[:: -(-count // limit)])


def test_moves_and_independent_values_are_counted() -> None:
    points = sheet(9)
    motion = np.array([0.0, 0.0, 0.02, 0.001, -0.002, 0.003])
    change = moved_by(motion, np.zeros(3))
    moves = transform_points(change, points) - points
    expected = np.sqrt(np.mean(np.linalg.norm(moves, axis=1) ** 2))
    assert registered.moved_m(change, points) == pytest.approx(expected)
    assert registered.independent(24) == 1.0
    assert registered.independent(250) == 10.0


def test_agreement_counts_points_beside_and_together() -> None:
    """A flat reference and a view of which a quarter lies 4 mm behind, and a quarter beyond its
    edge."""
    grid = np.stack(np.meshgrid(np.arange(40), np.arange(40)), axis=-1).reshape(-1, 2) * 1e-3
    reference_points = np.column_stack([grid, np.full(len(grid), 0.8)])
    random = np.random.default_rng(10)
    points = reference_points + [0.0, 0.0, 1e-4] * random.standard_normal((len(grid), 1))
    quarter = len(grid) // 4
    points[:quarter, 2] += 4e-3
    points[-quarter:, 1] += 0.05
    reference = view_of(reference_points)
    view = view_of(points)
    sampling = replace(registered.sampling_of(reference), pitch_m=1e-3, noise_m=2e-4)
    result = register._agreement(reference, sampling, view, np.eye(4))
    assert result.beside == pytest.approx(0.75, abs=0.01)
    assert result.overlap == pytest.approx(0.5, abs=0.01)
    of_view = registered.sampling_of(view)
    assert result.pitch_m == pytest.approx(max(1e-3, of_view.pitch_m))
    assert result.noise_m == pytest.approx(np.hypot(2e-4, of_view.noise_m))
    assert result.grids_m == pytest.approx(result.pitch_m / np.sqrt(6.0))
    beside = 0.75 * len(grid)
    assert result.scatter == pytest.approx(3.09 * 1.65 / np.sqrt(2 * beside / 25), rel=0.02)
    # two thirds at 0.1 mm, a third at 4 mm: the median is that of the smaller ones' upper quarter
    assert result.apart_m == pytest.approx(1e-4 * 1.15 / 0.6745, rel=0.15)
    assert np.isnan(result.marks_m)
    assert result.marks_scatter == pytest.approx(3.09 / np.sqrt(2.0))


def test_agreement_of_marks_leaves_the_farthest_tenth_out() -> None:
    points = sheet(11, 400)
    indices = np.arange(0, 400, 4)
    reference = replace(view_of(points), marks=MarkSet((), indices))
    off = np.zeros((400, 3))
    off[indices[:90], 2] = 2e-4
    off[indices[90:], 2] = 0.5
    view = replace(view_of(points + off), marks=MarkSet((), indices))
    sampling = registered.sampling_of(reference)
    result = register._agreement(reference, sampling, view, np.eye(4))
    assert result.marks_m == pytest.approx(2e-4, rel=1e-6)
    assert result.marks_scatter == pytest.approx(3.09 / np.sqrt(2 * 100 / 25))


# --- pairs of marks ---


def mark_at(place: np.ndarray, sigma_m: float = 1e-4) -> Mark:
    return Mark(
        centre_m=place,
        covariance_m2=sigma_m**2 * np.eye(3),
        normal=np.array([0.0, 0.0, -1.0]),
        pixels=np.arange(20),
        area_m2=1e-4,
    )


RECTANGLE_M = 0.1 * np.array([[0.8, 0.6], [-0.8, 0.6], [-0.8, -0.6], [0.8, -0.6]])
"""Four marks, each 0.1 m from the middle."""


@pytest.mark.parametrize(("guess_deg", "is_clear"), [(0.0, True), (54.5, True), (57.5, False)])
def test_twin_placements_need_odds_of_90_to_1(guess_deg: float, is_clear: bool) -> None:
    """A rectangle and its half turn: with the guess turned by an angle from the first, the root
    mean squares from it are 0.2 m sin and cos of half of the angle, so that over 50 mm the odds
    are 8 times its cosine: 4.5 at 55.8 degrees."""
    centres = np.column_stack([RECTANGLE_M, np.full(4, 0.7)])
    marks = [mark_at(centre) for centre in centres]
    turn = np.array([0.0, 0.0, np.deg2rad(guess_deg), 0.0, 0.0, 0.0])
    guess = moved_by(turn, np.array([0.0, 0.0, 0.7]))
    pairing = pair_marks(marks, marks, guess)
    np.testing.assert_array_equal(pairing.pairs, np.repeat(np.arange(4)[:, None], 2, axis=1))
    assert (pairing.problem == "") == is_clear
    if not is_clear:
        near_mm = 200 * np.sin(np.deg2rad(guess_deg / 2))
        far_mm = 200 * np.cos(np.deg2rad(guess_deg / 2))
        assert f"{near_mm:.0f} mm from one, {far_mm:.0f} mm from the other" in pairing.problem
    blind = pair_marks(marks, marks, None)
    assert "there is no guess to choose by" in blind.problem


def test_a_mark_is_matched_within_the_limit_of_chi_square() -> None:
    """One of six marks is moved across its plane; both have 0.1 mm of noise and 1 mm that views do
    not share."""
    random = np.random.default_rng(12)
    centres = np.column_stack([random.uniform(-0.2, 0.2, (6, 2)), np.full(6, 0.8)])
    marks = [mark_at(centre) for centre in centres]
    deviation = np.sqrt(2 * (1e-3**2 + 1e-4**2))
    for sigmas, is_matched in ((0.5, True), (12.0, False)):
        moved = centres.copy()
        moved[2, 2] += sigmas * deviation
        pairing = pair_marks(marks, [mark_at(centre) for centre in moved], None)
        assert pairing.problem == ""
        assert (2 in pairing.pairs[:, 0]) == is_matched
        np.testing.assert_array_equal(pairing.pairs[:, 0], pairing.pairs[:, 1])
    # three degrees of freedom: a true match is lost once in 10,000
    assert stats.chi2.sf(FIT_CHI2, 3) == pytest.approx(1e-4, rel=0.02)


@pytest.mark.parametrize(
    ("off_mm", "sigma_mm", "is_line"),
    [(4.1, 0.01, False), (3.9, 0.01, True), (10.1, 2.0, False), (9.9, 2.0, True)],
)
def test_marks_on_a_line_are_told(off_mm, sigma_mm, is_line) -> None:
    """Four marks whose distance from their line is a root mean square of 2 % of that along it, or
    five deviations of a mark, whichever is more."""
    centres = np.array([[-0.2, 0.0, 0.7], [0.2, 0.0, 0.7], [-0.2, 0.0, 0.7], [0.2, 0.0, 0.7]])
    centres[:, 1] = np.array([1.0, 1.0, -1.0, -1.0]) * off_mm * 1e-3
    text = off_line_problem([mark_at(centre, sigma_mm * 1e-3) for centre in centres])
    assert bool(text) == is_line
    if is_line:
        assert f"{off_mm:.1f} mm off it" in text


# --- the joint adjustment ---

ORDERS = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
"""Orders of the surface's terms in x and y."""


def plain_residuals(state: JointState, data: list[ViewData]) -> tuple[np.ndarray, list]:
    """All residuals of the adjustment one after another: points across the surface, marks within
    the plane, each view's own terms; and the sizes of these parts."""
    parts = []
    for v, view in enumerate(data):
        x, y, z = transform_points(state.T[v], view.points_m).T
        height = np.zeros(len(x))
        for term, (i, j) in enumerate(ORDERS):
            along_x = np.polynomial.chebyshev.chebval(x / state.half_m[0], np.eye(4)[i])
            along_y = np.polynomial.chebyshev.chebval(y / state.half_m[1], np.eye(4)[j])
            height += (state.surface[term] + state.view_terms[v, term]) * along_x * along_y
        parts.append(z - height)
        for mark, label in view.marks:
            centre = transform_points(state.T[v], mark.centre_m)
            parts.append(centre[:2] - state.marks_m[label])
        parts.append(state.view_terms[v])
    return np.concatenate(parts), [len(part) for part in parts]


def test_the_normal_equations_are_those_of_numerical_derivatives() -> None:
    """Two views of a bent surface with three marks: the Gauss-Newton step's matrix and right side
    from differences of all residuals, with the weights held."""
    random = np.random.default_rng(15)
    T = np.stack([np.eye(4), moved_by(np.array([0.1, -0.2, 0.3, 0.01, 0.02, 0.8]), np.zeros(3))])
    view_terms = np.zeros((2, 10))
    view_terms[:, 0] = [2e-4, -3e-4]  # levels only, whose slope is 0
    state = JointState(
        T=T,
        surface=1e-3 * random.normal(size=10),
        view_terms=view_terms,
        marks_m=random.uniform(-0.1, 0.1, (3, 2)),
        shared_m=4e-4,
        half_m=np.array([0.2, 0.15]),
    )
    data = []
    for v, labels in enumerate(((0, 1, 2), (2, 0))):
        across = random.normal(size=(40, 2)) * [0.08, 0.06]
        # some points are far off
        height = 1e-3 * random.standard_t(2, size=(40, 1))
        points = transform_points(np.linalg.inv(T[v]), np.hstack([across, height]))
        marks = []
        for label in labels:
            centre = np.append(state.marks_m[label] + 1e-3 * random.normal(size=2), 0.0)
            root = 1e-4 * random.normal(size=(3, 3))
            mark = mark_at(transform_points(np.linalg.inv(T[v]), centre))
            marks.append((replace(mark, covariance_m2=root @ root.T), label))
        data.append(ViewData(points, tuple(marks), noise_m=2e-4, sigma_m=9e-4))
    residuals, sizes = plain_residuals(state, data)
    weights = []
    position = 0
    for v, view in enumerate(data):
        off = residuals[position : position + 40]
        scale = max(view.noise_m, np.median(np.abs(off)) / 0.6745)
        tukey = np.maximum(1.0 - (off / scale / 4.685) ** 2, 0.0) ** 2
        weights.append(np.diag(tukey / 9e-4**2))
        turn = T[v][:2, :3]
        for mark, _ in view.marks:
            weights.append(np.linalg.inv(turn @ mark.covariance_m2 @ turn.T))
        weights.append(np.eye(10) / 4e-4**2)
        position += 40 + 2 * len(view.marks) + 10
    assert position == sum(sizes)
    weight = block_diag(*weights)
    assert (np.diag(weight)[:40] < 0.5 / 9e-4**2).any()
    count = 6 + 10 + 6 + 20
    jacobian = np.empty((len(residuals), count))
    for unknown in range(count):
        step = np.zeros(count)
        step[unknown] = 1e-6
        ahead, _ = plain_residuals(state.moved(step, 4e-4), data)
        behind, _ = plain_residuals(state.moved(-step, 4e-4), data)
        jacobian[:, unknown] = (ahead - behind) / 2e-6
    matrix, right = state.equations(data)
    expected = jacobian.T @ weight @ jacobian
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(matrix / size, expected / size, atol=1e-5)
    slope = -jacobian.T @ weight @ residuals
    np.testing.assert_allclose(right, slope, atol=1e-4 * np.abs(slope).max(), rtol=1e-3)


@pytest.mark.parametrize(("columns_apart", "share"), [(91.5, 9), (89.5, 11)])
def test_views_need_a_tenth_of_overlap(columns_apart: float, share: int) -> None:
    """Views of 100 x 20 points in steps of 1 mm: so many columns of one lie within a step of the
    other."""
    grid = np.stack(np.meshgrid(np.arange(100), np.arange(20)), axis=-1).reshape(-1, 2) * 1e-3
    points = np.column_stack([grid, np.full(len(grid), 0.8)])
    points[:, 2] += 1e-4 * np.random.default_rng(16).standard_normal(len(points))
    reference = view_of(points)
    view = view_of(points + np.array([1e-3 * columns_apart, 0.0, 0.0]))
    registration = registered.Registration(
        "v", "icp", np.eye(4), covariance=1e-10 * np.eye(6), centre_m=points.mean(axis=0)
    )
    judged = register.judge(registration, reference, view)
    too_few = f"the views do not overlap: {share} % of the view lies beside"
    assert judged.failure.startswith(too_few) == (share < 10)


def test_a_judged_view_s_covariance_gains_what_it_does_not_explain_across() -> None:
    """Two planes 1.5 mm apart, with 0.1 mm of noise; the covariance states 0.2 mm across and 1 mm
    within each axis of the surface."""
    grid = np.stack(np.meshgrid(np.arange(60), np.arange(50)), axis=-1).reshape(-1, 2) * 1e-3
    points = np.column_stack([grid, np.full(len(grid), 0.8)])
    random = np.random.default_rng(17)
    reference = view_of(points + 1e-4 * random.standard_normal((len(points), 1)) * [0, 0, 1])
    offset_m = np.array([0.0, 0.0, 1.5e-3])
    view = view_of(points + offset_m + 1e-4 * random.standard_normal((len(points), 1)) * [0, 0, 1])
    covariance = np.diag([0.0, 0.0, 0.0, 1e-6, 1e-6, 4e-8])
    registration = registered.Registration(
        "v", "icp", np.eye(4), covariance=covariance, centre_m=points.mean(axis=0)
    )
    judged = register.judge(registration, reference, view)
    assert judged.failure == ""
    assert judged.overlap < 0.1
    # the median size over 0.6745
    apart_m2 = (1.5e-3 / 0.6745) ** 2
    noise_m2 = registered.sampling_of(reference).noise_m ** 2
    noise_m2 += registered.sampling_of(view).noise_m ** 2
    gained_m2 = (judged.covariance - covariance)[5, 5]
    assert gained_m2 == pytest.approx(apart_m2 - noise_m2 - 4e-8, rel=0.02)
    np.testing.assert_allclose((judged.covariance - covariance)[:5, :5], 0.0, atol=1e-9)
