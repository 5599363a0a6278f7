"""The family of shapes against its plainly written reference, and averages of its fits by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.findings import family
from detectors.findings import hole_model_reference as reference
from detectors.findings.family import (
    BLURS,
    DEPTH_ERROR,
    DIAMETER_ERROR,
    LENS_ERROR_PX2,
    RADIUS_ERROR_PX,
    ShapeFit,
    Start,
    averaged,
    mixture,
    sized,
)
from detectors.findings.hole_model import HoleFit, fit_hole
from detectors.findings.hole_patch import HolePatch
from detectors.findings.pictures import pictures
from detectors.findings.shapes import CLOSE, SCRATCH, Shape, SightLines, _see_bowl, _see_cap
from detectors.findings.viewpoints import sight

EMITTER_M = np.array([-14e-3, 0.0, 1e-3])
FRONTAL_PX_M = np.array([[1.4e-3, 0.0, 1e-4], [0.0, 1.5e-3, -2e-4]])
OBLIQUE_PX_M = np.array([[1.4e-3, 0.0, 1.3e-3], [2e-4, 1.5e-3, 1e-4]])
"""A surface turned by 43 degrees about the columns."""


def patch_of(per_px_m: np.ndarray, noise_m: float = 1e-4) -> HolePatch:
    shape = (36, 40)
    viewpoint = sight(np.array([0.03, -0.02, 0.7]), per_px_m, EMITTER_M)
    return HolePatch(
        residual_m=np.zeros(shape),
        used=np.ones(shape, bool),
        metric_m2=per_px_m @ per_px_m.T,
        blur_px=(4.5, 3.0),
        noise_m=noise_m,
        sights=viewpoint[None],
    )


def numbers_of(shape: Shape, depth_m: float = 5e-3) -> np.ndarray:
    radius_m = 5e-3 if shape == "slot" else 12e-3
    stretch = math.log(2.2) if shape == "slot" else 0.0
    return np.array([19.3, 17.6, radius_m, depth_m, 0.5, stretch, 0.6])


@pytest.mark.parametrize("per_px_m", [FRONTAL_PX_M, OBLIQUE_PX_M])
@pytest.mark.parametrize("shape", ["cap", "bowl", "slot"])
@pytest.mark.parametrize("depth_m", [5e-3, -3e-3])
def test_a_picture_is_that_of_the_reference(
    per_px_m: np.ndarray, shape: Shape, depth_m: float
) -> None:
    patch = patch_of(per_px_m)
    numbers = numbers_of(shape, depth_m)
    image_m = pictures(patch, numbers[None], shape)[0]
    expected_m = reference.relief(patch, numbers, shape)
    np.testing.assert_allclose(image_m, expected_m, atol=0.02 * abs(depth_m))
    assert image_m.sum() == pytest.approx(expected_m.sum(), rel=0.015)


@pytest.mark.parametrize("shape", ["cap", "bowl"])
@pytest.mark.parametrize("deepest_m", [4e-3, -4e-3, 30e-3])
def test_a_line_of_sight_ends_on_the_relief(shape: Shape, deepest_m: float) -> None:
    """At the depth t, a line is at its point minus t times the drift, where the relief has this
    depth; a cap of 30 mm is deeper than its rim's radius."""
    lines = SightLines(-0.013, 0.002, 7e-4, -1e-4, 0.12, -0.2)
    depths_m = np.empty(36)
    if shape == "cap":
        _see_cap(lines, 12e-3, deepest_m, depths_m)
    else:
        _see_bowl(lines, 12e-3, deepest_m, np.empty((SCRATCH, 36)), depths_m)
    steps = np.arange(36)
    first_m = np.array([lines.along, lines.across])
    step_m = np.array([lines.step_along, lines.step_across])
    points_m = first_m + steps[:, None] * step_m
    met_m = points_m - depths_m[:, None] * np.array([lines.drift_along, lines.drift_across])
    expected_m = reference._height_m(met_m, 12e-3, deepest_m, 1.0, shape)
    inside = np.hypot(*points_m.T) < 12e-3
    error_m = 1e-12 if shape == "cap" else CLOSE * abs(deepest_m)
    np.testing.assert_allclose(depths_m[inside], expected_m[inside], atol=error_m)
    np.testing.assert_array_equal(depths_m[~inside], 0.0)
    assert 10 < inside.sum() < 36


