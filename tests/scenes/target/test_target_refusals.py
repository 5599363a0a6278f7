"""Declarations whose parts do not fit together are refused, each part by name and with its
numbers."""

from __future__ import annotations

from typing import Any

import pytest

from harness.vocabulary.errors import UserError
from scenes.target.checks import check_target
from scenes.target.mesh import build_target
from tests.support.declared_targets import target_from_data

BOARD: dict[str, Any] = {"width_mm": 300, "height_mm": 100, "thickness_mm": 12}


def hole(
    number: int,
    diameter_mm: float,
    x_mm: float,
    y_mm: float,
    depth_mm: float | None = None,
) -> dict[str, Any]:
    blind = {} if depth_mm is None else {"kind": "blind", "depth_mm": depth_mm}
    return {
        "id": number,
        "diameter_mm": diameter_mm,
        "centre_mm": [x_mm, y_mm],
        **blind,
    }


def dent(
    number: int,
    diameter_mm: float,
    depth_mm: float,
    x_mm: float = 0,
    y_mm: float = 0,
) -> dict[str, Any]:
    return {
        "id": number,
        "diameter_mm": diameter_mm,
        "depth_mm": depth_mm,
        "centre_mm": [x_mm, y_mm],
    }


def round_board(kind: str, radius_mm: float, **more: Any) -> dict[str, Any]:
    return {**BOARD, "shape": {"kind": kind, "radius_mm": radius_mm, **more}}


REFUSED: list[tuple[dict[str, Any], str]] = [
    (
        {"holes": [hole(1, 10, 0, 0), hole(2, 8, 9, 0)]},
        r"hole 1 .* and hole 2 .* meet: centres 9 mm apart, web 0 mm",
    ),
    (
        {"holes": [hole(1, 10, 0, 0)], "dents": [dent(2, 20, 2, 14, 0)]},
        r"hole 1 .* and dent 2 .* meet: centres 14 mm apart, web -1 mm",
    ),
    (
        {"holes": [hole(3, 10, 146, 0)]},
        r"hole 3 \(diameter 10 mm at \(146, 0\) mm\): leaves the board .* by 1 mm",
    ),
    (
        {"holes": [hole(3, 10, 0, -45)]},
        r"hole 3 .* leaves the board \(300 x 100 mm, centred on \(0, 0\)\) by 0 mm",
    ),
    ({"holes": [hole(4, 10, 400, 0)]}, r"hole 4 .* its centre is outside the board \(300 x 100 mm"),
    (
        {"holes": [hole(5, 10, 0, 0, 12)]},
        r"hole 5 .* depth 12 mm is not less than the board's thickness 12 mm",
    ),
    (
        {"holes": [hole(5, 10, 0, 0, 13)]},
        r"hole 5 .* depth 13 mm is not less than the board's thickness 12 mm",
    ),
    (
        {"dents": [dent(6, 60, 12)]},
        r"dent 6 .* depth 12 mm is not less than the board's thickness 12 mm",
    ),
    ({"dents": [dent(6, 10, 5.5)]}, r"dent 6 .* depth 5.5 mm is more than its radius 5 mm"),
    ({"dents": [dent(6, 40, 5, 140, 0)]}, r"dent 6 .* leaves the board .* by 10 mm"),
    (
        {"holes": [{**hole(3, 10, 140, 0), "chamfer_mm": 6}]},
        r"hole 3 .* leaves the board .* by 1 mm",
    ),
    (
        {"holes": [{**hole(3, 10, 0, 0), "chamfer_mm": 12.7}]},
        r"hole 3 .* chamfer of 12.7 mm must be less than the depth",
    ),
    (
        {"tapes": [{"centre_mm": [140, 0], "size_mm": [40, 12]}]},
        r"tape 1 \(40 x 12 mm .*: leaves the board .* by 10 mm",
    ),
    (
        {"tapes": [{"centre_mm": [0, 35], "size_mm": [40, 12], "angle_deg": 90}]},
        r"tape 1 .* leaves the board .* by 5 mm",
    ),
    (
        {"holes": [hole(7, 10, 0, 0)], "tapes": [{"centre_mm": [0, 10], "size_mm": [40, 12]}]},
        r"tape 1 .* lies over hole 7 .* by 1 mm",
    ),
    (
        {"holes": [hole(7, 30, 0, 0)], "tapes": [{"centre_mm": [0, 0], "size_mm": [5, 5]}]},
        r"tape 1 .* lies over hole 7 .* by 15 mm",
    ),
    (
        {"board": round_board("cylinder", 180)},
        r"cylinder of radius 180 mm .* reaches 150 mm .* must be 187.5 mm or more",
    ),
    (
        {"board": round_board("cylinder", 60, straight_along="x")},
        r"cylinder of radius 60 mm .* 62.5 mm or more",
    ),
    ({"board": round_board("sphere", 190)}, r"sphere of radius 190 mm .* reaches 158.114 mm"),
    (
        {"board": {**round_board("cylinder", 200), "thickness_mm": 101}},
        r"radius of curvature 200 mm is too small for a thickness of 101 mm; "
        r"it must be 202 mm or more",
    ),
    (
        {
            "board": {
                **BOARD,
                "shape": {
                    "kind": "polynomial",
                    "terms": [{"power_x": 0, "power_y": 2, "coefficient_mm": 40}],
                },
            }
        },
        r"its face is too steep: slope 1.6, the limit is 1.33",
    ),
    (
        {"board": round_board("sphere", 200), "dents": [dent(8, 20, 0.4)]},
        r"dent 8 .* too shallow .* radius of 200 mm",
    ),
    (
        {"board": round_board("cylinder", 190), "holes": [hole(8, 96, 0, 0)]},
        r"hole 8 .* too wide for a face bent",
    ),
    (
        {"pose": {"distance_m": 0.15, "tilt_y_deg": 60}},
        r"nearest point is 0.0201 m in front of the lens; the limit is 0.05 m",
    ),
    (
        {"room": {"floor_below_lens_m": 0.05}},
        r"reaches 0.05 m below the lens, through the floor at 0.05 m",
    ),
    ({"room": {"back_wall_distance_m": 0.71}}, r"reach 0.712 m, beyond the back wall at 0.71 m"),
    (
        {"backing": {"distance_mm": 50}, "room": {"back_wall_distance_m": 0.75}},
        r"board and backing reach 0.762 m, beyond the back wall at 0.75 m",
    ),
    (
        {
            "tapes": [
                {"centre_mm": [0, 0], "size_mm": [40, 12]},
                {"centre_mm": [0, 0], "size_mm": [40, 12], "angle_deg": 90},
            ]
        },
        r"tape 1 and tape 2 lie on each other over 144 mm2",
    ),
]


