"""Families of boards: every board legal, each quantity from its own stream, sizes uniform, too
full boards refused."""

from __future__ import annotations

import re
from itertools import combinations
from math import dist
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy import stats

from harness.target import main
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, transform_points
from scenes.perspectives import check_in_view
from scenes.sensor.camera import load_camera
from scenes.target.checks import SHALLOWEST_BEND, check_target
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig, Purpose, _backing_size_mm, _dent_depths_mm
from scenes.target.truth import backing_corners_board_m, outline_board_m
from tests.support.declared_targets import target_from_data

ALPHA = 1e-3
"""Of each statistical test; seeds are fixed, so a test that passes once always does."""
PURPOSES: tuple[Purpose, ...] = ("calibration", "hole_free", "damaged")
THROUGH = {"kind": "through", "per_board": 8, "diameter_mm": [2.0, 12.0]}
BLIND = {**THROUGH, "kind": "blind", "depth_mm": [1.0, 9.0]}
DENT = {**THROUGH, "kind": "dent", "depth_mm": [0.5, 3.0]}
SHAPES = (
    {"kind": "flat"},
    {"kind": "cylinder", "radius_mm": 260.0},
    {
        "kind": "cylinder",
        "radius_mm": 200.0,
        "straight_along": "x",
        "bulge": "away",
    },
    {"kind": "sphere", "radius_mm": 300.0},
    {"kind": "sphere", "radius_mm": 300.0, "bulge": "away"},
    {"kind": "polynomial", "terms": [{"power_x": 3, "power_y": 0, "coefficient_mm": 12.0}]},
)


def family(**parts: Any) -> DrawnTargetConfig:
    config = target_from_data({"name": "drawn", "damage": THROUGH, **parts})
    assert isinstance(config, DrawnTargetConfig)
    return config


def places(config: TargetConfig) -> list[tuple[float, float]]:
    return [damage.centre_mm for damage in config.damages]


def sizes(config: TargetConfig) -> list[float]:
    return [damage.diameter_mm for damage in config.damages]


@settings(max_examples=60, deadline=None)
@given(
    shape=st.sampled_from(SHAPES),
    damage=st.sampled_from((THROUGH, BLIND, DENT)),
    per_board=st.integers(1, 8),
    low=st.floats(1.0, 12.0),
    spread=st.floats(0.0, 8.0),
    edge_mm=st.floats(0.01, 20.0),
    log=st.booleans(),
    tape=st.booleans(),
    seed=st.integers(0, 2**63 - 1),
    purpose=st.sampled_from(PURPOSES),
    number=st.integers(0, 10_000),
)
def test_every_board_can_be_built(
    shape: dict[str, Any],
    damage: dict[str, Any],
    per_board: int,
    low: float,
    spread: float,
    edge_mm: float,
    log: bool,
    tape: bool,
    seed: int,
    purpose: Purpose,
    number: int,
) -> None:
    declared = {
        **damage,
        "per_board": per_board,
        "diameter_mm": [low, low + spread],
        "sizes": "log" if log else "uniform",
    }
    tapes = (
        [{"centre_mm": [20.0, 30.0], "size_mm": [60.0, 12.0], "angle_deg": 30.0}] if tape else []
    )
    board = {
        "width_mm": 304.8,
        "height_mm": 203.2,
        "thickness_mm": 12.7,
        "shape": shape,
    }
    drawn = family(
        board=board,
        damage=declared,
        edge_mm=edge_mm,
        tapes=tapes,
        seed=seed,
    )
    config = drawn.drawn(purpose, number)
    check_target(config)
    assert [damage.id for damage in config.damages] == list(range(1, per_board + 1))
    assert sizes(config) == sorted(sizes(config))
    assert min(sizes(config)) >= low
    assert max(sizes(config)) <= low + spread
    assert all(dist(a, b) >= drawn.apart_mm for a, b in combinations(places(config), 2))
    reach = np.abs(places(config)) + np.array(sizes(config))[:, None] / 2
    assert (reach <= np.array([304.8, 203.2]) / 2 - edge_mm + 1e-9).all()
    if damage["kind"] == "dent":
        assert all(damage.depth_mm <= damage.diameter_mm / 2 for damage in config.dents)


