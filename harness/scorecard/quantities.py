"""The closed list of what the scorecard measures, each with its unit, its conditions and how it is measured.

A published figure names a quantity and conditions; a curve is a quantity over a range of conditions. Both are measured
by the same function, so a figure stands on the curve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from harness.scorecard import planar, steps
from harness.scorecard.bench import Bench
from harness.scorecard.conditions import (
    LagConditions,
    PlaneConditions,
    PlateauConditions,
    RoomConditions,
    StepConditions,
    SurvivalConditions,
)
from harness.scorecard.estimate import Estimate
from harness.vocabulary.config import Config


@dataclass(frozen=True)
class Quantity:
    """Something that is measured. ``unit`` is empty for ratios; ``says`` is one sentence for the page."""

    name: str
    title: str
    unit: str
    conditions: type[Config]
    measure: Callable[[Bench, Any], Estimate]
    says: str


def _room_bias(bench: Bench, c: RoomConditions) -> Estimate:
    from harness.scorecard.room import board_bias

    return board_bias(bench, c)


def _room_bend(bench: Bench, c: RoomConditions) -> Estimate:
    from harness.scorecard.room import board_bend

    return board_bend(bench, c)


_LIST = (
    Quantity(
        "temporal_sigma_mm",
        "temporal deviation",
        "mm",
        PlaneConditions,
        planar.temporal_sigma,
        "Standard deviation over frames of one pixel's z, rms over pixels, noise alone.",
    ),
    Quantity(
        "random_error_mm",
        "random error",
        "mm",
        PlaneConditions,
        planar.random_error,
        "Standard deviation over frames of one pixel's z with whole-frame jitter and jumps, rms over pixels.",
    ),
    Quantity(
        "noise_correlation",
        "noise correlation",
        "",
        LagConditions,
        planar.noise_correlation,
        "Correlation of the temporal noise of two pixels, noise alone.",
    ),
    Quantity(
        "valid_fraction",
        "valid fraction",
        "",
        PlaneConditions,
        planar.valid_fraction,
        "Share of pixels about the axis that have a range.",
    ),
    Quantity("amplitude", "amplitude", "units", PlaneConditions, planar.amplitude, "Mean amplitude, camera's units."),
    Quantity(
        "bias_mm",
        "bias of one unit",
        "mm",
        PlaneConditions,
        planar.bias,
        "Mean error of z of unit 1 with all its effects but jumps, direct light only.",
    ),
    Quantity(
        "systematic_error_mm",
        "systematic error",
        "mm",
        PlaneConditions,
        planar.systematic_error,
        "Greatest absolute mean error of z among ten units an hour after power-on, direct light only.",
    ),
    Quantity(
        "fixed_pattern_mm",
        "fixed pattern",
        "mm",
        PlaneConditions,
        planar.pattern_sigma,
        "Deviation over pixels of the average less a smooth surface and the noise left in it, mean of five units.",
    ),
    Quantity(
        "frame_jitter_mm",
        "frame jitter",
        "mm",
        PlaneConditions,
        planar.frame_jitter,
        "Deviation of a frame's mean over 960 pixels from frame to frame; jumps of over 5 mm left out.",
    ),
    Quantity(
        "edge_gap_px",
        "gap at an edge",
        "px",
        StepConditions,
        steps.gap,
        "Width across an edge of pixels without a range, shadow included.",
    ),
    Quantity(
        "flying_pixels_px",
        "flying pixels",
        "px",
        StepConditions,
        steps.flying,
        "Width across an edge of pixels whose range is off both surfaces by more than four deviations and a tenth of "
        "the step.",
    ),
    Quantity(
        "front_erosion_px",
        "erosion of the front",
        "px",
        StepConditions,
        steps.front_erosion,
        "Width of pixels that look at the front and do not show it.",
    ),
    Quantity(
        "back_erosion_px",
        "erosion of the back",
        "px",
        StepConditions,
        steps.back_erosion,
        "Width of pixels that look at the back and do not show it, shadow included.",
    ),
    Quantity(
        "seen_share",
        "seen share of a step",
        "",
        PlateauConditions,
        steps.seen_share,
        "Height seen in the middle of a round plateau by its true height.",
    ),
    Quantity(
        "smallest_step_mm",
        "smallest surviving step",
        "mm",
        SurvivalConditions,
        steps.smallest_step,
        "Lowest step of a round plateau of which at least half is seen in its middle, in most of 16 places.",
    ),
    Quantity(
        "board_bias_mm",
        "bias of a board in a room",
        "mm",
        RoomConditions,
        _room_bias,
        "Mean error of z over a board of 400 x 300 mm before a floor and a wall, without noise and traits of a unit.",
    ),
    Quantity(
        "board_bend_mm",
        "bend of a board in a room",
        "mm",
        RoomConditions,
        _room_bend,
        "Deviation over the board's pixels of the same error; contains the rounding of the output.",
    ),
)
QUANTITIES: dict[str, Quantity] = {quantity.name: quantity for quantity in _LIST}