@pytest.mark.parametrize(
    ("shape", "volume"),
    [
        ("cap", math.pi * 4.0 / 6.0 * (3.0 * 12.0**2 + 4.0**2)),
        ("bowl", math.pi * 12.0**2 * 4.0 * (0.5 - 2.0 / math.pi**2)),
        ("slot", 4.0 * 10.0 * 22.0),
    ],
)
def test_a_frontal_picture_has_the_volume_of_the_solid(shape: Shape, volume: float) -> None:
    """Volumes in mm3: of a spherical cap, of a raised cosine, and of a box."""
    per_px_m = np.diag([1.4e-3, 1.5e-3, 0.0])[:2]
    patch = replace(patch_of(per_px_m), sights=np.array([[1.0, 0, 0, 0, 0, 0, 1.0, 1.0]]))
    image_m = pictures(patch, numbers_of(shape, 4e-3)[None], shape)[0]
    assert image_m.sum() * 1.4e-3 * 1.5e-3 == pytest.approx(volume * 1e-9, rel=0.005)


def test_a_soft_blur_has_the_second_moments_of_the_sharp_one() -> None:
    patch = patch_of(FRONTAL_PX_M)
    numbers = numbers_of("disc")[None]
    numbers[0, 3] = -1e-3
    rows, columns = np.indices(patch.used.shape)
    moments = []
    for soft in (False, True):
        image = -pictures(replace(patch, soft=soft), numbers)[0]
        across = np.average((columns - 19.3) ** 2, weights=image)
        moments.append([across, np.average((rows - 17.6) ** 2, weights=image)])
    np.testing.assert_allclose(moments[0], moments[1], rtol=0.02)


@pytest.mark.parametrize("per_px_m", [FRONTAL_PX_M, OBLIQUE_PX_M])
@pytest.mark.parametrize("shape", ["disc", "cap", "bowl", "slot"])
def test_a_shape_is_recognised_and_its_size_lies_within_two_errors(
    per_px_m: np.ndarray, shape: Shape
) -> None:
    truth = numbers_of(shape)
    blank = patch_of(per_px_m)
    draws = np.random.default_rng(7).standard_normal(blank.used.shape)
    noise_m = cv2.blur(draws, (5, 3)) * math.sqrt(15.0) * 1e-4
    seen_m = pictures(blank, truth[None], shape)[0] + noise_m
    start = Start(
        u_px=19.0,
        v_px=18.0,
        radius_m=9e-3,
        depth_m=4.5e-3,
        offset_m=0.0,
        stretch=truth[5],
        angle_rad=0.5,
    )
    patch = replace(blank, residual_m=seen_m)
    size = sized(patch, start, ("disc", "cap", "bowl", "slot"), BLURS[:1])
    assert size is not None and size.shape == shape
    area = 4.0 / math.pi * math.exp(truth[5]) if shape == "slot" else 1.0
    diameter_m = 2.0 * truth[2] * math.sqrt(area)
    assert abs(size.diameter_m - diameter_m) < 2.0 * size.diameter_se_m < 0.2 * diameter_m
    assert abs(size.depth_m - truth[3]) < 2.0 * size.depth_se_m < 0.3 * truth[3]
    assert sum(size.weights.values()) == pytest.approx(1.0)


def test_where_the_blur_hides_the_shape_the_error_contains_all() -> None:
    """A hole as wide as the blur, in noise: a disc of 5.6 mm may be a bowl of 9."""
    blank = patch_of(FRONTAL_PX_M, noise_m=3e-4)
    truth = np.array([19.3, 17.6, 2.8e-3, 4e-3, 0.5, 0.0, 0.0])
    draws = np.random.default_rng(3).standard_normal(blank.used.shape)
    seen_m = pictures(blank, truth[None])[0] + cv2.blur(draws, (5, 3)) * math.sqrt(15.0) * 3e-4
    start = Start(19.0, 18.0, 2.5e-3, 3e-3, 0.0, 0.0, 0.0)
    patch = replace(blank, residual_m=seen_m)
    size = sized(patch, start, ("disc", "cap", "bowl"), BLURS[:1])
    assert size is not None
    assert sum(weight > 0.05 for weight in size.weights.values()) >= 2
    alone = sized(patch, start, ("disc",), BLURS[:1])
    assert alone is not None
    assert size.diameter_se_m > 1.5 * alone.diameter_se_m