@pytest.mark.parametrize(
    "shape", SHAPES[1:], ids=["towards", "away", "sphere", "sphere away", "polynomial"]
)
@pytest.mark.parametrize("kind", ["through", "dent"])
def test_crowded_boards_of_bent_faces_can_be_built(
    shape: dict[str, Any],
    kind: str,
) -> None:
    """As near to one another and to the edge as may be declared: holes through boards so thick
    that their axes come together, dents so shallow that a face that bends away widens them."""
    thickness_mm = {"through": 95.0, "dent": 3.0}[kind]
    board = {
        "width_mm": 304.8,
        "height_mm": 203.2,
        "thickness_mm": thickness_mm,
        "shape": shape,
    }
    damage: dict[str, Any] = {"kind": kind, "per_board": 40, "diameter_mm": [10.0, 10.0]}
    if kind == "dent":
        damage["depth_mm"] = [0.14, 0.14]
    with pytest.raises(ValidationError, match="it must be") as refused:
        family(
            board=board,
            damage=damage,
            edge_mm=0.01,
            apart_mm=1.0,
        )
    least = re.search(r"it must be ([\d.]+) mm or more", str(refused.value))
    assert least is not None
    drawn = family(
        board=board,
        damage=damage,
        edge_mm=0.01,
        apart_mm=float(least[1]) + 0.01,
    )
    for number in range(3):
        check_target(drawn.drawn("damaged", number))


def test_a_board_is_the_same_however_it_is_asked_for() -> None:
    boards = family(seed=7)
    again = DrawnTargetConfig.from_data(boards.to_data())
    assert again.drawn("damaged", 11) == boards.drawn("damaged", 11)
    assert boards.declare() == boards.drawn("damaged", 0)


def test_no_two_boards_are_alike() -> None:
    drawn = [
        family(seed=seed).drawn(purpose, n)
        for seed in (1, 2)
        for purpose in PURPOSES
        for n in range(5)
    ]
    for first, second in combinations(drawn, 2):
        assert places(first)[0] != places(second)[0]
        assert sizes(first)[0] != sizes(second)[0]
        assert first.pose.tilt_x_deg != second.pose.tilt_x_deg
        assert first.material.grain_seed != second.material.grain_seed


@pytest.mark.parametrize(
    "changed",
    [
        {"distance_m": 1.2},
        {"material": {"albedo_850": 0.2}},
        {"backing": {"distance_mm": 200.0, "albedo_850": 0.2}},
        {"room": None},
        {"damage": BLIND},
        {"damage": {**BLIND, "depth_mm": [4.0, 4.0]}},
        {"damage": DENT},
    ],
    ids=["distance", "albedo", "backing", "room", "blind", "one depth", "dent"],
)
def test_an_axis_keeps_places_sizes_and_tilts(changed: dict[str, Any]) -> None:
    for number in range(3):
        before = family().drawn("damaged", number)
        after = family(**changed).drawn("damaged", number)
        assert places(after) == places(before)
        assert sizes(after) == sizes(before)
        assert after.material.grain_seed == before.material.grain_seed
        kept = ("offset_x_mm", "offset_y_mm", "tilt_x_deg", "tilt_y_deg", "roll_deg")
        assert [getattr(after.pose, name) for name in kept] == [
            getattr(before.pose, name) for name in kept
        ]
        moved_m = after.pose.distance_m - before.pose.distance_m
        assert moved_m == pytest.approx(changed.get("distance_m", 0.7) - 0.7, abs=1e-12)


def test_wider_limits_stretch_the_same_draw() -> None:
    """Tilts of twice the limit are twice the tilts: set-ups of an axis of tilts are paired too."""
    narrow = family(tilt_deg=5.0).drawn("damaged", 4)
    wide = family(tilt_deg=10.0).drawn("damaged", 4)
    assert wide.pose.tilt_x_deg == pytest.approx(2 * narrow.pose.tilt_x_deg)
    assert places(wide) == places(narrow)


def test_depths_of_one_kind_do_not_move_those_of_another() -> None:
    """A fixed depth is that depth; a range is covered evenly by each board, apart from the sizes'
    order."""
    assert {
        damage.depth_mm
        for damage in family(damage={**BLIND, "depth_mm": [4.0, 4.0]}).declare().holes
    } == {4.0}
    depths = np.array([damage.depth_mm for damage in family(damage=BLIND).declare().holes])
    assert np.array_equal(np.sort(np.floor((depths - 1.0) / 8.0 * 8)), np.arange(8))
    assert not np.array_equal(np.sort(depths), depths)


