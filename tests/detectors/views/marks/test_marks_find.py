"""Marks found by colour: all kinds of tape and light, holes that are none, doubts, problems, and
stated errors."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.views.marks.find import find_marks
from detectors.views.marks.mark import ColourMarks, MarkSet, RedMarks
from harness.vocabulary.geometry import Cloud, invert, transform_points
from harness.vocabulary.seeds import random_stream
from tests.support.marked_boards import RED, TAPES, WOOD, board_pose, marked_cloud, strips


def everywhere(cloud: Cloud) -> np.ndarray:
    return cloud.valid


def on_board_m(marks: MarkSet, T_camera_board: np.ndarray) -> np.ndarray:
    """(n, 3) centres of the trusted marks in the board's frame, by x, then y."""
    positions = transform_points(
        invert(T_camera_board), np.stack([mark.centre_m for mark in marks.trusted])
    )
    return positions[np.lexsort((positions[:, 1], positions[:, 0] > 0))]


EXPECTED = np.column_stack([TAPES, np.zeros(4)])[np.lexsort((TAPES[:, 1], TAPES[:, 0] > 0))]


def falling_light(scaled: np.ndarray) -> np.ndarray:
    """A lamp at one end: a factor of three over the board, of a warm colour; nothing is
    over-exposed."""
    return 0.6 * np.exp(0.5 * np.log(3.0) * scaled[..., :1]) * np.array([1.0, 0.9, 0.7])


def two_lamps(scaled: np.ndarray) -> np.ndarray:
    """A warm lamp at one end and a cold one at the other."""
    u = scaled[..., 0]
    return 0.7 * np.stack([1.2 - 0.5 * u, np.ones_like(u), 0.9 + 0.4 * u], axis=-1)


