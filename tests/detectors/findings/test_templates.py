"""Templates: pictures by their area, responses by direct sums, worth by dense algebra."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from detectors.findings.templates import (
    COARSE_PX,
    DEEP_PX,
    DENT_RADII_PX,
    RADII_PX,
    SIDES_PX,
    SLOT_LENGTHS_PX,
    SLOT_WIDTH_PX,
    SLOTS_DEG,
    SMALL_RADII_PX,
    WINDOWS_PX,
    Template,
    bank,
    halved,
    responses,
    spectra,
    transformed,
    window_of,
    worths,
)
from detectors.findings.whitening import GRID, LONGEST_LAG_PX

SHAPE = (90, 120)
GRID_SHAPE = (128, 152)
WHITE = np.ones((GRID, GRID // 2 + 1), np.float32)


def centroid(image: np.ndarray) -> np.ndarray:
    """Row and column of an image's centre from its middle."""
    rows, columns = np.indices(image.shape) - len(image) // 2
    return np.array([(image * rows).sum(), (image * columns).sum()]) / image.sum()


# ---- pictures


@pytest.mark.parametrize("window_px", WINDOWS_PX)
def test_the_bank_holds_discs_dents_and_slots_coarse_ones_last(window_px: int) -> None:
    templates = bank(window_px)
    coarse = [template.coarse for template in templates]
    assert coarse == sorted(coarse)
    slot_count = sum(template.slot is not None for template in templates)
    assert slot_count == len(SLOT_LENGTHS_PX) * len(SLOTS_DEG)
    small = [template for template in templates if template.radius_px in SMALL_RADII_PX]
    assert len(small) == 4 * len(SMALL_RADII_PX)
    deep = [template for template in templates if template.radius_px == DEEP_PX]
    assert len(deep) == (4 if window_px == 3 else 0)
    for template in templates:
        is_slot = template.slot is not None
        assert template.coarse == (is_slot or template.radius_px >= COARSE_PX)
        assert len(template.image) % 2 == 1


def test_a_deep_disc_is_blurred_less_than_by_the_window() -> None:
    """Variances add: of the disc, drawn from quarters of pixels, of the pixel and of the blur."""
    (deep,) = [
        template
        for template in bank(3)
        if template.radius_px == DEEP_PX and template.halves == (0, 0)
    ]
    half = len(deep.image) // 2
    offsets_px = np.arange(-half, half + 1)
    variance_px2 = (deep.image.sum(axis=0) * offsets_px**2).sum() / deep.image.sum()
    assert variance_px2 == pytest.approx(DEEP_PX**2 / 4 + 0.9**2 + 1 / 12, rel=0.06)


def of_radius(radius_px: float, window_px: int = 5) -> list[Template]:
    return [template for template in bank(window_px) if template.radius_px == radius_px]


@pytest.mark.parametrize("radius_px", [*SMALL_RADII_PX[1:], *RADII_PX])
def test_a_disc_has_the_volume_of_its_area(radius_px: float) -> None:
    for template in of_radius(radius_px):
        area_px2 = np.pi * radius_px**2
        assert template.image.sum() == pytest.approx(area_px2, rel=0.05)
        np.testing.assert_allclose(
            centroid(template.image),
            np.array(template.halves) / 2,
            atol=0.01,
        )


@pytest.mark.parametrize("radius_px", DENT_RADII_PX)
def test_a_dent_has_the_volume_of_a_paraboloid(radius_px: float) -> None:
    (template,) = of_radius(radius_px)
    assert template.image.sum() == pytest.approx(np.pi * radius_px**2 / 2, rel=0.01)
    # a window of 5 pixels lowers the middle by the mean square of the distance in it, 2 x 25 / 12,
    # and the lens and the pixel by a little more
    lowest = 1.0 - (2 * 25 / 12 + 1.0) / radius_px**2
    assert lowest - 0.02 < template.image.max() < 1.0 - 2 * 25 / 12 / radius_px**2 + 0.02


def test_slots_have_their_length_width_and_angle() -> None:
    slots = [template for template in bank(1) if template.slot]
    wanted = [(length, SLOT_WIDTH_PX, angle) for length in SLOT_LENGTHS_PX for angle in SLOTS_DEG]
    assert [template.slot for template in slots] == wanted
    for slot in slots:
        length, width, angle_deg = slot.slot
        assert slot.image.sum() == pytest.approx(length * width, rel=0.07)
        assert slot.radius_px == pytest.approx(np.sqrt(length * width / np.pi))
        rows, columns = np.indices(slot.image.shape) - len(slot.image) // 2
        turned = (columns + 1j * rows) * np.exp(-1j * np.radians(angle_deg))
        # a lens of 0.6 pixels and the pixel itself add to the moments of the rectangle
        added = 0.6**2 + 1 / 12
        along = (slot.image * turned.real**2).sum() / slot.image.sum()
        across = (slot.image * turned.imag**2).sum() / slot.image.sum()
        assert along == pytest.approx(length**2 / 12 + added, rel=0.03)
        assert across == pytest.approx(width**2 / 12 + added, rel=0.15)


# ---- responses