@pytest.mark.parametrize("law", ["uniform", "log"])
def test_sizes_are_uniform_and_each_board_has_one_of_each_part(law: str) -> None:
    """Within its part of the range, each size is uniform (Kolmogorov and Smirnov), and no two
    parts are correlated."""
    drawn = family(damage={**THROUGH, "sizes": law})
    quantiles = np.array([sizes(drawn.drawn("damaged", n)) for n in range(300)])
    low, high = (2.0, 12.0) if law == "uniform" else np.log((2.0, 12.0))
    quantiles = ((quantiles if law == "uniform" else np.log(quantiles)) - low) / (high - low)
    assert np.array_equal(np.floor(quantiles * 8), np.tile(np.arange(8), (300, 1)))
    within = quantiles * 8 - np.arange(8)
    assert stats.kstest(within.ravel(), "uniform").pvalue > ALPHA
    assert stats.spearmanr(within[:, 0], within[:, 1]).pvalue > ALPHA


def test_chosen_sizes_replace_those_that_would_be_drawn_and_nothing_else() -> None:
    chosen_mm = (2.5, 3.0, 3.0, 4.25, 5.0, 5.5, 8.0, 12.0)
    for damage in (THROUGH, BLIND):
        drawn = family(damage=damage).drawn("damaged", 3)
        chosen = family(damage=damage).drawn("damaged", 3, chosen_mm)
        assert tuple(hole.diameter_mm for hole in chosen.holes) == chosen_mm
        assert [hole.depth_mm for hole in chosen.holes] == [hole.depth_mm for hole in drawn.holes]
        assert places(chosen) == places(drawn)
        assert chosen.pose == drawn.pose
        assert chosen.material == drawn.material


def test_chosen_sizes_are_depths_if_only_depths_vary() -> None:
    chosen_mm = (1.0, 1.5, 2.0, 2.0, 4.0, 5.0, 6.0, 9.0)
    one_diameter = family(damage={**BLIND, "diameter_mm": [10.0, 10.0]})
    assert one_diameter.damage.limit_of == "depth"
    assert one_diameter.damage.limit_range_mm == (1.0, 9.0)
    chosen = one_diameter.drawn("damaged", 3, chosen_mm)
    assert [hole.depth_mm for hole in chosen.holes] == pytest.approx(chosen_mm)
    assert {hole.diameter_mm for hole in chosen.holes} == {10.0}
    # a dent is no deeper than its radius
    dents = family(damage={**DENT, "diameter_mm": [4.0, 4.0]})
    depths_mm = [
        dent.depth_mm for dent in dents.drawn("damaged", 0, (0.5, 1, 1, 1, 1, 1, 2, 3)).dents
    ]
    assert depths_mm == pytest.approx([0.5, 1, 1, 1, 1, 1, 2, 2])
    assert family().damage.limit_of == "diameter"


def test_pose_and_depth_are_uniform() -> None:
    drawn = family(damage=BLIND)
    boards = [drawn.drawn("hole_free", n) for n in range(200)]
    poses = [board.pose for board in boards]
    limits = {
        "offset_x_mm": 20.0,
        "offset_y_mm": 20.0,
        "tilt_x_deg": 8.0,
        "tilt_y_deg": 8.0,
        "roll_deg": 2.0,
    }
    drawn_values = {name: [getattr(pose, name) for pose in poses] for name in limits}
    limits["distance_m"] = 0.01
    drawn_values["distance_m"] = [pose.distance_m - 0.7 for pose in poses]
    for name, limit in limits.items():
        assert (
            stats.kstest(drawn_values[name], stats.uniform(-limit, 2 * limit).cdf).pvalue > ALPHA
        ), name
    drawn_values["first depth"] = [board.holes[0].depth_mm or 0.0 for board in boards]
    drawn_values["first diameter"] = [board.holes[0].diameter_mm for board in boards]
    for axis, name in enumerate(("first x", "first y")):
        drawn_values[name] = [board.holes[0].centre_mm[axis] for board in boards]
    drawn_values["grain"] = [board.material.grain_seed for board in boards]
    for (name, values), (second_name, second_values) in combinations(drawn_values.items(), 2):
        assert stats.spearmanr(values, second_values).pvalue > ALPHA / 55, (name, second_name)
    holes = [hole for board in boards for hole in board.holes]
    # independent of the size: the rank correlation of depth and diameter over all holes
    assert (
        stats.spearmanr([h.depth_mm for h in holes], [h.diameter_mm for h in holes]).pvalue > ALPHA
    )
    # one board's depths are no independent sample, its first hole's over all boards are
    assert (
        stats.kstest([board.holes[0].depth_mm for board in boards], stats.uniform(1, 8).cdf).pvalue
        > ALPHA
    )


