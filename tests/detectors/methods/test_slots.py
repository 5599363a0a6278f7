"""Slots that are refined: their energies and scores by dense sums, and what is found of one."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from detectors.findings import templates
from detectors.findings.templates import SLOT_LENGTHS_PX, SLOT_WIDTH_PX, SLOTS_DEG, SlotSides, bank
from detectors.findings.whitening import GRID
from detectors.methods import slots
from detectors.methods.scatter import FAINT

SHAPE = (90, 110)
WHITE = np.ones((GRID, GRID // 2 + 1), np.float32)
MIDDLE = (45.3, 54.8)


def seen(length_px: float, width_px: float, angle_deg: float, window_px: int) -> np.ndarray:
    """A slot around `MIDDLE`, as a camera sees it."""
    finer = 8
    height, width = SHAPE
    rows, columns = (np.indices((height * finer, width * finer)) + 0.5) / finer - 0.5
    from_middle = (columns - MIDDLE[1]) + 1j * (rows - MIDDLE[0])
    turned = from_middle * np.exp(-1j * np.radians(angle_deg))
    along = turned.real
    across = turned.imag
    inside = (np.abs(along) < length_px / 2) & (np.abs(across) < width_px / 2)
    pixels = inside.reshape(height, finer, width, finer).mean(axis=(1, 3))
    lens = cv2.GaussianBlur(pixels, (0, 0), templates.LENS_BLUR_PX)
    return cv2.blur(lens, (window_px, window_px)).astype(np.float32)


@pytest.mark.parametrize(("window_px", "error"), [(1, 0.12), (3, 0.08), (5, 0.08)])
def test_energies_in_white_noise_are_sums_of_squares(window_px: int, error: float) -> None:
    """Those of the bank's slots, but for how these are drawn and interpolated."""
    energies = slots.energies(WHITE, window_px)
    width = slots.WIDTHS_PX.index(SLOT_WIDTH_PX)
    for template in bank(window_px):
        if template.slot:
            angle = SLOTS_DEG.index(template.slot.angle_deg)
            length = slots.LENGTHS_PX.index(template.slot.length_px)
            # a rectangle is a sum over half pixels across
            energy = slots.ACROSS_PX**2 * energies[angle, length, width]
            assert energy == pytest.approx((template.image**2).sum(), rel=error)
    louder = slots.energies(4.0 * WHITE, window_px)
    np.testing.assert_allclose(louder, energies / 4.0, rtol=1e-5)


def test_energies_are_those_of_the_noise_along_each_angle() -> None:
    """Noise of high power at frequencies along rows weakens slots across rows."""
    power = WHITE.copy()
    power[:, 6:] = 100.0
    energies = slots.energies(power, 1)
    length = slots.LENGTHS_PX.index(24)
    along = energies[SLOTS_DEG.index(0.0), length, 0]
    across = energies[SLOTS_DEG.index(90.0), length, 0]
    assert along > 3.0 * across


@pytest.mark.parametrize(
    ("length_px", "width_px", "angle_deg"),
    [
        (18.0, 2.0, 33.75),
        (10.0, 3.0, 3.0),
        (32.0, 1.0, 97.0),
        (24.0, 4.0, 150.0),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_slot_is_found_with_its_size_and_place(
    length_px: float,
    width_px: float,
    angle_deg: float,
    sign: float,
) -> None:
    """In white noise, from a peak of the bank 1 to 2 pixels beside its middle: the score is that of
    the slot's own picture within 4 %."""
    picture = sign * seen(length_px, width_px, angle_deg, 1)
    nearest = min(SLOTS_DEG, key=lambda deg: abs((deg - angle_deg + 90.0) % 180.0 - 90.0))
    start = SlotSides(SLOT_LENGTHS_PX[1], SLOT_WIDTH_PX, nearest)
    energies = slots.energies(WHITE, 1)
    centre = (MIDDLE[0] + 1.2, MIDDLE[1] - 0.8)
    slot = slots.best_slot(slots.blurred(picture, 1), energies, centre, start, sign)
    exact = math.sqrt((picture**2).sum())
    assert 0.96 * exact < sign * slot.score < 1.02 * exact
    assert slot.length_px == pytest.approx(length_px, rel=0.26)
    assert slot.width_px == pytest.approx(width_px, abs=1.0)
    turn_deg = (slot.angle_deg - angle_deg + 90.0) % 180.0 - 90.0
    assert abs(turn_deg) < 3.0
    assert math.hypot(slot.row - MIDDLE[0], slot.column - MIDDLE[1]) < 1.6


def test_a_slot_of_the_other_sign_has_no_score() -> None:
    picture = -seen(18.0, 2.0, 0.0, 1)
    start = SlotSides(SLOT_LENGTHS_PX[1], SLOT_WIDTH_PX, 0.0)
    energies = slots.energies(WHITE, 1)
    slot = slots.best_slot(slots.blurred(picture, 1), energies, MIDDLE, start, 1.0)
    assert slot.score < 0.05 * math.sqrt((picture**2).sum())


def test_the_strongest_peaks_are_refined() -> None:
    signed = np.zeros((40, 50), np.float32)
    signed[10, 10] = slots.LEAST + 0.1
    signed[20, 20] = -8.0
    signed[20, 22] = -7.0
    signed[30, 30] = slots.LEAST - 0.1
    assert slots.peaks_of(signed).tolist() == [[20, 20], [10, 10]]


def test_scores_are_lowered_by_how_many_slots_there_are() -> None:
    scores = np.array([-6.0, FAINT, 1.0, 0.0])
    lowered = slots.lowered(scores)
    assert lowered[0] == pytest.approx(-math.sqrt(36.0 - slots.CROWD))
    share = math.sqrt(1.0 - slots.CROWD / FAINT**2)
    np.testing.assert_allclose(lowered[1:], share * scores[1:], rtol=1e-6)