@pytest.mark.parametrize("per_px_m", [FRONTAL_PX_M, OBLIQUE_PX_M])
@pytest.mark.parametrize("shape", ["cap", "bowl"])
@pytest.mark.parametrize(("radii", "is_possible"), [(1.0, True), (1.35, False), (4.0, False)])
def test_no_hollow_of_a_smooth_shape_is_deeper_than_its_radius(
    per_px_m: np.ndarray, shape: Shape, radii: float, is_possible: bool
) -> None:
    """``radii``: depth along the normal over the radius."""
    blank = patch_of(per_px_m)
    cosine = float(blank.sights[0, 0])
    truth = numbers_of(shape, radii * 12e-3 / cosine)
    draws = np.random.default_rng(5).standard_normal(blank.used.shape)
    noise_m = cv2.blur(draws, (5, 3)) * math.sqrt(15.0) * 1e-4
    patch = replace(blank, residual_m=pictures(blank, truth[None], shape)[0] + noise_m)
    start = Start(
        u_px=19.3,
        v_px=17.6,
        radius_m=9e-3,
        depth_m=truth[3],
        offset_m=0.0,
        stretch=0.0,
        angle_rad=0.0,
    )
    size = sized(patch, start, ("disc", "cap", "bowl"), BLURS[:2])
    weights = {} if size is None else size.weights
    assert (weights.get(shape, 0.0) > 0.5) is is_possible
    assert (shape in weights) is is_possible


def test_a_dim_floor_does_not_narrow_a_hole_where_light_weighs() -> None:
    """A floor of half the face's light, between two of those tried: taken for as bright, the hole is
    a tenth too narrow."""
    blank = replace(patch_of(FRONTAL_PX_M), blur_px=(3.0, 3.0), brightness=0.5)
    truth = np.array([19.3, 17.6, 5e-3, 33e-3, 0.2, 0.0, 0.0])
    draws = np.random.default_rng(3).standard_normal(blank.used.shape)
    seen_m = pictures(blank, truth[None])[0] + cv2.blur(draws, (3, 3)) * 3.0 * 1e-4
    start = Start(19.0, 18.0, 4.5e-3, 30e-3, 0.0, 0.0, 0.0)
    by_light = replace(blank, residual_m=seen_m, brightness=1.0)
    size = sized(by_light, start, ("disc",), BLURS[:1])
    assert size is not None
    assert size.best.shape == "disc"
    assert abs(size.diameter_m - 10e-3) < 2.0 * size.diameter_se_m < 2e-3
    assert size.diameter_m == pytest.approx(10e-3, rel=0.04)
    unweighted = sized(replace(by_light, brightness=0.0), start, ("disc",), BLURS[:1])
    assert unweighted is not None
    assert unweighted.diameter_m < 0.95 * 10e-3


def test_a_mixture_has_the_variance_within_and_between() -> None:
    mean, deviation = mixture(np.array([0.75, 0.25]), np.array([4.0, 8.0]), np.array([1.0, 2.0]))
    assert mean == pytest.approx(5.0)
    assert deviation**2 == pytest.approx(0.75 * (1.0 + 1.0) + 0.25 * (2.0 + 9.0))


def fit_of(shape: Shape, chi_square: float, **changes: float) -> HoleFit:
    covariance = np.zeros((8, 8))
    covariance[2, 2] = 1e-8
    covariance[3, 3] = 4e-8
    covariance[6, 6] = 1e-4
    fit = HoleFit(
        u_px=0.0,
        v_px=0.0,
        radius_m=6e-3,
        depth_m=4e-3,
        offset_m=0.0,
        wall=0.5,
        covariance=covariance,
        converged=True,
        shape=shape,
        chi_square=chi_square,
        independent=50.0,
    )
    return replace(fit, **changes)


