"""The word that a user may have meant."""

from harness.vocabulary.words import nearest


def test_a_similar_spelling_is_near_whatever_case_and_dashes():
    assert nearest("Kinect-V3", ["kinect_v2", "realsense_l515"]) == "kinect_v2"


def test_a_word_that_contains_the_sought_one_is_near():
    assert nearest("l515", ["kinect_v2", "realsense_l515"]) == "realsense_l515"


def test_the_shortest_of_several_such_words_is_nearest():
    words = ["realsense_l515_vga", "realsense_l515", "realsense_l515_lines"]
    assert nearest("l515", words) == "realsense_l515"


def test_a_word_that_is_part_of_the_sought_one_is_not_near():
    assert nearest("a_camera_of_mine_with_tof", ["tof"]) is None


def test_two_letters_are_too_few_to_be_sought_within_words():
    assert nearest("l5", ["realsense_l515"]) is None
