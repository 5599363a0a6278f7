"""Coded marks: on tags drawn on a board, and on the real plate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from detectors.averages.average import AverageConfig, average
from detectors.crop import AutoCrop, crop
from detectors.recordings.opening import open_capture
from detectors.views.marks.find import find_marks
from detectors.views.marks.mark import CodedMarks, ColourMarks, RedMarks
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import random_stream
from tests.support.marked_boards import LENS, WOOD, Paint, board_pose, marked_cloud

TAG_M = 0.06
PLACES = {3: (-0.2, 0.0), 7: (-0.06, 0.02), 11: (0.08, -0.02), 19: (0.2, 0.015)}
WIDE = replace(LENS, width=400, height=160, cy=79.5)


def tags(places: dict[int, tuple[float, float]], codes: dict[int, int] | None = None) -> Paint:
    """Tags of DICT_6X6_50 with a white rim of one module, on wood; ``codes`` of a tag where not
    its key."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50)

    def paint(xy: np.ndarray) -> np.ndarray:
        colours = np.broadcast_to(np.array(WOOD, float), (*xy.shape[:-1], 3)).copy()
        for key, position in places.items():
            modules = np.pad(
                dictionary.generateImageMarker((codes or {}).get(key, key), 8),
                1,
                constant_values=255,
            )
            # the board's y is up, a picture's rows go down
            cell = np.floor((xy - position) * [1, -1] / (TAG_M / 8) + 5).astype(int)
            on = np.all((cell >= 0) & (cell < 10), axis=-1)
            colours[on] = np.clip(modules[cell[on][:, 1], cell[on][:, 0]], 20, 235)[:, None]
        return colours

    return paint


def test_tags_are_read_and_placed_as_well_as_stated():
    rng = random_stream(1, "tags")
    errors = []
    squares = []
    for _ in range(5):
        T = board_pose(*rng.uniform(-20, 20, 2), rng.uniform(-15, 15))
        T[:3, 3] += rng.uniform(-2e-3, 2e-3, 3)
        cloud = marked_cloud(T, tags(PLACES), rng=rng, samples=3, lens=WIDE, sigma_m=2e-4)
        cloud = replace(cloud, rgb=cv2.GaussianBlur(cloud.rgb, (0, 0), rng.uniform(0.3, 1.0)))  # type: ignore[arg-type]
        for mark in find_marks(cloud, cloud.valid, CodedMarks()).trusted:
            assert mark.code is not None
            position = transform_points(invert(T), mark.centre_m)
            error = position - [*PLACES[mark.code], 0.0]
            errors.append(np.abs(error[:2]).max())
            in_camera = T[:3, :3] @ error
            squares.append(in_camera @ np.linalg.solve(mark.covariance_m2, in_camera) / 3)
            # a blurred corner is rounded off: its place is found up to half a pixel further in, on
            # all four sides alike
            assert mark.area_m2 == pytest.approx(TAG_M**2, rel=0.06)
    assert len(squares) >= 15
    # a tenth of a pixel is 0.14 mm
    assert np.sqrt(np.mean(np.square(errors))) < 0.2e-3
    assert 1 / 2.0**2 < np.mean(squares) < 1.5**2


def test_a_code_seen_twice_is_in_doubt_and_a_tag_off_the_target_is_none():
    cloud = marked_cloud(board_pose(), tags(PLACES, {19: 3}), samples=3, lens=WIDE)
    marks = find_marks(cloud, cloud.valid, CodedMarks())
    assert [(mark.code, mark.doubt) for mark in marks.marks] == [
        (3, "code 3 is seen more than once"),
        (3, "code 3 is seen more than once"),
        (7, ""),
        (11, ""),
    ]
    assert "2 marks found, 3 needed" in marks.problem
    inside = cloud.valid.copy()
    inside[:, :200] = False
    fewer = find_marks(cloud, inside, CodedMarks())
    assert [mark.code for mark in fewer.marks] == [3, 11]
    assert fewer.notes == ("2 tags lie off the target, or have no range",)


def test_tags_that_are_cut_or_lack_range_are_in_doubt():
    cloud = marked_cloud(board_pose(0.0, 0.0), tags(PLACES), samples=3, lens=WIDE)
    complete = {mark.code: mark for mark in find_marks(cloud, cloud.valid, CodedMarks()).marks}
    assert set(complete) == set(PLACES)
    inside = cloud.valid.copy()
    points = cloud.points_m.copy()
    columns = complete[3].pixels % 400
    inside[:, : int(np.quantile(columns, 0.25))] = False
    v, u = np.divmod(complete[7].pixels, 400)
    points[v.min() : int(np.quantile(v, 0.2)), u.min() : u.max() + 1] = np.nan
    marks = find_marks(
        replace(cloud, points_m=points), inside & np.isfinite(points[..., 2]), CodedMarks()
    )
    doubts = {mark.code: mark.doubt for mark in marks.marks}
    assert doubts[3].endswith("beyond the crop's edge")
    assert doubts[7].endswith("of it has no range")
    assert (doubts[11], doubts[19]) == ("", "")


def test_marks_need_a_pixel_grid():
    cloud = replace(marked_cloud(board_pose(), tags(PLACES)), organised=False)
    for config in (CodedMarks(), ColourMarks()):
        assert "no pixel grid" in find_marks(cloud, cloud.valid, config).problem
    of_red = find_marks(cloud, cloud.valid, RedMarks(deviations=0.1))
    assert "need a pixel grid" in of_red.problem and of_red.points.size


def test_a_dictionary_that_opencv_lacks_is_refused_with_those_it_has():
    assert CodedMarks(dictionary="DICT_APRILTAG_36h11").dictionary == "DICT_APRILTAG_36h11"
    with pytest.raises(
        ValidationError, match=r"no dictionary of codes 'DICT_9X9_1'; it has .*DICT_6X6_50"
    ):
        CodedMarks(dictionary="DICT_9X9_1")


@pytest.mark.slow  # a real capture
def test_the_real_plate_shows_its_tags(shared_data: Path):
    cloud = average(open_capture([shared_data / "azure_drilled_board"]), AverageConfig())
    inside = crop(cloud, AutoCrop())
    coded = find_marks(cloud, inside, CodedMarks())
    assert [mark.code for mark in coded.trusted] == [0, 2, 4, 9, 12]
    assert coded.problem == ""
    # printed squares of one size
    sides = np.sqrt([mark.area_m2 for mark in coded.trusted])
    assert sides.std() / sides.mean() < 0.02
    blue = find_marks(cloud, inside, ColourMarks())
    # the ink of most, each about the middle of its tag; one has no range along one side, another
    # shines
    nearby = [
        min(np.linalg.norm(b.centre_m - c.centre_m) for c in coded.trusted) for b in blue.trusted
    ]
    assert len(nearby) >= 3
    assert max(nearby) < 5e-3