def test_weights_are_priors_times_the_evidence() -> None:
    """Equal numbers of parameters: exp(-BIC / 2) is chi square to the power -n / 2."""
    patch = patch_of(FRONTAL_PX_M)
    disc = ShapeFit(fit_of("disc", 52.0), patch)
    cap = ShapeFit(fit_of("cap", 50.0), patch, loss=2.0)
    size = averaged([disc, cap])
    ratio = 0.7 / 0.15 * (50.0 / 52.0) ** 25.0 * math.e
    assert size.weights["disc"] / size.weights["cap"] == pytest.approx(ratio)


def test_errors_are_those_of_the_fit_of_what_it_leaves_and_of_the_model() -> None:
    patch = replace(patch_of(FRONTAL_PX_M), metric_m2=np.diag([1e-6, 4e-6]), blur_px=(2.0, 1.5))
    # residuals have twice the noise's variance; pi 36 / 2 pixels lie inside, a third independent
    slack = ShapeFit(fit_of("disc", 100.0), patch)
    inside = math.pi * 36.0 / 2.0 / 3.0
    raised = 1.0 + inside * 0.5
    assert slack.raised == pytest.approx(raised)
    edge_m2 = RADIUS_ERROR_PX**2 * 2.5e-6 + (LENS_ERROR_PX2 * 2.5e-6 / 6e-3) ** 2
    expected_m2 = raised * 4e-8 + 4.0 * edge_m2 + (DIAMETER_ERROR["disc"] * 12e-3) ** 2
    assert slack.diameter_variance_m2 == pytest.approx(expected_m2)
    assert slack.depth_variance_m2 == pytest.approx(raised * 4e-8 + (DEPTH_ERROR * 4e-3) ** 2)
    assert ShapeFit(fit_of("disc", 40.0), patch).raised == 1.0


def test_errors_of_the_radius_move_the_depth_that_hangs_on_it() -> None:
    """A fit that knows the volume alone: the depth falls by 2 x depth / radius per radius."""
    patch = patch_of(FRONTAL_PX_M)
    hidden = fit_of("disc", 40.0)
    hidden.covariance[2, 3] = -2.0 * 4e-3 / 6e-3 * 1e-8
    fit = ShapeFit(hidden, patch)
    pixel_m2 = float(np.trace(patch.metric_m2)) / 2.0
    edge_m2 = RADIUS_ERROR_PX**2 * pixel_m2 + (LENS_ERROR_PX2 * pixel_m2 / 6e-3) ** 2
    radius_m2 = edge_m2 + (DIAMETER_ERROR["disc"] * 6e-3) ** 2
    own_m2 = (DEPTH_ERROR * 4e-3) ** 2
    expected_m2 = 4e-8 + (8.0 / 6.0) ** 2 * radius_m2 + own_m2
    assert fit.depth_variance_m2 == pytest.approx(expected_m2)


def test_a_slot_s_diameter_is_that_of_the_circle_with_its_area() -> None:
    patch = patch_of(FRONTAL_PX_M)
    slot = ShapeFit(fit_of("slot", 50.0, stretch=math.log(3.0)), patch)
    size = averaged([slot])
    diameter_m = math.sqrt(4.0 / math.pi * 12e-3 * 36e-3)
    assert size.diameter_m == pytest.approx(diameter_m)
    pixel_m2 = np.trace(patch.metric_m2) / 2.0
    edge_m2 = 4.0 * RADIUS_ERROR_PX**2 * pixel_m2 + (2.0 * LENS_ERROR_PX2 * pixel_m2 / 6e-3) ** 2
    fitted_m2 = (diameter_m / 6e-3) ** 2 * 1e-8 + (diameter_m / 2.0) ** 2 * 1e-4
    expected_m2 = fitted_m2 + edge_m2 + (DIAMETER_ERROR["slot"] * diameter_m) ** 2
    assert size.diameter_se_m**2 == pytest.approx(expected_m2)


def test_a_slot_s_angle_and_length_are_fitted() -> None:
    patch = patch_of(FRONTAL_PX_M)
    truth = numbers_of("slot")
    seen_m = pictures(patch, truth[None], "slot")[0]
    fit = fit_hole(
        replace(patch, residual_m=seen_m),
        19.0,
        18.0,
        4e-3,
        4e-3,
        0.0,
        shape="slot",
        stretch=0.5,
        angle_rad=0.4,
    )
    assert fit.converged
    np.testing.assert_allclose(fit.numbers[[0, 1, 6]], truth[[0, 1, 6]], atol=0.02)
    np.testing.assert_allclose(fit.numbers[[2, 3, 5]], truth[[2, 3, 5]], rtol=0.02)