@pytest.mark.parametrize(("parts", "message"), REFUSED)
def test_refused_with_name_and_numbers(
    parts: dict[str, Any],
    message: str,
) -> None:
    config = target_from_data({"name": "custom", "board": BOARD, **parts}).declare()
    with pytest.raises(UserError, match=message):
        build_target(config)


ACCEPTED: list[dict[str, Any]] = [
    {"holes": [hole(1, 10, 0, 0), hole(2, 8, 9.02, 0)]},
    {"holes": [hole(3, 10, 144.98, 0)]},
    {"holes": [hole(5, 10, 0, 0, 11.99)]},
    {"dents": [dent(6, 10, 5)]},
    {"board": round_board("cylinder", 187.5)},
    {"board": round_board("sphere", 197.7)},
    {"holes": [hole(7, 10, 0, 0)], "tapes": [{"centre_mm": [0, 11.01], "size_mm": [40, 12]}]},
    {
        "tapes": [
            {"centre_mm": [-20, 0], "size_mm": [40, 12]},
            {"centre_mm": [20, 0], "size_mm": [40, 12]},
        ]
    },
    {"room": {"floor_below_lens_m": 0.051, "back_wall_distance_m": 0.713}},
]


@pytest.mark.parametrize("parts", ACCEPTED)
def test_just_inside_the_limits_is_built_watertight(parts: dict[str, Any]) -> None:
    built = build_target(target_from_data({"name": "custom", "board": BOARD, **parts}).declare())
    assert built.parts[0].mesh.is_watertight


def test_every_problem_is_named_at_once() -> None:
    config = target_from_data(
        {
            "name": "custom",
            "board": BOARD,
            "holes": [hole(1, 10, 0, 0), hole(2, 10, 5, 0), hole(3, 10, 149, 0, 15)],
            "dents": [dent(4, 10, 6, 60, 0)],
            "tapes": [{"centre_mm": [0, 0], "size_mm": [20, 12]}],
        }
    ).declare()
    with pytest.raises(UserError) as caught:
        check_target(config)
    lines = [line for line in caught.value.message.splitlines() if line.startswith("  - ")]
    assert len(lines) == 6
    assert caught.value.legal
    assert caught.value.fix


def test_holes_that_meet_below_the_face_of_a_bulging_board() -> None:
    """Two axes 13.1 mm apart on a face bent to 100 mm come 2.6 mm closer 20 mm down, where no web
    is left."""
    board = {"width_mm": 100, "height_mm": 100, "thickness_mm": 25}
    shape = {"kind": "cylinder", "radius_mm": 100}
    holes = [hole(1, 12, -6.55, 0, 20), hole(2, 12, 6.55, 0, 20)]
    flat = target_from_data({"name": "custom", "board": board, "holes": holes}).declare()
    check_target(flat)
    bent = target_from_data(
        {"name": "custom", "board": {**board, "shape": shape}, "holes": holes}
    ).declare()
    with pytest.raises(UserError, match=r"meet: centres 10\.\d+ mm apart, web -1\.\d+ mm"):
        check_target(bent)


def test_hole_that_leaves_through_the_side_of_a_bulging_board() -> None:
    """The side walls of a bent board lean inwards: 7.3 mm from axis to edge at the face are 5.5 mm
    at the back."""
    board = {"width_mm": 100, "height_mm": 100, "thickness_mm": 25}
    shape = {"kind": "cylinder", "radius_mm": 100}
    near_edge = [hole(1, 12, 43.5, 0)]
    check_target(target_from_data({"name": "custom", "board": board, "holes": near_edge}).declare())
    bent = target_from_data(
        {"name": "custom", "board": {**board, "shape": shape}, "holes": near_edge}
    ).declare()
    with pytest.raises(UserError, match=r"hole 1 .* leaves the board"):
        check_target(bent)


def test_a_face_that_needs_too_many_cells() -> None:
    # bent alike everywhere, so that cells of different sizes save none
    terms = []
    for power_x, power_y in ((2, 0), (1, 1), (0, 2)):
        terms.append({"power_x": power_x, "power_y": power_y, "coefficient_mm": 1000})
    shape = {"kind": "polynomial", "terms": terms}
    config = target_from_data(
        {
            "name": "custom",
            "board": {
                "width_mm": 5000,
                "height_mm": 5000,
                "thickness_mm": 12,
                "shape": shape,
            },
            "pose": {"distance_m": 8.0},
        }
    ).declare()
    with pytest.raises(UserError, match="cells for an error below 2 um"):
        build_target(config)
