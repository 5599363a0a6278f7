"""The steps of a render one by one: where it samples finely, and how many paths it follows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import Lens, Region
from scenes.optics import RenderConfig
from scenes.render import indirect, view
from scenes.render.direct import (
    DirectLight,
    OffFace,
    _error_m,
    _LaneSums,
    _slopes_kept,
    _told_closely,
)
from scenes.render.indirect import BATCHES, PATHS_A_LANE, PathWork, _gather, _sobol
from scenes.render.range_noise import range_noise_m
from scenes.render.view import (
    _around,
    _at_holes,
    _expected_noise_m,
    _inside_outline,
    _light_in_pixels,
)
from scenes.target.custom import (
    BoardConfig,
    DentConfig,
    FlatConfig,
    HoleConfig,
    PoseConfig,
    TargetConfig,
)
from scenes.target.mesh import Target, build_target

LENS = Lens(
    width=160,
    height=120,
    fx=200.0,
    fy=250.0,
    cx=79.5,
    cy=59.5,
)
FREQUENCIES_HZ = (20e6, 100e6)
WORK = PathWork(
    FREQUENCIES_HZ,
    bounces=2,
    seed=1,
)


@pytest.fixture(scope="module")
def target() -> Target:
    """A frontal board 0.5 m away: a hole of 40 mm, 16 px wide and 20 px high, and a dent."""
    config = TargetConfig(
        board=BoardConfig(
            width_mm=200.0,
            height_mm=120.0,
            thickness_mm=12.0,
            shape=FlatConfig(),
        ),
        holes=(
            HoleConfig(
                id=1,
                diameter_mm=38.0,
                centre_mm=(-40.0, 0.0),
                chamfer_mm=1.0,
            ),
        ),
        dents=(
            DentConfig(
                id=2,
                diameter_mm=40.0,
                depth_mm=4.0,
                centre_mm=(50.0, 0.0),
            ),
        ),
        pose=PoseConfig(distance_m=0.5),
    )
    return build_target(config)


@pytest.mark.parametrize("centre_m", [(0.0, 0.0, 0.5), (0.3, -0.2, 0.5), (-0.4, 0.4, 0.2)])
def test_no_point_of_a_ball_is_seen_beside_the_rays_around_it(
    centre_m: tuple[float, float, float],
) -> None:
    """The rays to points all over a ball of 0.1 m; they span at least half of what is kept."""
    random = np.random.default_rng(1)
    directions = random.standard_normal((20_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points_m = np.array(centre_m) + 0.1 * directions
    slopes = points_m[:, :2] / points_m[:, 2:]
    assert _around(slopes[None], np.array(centre_m), 0.1).all()
    middle = np.array(centre_m[:2]) / centre_m[2]
    twice_as_far = middle + 2.0 * (slopes - middle)
    assert not _around(twice_as_far[None], np.array(centre_m), 0.1).all()


def test_pixels_of_a_hole_are_one_and_those_about_its_rim_two(target: Target) -> None:
    """The rim's chamfer counts; a pixel is 2.5 mm wide, so that the rim lies between 17.5 and 22.5
    mm from the axis, minus and plus its chamfer."""
    slopes = LENS.region_slopes(LENS.whole)
    closeness = _at_holes(target, LENS, slopes)
    off_axis_m = np.linalg.norm(0.5 * slopes - [-0.04, 0.0], axis=-1)
    inner_m = 0.019 - 0.0025
    outer_m = 0.020 + 0.0025
    assert (closeness[off_axis_m < inner_m] == 1).all()
    assert (closeness[(off_axis_m > inner_m) & (off_axis_m < outer_m)] == 2).all()
    assert (closeness[off_axis_m > outer_m] == 0).all()


def test_the_outline_is_filled_and_all_counts_if_it_leaves_the_view(target: Target) -> None:
    region = Region(20, 100, 10, 150)
    inside = _inside_outline(target, LENS, region)
    slopes = LENS.region_slopes(region)
    expected = (np.abs(0.5 * slopes) < [0.1, 0.06]).all(axis=-1)
    # a filled polygon holds its rim of a pixel
    assert (inside | ~expected).all()
    assert (inside & ~expected).sum() < 2 * (80 + 60) + 8
    narrow = Lens(
        width=60,
        height=120,
        fx=200.0,
        fy=250.0,
        cx=29.5,
        cy=59.5,
    )
    assert _inside_outline(target, narrow, narrow.whole).all()


def direct_with(rays: OffFace, shape: tuple[int, int]) -> DirectLight:
    """Return direct light of which only the shape and the sub-rays are looked at."""
    none: Any = None
    return DirectLight(
        phasor=none,
        intensity=none,
        range_m=np.zeros(shape),
        surface=none,
        uv=none,
        coverage=none,
        fine=none,
        face=none,
        face_range_m=none,
        off_face=rays,
    )


def rays_in(pixels: np.ndarray, share: float) -> OffFace:
    count = len(pixels)
    return OffFace(
        pixel=pixels,
        counts=np.ones(count, int),
        share=np.full(count, share),
        slopes=np.zeros((count, 2), np.float32),
    )


def test_the_noise_to_expect_is_that_of_the_pixels_around() -> None:
    """Two neighbours with noise 1 and 3 mm, and one far away."""
    pixels = np.array([2 * 20 + 2, 2 * 20 + 3, 2 * 20 + 15])
    other_light = np.array([1.0, 2.0, 1.0], complex)
    mean = np.array([1.0, 0.5j, 1.0])
    noise_m = np.array([1e-3, 3e-3, 7e-3])
    expected_m = _expected_noise_m((6, 20), pixels, other_light, mean, noise_m)
    first = noise_m[1] * abs(2 + 0.5j) / abs(1 + 0.5j)  # the second's noise at its other light
    second = noise_m[0] * 2.0 / abs(2 + 1)
    assert expected_m == pytest.approx([first, second, noise_m[2]])


def test_paths_are_doubled_until_the_noise_is_what_is_wanted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """16 first paths, a quarter of the noise wanted: 16 times as many, 256, of which 16 stand."""
    calls = []

    def gather(
        lit: Any,
        rays: OffFace,
        work: PathWork,
        samples: np.ndarray,
        after: int = 0,
    ) -> np.ndarray:
        calls.append((rays.pixel.tolist(), np.asarray(samples).tolist(), after))
        return np.full((BATCHES, 3, len(rays.pixel)), 2.0 if after else 1.0, np.complex64)

    monkeypatch.setattr(view, "gather_in_pixels", gather)
    monkeypatch.setattr(view, "FIRST_SAMPLES", 16)
    expected_m = np.array([4e-4, 1e-4, 1e-1])
    monkeypatch.setattr(view, "_expected_noise_m", lambda *_: expected_m)
    pixels = np.array([3, 4, 5, 6])
    direct = direct_with(rays_in(pixels, 0.5), (2, 10))
    within = np.array([True, True, True, False])
    config = RenderConfig(
        hole_noise_mm=0.1,
        hole_samples=1024,
        rest_samples=24,
    )
    lit: Any = None
    total = np.ones((2, 4), complex)
    light = _light_in_pixels(
        lit,
        direct,
        total,
        within,
        WORK,
        config,
    )
    assert calls[0] == ([3, 4, 5, 6], [16, 16, 16, 24], 0)
    assert calls[1] == ([3, 5], [240, 1008], 16)
    means = light.mean(axis=(0, 1)).real
    assert means == pytest.approx([(16 + 2 * 240) / 256, 1.0, (16 + 2 * 1008) / 1024, 1.0])


class CountingWalk:
    """In place of `_Walk`: each path of a lane gives its number as light."""

    def __init__(self, *arguments: Any) -> None:
        self.longest = arguments[-1]
        self.lanes: list[np.ndarray] = []
        CountingWalk.last = self

    def sums(self, lanes: np.ndarray) -> np.ndarray:
        self.lanes.append(lanes)
        sums = np.zeros((3, lanes.shape[1]), np.complex64)
        for lane, (place_index, batch, first, count) in enumerate(lanes.T):
            numbers = np.arange(first, first + count)
            sums[0, lane] = numbers.sum()
            sums[1, lane] = count * place_index
            sums[2, lane] = count * batch
        return sums


@pytest.mark.parametrize("after", [0, 16])
def test_paths_are_shared_out_over_lanes_and_batches(
    monkeypatch: pytest.MonkeyPatch,
    after: int,
) -> None:
    """Each batch of a place follows its share of the paths, numbered on from those before."""
    monkeypatch.setattr(indirect, "_Walk", CountingWalk)
    monkeypatch.setattr(indirect, "FLOATS_AT_ONCE", 50)
    samples = np.array([8, 3, 8 * 150])
    none: Any = None
    light = _gather(
        none,
        none,
        WORK,
        samples,
        np.zeros(3),
        None,
        after,
    )
    walk = CountingWalk.last
    lanes = np.concatenate(walk.lanes, axis=1)
    assert walk.longest == 150 + after // BATCHES
    assert lanes[3].max() == PATHS_A_LANE
    assert max(part.shape[1] for part in walk.lanes) == 10
    assert lanes.shape[1] == BATCHES * (1 + 1 + 3)
    assert light.shape == (BATCHES, 3, 3)
    assert light.dtype == np.complex64
    # the mean of the numbers of each place's paths, of its index and of the batch's
    first = after // BATCHES
    numbers = [first, first, first + 74.5]
    for batch in range(BATCHES):
        assert light[batch, 0].real == pytest.approx(numbers)
        assert light[batch, 1].real == pytest.approx([0, 1, 2])
        assert light[batch, 2].real == pytest.approx([batch] * 3)


def test_low_discrepancy_points_are_even_and_new_in_each_batch() -> None:
    points = _sobol(3, 64, 5).reshape(BATCHES, 64, 3)
    assert points.dtype == np.float32
    for batch in points:
        for column in batch.T:
            assert sorted(np.floor(64 * column)) == list(range(64))
    assert not np.array_equal(points[0], points[1])
    assert not np.array_equal(points, _sobol(3, 64, 6).reshape(points.shape))


def test_an_edges_error_is_that_of_misplaced_sub_rays() -> None:
    """A dark wall at 0 and a bright strip, a tenth of the sub-rays, 1 m behind: the spread of the
    light's way is sqrt(s (1 - s)) of its share s."""
    count = 256
    light = np.array([0.2])
    share = 0.5
    none: Any = None
    means = _LaneSums(
        light=np.stack([light, light]),
        face=none,
        count=none,
        same=none,
        face_range_m=none,
        first=light * share,
        second=light * share,
        strongest=none,
    )
    strongest = np.array([0.8])
    expected_m = 1.5 * np.sqrt(share * (1 - share)) / (count * np.sqrt(0.25))
    assert _error_m(means, strongest, count) == pytest.approx([expected_m])
    dark = means._replace(
        light=np.zeros((2, 1)),
        first=np.zeros(1),
        second=np.zeros(1),
    )
    assert _error_m(dark, strongest, count).tolist() == [0.0]