def test_a_slot_s_length_width_and_angle_lie_within_their_errors() -> None:
    """In 24 draws of noise that the blur correlates: errors over standard errors have a root mean
    square of about 1 for the angle, and less for the sides, whose errors contain the model's."""
    patch = replace(patch_of(FRONTAL_PX_M), blur_px=(3.0, 3.0))
    truth = numbers_of("slot")
    clear_m = pictures(patch, truth[None], "slot")[0]
    length_m = 2.0 * truth[2] * math.exp(truth[5])
    pulls = []
    for seed in range(24):
        white = np.random.default_rng(seed).standard_normal(clear_m.shape)
        noise_m = cv2.blur(white, (3, 3)) * 3.0 * 4e-4
        noisy = replace(patch, residual_m=clear_m + noise_m, noise_m=4e-4)
        fit = fit_hole(
            noisy,
            19.0,
            18.0,
            4e-3,
            4e-3,
            0.0,
            shape="slot",
            stretch=0.5,
            angle_rad=0.4,
        )
        length_se_m, width_se_m, angle_se_rad = ShapeFit(fit, noisy).slot_errors
        width_m = 2.0 * fit.radius_m
        pulls.append(
            [
                (width_m * math.exp(fit.stretch) - length_m) / length_se_m,
                (width_m - 2.0 * truth[2]) / width_se_m,
                (fit.angle_rad - truth[6]) / angle_se_rad,
            ]
        )
    length, width, angle = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert 0.45 < length < 0.75
    assert 0.45 < width < 0.75
    assert 0.8 < angle < 1.2


def noisy_hole(noise_m: float) -> HolePatch:
    """A drilled hole of 12 mm radius in noise that the blur correlates."""
    patch = patch_of(FRONTAL_PX_M, noise_m)
    clear_m = pictures(patch, numbers_of("disc")[None])[0]
    white = np.random.default_rng(4).standard_normal(clear_m.shape)
    noise = cv2.blur(white, (5, 3)) * math.sqrt(15.0) * noise_m
    return replace(patch, residual_m=clear_m + noise)


def test_a_descent_ends_early_where_its_shape_cannot_explain_the_pixels() -> None:
    patch = noisy_hole(1e-4)
    start = (19.0, 18.0, 11e-3, 4e-3, 0.0)
    disc = fit_hole(patch, *start)
    cap = fit_hole(patch, *start, shape="cap")
    assert cap.converged
    assert cap.chi_square > 3.0 * disc.chi_square
    assert not fit_hole(patch, *start, shape="cap", largest_chi_square=disc.chi_square).converged
    again = fit_hole(patch, *start, shape="cap", largest_chi_square=cap.chi_square)
    assert again.converged
    np.testing.assert_array_equal(again.numbers, cap.numbers)
    np.testing.assert_array_equal(again.covariance, cap.covariance)


@pytest.mark.parametrize(
    ("noise_m", "kept"),
    [
        (1e-4, ["disc"]),
        (5e-4, ["disc", "cap"]),
        (2e-3, ["disc", "cap", "bowl"]),
    ],
)
def test_shapes_that_are_left_out_change_no_size(
    noise_m: float, kept: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    patch = noisy_hole(noise_m)
    start = Start(19.0, 18.0, 11e-3, 4e-3, 0.0, 0.0, 0.0)
    size = sized(patch, start, ("disc", "cap", "bowl"), BLURS[:1])
    monkeypatch.setattr(family, "LEAST_WEIGHT", 1e-300)
    complete = sized(patch, start, ("disc", "cap", "bowl"), BLURS[:1])
    assert size is not None
    assert complete is not None
    assert list(size.weights) == kept
    assert len(complete.weights) == 3
    assert [shape for shape, weight in complete.weights.items() if weight >= 1e-9] == kept
    assert size.diameter_m == pytest.approx(complete.diameter_m, rel=1e-7)
    assert size.depth_m == pytest.approx(complete.depth_m, rel=1e-7)
    assert size.depth_se_m == pytest.approx(complete.depth_se_m, rel=1e-3)
