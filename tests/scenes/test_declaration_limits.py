"""Limits and defaults of what a user may declare of a target, as the documents state them.

A change of one is a change of what users' files mean: it belongs into the change log."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel

from scenes import optics, perspectives
from scenes.target import custom, drawn, flaws, part, thesis

MODULES = (
    custom,
    drawn,
    flaws,
    part,
    thesis,
    optics,
    perspectives,
)
STATED = """
ArcViews.guess_error_deg [0,45] 3.0
ArcViews.guess_error_mm [0,500] 10.0
ArcViews.seed [0,4294967295] 1
ArcViews.count [1,200] required
ArcViews.spread_deg (0,120] required
ArcViews.distance_jitter_mm [0,500] 0.0
ArcViews.aim_jitter_mm [0,500] 0.0
BackingConfig.distance_mm [0,5000] required
BackingConfig.albedo_850 [0,1] 0.6
BackingConfig.rgb [0,1] [0.55,0.55,0.55]
BackingConfig.size_mm [1,10000] None
BoardConfig.width_mm [5,5000] required
BoardConfig.height_mm [5,5000] required
BoardConfig.thickness_mm [0.5,500] required
ChipConfig.id [1,9999] required
ChipConfig.centre_mm [-5000,5000] required
ChipConfig.length_mm [0.05,2000] required
ChipConfig.width_mm [0.05,2000] required
ChipConfig.depth_mm (0,500] required
ChipConfig.angle_deg (-inf,inf) required
CorrosionConfig.id [1,9999] required
CorrosionConfig.centre_mm [-5000,5000] required
CorrosionConfig.diameter_mm [0.05,2000] required
CorrosionConfig.depth_mm (0,500] required
CorrosionConfig.rough_mm [0,100] 0.2
CorrosionConfig.grain_mm [0.1,200] 3.0
CorrosionConfig.uneven [0,0.3] 0.12
CorrosionConfig.seed [0,9223372036854775807] 1
CastingConfig.high_mm [-50,50] 4.0
CastingConfig.rib_width_mm [1,1000] 16.0
CastingConfig.ribs_x_mm [0,5000] 90.0
CastingConfig.rib_y_mm [-5000,5000] 60.0
CastingConfig.boss_width_mm [1,1000] 50.0
CastingConfig.flank_mm [1,1000] 6.0
CorrugatedConfig.period_mm [5,1000] 76.0
CorrugatedConfig.depth_mm (0,200] 18.0
CylinderConfig.radius_mm [10,1000000] required
DamageConfig.id [1,9999] required
DamageConfig.centre_mm [-5000,5000] required
DamageConfig.diameter_mm [0.2,1000] required
DentConfig.id [1,9999] required
DentConfig.centre_mm [-5000,5000] required
DentConfig.diameter_mm [0.2,1000] required
DentConfig.depth_mm [0.04,500] required
DrawnChipConfig.per_board [1,100] required
DrawnChipConfig.length_mm [0.05,2000] required
DrawnChipConfig.width_mm [0.05,2000] required
DrawnChipConfig.depth_mm (0,500] required
DrawnCorrosionConfig.per_board [1,100] required
DrawnCorrosionConfig.diameter_mm [0.05,2000] required
DrawnCorrosionConfig.depth_mm (0,500] required
DrawnCorrosionConfig.rough_mm [0,100] 0.2
DrawnCorrosionConfig.grain_mm [0.1,200] 3.0
DrawnCorrosionConfig.uneven [0,0.3] 0.12
DrawnDeep.per_board [1,100] required
DrawnDeep.diameter_mm [0.2,1000] required
DrawnDeep.chamfer_mm [0,100] 0.0
DrawnDeep.depth_mm [0.04,500] required
DrawnFlaws.per_board [1,100] required
DrawnGougeConfig.per_board [1,100] required
DrawnGougeConfig.length_mm [0.05,2000] required
DrawnGougeConfig.width_mm [0.05,2000] required
DrawnGougeConfig.angle_deg [-180,180] [-90.0,90.0]
DrawnGougeConfig.wander_mm [0,200] 0.0
DrawnGougeConfig.depth_mm (0,500] required
DrawnGougeConfig.run_out_mm [0.1,1000] 5.0
DrawnRoundConfig.per_board [1,100] required
DrawnRoundConfig.diameter_mm [0.05,2000] required
DrawnRoundConfig.depth_mm (0,500] required
DrawnSlotConfig.per_board [1,100] required
DrawnSlotConfig.length_mm [0.05,2000] required
DrawnSlotConfig.width_mm [0.05,2000] required
DrawnSlotConfig.angle_deg [-180,180] [-90.0,90.0]
DrawnSlotConfig.wander_mm [0,200] 0.0
DrawnSlotConfig.depth_mm (0,500] None
DrawnTargetConfig.seed [0,9223372036854775807] 1
DrawnTargetConfig.apart_mm (0,10000] 40.0
DrawnTargetConfig.edge_mm [0.01,10000] 15.0
DrawnTargetConfig.distance_m [0.1,10] 0.7
DrawnTargetConfig.distance_jitter_mm [0,1000] 10.0
DrawnTargetConfig.offset_mm [0,5000] 20.0
DrawnTargetConfig.tilt_deg [0,70] 8.0
DrawnTargetConfig.roll_deg [0,90] 2.0
DrawnThrough.per_board [1,100] required
DrawnThrough.diameter_mm [0.2,1000] required
DrawnThrough.chamfer_mm [0,100] 0.0
DrillConfig.diameter_mm [0.2,1000] required
DrillConfig.depth_mm (0,500] None
DrillConfig.chamfer_mm [0,100] 0.0
GlossConfig.share [0,1] required
GlossConfig.exponent [1,500] required
GougeConfig.id [1,9999] required
GougeConfig.centre_mm [-5000,5000] required
GougeConfig.length_mm [0.05,2000] required
GougeConfig.width_mm [0.05,2000] required
GougeConfig.angle_deg [-180,180] 0.0
GougeConfig.wander_mm [0,200] 0.0
GougeConfig.seed [0,9223372036854775807] 1
GougeConfig.depth_mm (0,500] required
GougeConfig.run_out_mm [0.1,1000] 5.0
GridViews.guess_error_deg [0,45] 3.0
GridViews.guess_error_mm [0,500] 10.0
GridViews.seed [0,4294967295] 1
GridViews.count [1,200] required
GridViews.spread_deg (0,120] required
GridViews.distance_jitter_mm [0,500] 0.0
GridViews.aim_jitter_mm [0,500] 0.0
HandHeldViews.guess_error_deg [0,45] 3.0
HandHeldViews.guess_error_mm [0,500] 10.0
HandHeldViews.seed [0,4294967295] 1
HandHeldViews.count [1,200] required
HandHeldViews.sway_deg [0,60] 10.0
HandHeldViews.sway_mm [0,500] 40.0
HoleConfig.id [1,9999] required
HoleConfig.centre_mm [-5000,5000] required
HoleConfig.diameter_mm [0.2,1000] required
HoleConfig.depth_mm (0,500] None
HoleConfig.chamfer_mm [0,100] 0.0
ListedViews.guess_error_deg [0,45] 3.0
ListedViews.guess_error_mm [0,500] 10.0
ListedViews.seed [0,4294967295] 1
MadeConfig.form_mm [0,20] 0.3
MadeConfig.sizes_percent [0,20] 1.0
MadeConfig.seed [0,9223372036854775807] 1
MaterialConfig.albedo_850 [0,1] 0.6
MaterialConfig.rgb [0,1] [0.55,0.42,0.28]
MaterialConfig.grain_contrast [0,0.3] 0.05
MaterialConfig.grain_period_mm [1,200] 8.0
MaterialConfig.grain_seed [0,4294967295] 1
PanelConfig.radius_x_mm [50,1000000] 4000.0
PanelConfig.radius_y_mm [50,1000000] 1500.0
PanelConfig.swage_mm [-50,50] 4.0
PanelConfig.swage_y_mm [-5000,5000] 40.0
PanelConfig.swage_width_mm [1,1000] 12.0
PlacedConfig.id [1,9999] required
PlacedConfig.centre_mm [-5000,5000] required
PoseConfig.distance_m [0.1,10] 0.7
PoseConfig.offset_x_mm [-5000,5000] 0.0
PoseConfig.offset_y_mm [-5000,5000] 0.0
PoseConfig.tilt_x_deg [-70,70] 0.0
PoseConfig.tilt_y_deg [-70,70] 0.0
PoseConfig.roll_deg [-180,180] 0.0
ReflectanceConfig.albedo_850 [0,1] 0.6
ReflectanceConfig.rgb [0,1] [0.55,0.42,0.28]
ReflectanceConfig.grain_contrast [0,0.3] 0.05
ReflectanceConfig.grain_period_mm [1,200] 8.0
RenderConfig.bounces [0,32] 10
RenderConfig.face_spacing_mm (0,inf) 80.0
RenderConfig.face_samples [8,inf) 8192
RenderConfig.hole_noise_mm (0,inf) 0.1
RenderConfig.hole_samples [8,inf) 8192
RenderConfig.rest_samples [8,inf) 16
RenderConfig.seed [0,1000000] 1
RoomConfig.floor_below_lens_m [0.05,10] None
RoomConfig.floor_albedo_850 [0,1] 0.3
RoomConfig.floor_rgb [0,1] [0.3,0.3,0.3]
RoomConfig.back_wall_distance_m [0.1,20] None
RoomConfig.back_wall_albedo_850 [0,1] 0.6
RoomConfig.back_wall_rgb [0,1] [0.6,0.6,0.6]
RoomConfig.width_m [0.5,40] 4.0
RoomConfig.height_m [0.5,20] 2.5
RoughConfig.deviation_mm (0,20] 0.3
RoughConfig.outer_mm [2,1000] 60.0
RoughConfig.inner_mm [1,100] 6.0
RoughConfig.hurst (0,1] 0.8
RoughConfig.seed [0,9223372036854775807] 1
RoundConfig.id [1,9999] required
RoundConfig.centre_mm [-5000,5000] required
RoundConfig.diameter_mm [0.05,2000] required
RoundConfig.depth_mm (0,500] required
SlotConfig.id [1,9999] required
SlotConfig.centre_mm [-5000,5000] required
SlotConfig.length_mm [0.05,2000] required
SlotConfig.width_mm [0.05,2000] required
SlotConfig.angle_deg [-180,180] 0.0
SlotConfig.wander_mm [0,200] 0.0
SlotConfig.seed [0,9223372036854775807] 1
SlotConfig.depth_mm (0,500] None
SphereConfig.radius_mm [10,1000000] required
TapeConfig.centre_mm [-5000,5000] required
TapeConfig.size_mm [1,10000] required
TapeConfig.angle_deg [-180,180] 0.0
TapeConfig.rgb [0,1] [0.85,0.08,0.08]
TapeConfig.albedo_850 [0,1] 0.6
TapeConfig.thickness_mm [0.02,3] 0.15
TermConfig.power_x [0,8] required
TermConfig.power_y [0,8] required
TermConfig.coefficient_mm [-1000,1000] required
ThesisTargetConfig.blind_depth_mm (0,12.7) 9.5
ThesisTargetConfig.backing_distance_mm [0,5000] 20.0
ThesisTargetConfig.backing_albedo_850 [0,1] 0.6
ThesisTargetConfig.hole_spacing_mm [30,100] 50.8
ThesisTargetConfig.board_width_mm [100,5000] 609.6
ThesisTargetConfig.board_height_mm [30,5000] 114.3
ThesisTargetConfig.row_offset_y_mm [-2000,2000] 0.0
ThesisTargetConfig.distance_m [0.3,5] 0.7
ThesisTargetConfig.offset_x_mm [-5000,5000] 0.0
ThesisTargetConfig.offset_y_mm [-5000,5000] 0.0
ThesisTargetConfig.tilt_x_deg [-70,70] 3.0
ThesisTargetConfig.tilt_y_deg [-70,70] 4.0
ThesisTargetConfig.roll_deg [-180,180] 0.0
ThesisTargetConfig.plywood_albedo_850 [0,1] 0.6
ThesisTargetConfig.plywood_rgb [0,1] [0.55,0.42,0.28]
ThesisTargetConfig.grain_contrast [0,0.3] 0.05
ThesisTargetConfig.grain_period_mm [1,200] 8.0
ThesisTargetConfig.grain_seed [0,4294967295] 1
ThesisTargetConfig.tape_length_mm [1,10000] 40.0
ThesisTargetConfig.tape_width_mm [1,10000] 12.0
ThesisTargetConfig.tape_x_mm [0,5000] 200.0
ThesisTargetConfig.tape_y_mm [0,5000] 38.0
ThesisTargetConfig.tape_thickness_mm [0.02,3] 0.15
ThesisTargetConfig.tape_albedo_850 [0,1] 0.6
ThesisTargetConfig.tape_rgb [0,1] [0.85,0.08,0.08]
ThesisTargetConfig.floor_below_lens_m [0.05,10] 0.75
ThesisTargetConfig.floor_albedo_850 [0,1] 0.3
ThesisTargetConfig.back_wall_distance_m [0.1,20] 2.5
ThesisTargetConfig.back_wall_albedo_850 [0,1] 0.6
WavelengthConfig.wavelength_nm [300,2000] required
WavelengthConfig.board [0,1] required
WavelengthConfig.tape [0,1] None
WavelengthConfig.backing [0,1] None
WavelengthConfig.floor [0,1] None
WavelengthConfig.back_wall [0,1] None
"""


def limits_of(schema: dict[str, Any]) -> str:
    """Return the limits of a number: [ and ] include the end, ( and ) exclude it."""
    low = "(-inf"
    high = "inf)"
    if "minimum" in schema:
        low = "[" + plain(schema["minimum"])
    if "exclusiveMinimum" in schema:
        low = "(" + plain(schema["exclusiveMinimum"])
    if "maximum" in schema:
        high = plain(schema["maximum"]) + "]"
    if "exclusiveMaximum" in schema:
        high = plain(schema["exclusiveMaximum"]) + ")"
    return f"{low},{high}"


def plain(number: float) -> str:
    return str(number).removesuffix(".0")


def numbers_in(schema: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the numbers of a field: itself, one of several types, or the items of a list."""
    if schema.get("type") in ("number", "integer"):
        yield schema
    for part_of_field in (*schema.get("anyOf", ()), *schema.get("prefixItems", ())):
        yield from numbers_in(part_of_field)