def test_responses_are_sums_of_products_with_the_picture() -> None:
    picture = np.random.default_rng(1).standard_normal(SHAPE).astype(np.float32)
    fine_spectrum = transformed(picture, GRID_SHAPE)
    coarse_spectrum = halved(fine_spectrum)
    checked_numbers = set()
    for pair, numbers in spectra(GRID_SHAPE, 3):
        coarse = bank(3)[numbers[0]].coarse
        fields = responses(coarse_spectrum if coarse else fine_spectrum, pair)
        for channel, number in enumerate(numbers):
            checked_numbers.add(number)
            image = bank(3)[number].image
            direct = cv2.filter2D(
                picture.astype(np.float64),
                -1,
                image,
                borderType=cv2.BORDER_CONSTANT,
            )
            if not coarse:
                np.testing.assert_allclose(
                    fields[: SHAPE[0], : SHAPE[1], channel],
                    direct,
                    atol=2e-4,
                )
                continue
            # in the middles of 2 x 2 pixels, to what a smooth template leaves between them
            between = cv2.blur(direct, (2, 2), anchor=(0, 0))[20:60:2, 20:80:2]
            error = fields[10:30, 10:40, channel] - between
            assert error.std() < 0.1 * direct.std()
    assert checked_numbers == set(range(len(bank(3))))


# ---- worth


def test_the_energy_in_white_noise_is_the_sum_of_squares() -> None:
    for template, worth in zip(bank(5), worths(WHITE, 5), strict=True):
        # coarse templates lose what little they have at high frequencies
        expected = (template.image**2).sum()
        assert worth.energy == pytest.approx(expected, rel=0.02 if template.coarse else 1e-4)
    louder = worths(4.0 * WHITE, 5)
    assert louder[3].energy == pytest.approx(worths(WHITE, 5)[3].energy / 4.0, rel=1e-5)


def test_the_rectangle_spreads_as_widely_as_the_energy() -> None:
    """A square of 2 b + 1 pixels has the mean square b^2 / 3 of distances along an axis; the
    nearest of the legal half-sides b is taken."""
    checked = 0
    for template, worth in zip(bank(5), worths(WHITE, 5), strict=True):
        rows, columns = np.indices(template.image.shape) - len(template.image) // 2
        energy = template.image**2
        step = 2 if template.coarse else 1
        for squares, side in ((columns**2, worth.sides[0]), (rows**2, worth.sides[1])):
            half_px = np.sqrt(3.0 * (energy * squares).sum() / energy.sum()) / step
            nearest = sorted(np.abs(np.array(SIDES_PX) - half_px))
            # offsets of half a pixel and decisions that are close may fall either way
            if not any(template.halves) and nearest[1] - nearest[0] > 0.3:
                assert (side - 1) // 2 == SIDES_PX[np.abs(np.array(SIDES_PX) - half_px).argmin()]
                checked += 1
    assert checked > 30


def test_the_legal_half_sides_are_near_those_of_all_templates() -> None:
    """Within half a pixel of small ones, and within a quarter of large ones."""
    half_sides_px = np.arange(0.0, 18.01, 0.25)
    distances_px = np.abs(half_sides_px[:, None] - np.array(SIDES_PX)).min(axis=1)
    assert (distances_px <= np.maximum(0.5, half_sides_px / 4)).all()


def test_templates_with_fewer_independent_maxima_are_raised() -> None:
    """The density of maxima is the root of the product of the second moments of the whitened
    spectrum along both axes; the logarithm of its ratio raises the square of a score."""
    densities = []
    slot_count = len(SLOT_LENGTHS_PX) * len(SLOTS_DEG)
    cycles = np.fft.fftfreq(GRID)
    for template in bank(5):
        power = np.abs(np.fft.fft2(template.image, (GRID, GRID))) ** 2
        if template.coarse:
            low = np.abs(cycles) <= 0.25
            power = power * np.outer(low, low)
        moments = (power.sum(axis=1) @ cycles**2) * (power.sum(axis=0) @ cycles**2)
        densities.append(np.sqrt(moments) / power.sum() * (slot_count if template.slot else 1))
    raised = np.array([worth.raised for worth in worths(WHITE, 5)])
    # relative to the narrowest disc, which is the first
    coarse = np.array([template.coarse for template in bank(5)])
    expected = np.log(densities[0] / np.array(densities)) + raised[0]
    fine = ~coarse & (raised > 0)
    np.testing.assert_allclose(raised[fine], expected[fine], atol=0.02)
    # a coarse picture has a quarter of the pixels, over which frequencies are twice as high
    wide = coarse & (raised > 0)
    np.testing.assert_allclose(raised[wide], expected[wide], atol=0.1)
    assert (raised >= 0).all()
    assert raised.min() == 0.0
    assert raised[-1] < raised.max()


# ---- the window that noise indicates


@pytest.mark.parametrize("side", [3, 5])
def test_the_window_is_where_the_covariance_bends(side: int) -> None:
    lags = np.abs(np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1))
    triangle = np.maximum(side - lags, 0) / side
    assert window_of(np.outer(triangle, triangle)) == side


def test_noise_that_neighbours_hardly_share_has_no_window() -> None:
    lags = np.abs(np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1))
    for neighbour, window_px in ((0.45, 1), (0.6, 3)):
        covariance = np.outer(neighbour**lags, neighbour**lags)
        assert window_of(covariance) == window_px


def test_scores_of_coarse_templates_change_little_between_the_pixels_that_are_scored() -> None:
    """The score of a template's own picture one pixel beside the best place along both axes: those
    of coarse ones fall by some hundredths, those of smaller sharp discs by more."""
    losses: dict[bool, list[float]] = {True: [], False: []}
    for template in bank(1):
        is_disc = template.radius_px in (*SMALL_RADII_PX, *RADII_PX)
        if template.slot or not (template.coarse or is_disc):
            continue
        image = np.pad(template.image, 2)
        beside = [(image * np.roll(image, step, axis=(0, 1))).sum() for step in (1, -1)]
        losses[template.coarse].append(1.0 - max(beside) / (image**2).sum())
    assert max(losses[True]) < 0.05 < min(losses[False])
    assert len(losses[True]) == 7