def test_size_does_not_depend_on_place() -> None:
    """Were large holes kept farther from the edge, a limit would mix size with place."""
    holes = [hole for n in range(150) for hole in family().drawn("damaged", n).holes]
    diameters = [hole.diameter_mm for hole in holes]
    for axis in (0, 1):
        from_middle = [abs(hole.centre_mm[axis]) for hole in holes]
        assert stats.spearmanr(diameters, from_middle).pvalue > ALPHA


def test_a_dent_is_as_deep_as_its_radius_allows() -> None:
    """At 2 mm wide depths are uniform from 0.5 to 1 mm, at 12 mm from 0.5 to 3 mm: no pile at
    either limit."""
    narrow = family(damage={**DENT, "per_board": 1, "diameter_mm": [2.0, 2.0]})
    depths = [narrow.drawn("damaged", n).dents[0].depth_mm for n in range(200)]
    assert stats.kstest(depths, stats.uniform(0.5, 0.5).cdf).pvalue > ALPHA


@pytest.mark.parametrize(
    ("reach", "least"),
    [(0.0, 0.0), (0.6, (1 - 0.8) / 0.6), (0.8, (1 - 0.6) / 0.8), (1.0, 1.0), (1.5, 1.0)],
)
def test_a_dent_is_at_least_as_deep_as_its_ball_on_a_bent_face(reach: float, least: float) -> None:
    """A cap of a ball of half the radius of curvature R, with a chord of reach x R: its depth is
    R / 2 (1 - sqrt(1 - reach^2)), at most the hemisphere's."""
    ball_mm = SHALLOWEST_BEND * 200.0
    radius_mm = reach * ball_mm
    least_mm, most_mm = _dent_depths_mm(2 * max(radius_mm, 1e-9), 1 / 200.0)
    assert most_mm == pytest.approx(radius_mm, abs=1e-8)
    assert least_mm == pytest.approx(radius_mm * least, rel=1e-4, abs=1e-8)


def test_a_backing_is_as_wide_as_the_shadows_up_to_ten_metres() -> None:
    """From the lens at 0.5 m, straight in front, the shadow of a face grows with the distance."""
    straight = family(
        board={"width_mm": 300.0, "height_mm": 200.0, "thickness_mm": 5.0},
        distance_m=0.5,
        offset_mm=0.0,
        tilt_deg=0.0,
        roll_deg=0.0,
        distance_jitter_mm=0.0,
    )
    assert _backing_size_mm(straight, 0.0) == pytest.approx((300.0, 200.0))
    assert _backing_size_mm(straight, -0.25) == pytest.approx((450.0, 300.0))
    assert _backing_size_mm(straight, -20.0) == pytest.approx((10_000.0, 8200.0))


def test_backing_fills_every_hole_in_every_pose() -> None:
    """Through any point of the face the camera sees the backing, whatever the pose; at zero tilt
    that is no news."""
    drawn = family(tilt_deg=25.0, backing={"distance_mm": 150.0})
    config = drawn.declare()
    assert config.backing is not None
    corners = backing_corners_board_m(config, config.backing)
    half = np.abs(corners[:, :2]).max(axis=0)
    outline = outline_board_m(drawn.board)
    shadow_shares = []
    for pose in drawn.extreme_poses():
        lens = transform_points(invert(pose.T_camera_board), np.zeros(3))
        share = (corners[0, 2] - lens[2]) / (outline[:, 2] - lens[2])
        shadow_shares.append(
            np.abs(lens + share[:, None] * (outline - lens))[:, :2].max(axis=0) / half
        )
    assert np.max(shadow_shares, axis=0) == pytest.approx([1.0, 1.0], abs=1e-9)
    declared = family(backing={"distance_mm": 150.0, "size_mm": [90.0, 80.0]}).declare()
    assert declared.backing is not None
    assert declared.backing.size_mm == (90.0, 80.0)