def lines_of(config: type[BaseModel]) -> Iterator[str]:
    """Yield a line for each field of a declaration that holds numbers."""
    for name, schema in config.model_json_schema()["properties"].items():
        numbers = list(numbers_in(schema))
        if numbers:
            limits = " ".join(dict.fromkeys(limits_of(number) for number in numbers))
            default = str(schema.get("default", "required")).replace(" ", "")
            yield f"{config.__name__}.{name} {limits} {default}"


def declarations() -> Iterator[type[BaseModel]]:
    """Yield all declarations of the modules, in the order of their names."""
    models = {}
    for module in MODULES:
        for name, value in vars(module).items():
            is_model = isinstance(value, type) and issubclass(value, BaseModel)
            if is_model and value.__module__ == module.__name__ and name[0] != "_":
                models[name] = value
    for name in sorted(models):
        yield models[name]


@pytest.mark.parametrize("config", list(declarations()), ids=lambda config: config.__name__)
def test_limits_and_defaults_are_those_stated(config: type[BaseModel]) -> None:
    stated = [line for line in STATED.split("\n") if line.startswith(f"{config.__name__}.")]
    assert list(lines_of(config)) == stated


def test_sizes_of_the_thesis_are_sixteenths_of_an_inch() -> None:
    sixteenths = [16 * diameter for diameter in thesis.DIAMETERS_IN]
    assert sixteenths == [1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16]
    assert thesis.THICKNESS_MM == 12.7