def test_every_second_sub_ray_off_the_face_is_kept() -> None:
    """Two lanes of 16 sub-rays; the second pixel keeps each of its own."""
    weights = np.stack([np.ones(32), np.arange(32.0)])
    axes = np.array(
        [
            [[1.0, 0.1], [2.0, 0.0], [2.0, 0.0]],
            [[0.0, 1.0], [1.0, 0.0], [4.0, 0.0]],
        ]
    )
    off = np.array([[0b1011, 0b11], [0, 0b100]], np.uint32)
    slopes = np.empty((4, 2), np.float32)
    _slopes_kept(off, np.array([2, 1]), axes, weights, slopes)
    # the first, third and fifth of sub-rays 0, 1, 3, 16, 17; then sub-ray 18
    expected = [(0.5 + 0.05 * j, 1.0) for j in (0, 3, 17)] + [(18 / 4, 0.25)]
    assert slopes == pytest.approx(np.array(expected, np.float32))


def test_chosen_pixels_keep_their_own_sub_rays() -> None:
    rays = OffFace(
        pixel=np.array([4, 7, 9]),
        counts=np.array([2, 1, 3]),
        share=np.array([0.2, 0.1, 0.3]),
        slopes=np.arange(12.0).reshape(6, 2).astype(np.float32),
    )
    chosen = rays.chosen(np.array([True, False, True]))
    assert chosen.pixel.tolist() == [4, 9]
    assert chosen.counts.tolist() == [2, 3]
    assert chosen.share.tolist() == [0.2, 0.3]
    assert chosen.slopes[:, 0].tolist() == [0, 2, 6, 8, 10]