def photographed(cloud: Cloud, rng: np.random.Generator, quality: int = 80) -> Cloud:
    assert cloud.rgb is not None
    noisy = np.clip(np.rint(cloud.rgb + 3.0 * rng.standard_normal(cloud.rgb.shape)), 0, 255).astype(
        np.uint8
    )
    _, packed = cv2.imencode(".jpg", noisy[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return replace(
        cloud, rgb=np.ascontiguousarray(cv2.imdecode(packed, cv2.IMREAD_COLOR)[..., ::-1])
    )


@pytest.mark.parametrize(
    ("colour", "light"),
    [
        (RED, falling_light),
        ((20, 150, 40), two_lamps),
        ((20, 40, 190), falling_light),
        ((220, 200, 30), two_lamps),
        ((20, 20, 20), falling_light),
        ((240, 240, 240), two_lamps),
        pytest.param(RED, two_lamps, marks=pytest.mark.slow),
        pytest.param((20, 20, 20), two_lamps, marks=pytest.mark.slow),
        pytest.param((240, 240, 240), falling_light, marks=pytest.mark.slow),
    ],
)
def test_tape_of_any_colour_is_found_in_uneven_coloured_light_through_jpeg(colour, light):
    rng = random_stream(1, "tapes", str(colour), light.__name__)
    T = board_pose(5.0, -8.0, 2.0)
    cloud = photographed(
        marked_cloud(T, strips(colour=colour), rng=rng, samples=3, light=light), rng
    )
    marks = find_marks(cloud, everywhere(cloud), ColourMarks())
    assert (marks.problem, len(marks.trusted)) == ("", 4), [mark.doubt for mark in marks.marks]
    # half a pixel is 0.7 mm
    np.testing.assert_allclose(on_board_m(marks, T), EXPECTED, atol=0.7e-3)


def test_the_thesis_rule_takes_the_pixels_that_matlab_takes():
    rng = random_stream(2, "red rule")
    cloud = marked_cloud(board_pose(), strips(), rng=rng)
    assert cloud.rgb is not None
    cloud = replace(
        cloud,
        rgb=np.clip(cloud.rgb + rng.integers(-20, 21, cloud.rgb.shape), 0, 255).astype(np.uint8),
    )
    inside = cloud.valid.copy()
    inside[:, :40] = False
    red = cloud.rgb[inside][:, 0].astype(float)
    limit = red.sum() / len(red) + 2.6 * np.sqrt(((red - red.mean()) ** 2).sum() / (len(red) - 1))
    expected = np.flatnonzero(inside & (cloud.rgb[..., 0] > limit))
    marks = find_marks(cloud, inside, RedMarks())
    np.testing.assert_array_equal(marks.points, expected)
    assert len(marks.trusted) == 4
    fewer = find_marks(cloud, inside, RedMarks(deviations=20.0))
    assert "no pixel's red exceeds" in fewer.problem


def holed(xy: np.ndarray) -> np.ndarray:
    """Six holes of 5 to 26 mm, 40 mm deep."""
    deep = np.zeros(xy.shape[:-1])
    for number, radius_m in enumerate((2.5e-3, 4e-3, 6e-3, 8e-3, 10e-3, 13e-3)):
        deep[np.linalg.norm(xy - [(number - 2.5) * 0.06, 0.0], axis=-1) < radius_m] = 0.04
    return deep


@pytest.mark.parametrize("backing", [(140, 140, 140), (200, 40, 40), (10, 10, 10)])
def test_holes_that_show_a_backing_of_another_colour_are_no_marks(backing):
    tapes = strips()

    def paint(xy: np.ndarray) -> np.ndarray:
        colours = tapes(xy)
        colours[holed(xy) > 0] = backing
        return colours

    rng = random_stream(3, "holes", str(backing))
    T = board_pose()
    cloud = marked_cloud(T, paint, rng=rng, behind_m=holed)
    marks = find_marks(cloud, everywhere(cloud), ColourMarks())
    assert (marks.problem, len(marks.trusted)) == ("", 4)
    np.testing.assert_allclose(on_board_m(marks, T), EXPECTED, atol=1e-3)
    assert any("count as holes" in note for note in marks.notes)


@pytest.mark.parametrize(
    ("sigma_m", "samples", "turn_deg", "half_size"),
    [
        pytest.param(5e-5, 1, 4.0, (0.02, 0.006), id="pixelation"),
        pytest.param(5e-4, 1, 15.0, (0.008, 0.008), id="turned squares"),
        pytest.param(2e-3, 3, 4.0, (0.02, 0.006), id="mixed colours, depth noise"),
    ],
)
@pytest.mark.slow  # a Monte Carlo campaign
def test_the_stated_covariance_is_that_of_the_errors(sigma_m, samples, turn_deg, half_size):
    rng = random_stream(4, "covariance", sigma_m, samples)
    squares = []
    across = []
    stated = []
    for _ in range(15):
        T = board_pose(*rng.uniform(-15, 15, 2), rng.uniform(-turn_deg, turn_deg))
        T[:3, 3] += rng.uniform(-2e-3, 2e-3, 3)
        cloud = marked_cloud(
            T, strips(half_size=half_size), rng=rng, samples=samples, sigma_m=sigma_m
        )
        for mark in find_marks(cloud, everywhere(cloud), ColourMarks()).trusted:
            position = transform_points(invert(T), mark.centre_m)
            error = T[:3, :3] @ (
                position - EXPECTED[np.linalg.norm(EXPECTED - position, axis=1).argmin()]
            )
            squares.append(error @ np.linalg.solve(mark.covariance_m2, error) / 3)
            across.append(error @ T[:3, 2])
            stated.append(T[:3, 2] @ mark.covariance_m2 @ T[:3, 2])
    assert len(squares) > 50
    # 50 values of chi-squared over three: their mean is known to 0.12
    assert 1 / 1.5**2 < np.mean(squares) < 1.5**2
    assert 1 / 1.5 < np.sqrt(np.mean(np.square(across)) / np.mean(stated)) < 1.5


def test_averaged_frames_and_stated_variances_count():
    T = board_pose()
    cloud = marked_cloud(T, strips(), rng=random_stream(5, "frames"), sigma_m=1e-4)
    noisy = replace(
        cloud,
        variance_m2=np.full(cloud.valid.shape, (2e-3) ** 2),
        count=np.full(cloud.valid.shape, 4),
    )
    mark = find_marks(noisy, everywhere(noisy), ColourMarks()).trusted[0]
    n = len(mark.pixels)
    along = (
        mark.centre_m
        / mark.centre_m[2]
        * mark.normal[2]
        / (mark.normal @ mark.centre_m / mark.centre_m[2])
    )
    depth_part = mark.normal @ np.outer(along, along) @ mark.normal * (1e-3) ** 2 * 25 / n
    # across the plane pixelation has no part
    assert mark.normal @ mark.covariance_m2 @ mark.normal == pytest.approx(depth_part, rel=1e-6)


def test_a_mark_cut_by_the_crop_or_the_picture_is_in_doubt_and_the_rest_is_not():
    T = board_pose(0.0, 0.0)
    cloud = marked_cloud(T, strips(), rng=random_stream(6, "cut"))
    columns = np.flatnonzero((cloud.rgb[:, :200] == RED).all(axis=-1).any(axis=0))  # type: ignore[index]
    inside = cloud.valid.copy()
    inside[:, : columns[len(columns) // 2]] = False
    marks = find_marks(cloud, inside, ColourMarks())
    assert [mark.doubt for mark in marks.marks].count("cut by the crop's edge") == 2
    assert "2 marks found, 3 needed; 2 more in doubt: cut by the crop's edge" in marks.problem
    edge = replace(
        cloud,
        **{name: getattr(cloud, name)[:, columns[3] :] for name in ("points_m", "reason", "count")},
    )
    edge = replace(
        edge, variance_m2=cloud.variance_m2[:, columns[3] :], rgb=cloud.rgb[:, columns[3] :]
    )  # type: ignore[index]
    doubts = [mark.doubt for mark in find_marks(edge, everywhere(edge), ColourMarks()).marks]
    assert doubts.count("cut by the picture's edge") == 2


def test_a_mark_without_range_in_a_part_is_in_doubt():
    cloud = marked_cloud(board_pose(0.0, 0.0), strips(), rng=random_stream(7, "no range"))
    assert cloud.rgb is not None
    v, u = (axis[0] for axis in np.nonzero((cloud.rgb == RED).all(axis=-1)))
    points = cloud.points_m.copy()
    points[v : v + 5, u : u + 12] = np.nan
    lost = replace(cloud, points_m=points)
    doubts = [mark.doubt for mark in find_marks(lost, everywhere(lost), ColourMarks()).marks]
    assert sorted(doubts) == ["", "", "", "without range in parts of it"]


def test_the_odd_one_out_is_in_doubt():
    tapes = strips()
    patch = strips(np.array([[0.0, 0.0]]), half_size=(0.04, 0.012))

    def paint(xy: np.ndarray) -> np.ndarray:
        return np.where((patch(xy) == RED).all(axis=-1, keepdims=True), RED, tapes(xy)).astype(
            float
        )

    cloud = marked_cloud(board_pose(), paint, rng=random_stream(8, "odd"))
    marks = find_marks(cloud, everywhere(cloud), ColourMarks())
    assert len(marks.trusted) == 4
    assert [mark.doubt.split(":")[0] for mark in marks.marks if mark.doubt] == ["unlike the others"]


@pytest.mark.parametrize(
    ("places", "said"),
    [
        (TAPES[:2], "2 marks found, 3 needed"),
        (TAPES[:0], "0 marks found, 3 needed"),
        (np.array([[-0.2, 0.0], [0.0, 0.0], [0.15, 0.0]]), "lie on a line"),
    ],
)
def test_what_is_missing_is_said(places, said):
    cloud = marked_cloud(board_pose(), strips(places), rng=random_stream(9, "missing"))
    for config in (ColourMarks(), RedMarks()):
        assert said in find_marks(cloud, everywhere(cloud), config).problem


def test_no_colour_and_no_target_are_said():
    cloud = marked_cloud(board_pose(), strips())
    assert (
        "no colour"
        in find_marks(replace(cloud, rgb=None), everywhere(cloud), ColourMarks()).problem
    )
    subset = np.zeros_like(cloud.valid)
    subset[:5, :5] = True
    assert "25 pixels of the target" in find_marks(cloud, subset, RedMarks()).problem


def test_the_same_cloud_gives_the_same_bits():
    cloud = marked_cloud(board_pose(), strips(wood=WOOD), rng=random_stream(11, "twice"), samples=2)
    first, second = (find_marks(cloud, everywhere(cloud), ColourMarks()) for _ in range(2))
    for a, b in zip(first.marks, second.marks, strict=True):
        np.testing.assert_array_equal(a.centre_m, b.centre_m)
        np.testing.assert_array_equal(a.covariance_m2, b.covariance_m2)
