"""The scatter of scores against its plainly written reference."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.findings.templates import SlotSides, Template
from detectors.methods import scatter_reference as reference
from detectors.methods.scatter import (
    FEWEST,
    PART_PX,
    RIM_ENDS_PX,
    UNEVEN,
    Zones,
    evened,
    scatter,
    tail_of,
    zones_of,
)
from detectors.methods.template_scores import keep_stronger

SHAPE = (90, 120)
NARROW = Template(np.zeros((1, 1)), 2.2)


def depth_px(shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Distance of each pixel from beyond the picture's edge."""
    rows, columns = np.indices(shape)
    nearest = np.minimum(
        np.minimum(rows, shape[0] - 1 - rows), np.minimum(columns, shape[1] - 1 - columns)
    )
    return (nearest + 1).astype(np.float32)


def noisy(seed: int, rim: float = 1.0) -> np.ndarray:
    """Scores of deviation 1, and of ``rim`` within three pixels of the edge."""
    scores = np.random.default_rng(seed).standard_normal(SHAPE)
    return np.where(depth_px() <= 3, rim * scores, scores).astype(np.float32)


def zones(loud: np.ndarray | None = None) -> Zones:
    if loud is None:
        loud = np.zeros(SHAPE, bool)
    return zones_of(np.ones(SHAPE, np.float32), depth_px(), loud)


def test_zones_are_the_pixels_by_their_distance_from_the_outline() -> None:
    is_seen = np.ones(SHAPE, np.float32)
    is_seen[40:50, 40:50] = 0.0
    result = zones_of(is_seen, depth_px(), np.zeros(SHAPE, bool))
    start = 0
    least_px = 0.0
    for most_px, end in zip(RIM_ENDS_PX, result.ends, strict=True):
        inside = (depth_px() > least_px) & (depth_px() <= most_px) & (is_seen > 0)
        np.testing.assert_array_equal(np.sort(result.pixels[start:end]), np.flatnonzero(inside))
        start = end
        least_px = most_px
    assert start == len(result.pixels)


@pytest.mark.parametrize("rim", [0.5, 1.0, 1.7, 4.0])
def test_deviations_are_those_of_the_reference(rim: float) -> None:
    scores = noisy(1, rim)
    loud = np.random.default_rng(2).random(SHAPE) < 0.1
    scores[loud] = 100.0
    scores[::7] = 0.0
    result = scatter(scores, zones(loud), loud).deviations
    expected = reference.deviations(scores, depth_px(), loud)
    np.testing.assert_allclose(result, expected, rtol=2e-3)
    # no zone has less than the inside of the picture
    assert result.min() == result[-1]


def test_zones_with_few_scores_have_the_deviation_of_the_inside() -> None:
    scores = noisy(1, 4.0)
    hidden = depth_px() == 1
    count = FEWEST - 1
    scores.ravel()[np.flatnonzero(hidden)[count:]] = 0.0
    result = scatter(scores, zones(), np.zeros(SHAPE, bool)).deviations
    assert result[0] == result[-1]
    # the next one is wide
    assert result[1] > 3.0


