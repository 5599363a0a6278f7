"""Declarations of targets: strict ranges, kinds, and the facts of the named board."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from scenes.target.custom import BoardConfig, DentConfig, FlatConfig, HoleConfig, TargetConfig
from scenes.target.thesis import AnyTargetConfig, ThesisTargetConfig
from tests.support.declared_targets import target_from_data

BOARD = {"width_mm": 300, "height_mm": 100, "thickness_mm": 12}


def custom(**parts: object) -> TargetConfig:
    config = target_from_data({"name": "custom", "board": BOARD, **parts})
    assert isinstance(config, TargetConfig)
    return config


def test_thesis_holes_are_table_one_in_one_row() -> None:
    config = ThesisTargetConfig().declare()
    in_inches = [hole.diameter_mm / 25.4 for hole in config.holes]
    assert np.allclose(in_inches, np.array([1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16]) / 16, rtol=1e-12)
    assert [hole.id for hole in config.holes] == list(range(1, 12))
    assert [hole.centre_mm for hole in config.holes] == [
        (round(50.8 * k, 6), 0.0) for k in range(-5, 6)
    ]
    assert all(hole.kind == "through" for hole in config.holes)
    assert config.board.thickness_mm == 12.7


def test_thesis_blind_and_without_surroundings() -> None:
    config = ThesisTargetConfig(
        hole_kind="blind",
        backing_distance_mm=None,
        floor_below_lens_m=None,
        back_wall_distance_m=None,
    ).declare()
    assert {(hole.kind, hole.depth_mm) for hole in config.holes} == {("blind", 9.5)}
    assert config.backing is None
    assert config.room is None


def test_thesis_tape_is_told_by_its_red_channel() -> None:
    """Red above mean + 2.6 standard deviations of the face finds the tape and nothing else, as the
    source demands."""
    from scenes.target.mesh import build_target

    target = build_target(ThesisTargetConfig().declare())
    board = target.parts[0]
    assert board.texture_rgb is not None
    wood = board.texture_rgb[..., 0].ravel().astype(float)
    tape_share = 4 * 40.0 * 12.0 / (609.6 * 114.3)
    tape_texels = round(tape_share / (1 - tape_share) * wood.size)
    red = np.concatenate([wood, np.full(tape_texels, target.parts[1].rgb[0])])
    limit = red.mean() + 2.6 * red.std()
    assert wood.max() < limit < target.parts[1].rgb[0]


def test_every_open_fact_has_a_reason() -> None:
    for name in set(ThesisTargetConfig.model_fields) - {"name"}:
        assert ThesisTargetConfig.model_fields[name].description


def test_plain_data_round_trip() -> None:
    for config in (ThesisTargetConfig(), ThesisTargetConfig().declare()):
        assert target_from_data(json.loads(json.dumps(config.to_data()))) == config


def test_hole_free_keeps_everything_else() -> None:
    hole = {"id": 1, "centre_mm": [0, 0]}
    config = custom(holes=[{**hole, "diameter_mm": 5}])
    bare = config.hole_free()
    assert bare.damages == ()
    assert bare == custom()
    # all drills leave the same board
    assert custom(holes=[hole], drill={"diameter_mm": 6}).hole_free() == bare
    assert config.declare() is config


def test_kind_is_told_by_name() -> None:
    adapter: TypeAdapter[ThesisTargetConfig | TargetConfig] = TypeAdapter(AnyTargetConfig)
    assert isinstance(adapter.validate_python({"name": "thesis"}), ThesisTargetConfig)
    with pytest.raises(
        ValidationError, match="does not match any of the expected tags: 'thesis', 'custom'"
    ):
        target_from_data({"name": "tesis"})


@pytest.mark.parametrize(
    ("parts", "loc"),
    [
        ({"board": {**BOARD, "width_mm": True}}, ("custom", "board", "width_mm")),
        ({"board": {**BOARD, "width_mm": "300"}}, ("custom", "board", "width_mm")),
        ({"board": {**BOARD, "thickness_mm": float("nan")}}, ("custom", "board", "thickness_mm")),
        ({"board": {**BOARD, "shape": {"kind": "cone"}}}, ("custom", "board", "shape")),
        ({"material": {"albedo_850": 1.1}}, ("custom", "material", "albedo_850")),
        ({"material": {"rgb": [0.1, 0.2, -0.1]}}, ("custom", "material", "rgb", 2)),
        ({"pose": {"distance_m": 700}}, ("custom", "pose", "distance_m")),
        ({"backing": {"distance": 20}}, ("custom", "backing", "distance_mm")),
        (
            {"holes": [{"id": 0, "diameter_mm": 5, "centre_mm": [0, 0]}]},
            ("custom", "holes", 0, "id"),
        ),
        (
            {"holes": [{"id": 1, "diameter_mm": 5, "centre_mm": [0]}]},
            ("custom", "holes", 0, "centre_mm", 1),
        ),
        (
            {
                "holes": [
                    {
                        "id": 1,
                        "diameter_mm": 5,
                        "centre_mm": [0, 0],
                        "kind": "blind",
                    }
                ]
            },
            ("custom", "holes", 0),
        ),
        (
            {
                "holes": [
                    {
                        "id": 1,
                        "diameter_mm": 5,
                        "centre_mm": [0, 0],
                        "depth_mm": 3,
                    }
                ]
            },
            ("custom", "holes", 0),
        ),
    ],
)
def test_illegal_fields_are_refused_with_their_place(
    parts: dict[str, object],
    loc: tuple[str | int, ...],
) -> None:
    with pytest.raises(ValidationError) as caught:
        custom(**parts)
    assert loc in [error["loc"] for error in caught.value.errors()]


def test_ids_are_unique_over_holes_and_dents() -> None:
    with pytest.raises(ValidationError, match="given more than once: 4"):
        TargetConfig(
            board=BoardConfig(
                width_mm=300,
                height_mm=100,
                thickness_mm=12,
                shape=FlatConfig(),
            ),
            holes=(
                HoleConfig(
                    id=4,
                    diameter_mm=5,
                    centre_mm=(0, 0),
                ),
            ),
            dents=(
                DentConfig(
                    id=4,
                    diameter_mm=5,
                    depth_mm=1,
                    centre_mm=(50, 0),
                ),
            ),
        )


def test_constant_term_of_a_polynomial_is_refused() -> None:
    shape = {"kind": "polynomial", "terms": [{"power_x": 0, "power_y": 0, "coefficient_mm": 1}]}
    with pytest.raises(ValidationError, match="constant term"):
        custom(board={**BOARD, "shape": shape})