def test_what_is_in_view_in_the_extreme_poses_always_is() -> None:
    optics = load_camera("azure_kinect_nfov").optics
    for roll_deg in (2.0, 60.0):
        drawn = family(
            tilt_deg=20.0,
            offset_mm=50.0,
            roll_deg=roll_deg,
        )
        reach = [_reach_px(drawn, pose, optics) for pose in drawn.extreme_poses()]
        for number in range(30):
            assert (
                _reach_px(drawn, drawn.drawn("damaged", number).pose, optics)
                <= np.max(reach, axis=0)
            ).all()
    for pose in family().extreme_poses():
        check_in_view(family().declare().model_copy(update={"pose": pose}), optics)


def _reach_px(
    drawn: DrawnTargetConfig,
    pose: Any,
    optics: Any,
) -> np.ndarray:
    """(4,) how far the board's outline reaches left, up, right and down."""
    pixels = optics.lens.project(
        transform_points(pose.T_camera_board, outline_board_m(drawn.board))
    )
    return np.concatenate([-pixels.min(axis=0), pixels.max(axis=0)])


def test_a_board_too_full_is_refused_with_numbers() -> None:
    full = family(damage={**THROUGH, "per_board": 60})
    message = (
        r"a board of 304\.8 x 203\.2 mm is too small for 60 damages with centres 40 mm apart and "
        r"21 mm from its edge: only (\d+) fit on the 262\.8 x 161\.2 mm that are left"
    )
    with pytest.raises(UserError, match=message) as refused:
        full.declare()
    match = re.search(message, refused.value.message)
    assert match is not None
    # of what discs of 40 mm in the densest packing fill, random placement reaches some 60 %
    densest = 0.9069 * (262.8 + 40) * (161.2 + 40) / (np.pi * 20**2)
    assert 0.5 * densest < int(match[1]) < 0.75 * densest
    assert refused.value.legal == f"fewer than {match[1]} damages on this board"


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"apart_mm": 11.0}, r"apart_mm: 11 mm lets holes of 12 mm meet; it must be 12\.01 mm"),
        ({"edge_mm": 100.0}, r"leaves no place for a centre that is 106 mm off every edge"),
        (
            {"damage": {**BLIND, "depth_mm": [1.0, 12.7]}},
            r"12\.7 mm is not less than the board's thickness, 12\.7 mm",
        ),
        (
            {"damage": {**DENT, "depth_mm": [1.5, 3.0]}},
            r"a dent 2 mm wide on this face can be 0 to 1 mm deep, not 1\.5",
        ),
        (
            {"damage": {**THROUGH, "diameter_mm": [12.0, 2.0]}},
            r"lower limit 12 is above the upper limit 2",
        ),
        (
            {"distance_m": 0.15, "distance_jitter_mm": 60.0},
            r"60 mm leads from 0\.15 m beyond 0\.1 to 10 m",
        ),
        ({"damage": {**THROUGH, "depth_mm": [1.0, 2.0]}}, r"Extra inputs"),
    ],
)
def test_what_cannot_be_drawn_is_refused(
    parts: dict[str, Any],
    message: str,
) -> None:
    with pytest.raises(ValidationError, match=message):
        family(**parts)


def test_damage_too_wide_for_a_bent_face_is_refused() -> None:
    board = {
        "width_mm": 60.0,
        "height_mm": 60.0,
        "thickness_mm": 5.0,
        "shape": {"kind": "sphere", "radius_mm": 60.0},
    }
    wide = {"kind": "through", "per_board": 1, "diameter_mm": [31.0, 31.0]}
    with pytest.raises(
        ValidationError, match=r"31 mm is too wide for a face bent to a radius of 60 mm"
    ):
        family(
            board=board,
            damage=wide,
            apart_mm=60.0,
            edge_mm=1.0,
        )


def test_the_target_program_shows_any_board(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = tmp_path / "boards.yaml"
    damage = "damage: {kind: through, per_board: 2, diameter_mm: [3.0, 9.0]}"
    file.write_text(f"name: drawn\n{damage}\n")
    assert main([str(file), "--board", "5"]) == 0
    shown = capsys.readouterr().out
    for size in sizes(
        family(damage={"kind": "through", "per_board": 2, "diameter_mm": [3.0, 9.0]}).drawn(
            "damaged", 5
        )
    ):
        assert f"{size:.3f}" in shown
    assert main([str(file), "--board", "-1"]) == 2
    assert "from 0 upwards" in capsys.readouterr().err
    assert main(["thesis", "--board", "1"]) == 2
    assert "is a single board, not a family" in capsys.readouterr().err