def test_indirect_light_adds_face_and_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixel 0 sees the face, pixel 1 both, pixel 2 only what is off it."""
    rays = rays_in(np.array([1, 2]), 0.25)
    face = np.zeros((3, 1, 3), complex)
    face[-1, 0, :2] = 1.0
    phasor = np.full((2, 1, 3), 2.0 + 0j)
    direct = direct_with(rays, (1, 3))._replace(face=face, phasor=phasor)
    works = []
    totals = []

    def of_face(*arguments: Any) -> tuple[np.ndarray, np.ndarray]:
        works.append(arguments[4])
        return np.full((3, 2), 1.0 + 0j), np.array([3e-4, 4e-4])

    rng = np.random.default_rng(1)
    batches = 8 + rng.random((BATCHES, 3, 2)) + 1j * rng.random((BATCHES, 3, 2))

    def in_pixels(*arguments: Any) -> np.ndarray:
        totals.append(arguments[2].copy())
        works.append(arguments[4])
        assert arguments[3].tolist() == [False, True]
        return batches

    monkeypatch.setattr(view, "face_light", of_face)
    monkeypatch.setattr(view, "_light_in_pixels", in_pixels)
    optics: Any = SimpleNamespace(frequencies_hz=FREQUENCIES_HZ)
    none: Any = None
    inside = np.array([[True, False, True]])
    config = RenderConfig(bounces=7, seed=5)
    light, noise_m = view.indirect_light(
        none,
        none,
        optics,
        none,
        direct,
        inside,
        config,
    )
    assert works == [PathWork(FREQUENCIES_HZ, 6, 5), PathWork(FREQUENCIES_HZ, 7, 5)]
    assert totals[0].tolist() == [[3.0, 2.0], [3.0, 2.0]]
    mean = 0.25 * batches.mean(axis=0)
    assert light[:, 0, 0] == pytest.approx([1.0] * 3)
    assert light[:, 0, 1] == pytest.approx(1.0 + mean[:, 0])
    assert light[:, 0, 2] == pytest.approx(mean[:, 1])
    all_light = totals[0] + mean[:-1]
    from_paths_m = range_noise_m(0.25 * batches[:, :2], all_light, FREQUENCIES_HZ)
    assert noise_m[0, 0] == pytest.approx(3e-4)
    assert noise_m[0, 1] == pytest.approx(np.hypot(4e-4, from_paths_m[0]))
    assert noise_m[0, 2] == pytest.approx(from_paths_m[1])


def test_pixels_are_sampled_closely_beside_edges_or_anywhere() -> None:
    """The eight pixels around an edge count where 1 is asked, all where 2 is."""
    edge = np.zeros((7, 9), bool)
    edge[3, 4] = True
    beside = np.zeros((7, 9), bool)
    beside[2:5, 3:6] = True
    assert np.array_equal(_told_closely(np.ones((7, 9), int), edge), beside)
    closely = np.zeros((7, 9), int)
    closely[3, 5] = 1
    closely[0, 0] = 1
    closely[6, 8] = 2
    assert np.argwhere(_told_closely(closely, edge)).tolist() == [[3, 5], [6, 8]]