def test_sums_and_counts_are_those_of_squares() -> None:
    scores = noisy(3)
    scores[:10] = 0.0
    loud = np.zeros(SHAPE, bool)
    loud[50:60, 20:30] = True
    result = scatter(scores, zones(), loud)
    assert result.sums.shape == (SHAPE[0] // PART_PX, SHAPE[1] // PART_PX)
    sizes = np.minimum(np.abs(scores), 2.0) * ~loud
    rows = np.arange(12) * SHAPE[0] // 11
    columns = np.arange(16) * SHAPE[1] // 15
    for image, counted in ((sizes, result.sums), (sizes > 0, result.counts)):
        by_row = np.add.reduceat(image.astype(float), rows[:-1], axis=0)
        expected = np.add.reduceat(by_row, columns[:-1], axis=1)
        np.testing.assert_allclose(counted, expected, rtol=1e-5)


def test_evened_scores_have_one_deviation_in_all_zones() -> None:
    scores = noisy(4, 2.5)
    deviation = evened(scores, NARROW, zones())
    assert deviation == pytest.approx(1.0, rel=0.03)
    result = scatter(scores, zones(), np.zeros(SHAPE, bool)).deviations
    np.testing.assert_allclose(result, deviation, rtol=0.05)


def test_scores_where_the_noise_is_higher_are_divided() -> None:
    """Four times the noise on the left third: what is left of it there is what chance explains."""
    scores = np.random.default_rng(5).standard_normal((120, 360)).astype(np.float32)
    scores[:, :120] *= 4.0
    inside = np.full(scores.shape, 100.0, np.float32)
    still = np.zeros(scores.shape, bool)
    deviation = evened(scores, NARROW, zones_of(np.ones_like(inside), inside, still))
    left_share = scores[:, :80].std() / deviation
    right_share = scores[:, 200:].std() / deviation
    assert left_share == pytest.approx(UNEVEN, rel=0.15)
    # the quiet part stays as it is
    assert scores[:, 200:].std() == pytest.approx(1.0, rel=0.02)
    assert right_share < 1.0


@pytest.mark.parametrize(("quiet", "deviation"), [(FEWEST, 7.0), (FEWEST + 1, 1.0)])
def test_too_few_quiet_scores_leave_the_scatter_to_the_loud_ones(
    quiet: int, deviation: float
) -> None:
    """Loud scores scatter seven times as much, all of them far from the outline."""
    scores = (7.0 * np.random.default_rng(8).standard_normal(SHAPE)).astype(np.float32)
    loud = np.ones(SHAPE, bool)
    loud.ravel()[:quiet] = False
    scores.ravel()[:quiet] = np.random.default_rng(9).standard_normal(quiet)
    far_px = np.full(SHAPE, 100.0, np.float32)
    one_zone = zones_of(np.ones(SHAPE, np.float32), far_px, loud)
    assert evened(scores, NARROW, one_zone) == pytest.approx(deviation, rel=0.1)


@pytest.mark.parametrize("slot", [False, True])
def test_strong_scores_of_wide_templates_do_not_count(slot: bool) -> None:
    sides = SlotSides(24.0, 2.0, 0.0) if slot else None
    wide = Template(np.zeros((1, 1)), 5.0, slot=sides)
    scores = noisy(6)
    scores[30:60, 30:90] = 50.0
    # of a slot's scores, the block of a fifth of the pixels counts as 2 each
    counted = scores if slot else noisy(6)
    expected = reference.deviations(counted, depth_px(), np.zeros(SHAPE, bool))[-1]
    assert evened(scores, wide, zones()) == pytest.approx(expected, rel=0.05)


def test_a_tail_is_measured_on_its_shorter_side() -> None:
    scores = np.random.default_rng(7).standard_normal((300, 400)).astype(np.float32)
    assert tail_of(scores, 1.0) == pytest.approx(1.0, abs=0.04)
    two_sided = scores.copy()
    two_sided[::20, ::20] = 6.0
    # one side alone is damage
    assert tail_of(two_sided, 1.0) == pytest.approx(1.0, abs=0.04)
    two_sided[::20, 1::20] = -5.0
    assert tail_of(two_sided, 1.0) == pytest.approx(5.0 / 3.29, rel=1e-4)
    assert tail_of(2.0 * scores, 2.0) == pytest.approx(tail_of(scores, 1.0), rel=1e-6)
    # too few scores show no tail
    assert tail_of(two_sided[:3, :3], 1.0) == 1.0


@pytest.mark.parametrize(
    ("down", "right"),
    [
        (0, 0),
        (1, 1),
        (0, 1),
        (1, 0),
    ],
)
def test_the_stronger_of_two_templates_is_kept(down: int, right: int) -> None:
    random = np.random.default_rng(8)
    scores = (6.0 * random.standard_normal((12, 15))).astype(np.float32)
    signed = (4.0 * random.standard_normal((12, 15))).astype(np.float32)
    template = np.full(signed.shape, 7, np.uint8)
    expected = signed.copy()
    expected_by = template.copy()
    raised = reference.raised(scores.astype(float), 2.0, 1.3)
    for i, j in np.ndindex(12, 15):
        # a score between pixels belongs to all around
        for row in range(i, min(i + down, 11) + 1):
            for column in range(j, min(j + right, 14) + 1):
                fits = i + down < 12 or row == i
                fits = fits and (j + right < 15 or column == j)
                if fits and abs(raised[i, j]) > abs(expected[row, column]):
                    expected[row, column] = raised[i, j]
                    expected_by[row, column] = 3
    keep_stronger(signed, template, scores, 1 / 2.0, 1.3, down, right, 3)
    np.testing.assert_allclose(signed, expected, rtol=1e-5)
    np.testing.assert_array_equal(template, expected_by)


def test_the_limit_of_strong_scores_is_that_of_the_inside() -> None:
    """A rim that scatters four times as widely does not raise it: a block at six deviations of the
    inside does not count."""
    wide = Template(np.zeros((1, 1)), 5.0)
    scores = noisy(6, rim=4.0)
    scores[30:60, 30:90] = 6.0
    without = scores.copy()
    without[30:60, 30:90] = 0.0
    expected = reference.deviations(without, depth_px(), np.zeros(SHAPE, bool))[-1]
    assert evened(scores, wide, zones()) == pytest.approx(expected, rel=0.05)
