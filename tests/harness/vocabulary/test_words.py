"""The word that a user may have meant."""

import pytest

from harness.vocabulary.errors import UserError
from harness.vocabulary.words import DAMAGE, damage_kind, kind_called, nearest
from scenes.target.drawn import DrawnTargetConfig


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


def test_what_people_call_a_damage_is_a_kind_of_the_boards():
    (field,) = [DrawnTargetConfig.model_fields["damage"]]
    kinds = {
        kind
        for model in field.annotation.__args__
        for kind in model.model_fields["kind"].annotation.__args__
    }
    assert {*DAMAGE.values()} <= kinds
    assert not {*DAMAGE} & kinds
    assert kind_called("Through-Hole") == kind_called("through_hole") == "through"
    assert kind_called("cauliflower") == "cauliflower"
    assert nearest("crack", ["through", "slot"]) == "slot", "though no letters are alike"


def test_a_wrong_damage_has_the_nearest_word():
    assert damage_kind("--damage", "hole", ["through", "dent"]) == "through"
    with pytest.raises(UserError, match="did you mean 'hole'") as caught:
        damage_kind("--damage", "hol", ["through", "dent"])
    assert caught.value.legal == "hole, through-hole, through, dent"
    with pytest.raises(UserError, match="--damage scratch: no such damage here"):
        damage_kind("--damage", "scratch", ["through", "dent"])
